//! The list of what was taken back: tokens, and keys of robots. It lies outside the rows, so that an older copy of them gives nothing back.
//!
//! Invariants:
//! 1. The list is made of rows alone. What a row says as taken back and the list has not is appended; nothing is ever taken off.
//! 2. A list that is merged into rows takes back, and gives nothing.
//!
//! Called by identity, which writes the list, and by a restore, which merges one.

use super::enrolment::{Deny, RobotIdentity};
use super::rows::{Act, TokenRecord};
use super::token::{Digest, TokenId};
use crate::ids::RobotId;
use serde::{Deserialize, Serialize};

/// One line of the list. A field of a newer version is passed over, and a kind of a newer version is refused by whoever merges.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "what", rename_all = "snake_case")]
pub enum Revocation {
    /// A token was revoked, or rotated and ends at a moment to come.
    Token {
        /// The token that is worth nothing from then on.
        token_id: TokenId,
        /// Who did it, and from when on.
        revoked: Act,
    },
    /// A key of a robot was taken out: the robot was revoked, or another machine took its place.
    Key {
        /// Of which robot.
        robot_id: RobotId,
        /// The key, and until when a certificate of it may be genuine.
        deny: Deny,
        /// Who revoked the robot; none: it was replaced, or enrolled again before this was written.
        revoked: Option<Act>,
    },
}

impl Revocation {
    /// What two lines have in common that say the same: the newer one adds nothing.
    pub fn mark(&self) -> (String, i64) {
        match self {
            Self::Token { token_id, revoked } => (format!("token {token_id}"), revoked.at_unix_ms),
            Self::Key { deny, .. } => (format!("key {}", deny.key), 0),
        }
    }
}

/// Everything that these rows say as taken back.
pub fn revocations<'a>(
    tokens: impl IntoIterator<Item = &'a TokenRecord>,
    robots: impl IntoIterator<Item = &'a RobotIdentity>,
) -> Vec<Revocation> {
    let tokens = tokens.into_iter().filter_map(|token| {
        let revoked = token.revoked.clone()?;
        Some(Revocation::Token { token_id: token.token_id.clone(), revoked })
    });
    let keys = robots.into_iter().flat_map(|robot| {
        robot.denied.iter().map(move |deny| Revocation::Key {
            robot_id: robot.robot_id.clone(),
            deny: deny.clone(),
            revoked: robot.revoked.clone(),
        })
    });
    tokens.chain(keys).collect()
}

impl TokenRecord {
    /// Takes it back from a moment on, unless it is taken back from an earlier one on. Whether that changed anything.
    pub fn take_back(&mut self, act: &Act) -> bool {
        let is_earlier = self.revoked.as_ref().is_none_or(|known| act.at_unix_ms < known.at_unix_ms);
        if is_earlier {
            self.revoked = Some(act.clone());
        }
        is_earlier
    }
}

impl RobotIdentity {
    /// Takes a key out. If it is the robot's own, the robot has none from then on. Whether that changed anything.
    pub fn take_out(&mut self, deny: &Deny, revoked: Option<&Act>) -> bool {
        let before = self.clone();
        if self.key == Some(deny.key) {
            self.key = None;
            self.expires_unix_ms = None;
            self.enrolment = None;
        }
        if self.key.is_none() && self.revoked.is_none() {
            self.revoked = revoked.cloned();
        }
        match self.denied.iter_mut().find(|known| known.key == deny.key) {
            Some(known) => known.until_unix_ms = known.until_unix_ms.max(deny.until_unix_ms),
            None => self.denied.push(deny.clone()),
        }
        *self != before
    }

    /// Takes a secret back that was handed out and not used, as far as these rows know. Whether there was one.
    pub fn take_offer_back(&mut self) -> bool {
        self.enrolment.take_if(|open| open.used_unix_ms.is_none()).is_some()
    }

    /// Whether this is the key of its machine.
    pub fn has_key(&self, key: &Digest) -> bool {
        self.key.as_ref() == Some(key)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEY: Digest = Digest([1; 32]);
    const OTHER: Digest = Digest([2; 32]);

    fn token() -> TokenRecord {
        TokenRecord {
            token_id: TokenId::new("t1").expect("an id"),
            name: "anna".to_owned(),
            person: None,
            digest: Digest([7; 32]),
            grants: Vec::new(),
            created_unix_ms: 0,
            created_by: "bert".to_owned(),
            expires_unix_ms: 1_000,
            revoked: None,
            rotation: None,
        }
    }

    fn robot() -> RobotIdentity {
        let robot = RobotIdentity::new(RobotId::parse("r7").expect("an id"));
        RobotIdentity { key: Some(KEY), enrolled_unix_ms: Some(1), expires_unix_ms: Some(900), ..robot }
    }

    #[test]
    fn what_rows_say_as_taken_back_takes_it_back_in_an_older_copy_of_them() {
        let (mut old_token, mut old_robot) = (token(), robot());
        let mut newer = robot();
        newer.revoke("anna", crate::time::Utc(50));
        let token = TokenRecord { revoked: Some(Act::new("bert", 60)), ..token() };
        let list = revocations([&token], [&newer]);
        for line in &list {
            let text = serde_json::to_string(line).expect("a line");
            match serde_json::from_str(&text).expect("the same line") {
                Revocation::Token { token_id, revoked } => {
                    assert!(token_id == old_token.token_id && old_token.take_back(&revoked));
                }
                Revocation::Key { robot_id, deny, revoked } => {
                    assert!(robot_id == old_robot.robot_id && old_robot.take_out(&deny, revoked.as_ref()));
                    assert!(!old_robot.take_out(&deny, revoked.as_ref()), "once");
                }
            }
        }
        assert_eq!((list.len(), &old_token), (2, &token));
        assert_eq!((old_robot.key, &old_robot.denied, &old_robot.revoked), (None, &newer.denied, &newer.revoked));
    }

    #[test]
    fn a_token_ends_at_the_earliest_moment_that_was_said() {
        let mut token = token();
        assert!(token.take_back(&Act::new("anna", 60)) && token.take_back(&Act::new("anna", 50)));
        assert!(!token.take_back(&Act::new("anna", 55)));
        assert_eq!(token.revoked, Some(Act::new("anna", 50)));
    }

    #[test]
    fn a_key_of_before_is_denied_and_the_robot_that_has_another_one_keeps_it() {
        let mut robot = robot();
        assert!(robot.take_out(&Deny { key: OTHER, until_unix_ms: 5 }, Some(&Act::new("anna", 1))));
        assert_eq!((robot.key, robot.revoked.as_ref(), robot.denied.len()), (Some(KEY), None, 1));
        assert!(robot.has_key(&KEY) && !robot.has_key(&OTHER) && robot.knows(&OTHER));
    }

    #[test]
    fn lines_that_say_the_same_have_one_mark_and_an_earlier_end_of_a_token_has_its_own() {
        let mark = |at| Revocation::Token { token_id: token().token_id, revoked: Act::new("anna", at) }.mark();
        assert!(mark(5) == mark(5) && mark(5) != mark(4));
        let key = |revoked| {
            let deny = Deny { key: KEY, until_unix_ms: 5 };
            Revocation::Key { robot_id: robot().robot_id, deny, revoked }.mark()
        };
        assert_eq!(key(None), key(Some(Act::new("anna", 1))));
    }
}
