//! The beginning of a session: checks the Hello, tells a succession from a clone, and makes the new epoch durable before the Welcome.

use crate::clones::{SuspectedClone, heard_elsewhere, in_gap};
use crate::enrolment::{Enrolment, Waits, accepts, known_device_key};
use crate::inner::Inner;
use crate::registry::{InCharge, Replay};
use midshift_bundle::installed::{self, Rejection};
use midshift_core::identity::{Caller, RobotIdentity, SessionSecret};
use midshift_core::item::{Expect, Item};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::robot::Lane;
use midshift_core::rows::{Key, Record, Revision, Writer};
use midshift_core::session::{LaneMark, Session};
use midshift_core::update::Installed;
use midshift_proto::session::{Hello, LaneAck, PROTOCOL_VERSION, Previous, Welcome};
use midshift_store::{CommitError, Error, Store, find_record};
use std::sync::Arc;
use tokio::sync::mpsc;
use tracing::field::Empty;

/// Tries to write the session row against other writers of it.
const TRIES: usize = 3;
/// Milliseconds of site time between STATUS samples.
const STATUS_PERIOD_MS: u32 = 2_000;

/// What a session begins with.
pub struct Begun {
    /// Its place in the registry, and replays for it; none: it is observed only.
    pub part: Option<(InCharge, mpsc::Receiver<Replay>)>,
    /// What ends it, if something does.
    pub waits: Option<Waits>,
    /// What the robot is told.
    pub welcome: Welcome,
    /// Durable numbers of its ring, with the revision of their row.
    pub mark: (LaneMark, Revision),
    /// Durable STATUS of its ring.
    pub status: u64,
}

/// Checks what needs no row.
pub fn check(inner: &Inner, hello: &Hello) -> Result<(), Refusal> {
    if !hello.protocol_versions.contains(&PROTOCOL_VERSION) {
        let reason = Reason::from(Code::ProtocolError).with("spoken", PROTOCOL_VERSION);
        return Err(Refusal::new(Kind::Precondition, reason));
    }
    let rate = inner.parts.clock.rate_permille();
    if hello.clock_rate_permille != rate {
        let reason = Reason::from(Code::ClockRateMismatch)
            .with("server_permille", rate)
            .with("robot_permille", hello.clock_rate_permille);
        return Err(Refusal::new(Kind::Precondition, reason));
    }
    Ok(())
}

fn unavailable(error: impl std::fmt::Display) -> Refusal {
    Refusal::new(Kind::Unavailable, Reason::new(Code::StoreUnavailable, error.to_string()))
}

/// Nobody is admitted without the database that gateways share.
pub fn cut_off() -> Refusal {
    unavailable("this gateway has lost the database")
}

