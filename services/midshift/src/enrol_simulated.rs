//! Simulated machines become robots of a site: each with a key and a certificate of its own, enrolled by whoever is
//! signed in.
//!
//! Invariant: what a simulated robot shows is what a real one would: the server makes no difference. No robot loses its
//! machine to a simulated one but one that said itself that its body is simulated ([`BODY_LABEL`]), unless the caller
//! gives all names away.

use anyhow::{Context, ensure};
use midshift_agent::device::DeviceKey;
use midshift_agent::dial::TcpDial;
use midshift_agent::enrolment::{Enrolled, Identity, Invitation};
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::device_key;
use midshift_agent::tls::Tls;
use midshift_cli::endpoint::Endpoint;
use midshift_cli::pages::PAGE_SIZE;
use midshift_core::Boxed;
use midshift_core::ids::RobotId;
use midshift_core::time::{Clock, Utc};
use midshift_proto::convert::time_of;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_proto::identity::v1::{CreateEnrolmentRequest, ListRobotIdentitiesRequest, RobotIdentity};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{GetRobotRequest, Robot};
use midshift_sim::body::BODY_LABEL;
use midshift_sim::swarm::AGENT_FILE;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio_util::task::AbortOnDropHandle;
use tonic::Code;

/// So many are enrolled at a time.
const AT_ONCE: usize = 32;
/// Clocks of two processes of a site differ by no more, milliseconds.
const CLOCKS_APART_MS: i64 = 2_000;
/// So many names are told of those that are taken.
const NAMES_MAX: usize = 12;

/// Robots whose machines simulated ones replace. Of nobody else a key is taken out.
#[derive(Debug, Default)]
pub struct Replaced(BTreeSet<RobotId>);

/// Which robots that have a machine may lose it to a simulated one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Replace {
    /// Robots that said that their bodies are simulated.
    Simulated,
    /// Any robot, simulated or not.
    Any,
}

impl Replaced {
    /// Finds out at `identities`, and at the server `robots` that they dial, which of `robot_ids` have a machine and
    /// may lose it. One whose folder below `data` has its certificate keeps it.
    ///
    /// # Errors
    /// A robot has another machine and is not known to be simulated; a server says no.
    pub async fn find(
        (identities, robots): (&Endpoint, &Endpoint),
        robot_ids: &[RobotId],
        data: Option<&Path>,
        replace: Replace,
    ) -> anyhow::Result<Self> {
        let mut new = BTreeSet::new();
        for robot_id in robot_ids {
            if enrolled_in(data, robot_id)?.is_none() {
                new.insert(robot_id.as_str());
            }
        }
        if new.is_empty() {
            // All go on with what they have, also while nobody hands out certificates.
            return Ok(Self(BTreeSet::new()));
        }
        let mut client = IdentityServiceClient::new(identities.lazy());
        let mut request = ListRobotIdentitiesRequest { page_size: PAGE_SIZE, ..Default::default() };
        let mut taken = BTreeMap::new();
        loop {
            let page = client.list_robot_identities(request.clone()).await.context("asking who is enrolled")?;
            let page = page.into_inner();
            for robot in page.robots.iter().filter(|robot| is_taken(robot) && new.contains(&*robot.robot_id)) {
                let enrolled = robot.enrol_time.as_ref().map_or(Utc(i64::MAX), time_of);
                taken.insert(RobotId::parse(&robot.robot_id)?, enrolled);
            }
            if page.next_page_token.is_empty() {
                break;
            }
            request.page_token = page.next_page_token;
        }
        if replace == Replace::Any || taken.is_empty() {
            return Ok(Self(taken.into_keys().collect()));
        }
        let mut client = TelemetryServiceClient::new(robots.lazy());
        let mut strangers = Vec::new();
        for (robot_id, enrolled) in &taken {
            let said = client.get_robot(GetRobotRequest { robot_id: robot_id.to_string() }).await;
            let robot = match said {
                Ok(answer) => answer.into_inner().robot.unwrap_or_default(),
                Err(status) if status.code() == Code::NotFound => Robot::default(),
                Err(status) => return Err(status).with_context(|| format!("asking whether {robot_id} is simulated")),
            };
            if !is_simulated(&robot, *enrolled) {
                strangers.push(robot_id.as_str());
            }
        }
        ensure!(strangers.is_empty(), refusal(&strangers));
        Ok(Self(taken.into_keys().collect()))
    }
}

/// Whether a machine has the robot's name, had it until a person revoked it, or has a secret to get it.
fn is_taken(robot: &RobotIdentity) -> bool {
    !robot.key_sha256.is_empty() || robot.revoke_time.is_some() || robot.enrolment_expire_time.is_some()
}

/// Whether the machine that was enrolled then said at its Hello that its body is simulated. What an older machine of
/// the robot said does not count; one that never said Hello may be a real one. Epochs of sessions are unix
/// milliseconds.
fn is_simulated(robot: &Robot, enrolled: Utc) -> bool {
    let (key, value) = BODY_LABEL;
    let said = robot.inventory.as_ref().and_then(|inventory| inventory.labels.get(key));
    let is_newer = i64::try_from(robot.session_epoch).is_ok_and(|at| at.saturating_add(CLOCKS_APART_MS) >= enrolled.0);
    is_newer && said.is_some_and(|said| said == value)
}

/// What is told of names that robots have which are not known to be simulated.
fn refusal(names: &[&str]) -> String {
    let shown = names[..names.len().min(NAMES_MAX)].join(", ");
    let more = names.len().saturating_sub(NAMES_MAX);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    format!(
        "these names have machines of their own that never said they are simulated: {shown}{more}. Nobody was enrolled\n  try: other names, with --prefix; or, if \
         these machines are to lose their certificates, --replace"
    )
}

