//! What people say of a robot's machine: that one which is not known is the robot.
//!
//! Invariant: it gives no certificate. A machine that is adopted has shown one of this authority, and shows it again.

use crate::grpc::known;
use crate::register::decided;
use crate::{IdentityService, encode};
use midshift_core::audit::Note;
use midshift_core::identity::{Caller, Digest, Replace};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::time::Utc;
use midshift_proto::identity::v1;

impl IdentityService {
    /// Takes a machine in that the store does not know.
    ///
    /// # Errors
    /// The key was taken out, or is another robot's; the robot has another machine; the store.
    pub(crate) async fn adopt(
        &self,
        r: v1::AdoptRobotRequest,
        actor: &Caller,
    ) -> Result<v1::AdoptRobotResponse, Refusal> {
        let mut bad = Violations::default();
        let robot_id = bad.accept("robot_id", RobotId::parse(&r.robot_id));
        let key = bad.accept("key_sha256", r.key_sha256.parse::<Digest>());
        bad.finish()?;
        let (Some(robot_id), Some(key)) = (robot_id, key) else {
            return Err(Refusal::field("key_sha256", "is required"));
        };
        let now = self.now();
        // A certificate of it is good no longer than this: when it was signed is not known any more.
        let expires = Utc(now.0.saturating_add_unsigned(limits::ROBOT_CERTIFICATE_VALID.as_ms()));
        let replace = if r.replace { Replace::Yes } else { Replace::No };
        let asked = Note::new("robot.adopt").about("robot", &robot_id).with("key", key);
        // One at a time, as machines are enrolled: whether a key is another robot's is decided over all of them.
        let _alone = self.0.enrolling.lock().await;
        let adopted = self.0.register.decide_for(actor, asked.clone(), |view| {
            let (mut robot, at) = known(view.robots.get(&robot_id), &robot_id);
            if robot.has_key(&key) {
                return Ok((None, robot));
            }
            if view.robots.values().any(|(other, _)| other.robot_id != robot_id && other.knows(&key)) {
                let text = "the key of this machine is, or was, that of another robot";
                return Err(Refusal::new(Kind::Precondition, Reason::new(Code::KeyDenied, text)));
            }
            robot.adopt(key, replace, now, expires)?;
            Ok((Some(decided(&robot, at, actor, "robot.adopted", asked.clone())), robot))
        });
        let robot = adopted.await?;
        // The key of the machine whose place it took.
        self.recorded().await?;
        Ok(v1::AdoptRobotResponse { robot: Some(encode::robot(&robot)) })
    }
}