/// Admits the session, in charge or observed.
pub async fn begin(inner: &Inner, hello: &Hello, by: &Caller) -> Result<Begun, Refusal> {
    let store = inner.parts.store.as_ref();
    // Asking a database that is away takes time that the robot's authority has not.
    if inner.shared.as_ref().is_some_and(|shared| *shared.cut_off().borrow()) {
        return Err(cut_off());
    }
    for _ in 0..TRIES {
        let Known { row, mark, robot } = read_known(store, hello, by).await.map_err(unavailable)?;
        let status = status_of(inner, hello).await?;
        // A secret lies in a file and can be copied with it: of another start it proves nothing while the older session is heard.
        let proven = row.as_ref().is_some_and(|(row, _)| {
            let known = |p: &Previous| p.session_epoch == row.session_epoch && p.secret == row.secret;
            hello.boot_id == row.boot_id && hello.previous.as_ref().is_some_and(known)
        });
        let here = inner.registry.get(&hello.robot_id).is_some();
        let has_other_ring = row.as_ref().is_some_and(|(row, _)| row.ring != hello.ring);
        let is_held = here
            || heard_elsewhere(inner, &hello.robot_id).is_some()
            || (has_other_ring && in_gap(inner, &hello.robot_id).is_some());
        let now = inner.parts.clock.now();
        let last = row.as_ref().map_or(0, |(r, _)| r.session_epoch);
        let session_epoch = (last + 1).max(now.wall.0.max(0) as u64);
        let enrolment = Enrolment::judge(robot, &hello.robot_id, by);
        let robot = enrolment.own().cloned();
        let waits = match enrolment {
            Enrolment::Unknown(machine) => Some(Waits::Enrolment(machine)),
            _ if is_held && !proven && !inner.parts.bugs.no_clone_fence() => {
                Some(Waits::Older(SuspectedClone::new(inner, hello, by, has_other_ring)))
            }
            _ => None,
        };
        if waits.is_some() {
            // Its epoch and secret are in no row: they prove nothing later.
            let welcome = welcome(inner, session_epoch, draw_secret(), &mark.0, status, true);
            return Ok(Begun { part: None, waits, welcome, mark, status });
        }
        let live = inner.parts.board.get(&hello.robot_id);
        let measured = live.and_then(|live| live.clock).map(|clock| clock.clock_offset_ms);
        let clock_offset_ms = measured.or(row.as_ref().and_then(|(row, _)| row.clock_offset_ms));
        let known = row.as_ref().and_then(|(row, _)| known_device_key(row, robot.as_ref()));
        let mut claim = judge(hello, known);
        if let Some(key) = &claim.other_key
            && accepts(inner, &hello.robot_id, key).await.map_err(unavailable)?
        {
            claim = judge(hello, None);
        }
        let enrolled_unix_ms = robot.as_ref().and_then(|robot| robot.enrolled_unix_ms);
        let session = Session { clock_offset_ms, enrolled_unix_ms, ..session_row(hello, session_epoch, &claim) };
        let mut item = Item::new(Writer::Telemetry, hello.robot_id.as_str());
        item.put_row(&session, row.map_or(Expect::Absent, |(_, revision)| Expect::At(revision)), "session.begun");
        match store.commit(vec![item]).await.pop() {
            Some(Ok(_)) => {}
            Some(Err(CommitError::Conflict { .. })) => continue,
            Some(Err(error)) => return Err(unavailable(error)),
            None => return Err(unavailable("the store gave no answer")),
        }
        log_disbelief(hello, &claim);
        let (in_charge, replays) = InCharge::new(session_epoch, session.secret.clone(), now.link);
        if !inner.registry.take_charge(&hello.robot_id, in_charge.clone()) {
            continue;
        }
        let welcome = welcome(inner, session_epoch, session.secret, &mark.0, status, false);
        let waits = claim.other_key.map(|key| Waits::DeviceKey(hello.robot_id.clone(), key));
        return Ok(Begun { part: Some((in_charge, replays)), waits, welcome, mark, status });
    }
    Err(Refusal::new(Kind::Conflict, Code::CloneSeen))
}

/// What the rows say of a robot, all of one moment.
struct Known {
    /// Its newest session.
    row: Option<(Session, Revision)>,
    /// Durable numbers of its ring.
    mark: (LaneMark, Revision),
    /// Its enrolment; none without a login.
    robot: Option<RobotIdentity>,
}

async fn read_known(store: &dyn Store, hello: &Hello, by: &Caller) -> Result<Known, Error> {
    let fresh = LaneMark::fresh(hello.robot_id.clone(), &hello.ring);
    let robot_id = hello.robot_id.as_str();
    let mut keys = vec![Key::new(Session::TABLE, robot_id), Key::new(LaneMark::TABLE, &*fresh.id())];
    keys.extend(by.key().map(|_| Key::new(RobotIdentity::TABLE, robot_id)));
    let rows = store.get(keys).await?;
    let mark = find_record(&rows)?.unwrap_or((fresh, Revision(0)));
    Ok(Known { row: find_record(&rows)?, mark, robot: find_record(&rows)?.map(|(robot, _)| robot) })
}

/// Durable STATUS of the robot's ring, which another gateway may have kept.
async fn status_of(inner: &Inner, hello: &Hello) -> Result<u64, Refusal> {
    let ring: Arc<str> = Arc::from(hello.ring.as_str());
    let here = inner.projection.durable_status(&hello.robot_id, &ring);
    if inner.shared.is_none() {
        return Ok(here);
    }
    let kept = inner.parts.frames.mark(&hello.robot_id, &ring).await.map_err(unavailable)?;
    Ok(kept.max(here))
}

