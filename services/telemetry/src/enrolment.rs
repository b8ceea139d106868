//! Holds the certificate of a session against the robot's enrolment, and says what ends a session that waits for a person's word.
//!
//! A certificate of the site's authority that the rows do not know was given after the backup that they were restored from, or is older than the robot's
//! newest machine. Its machine is observed, people are told, and it takes charge once it is adopted. Invariant: the rows are asked, at each Hello: no projection of
//! them can be late. Where nobody shows a certificate there is no enrolment, and nothing is asked.

use crate::clones::SuspectedClone;
use crate::facts::state;
use crate::inner::Inner;
use midshift_core::fleet::NOT_ENROLLED_SEEN;
use midshift_core::identity::{Caller, Digest, RobotIdentity};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::rollout::rows::RobotSoftware;
use midshift_core::session::Session;
use midshift_store::{Error, load};
use std::sync::Arc;
use std::time::Duration;
use tracing::field::Empty;

/// What the rows say of a machine.
pub enum Enrolment {
    /// It shows no certificate: there is no login.
    None,
    /// It is the robot's.
    Own(Box<RobotIdentity>),
    /// The rows do not know it.
    Unknown(NotEnrolled),
}

impl Enrolment {
    /// Of whoever asks to be this robot. `robot`: what the rows know of it.
    pub fn judge(robot: Option<RobotIdentity>, robot_id: &RobotId, by: &Caller) -> Self {
        let Some(key) = by.key() else { return Self::None };
        let unknown = || NotEnrolled { robot_id: robot_id.clone(), certificate: by.certificate().cloned(), key: *key };
        let robot = robot.filter(|robot| robot.has_key(key));
        robot.map_or_else(|| Self::Unknown(unknown()), |robot| Self::Own(Box::new(robot)))
    }

    /// The robot, where its machine is known.
    pub fn own(&self) -> Option<&RobotIdentity> {
        match self {
            Self::Own(robot) => Some(robot),
            Self::None | Self::Unknown(_) => None,
        }
    }
}

async fn enrolled(inner: &Inner, robot_id: &RobotId) -> Result<Option<RobotIdentity>, Error> {
    Ok(load::<RobotIdentity>(inner.parts.store.as_ref(), robot_id.as_str()).await?.map(|(robot, _)| robot))
}

/// The device key that holds for a robot: the one that was known, unless it was enrolled anew since.
pub fn known_device_key(session: &Session, robot: Option<&RobotIdentity>) -> Option<String> {
    let enrolled = robot.and_then(|robot| robot.enrolled_unix_ms);
    let is_anew = session.enrolled_unix_ms.is_some() && enrolled.is_some() && session.enrolled_unix_ms != enrolled;
    session.device_key.clone().filter(|_| !is_anew)
}

/// Whether a person took this device key of a robot.
///
/// # Errors
/// The store does not answer.
pub async fn accepts(inner: &Inner, robot_id: &RobotId, device_key: &str) -> Result<bool, Error> {
    let software = load::<RobotSoftware>(inner.parts.store.as_ref(), robot_id.as_str()).await?;
    Ok(software.is_some_and(|(row, _)| row.device_key.as_deref() == Some(device_key)))
}

/// A machine with a genuine certificate that is not enrolled.
pub struct NotEnrolled {
    robot_id: RobotId,
    /// Serial number of the certificate that it showed.
    certificate: Option<Arc<str>>,
    key: Digest,
}

impl NotEnrolled {
    /// Tells people once, and waits until it is adopted.
    async fn until_enrolled(self, inner: &Inner) {
        let Self { robot_id, certificate, key } = self;
        let certificate = certificate.as_deref();
        tracing::warn!(peer = Empty, %robot_id, certificate, %key, "a machine with a genuine certificate is not enrolled: observed only");
        let body = serde_json::json!({
            "robot_id": robot_id, "certificate": certificate, "key": key, "code": Code::RobotNotEnrolled.as_str(),
        });
        let mut is_told = false;
        loop {
            if !is_told {
                is_told = state(inner, &robot_id, NOT_ENROLLED_SEEN, &body).await;
            }
            tokio::time::sleep(Duration::from_millis(limits::HEARTBEAT.as_ms())).await;
            let robot = enrolled(inner, &robot_id).await;
            if robot.is_ok_and(|robot| robot.is_some_and(|robot| robot.has_key(&key))) {
                return;
            }
        }
    }
}

/// What ends a session, so that its robot comes again and is taken otherwise.
pub enum Waits {
    /// The session of the robot in charge: it falls silent.
    Older(SuspectedClone),
    /// The machine is enrolled.
    Enrolment(NotEnrolled),
    /// A person takes the device key that the robot shows.
    DeviceKey(RobotId, String),
}

impl Waits {
    /// Waits for that.
    pub async fn until_over(self, inner: Arc<Inner>) {
        match self {
            Self::Older(second) => second.until_alone(inner).await,
            Self::Enrolment(machine) => machine.until_enrolled(&inner).await,
            Self::DeviceKey(robot_id, device_key) => loop {
                tokio::time::sleep(Duration::from_millis(limits::HEARTBEAT.as_ms())).await;
                if accepts(&inner, &robot_id, &device_key).await.is_ok_and(|is_taken| is_taken) {
                    return;
                }
            },
        }
    }
}
