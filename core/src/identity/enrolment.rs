//! A robot's identity: how it gets a key known, and how a key is taken out.
//!
//! Invariant: one key a robot. A secret enrols once, within its time, and only while it is the newest of its robot; a key that was denied is never taken again.

use super::rows::Act;
use super::token::{Digest, TokenId};
use crate::ids::RobotId;
use crate::limits;
use crate::reason::{Code, Kind, Reason, Refusal};
use crate::rows::{Record, Table, body_is_json};
use crate::time::Utc;
use serde::{Deserialize, Serialize};

/// A key that lets nobody in, until no certificate of it can be genuine any more.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Deny {
    /// Digest of the public key.
    pub key: Digest,
    /// UTC, unix ms.
    pub until_unix_ms: i64,
}

/// A secret that was handed out for a robot.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EnrolmentState {
    /// Which secret.
    pub secret_id: TokenId,
    /// Its digest.
    pub digest: Digest,
    /// UTC, unix ms; from then on it enrols nobody.
    pub expires_unix_ms: i64,
    /// When it was used; none: not yet.
    pub used_unix_ms: Option<i64>,
}

/// One robot, as identity knows it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RobotIdentity {
    /// Which robot.
    pub robot_id: RobotId,
    /// Digest of its public key; none: it has none, or it was revoked.
    pub key: Option<Digest>,
    /// When it was enrolled with it, UTC unix ms.
    pub enrolled_unix_ms: Option<i64>,
    /// When its newest certificate is over, UTC unix ms.
    pub expires_unix_ms: Option<i64>,
    /// The newest secret that was handed out for it.
    pub enrolment: Option<EnrolmentState>,
    /// Who revoked it last; none: nobody, or it was enrolled again since.
    pub revoked: Option<Act>,
    /// Keys that were taken out.
    pub denied: Vec<Deny>,
}

impl Record for RobotIdentity {
    const TABLE: Table = Table::RobotIdentity;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

impl RobotIdentity {
    /// One that nothing is known of.
    pub const fn new(robot_id: RobotId) -> Self {
        Self {
            robot_id,
            key: None,
            enrolled_unix_ms: None,
            expires_unix_ms: None,
            enrolment: None,
            revoked: None,
            denied: Vec::new(),
        }
    }

    /// Hands out a secret; an older one that was not used is worth nothing from then on.
    ///
    /// # Errors
    /// It is enrolled, and this is no replacement.
    pub fn offer(&mut self, secret_id: TokenId, digest: Digest, replace: Replace, now: Utc) -> Result<(), Refusal> {
        if self.key.is_some() && replace == Replace::No {
            let text = format!("{} is enrolled: another machine would need `robot replace {0}`", self.robot_id);
            return Err(Refusal::new(
                Kind::Precondition,
                Reason::new(Code::RobotEnrolled, text).with("robot_id", &self.robot_id),
            ));
        }
        let expires_unix_ms = now.0.saturating_add_unsigned(limits::ENROLMENT_VALID.as_ms());
        self.enrolment = Some(EnrolmentState { secret_id, digest, expires_unix_ms, used_unix_ms: None });
        Ok(())
    }

    /// A machine shows the secret and its key, and becomes the robot. The same key with the same secret again, within the secret's time, is the same answer,
    /// since the first one may have been lost on its way.
    ///
    /// # Errors
    /// The secret is another, used, or too old; the key was denied before.
    pub fn enrol(&mut self, secret_id: &TokenId, digest: &Digest, key: Digest, now: Utc) -> Result<(), Refusal> {
        let bad = |code| Err(Refusal::new(Kind::Unauthenticated, code));
        let Some(open) = self.enrolment.as_mut().filter(|open| open.secret_id == *secret_id && open.digest == *digest)
        else {
            return bad(Code::EnrolmentUnknown);
        };
        let is_over = now.0 >= open.expires_unix_ms;
        match open.used_unix_ms {
            Some(_) if self.key != Some(key) || self.revoked.is_some() => return bad(Code::EnrolmentUsed),
            _ if is_over => return bad(Code::EnrolmentExpired),
            Some(_) => return Ok(()),
            None => {}
        }
        if self.denied.iter().any(|deny| deny.key == key) {
            return bad(Code::KeyDenied);
        }
        open.used_unix_ms = Some(now.0);
        if self.key != Some(key) {
            self.deny(now);
        }
        self.key = Some(key);
        self.enrolled_unix_ms = Some(now.0);
        self.revoked = None;
        Ok(())
    }

    /// A certificate for the key it has.
    ///
    /// # Errors
    /// The key is not its own.
    pub fn renew(&mut self, key: &Digest, expires: Utc) -> Result<(), Refusal> {
        if self.key.as_ref() != Some(key) {
            return Err(Refusal::new(Kind::Denied, Code::KeyDenied));
        }
        self.expires_unix_ms = Some(expires.0);
        Ok(())
    }