/// Simulated machines, and which robot each is.
pub struct Machines(Vec<Identity>);

impl Machines {
    /// Enrols each of `robots` at `server`, unless its folder below `data` says that it is. Without folders each run
    /// brings new machines, which take the places of those of the run before where they are among `replaced`.
    ///
    /// # Errors
    /// The server says no, as of a robot that has a machine and is not replaced.
    pub fn enrol<'a>(
        identities: &'a Endpoint,
        server: &'a str,
        robots: Vec<RobotId>,
        data: Option<&'a Path>,
        replaced: &'a Replaced,
    ) -> Boxed<'a, anyhow::Result<Self>> {
        Box::pin(async move {
            let (room, line) = (Arc::new(Semaphore::new(AT_ONCE)), identities.lazy());
            let mut joined = JoinSet::new();
            for robot_id in robots {
                let (client, server) = (IdentityServiceClient::new(line.clone()), server.to_owned());
                let (folder, room) = (data.map(|data| data.join(robot_id.as_str())), room.clone());
                let replace = replaced.0.contains(&robot_id);
                joined.spawn(async move {
                    let _place = room.acquire_owned().await?;
                    let machine = enrol_one(client, &server, &robot_id, folder, replace).await;
                    machine.with_context(|| format!("enrolling {robot_id}"))
                });
            }
            let mut machines = Vec::with_capacity(joined.len());
            while let Some(machine) = joined.join_next().await {
                machines.push(machine??);
            }
            Ok(Self(machines))
        })
    }

    /// How each of them speaks to the site.
    pub fn tls(&self) -> BTreeMap<RobotId, Tls> {
        self.0.iter().map(|machine| (machine.enrolled().robot_id.clone(), machine.tls())).collect()
    }

    /// Renews their certificates until the handles are dropped.
    ///
    /// # Errors
    /// The address is none.
    pub fn renew_certificates(
        self,
        server: &str,
        clock: &Arc<dyn Clock>,
    ) -> anyhow::Result<Vec<AbortOnDropHandle<()>>> {
        let renew = |machine: Identity| {
            let dial = TcpDial::new(&format!("https://{server}"), None)?.with_tls(machine.tls());
            Ok(AbortOnDropHandle::new(tokio::spawn(machine.renew_when_due(Arc::new(dial), clock.clone()))))
        };
        self.0.into_iter().map(renew).collect()
    }
}

/// What the folder of a robot below `data` says of its machine.
fn enrolled_in(data: Option<&Path>, robot_id: &RobotId) -> anyhow::Result<Option<Enrolled>> {
    Ok(data.map(|data| Enrolled::read(&data.join(robot_id.as_str()))).transpose()?.flatten())
}

async fn enrol_one(
    mut client: IdentityServiceClient<midshift_cli::endpoint::Line>,
    server: &str,
    robot_id: &RobotId,
    folder: Option<PathBuf>,
    replace: bool,
) -> anyhow::Result<Identity> {
    let key = match &folder {
        None => DeviceKey::draw(),
        Some(folder) => {
            midshift_durable::make_folder(folder).with_context(|| format!("making {}", folder.display()))?;
            let mut ledger = SqliteStore::open(&folder.join(AGENT_FILE)).await?;
            device_key(&mut ledger, &format!("{:032x}", rand::random::<u128>())).await?
        }
    };
    let known = folder.as_deref().map(Enrolled::read).transpose()?.flatten();
    if let Some(known) = known {
        return Ok(Identity::new(known, key, folder)?);
    }
    let asked = CreateEnrolmentRequest { robot_id: robot_id.to_string(), replace };
    let offered = client.create_enrolment(asked).await?.into_inner();
    let invitation: Invitation = offered.secret.parse()?;
    let enrolled = midshift_agent::enrolment::enrol(server, robot_id, &invitation, &key).await?;
    if let Some(folder) = &folder {
        enrolled.write(folder)?;
    }
    Ok(Identity::new(enrolled, key, folder)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_proto::link::v1::Inventory;

    const ENROLLED: Utc = Utc(1_800_000_000_000);

    fn robot(labels: &[(&str, &str)], after_ms: i64) -> Robot {
        let labels = labels.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
        let inventory = Some(Inventory { labels, ..Inventory::default() });
        Robot { inventory, session_epoch: (ENROLLED.0 + after_ms).cast_unsigned(), ..Robot::default() }
    }

    #[test]
    fn a_robot_is_simulated_if_its_machine_says_so_and_not_if_nobody_has_heard_it() {
        let simulated = [("body", "simulated"), ("floor", "2")];
        assert!(is_simulated(&robot(&simulated, 0), ENROLLED));
        assert!(!is_simulated(&robot(&simulated, -60_000), ENROLLED), "that was the machine before it");
        assert!(!is_simulated(&robot(&[("body", "steel")], 0), ENROLLED) && !is_simulated(&robot(&[], 0), ENROLLED));
        assert!(!is_simulated(&Robot::default(), ENROLLED), "it may be switched on tomorrow");
    }

    #[test]
    fn names_that_are_taken_are_told_with_both_ways_out() {
        let told = refusal(&["rbt-01", "rbt-02"]);
        assert!(told.contains("simulated: rbt-01, rbt-02. Nobody was enrolled"), "{told}");
        assert!(told.contains("--prefix") && told.contains("--replace"), "{told}");
        assert!(refusal(&["r"; 20]).contains("r, r and 8 more."));
    }
}
