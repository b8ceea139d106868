//! Simulated machines become robots of a site: each with a key and a certificate of its own, enrolled by whoever is signed in.
//!
//! Invariant: what a simulated robot shows is what a real one would: the server makes no difference.

use anyhow::Context;
use midshift_agent::device::{self, DeviceKey};
use midshift_agent::dial::TcpDial;
use midshift_agent::enrolment::{Enrolled, Identity, Invitation};
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::tls::Tls;
use midshift_cli::endpoint::Endpoint;
use midshift_core::Boxed;
use midshift_core::ids::RobotId;
use midshift_core::time::Clock;
use midshift_proto::identity::v1::CreateEnrolmentRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_sim::swarm::AGENT_FILE;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio_util::task::AbortOnDropHandle;

/// So many are enrolled at a time.
const AT_ONCE: usize = 32;

/// Simulated machines, and which robot each is.
pub struct Machines(Vec<Identity>);

impl Machines {
    /// Enrols each of `robots` at `server`, unless its folder below `data` says that it is. Without folders each run brings new machines, which take the places of
    /// those of the run before.
    ///
    /// # Errors
    /// The server says no.
    pub fn enrol<'a>(
        identities: &'a Endpoint,
        server: &'a str,
        robots: Vec<RobotId>,
        data: Option<&'a Path>,
    ) -> Boxed<'a, anyhow::Result<Self>> {
        Box::pin(async move {
            let (room, line) = (Arc::new(Semaphore::new(AT_ONCE)), identities.lazy());
            let mut joined = JoinSet::new();
            for robot_id in robots {
                let (client, server) = (IdentityServiceClient::new(line.clone()), server.to_owned());
                let (folder, room) = (data.map(|data| data.join(robot_id.as_str())), room.clone());
                joined.spawn(async move {
                    let _place = room.acquire_owned().await?;
                    let machine = enrol_one(client, &server, &robot_id, folder).await;
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
            Ok(AbortOnDropHandle::new(tokio::spawn(machine.keep(Arc::new(dial), clock.clone()))))
        };
        self.0.into_iter().map(renew).collect()
    }
}

async fn enrol_one(
    mut client: IdentityServiceClient<midshift_cli::endpoint::Line>,
    server: &str,
    robot_id: &RobotId,
    folder: Option<PathBuf>,
) -> anyhow::Result<Identity> {
    let key = match &folder {
        None => DeviceKey::draw(),
        Some(folder) => {
            midshift_durable::make_folder(folder).with_context(|| format!("making {}", folder.display()))?;
            let mut ledger = SqliteStore::open(&folder.join(AGENT_FILE)).await?;
            device::key_of(&mut ledger, &format!("{:032x}", rand::random::<u128>())).await?
        }
    };
    let known = folder.as_deref().map(Enrolled::read).transpose()?.flatten();
    if let Some(known) = known {
        return Ok(Identity::new(known, key, folder)?);
    }
    let asked = CreateEnrolmentRequest { robot_id: robot_id.to_string(), replace: true };
    let offered = client.create_enrolment(asked).await?.into_inner();
    let invitation: Invitation = offered.secret.parse()?;
    let enrolled = midshift_agent::enrolment::enrol(server, robot_id, &invitation, &key).await?;
    if let Some(folder) = &folder {
        enrolled.write(folder)?;
    }
    Ok(Identity::new(enrolled, key, folder)?)
}