    /// Takes a machine in that shows a genuine certificate of this key and is not known: it was enrolled after the backup of which the rows were restored.
    ///
    /// # Errors
    /// The key was taken out; or the robot has another one, and this is no replacement.
    pub fn adopt(&mut self, key: Digest, replace: Replace, now: Utc, expires: Utc) -> Result<(), Refusal> {
        if self.denied.iter().any(|deny| deny.key == key) {
            return Err(Refusal::new(Kind::Precondition, Code::KeyDenied));
        }
        if self.key.is_some_and(|own| own != key) {
            if replace == Replace::No {
                let text =
                    format!("{} has another machine, whose key would be taken out: --replace says so", self.robot_id);
                let reason = Reason::new(Code::RobotEnrolled, text).with("robot_id", &self.robot_id);
                return Err(Refusal::new(Kind::Precondition, reason));
            }
            self.deny(now);
        }
        self.key = Some(key);
        self.enrolled_unix_ms = Some(now.0);
        self.expires_unix_ms = Some(expires.0);
        self.enrolment = None;
        self.revoked = None;
        Ok(())
    }

    /// Whether a machine was ever enrolled as this robot, also one that was revoked since.
    pub fn was_ever_enrolled(&self) -> bool {
        self.key.is_some() || self.enrolled_unix_ms.is_some() || !self.denied.is_empty()
    }

    /// Whether nothing of it lets a machine in, or has to keep one out: no certificate can be genuine, and no secret is open.
    pub fn is_spent(&self, now: Utc) -> bool {
        let is_over = |until_unix_ms: i64| until_unix_ms <= now.0;
        let certificates = self.key.is_none() || self.expires_unix_ms.is_some_and(is_over);
        let secret = self.enrolment.as_ref().is_none_or(|open| is_over(open.expires_unix_ms));
        certificates && secret && self.denied.iter().all(|deny| is_over(deny.until_unix_ms))
    }

    /// Whether this key is its own, or was and was taken out: another robot with it would be the same machine, or let a denied one in.
    pub fn knows(&self, key: &Digest) -> bool {
        self.key.as_ref() == Some(key) || self.denied.iter().any(|deny| deny.key == *key)
    }

    /// Takes its key out, and the secret that was handed out for it.
    pub fn revoke(&mut self, actor: &str, now: Utc) {
        self.deny(now);
        self.enrolment = None;
        self.revoked = Some(Act::new(actor, now.0));
    }

    /// What is there of a key is denied for as long as a certificate of it may be genuine.
    fn deny(&mut self, now: Utc) {
        self.denied.retain(|deny| deny.until_unix_ms > now.0);
        if let Some(key) = self.key.take() {
            let until_unix_ms = now.0.saturating_add_unsigned(limits::KEY_DENIED_FOR.as_ms());
            self.denied.push(Deny { key, until_unix_ms });
        }
        self.expires_unix_ms = None;
    }
}

/// Whether another machine takes a robot's place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Replace {
    /// It has no machine yet.
    No,
    /// It does: its key is denied as soon as the new machine is enrolled.
    Yes,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(text: &str) -> TokenId {
        TokenId::new(text).expect("an id")
    }
    fn robot() -> RobotIdentity {
        RobotIdentity::new(RobotId::parse("r7").expect("an id"))
    }
    const SECRET: Digest = Digest([9; 32]);
    const FIRST: Digest = Digest([1; 32]);
    const SECOND: Digest = Digest([2; 32]);

    fn enrolled() -> RobotIdentity {
        let mut robot = robot();
        robot.offer(id("s1"), SECRET, Replace::No, Utc(0)).expect("offered");
        robot.enrol(&id("s1"), &SECRET, FIRST, Utc(1)).expect("enrolled");
        robot
    }

    #[test]
    fn a_secret_enrols_one_machine_once_and_its_answer_may_be_asked_for_again() {
        let mut robot = enrolled();
        assert_eq!(robot.enrol(&id("s1"), &SECRET, FIRST, Utc(2)), Ok(()), "the answer was lost");
        let again = robot.enrol(&id("s1"), &SECRET, SECOND, Utc(2)).expect_err("another machine");
        assert_eq!(again.reason.code, Code::EnrolmentUsed);
        assert_eq!(robot.key, Some(FIRST));
        let late = robot.enrol(&id("s1"), &SECRET, FIRST, Utc(limits::ENROLMENT_VALID.as_ms().cast_signed()));
        assert_eq!(
            late.expect_err("its time is over").reason.code,
            Code::EnrolmentExpired,
            "the answer is not kept for ever"
        );
    }