fn draw_secret() -> SessionSecret {
    format!("{:032x}", rand::random::<u128>()).into()
}

/// What a Hello claims of the robot's software, checked against the key that its machine is known by.
#[derive(Default)]
struct SoftwareClaim {
    installed: Option<Installed>,
    device_key: Option<String>,
    /// Another key signed it.
    other_key: Option<String>,
    /// It cannot be believed at all.
    rejection: Option<Rejection>,
}

/// Believes what the known key signed, and the first key that is ever seen. The session goes on in any case: work is no matter of this key.
fn judge(hello: &Hello, known: Option<String>) -> SoftwareClaim {
    if hello.installed.is_empty() {
        return SoftwareClaim { device_key: known, ..SoftwareClaim::default() };
    }
    match installed::open(&hello.installed, &hello.robot_id, &hello.boot_id) {
        Err(rejection) => SoftwareClaim { device_key: known, rejection: Some(rejection), ..SoftwareClaim::default() },
        Ok(installed) => {
            let key = installed.device_key.clone();
            match known {
                Some(known) if known != key => {
                    SoftwareClaim { device_key: Some(known), other_key: Some(key), ..SoftwareClaim::default() }
                }
                _ => SoftwareClaim { device_key: Some(key), installed: Some(installed), ..SoftwareClaim::default() },
            }
        }
    }
}

/// Logs which of a robot's claims are not believed.
fn log_disbelief(hello: &Hello, claim: &SoftwareClaim) {
    let robot_id = &hello.robot_id;
    if let Some(other_key) = &claim.other_key {
        metrics::counter!("midshift_telemetry_device_keys_changed_total").increment(1);
        let device_key = claim.device_key.as_deref().unwrap_or_default();
        tracing::warn!(peer = Empty, %robot_id, device_key, other_key, "another machine's key signed what this robot says it has installed: not believed");
    }
    if let Some(rejection) = &claim.rejection {
        metrics::counter!("midshift_telemetry_installed_rejected_total").increment(1);
        tracing::warn!(peer = Empty, %robot_id, %rejection, "what this robot says it has installed is not believed");
    }
}

fn session_row(hello: &Hello, session_epoch: u64, claim: &SoftwareClaim) -> Session {
    Session {
        robot_id: hello.robot_id.clone(),
        session_epoch,
        secret: draw_secret(),
        boot_id: hello.boot_id.clone(),
        ring: hello.ring.clone(),
        inventory: hello.inventory.clone(),
        applied_work: hello.reported.applied_work,
        applied_update: hello.reported.applied_update,
        places: hello.reported.places.clone(),
        clock_offset_ms: None,
        installed: claim.installed.clone(),
        device_key: claim.device_key.clone(),
        device_key_changed: claim.other_key.is_some(),
        other_device_key: claim.other_key.clone(),
        enrolled_unix_ms: None,
    }
}

fn welcome(
    inner: &Inner,
    session_epoch: u64,
    session_secret: SessionSecret,
    mark: &LaneMark,
    status: u64,
    observed: bool,
) -> Welcome {
    let ack = |lane, seq| LaneAck { lane, seq, expect: None };
    Welcome {
        session_epoch,
        session_secret,
        store_id: inner.parts.store.id().to_string(),
        acks: vec![ack(Lane::Critical, mark.critical), ack(Lane::Event, mark.event), ack(Lane::Status, status)],
        heartbeat_period_ms: limits::HEARTBEAT.as_ms() as u32,
        status_period_ms: STATUS_PERIOD_MS,
        authority_ms: limits::AUTHORITY.as_ms() as u32,
        status_credit_bytes: limits::STATUS_IN_FLIGHT_BYTES as u32,
        protocol_version: PROTOCOL_VERSION,
        clock_rate_permille: inner.parts.clock.rate_permille(),
        observed,
    }
}