    #[test]
    fn a_key_that_another_robot_has_or_had_enrols_nobody_else() {
        let (mut first, other) = (enrolled(), RobotIdentity::new(RobotId::parse("r8").expect("an id")));
        assert!(first.knows(&FIRST) && !first.knows(&SECOND) && !other.knows(&FIRST));
        first.revoke("anna", Utc(2));
        assert!(first.knows(&FIRST), "what was taken out is nobody's");
    }

    #[test]
    fn a_machine_that_is_not_known_is_adopted_unless_its_key_was_taken_out_or_the_robot_has_another_one() {
        let mut unknown = robot();
        unknown.adopt(FIRST, Replace::No, Utc(5), Utc(100)).expect("adopted");
        assert_eq!((unknown.key, unknown.enrolled_unix_ms, unknown.expires_unix_ms), (Some(FIRST), Some(5), Some(100)));
        let mut robot = enrolled();
        let refused = robot.adopt(SECOND, Replace::No, Utc(5), Utc(100)).expect_err("it has a machine");
        assert_eq!((refused.reason.code, robot.key), (Code::RobotEnrolled, Some(FIRST)));
        robot.adopt(SECOND, Replace::Yes, Utc(5), Utc(100)).expect("adopted");
        assert_eq!((robot.key, robot.denied[0].key), (Some(SECOND), FIRST));
        let refused = robot.adopt(FIRST, Replace::Yes, Utc(6), Utc(100)).expect_err("it was taken out");
        assert_eq!((refused.reason.code, robot.key), (Code::KeyDenied, Some(SECOND)));
    }

    #[test]
    fn a_secret_that_is_wrong_or_late_or_no_longer_the_newest_enrols_nobody() {
        let mut robot = robot();
        let refused = |robot: &mut RobotIdentity, id: TokenId, digest, now| {
            robot.enrol(&id, &digest, FIRST, Utc(now)).expect_err("refused").reason.code
        };
        assert_eq!(refused(&mut robot, id("s1"), SECRET, 0), Code::EnrolmentUnknown);
        robot.offer(id("s1"), SECRET, Replace::No, Utc(0)).expect("offered");
        assert_eq!(refused(&mut robot, id("s1"), FIRST, 0), Code::EnrolmentUnknown);
        let late = limits::ENROLMENT_VALID.as_ms().cast_signed();
        assert_eq!(refused(&mut robot, id("s1"), SECRET, late), Code::EnrolmentExpired);
        robot.offer(id("s2"), SECRET, Replace::No, Utc(0)).expect("offered");
        assert_eq!(refused(&mut robot, id("s1"), SECRET, 0), Code::EnrolmentUnknown);
        assert_eq!(robot.key, None);
    }

    #[test]
    fn another_machine_needs_a_replacement_and_takes_the_key_of_the_first_one_out() {
        let mut robot = enrolled();
        let refused = robot.offer(id("s2"), SECRET, Replace::No, Utc(2)).expect_err("enrolled");
        assert_eq!(refused.reason.code, Code::RobotEnrolled);
        robot.offer(id("s2"), SECRET, Replace::Yes, Utc(2)).expect("offered");
        assert_eq!(robot.key, Some(FIRST), "the old machine works until the new one is there");
        robot.enrol(&id("s2"), &SECRET, SECOND, Utc(3)).expect("enrolled");
        assert_eq!(robot.key, Some(SECOND));
        assert_eq!(robot.denied.iter().map(|deny| deny.key).collect::<Vec<_>>(), [FIRST]);
        robot.offer(id("s3"), SECRET, Replace::Yes, Utc(4)).expect("offered");
        let back = robot.enrol(&id("s3"), &SECRET, FIRST, Utc(5)).expect_err("denied");
        assert_eq!(back.reason.code, Code::KeyDenied);
    }

    #[test]
    fn a_revoked_robot_has_no_key_and_renews_nothing_until_it_is_enrolled_anew() {
        let mut robot = enrolled();
        assert_eq!(robot.renew(&FIRST, Utc(100)), Ok(()));
        robot.revoke("anna", Utc(2));
        assert_eq!((robot.key, robot.denied.len()), (None, 1));
        assert!(robot.renew(&FIRST, Utc(100)).is_err());
        let again = robot.enrol(&id("s1"), &SECRET, FIRST, Utc(3)).expect_err("its secret went too");
        assert_eq!(again.reason.code, Code::EnrolmentUnknown);
        robot.offer(id("s2"), SECRET, Replace::No, Utc(3)).expect("offered");
        robot.enrol(&id("s2"), &SECRET, SECOND, Utc(4)).expect("enrolled");
        assert_eq!((robot.key, robot.revoked), (Some(SECOND), None));
    }
}
