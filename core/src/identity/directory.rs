//! Everything a port must know to tell who somebody is: built from rows where the store is, read from a snapshot where it is not.
//!
//! Invariant: it holds digests only. What is not in it lets nobody in, and a key that is denied in it is denied although its certificate is genuine.

use super::caller::Caller;
use super::enrolment::{Deny, RobotIdentity};
use super::grant::HeldGrant;
use super::rows::TokenRecord;
use super::token::{Digest, TokenId};
use crate::limits;
use crate::reason::{Code, Kind, Refusal};
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// So long after its end a token still engages stops, milliseconds.
const STOPS_FOR_MS: i64 = limits::TOKEN_STOPS_AFTER_EXPIRY.as_ms().cast_signed();

/// One token, as a port knows it. A field of a newer version is passed over: the stop service may be older than the
/// writer of its snapshot.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DirectoryToken {
    /// Who it stands for.
    pub name: Arc<str>,
    /// The person who has it; none: none was named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub person: Option<Arc<str>>,
    /// Digest of its secret.
    pub digest: Digest,
    /// Its rights.
    pub grants: Arc<[HeldGrant]>,
    /// When its time is over.
    pub expires_unix_ms: i64,
}

/// Tokens that were not revoked, and keys that were.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Directory {
    /// By id. Those of which even the time to stop is over are left out.
    pub tokens: BTreeMap<TokenId, DirectoryToken>,
    /// Digests of the public keys of robots that were revoked or replaced, and until when a certificate of them may still be genuine.
    pub denied: BTreeMap<Digest, i64>,
}

impl Directory {
    /// Of these rows, without what is over at `now`. That is a moment without jumps of the wall ([`crate::time::Now::steady_wall`]): none of them gives a
    /// key back, or takes a token from streams that stand.
    pub fn from_rows<'a>(
        tokens: impl IntoIterator<Item = &'a TokenRecord>,
        robots: impl IntoIterator<Item = &'a RobotIdentity>,
        now: Utc,
    ) -> Self {
        let stops_until = |expires: i64| expires.saturating_add_unsigned(limits::TOKEN_STOPS_AFTER_EXPIRY.as_ms());
        let live = tokens.into_iter().filter(|t| !t.is_revoked(now) && stops_until(t.expires_unix_ms) > now.0);
        let tokens = live.map(|t| {
            let (grants, name, person) = (t.grants.iter().cloned().collect(), t.name.as_str().into(), t.person.clone());
            // One that was rotated ends by itself at every port, also where nobody hears that it went.
            let ends = t.revoked.as_ref().map_or(i64::MAX, |act| act.at_unix_ms);
            let expires_unix_ms = t.expires_unix_ms.min(ends);
            (t.token_id.clone(), DirectoryToken { name, person, digest: t.digest, grants, expires_unix_ms })
        });
        let denied = robots.into_iter().flat_map(|robot| &robot.denied).filter(|deny| deny.until_unix_ms > now.0);
        Self {
            tokens: tokens.collect(),
            denied: denied.map(|Deny { key, until_unix_ms }| (*key, *until_unix_ms)).collect(),
        }
    }

    /// Whether a robot's key was taken out. Time gives no key back: its certificates expire by themselves.
    pub fn denies(&self, key: &Digest) -> bool {
        self.denied.contains_key(key)
    }

    /// Who shows a token with this id, whose secret has this digest.
    ///
    /// # Errors
    /// There is none, it was revoked, its secret is another, or its time is over for longer than a stop needs.
    pub fn holder(&self, token: &TokenId, digest: &Digest, now: Utc) -> Result<Caller, Refusal> {
        let known = self.tokens.get(token).filter(|known| same(&known.digest, digest));
        let Some(known) = known else { return Err(Refusal::new(Kind::Unauthenticated, Code::TokenUnknown)) };
        let late_ms = now.0.saturating_sub(known.expires_unix_ms);
        if late_ms >= STOPS_FOR_MS {
            return Err(Refusal::new(Kind::Unauthenticated, Code::TokenExpired));
        }
        let caller = Caller::holder(token.clone(), known.name.clone(), known.grants.clone(), late_ms >= 0);
        Ok(caller.with_person(known.person.clone()))
    }

    /// Whether what was begun with this token may go on: it was not taken back, and its time is not over, or no longer than a stop needs if it was over when that began.
    pub fn is_good(&self, token: &TokenId, was_expired: bool, now: Utc) -> bool {
        let least = if was_expired { STOPS_FOR_MS } else { 0 };
        self.tokens.get(token).is_some_and(|known| now.0.saturating_sub(known.expires_unix_ms) < least)
    }
}

/// Compares all of both, so that the time it takes says nothing.
fn same(a: &Digest, b: &Digest) -> bool {
    a.0.iter().zip(&b.0).fold(0, |differ, (a, b)| differ | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use super::super::grant::{Access, Object, Permission};
    use super::*;
    use crate::overload::Class;

    const DAY_MS: i64 = 24 * 3_600 * 1_000;

    fn directory() -> (TokenId, Directory) {
        let id = TokenId::new("t1").expect("an id");
        let grants = Arc::from(["operator".to_owned().into()]);
        let (name, digest, person) = ("anna".into(), Digest([7; 32]), None);
        let token = DirectoryToken { name, person, digest, grants, expires_unix_ms: DAY_MS };
        (id.clone(), Directory { tokens: [(id, token)].into(), denied: BTreeMap::new() })
    }

    #[test]
    fn the_secret_must_be_the_whole_secret_of_this_token() {
        let (id, directory) = directory();
        let holder = directory.holder(&id, &Digest([7; 32]), Utc(0)).expect("anna");
        assert_eq!(holder.to_string(), "anna");
        let mut nearly = [7; 32];
        nearly[31] = 6;
        for (id, digest) in [(id, Digest(nearly)), (TokenId::new("t2").expect("an id"), Digest([7; 32]))] {
            assert_eq!(directory.holder(&id, &digest, Utc(0)).expect_err("not hers").reason.code, Code::TokenUnknown);
        }
    }

    #[test]
    fn a_token_that_expired_stops_for_thirty_days_more_and_then_does_nothing() {
        let (id, directory) = directory();
        let at = |day: i64| directory.holder(&id, &Digest([7; 32]), Utc(day * DAY_MS));
        let (stop, read) = (Permission::Stop, Permission::Read);
        let may = |day, permission| {
            at(day)
                .and_then(|caller| caller.may_call(Access { permission, object: Object::None, class: Class::Control }))
                .is_ok()
        };
        assert!(may(0, stop) && may(0, read));
        assert!(may(1, stop) && !may(1, read));
        assert!(may(30, stop) && !may(31, stop));
    }

    #[test]
    fn revoked_tokens_are_left_out_and_so_are_keys_whose_certificates_are_over() {
        let record = |id: &str, revoked| TokenRecord {
            token_id: TokenId::new(id).expect("an id"),
            name: "anna".to_owned(),
            person: None,
            digest: Digest([7; 32]),
            grants: vec!["viewer".to_owned().into()],
            created_unix_ms: 0,
            created_by: "bert".to_owned(),
            expires_unix_ms: DAY_MS,
            revoked,
            rotation: None,
        };
        let tokens = [record("t1", None), record("t2", Some(crate::identity::Act::new("bert", 5)))];
        let denied = vec![
            Deny { key: Digest([1; 32]), until_unix_ms: DAY_MS },
            Deny { key: Digest([2; 32]), until_unix_ms: 3 * DAY_MS },
        ];
        let robot = RobotIdentity { denied, ..RobotIdentity::new(crate::ids::RobotId::parse("r7").expect("an id")) };
        let directory = Directory::from_rows(&tokens, [&robot], Utc(2 * DAY_MS));
        assert_eq!(directory.tokens.keys().map(TokenId::as_str).collect::<Vec<_>>(), ["t1"]);
        assert!(directory.denies(&Digest([2; 32])) && !directory.denies(&Digest([1; 32])));
        let text = serde_json::to_string(&directory).expect("text");
        assert_eq!(serde_json::from_str::<Directory>(&text).expect("a directory"), directory);
    }

    #[test]
    fn a_token_that_was_rotated_is_good_until_its_moment_and_then_at_most_stops_where_nobody_hears_that_it_went() {
        let (id, directory) = directory();
        let record = TokenRecord {
            token_id: id.clone(),
            name: "anna".to_owned(),
            person: Some("anna".into()),
            digest: Digest([7; 32]),
            grants: directory.tokens[&id].grants.to_vec(),
            created_unix_ms: 0,
            created_by: "bert".to_owned(),
            expires_unix_ms: DAY_MS,
            revoked: Some(crate::identity::Act::new("bert", 1_000)),
            rotation: None,
        };
        assert!(record.stands(Utc(999)) && !record.stands(Utc(1_000)));
        let told = Directory::from_rows([&record], [], Utc(0));
        let at = |ms: i64| told.holder(&id, &Digest([7; 32]), Utc(ms)).expect("known").is_expired();
        assert!(!at(999) && at(1_000));
        assert_eq!(told.holder(&id, &Digest([7; 32]), Utc(0)).expect("known").person(), "anna");
        assert!(Directory::from_rows([&record], [], Utc(1_000)).tokens.is_empty(), "whoever hears it knows it no more");
    }

    #[test]
    fn what_a_newer_version_says_of_a_token_is_passed_over() {
        let (id, directory) = directory();
        let mut text = serde_json::to_value(&directory).expect("JSON");
        text["tokens"][id.as_str()]["more"] = "new".into();
        text["more"] = "new".into();
        assert_eq!(serde_json::from_value::<Directory>(text).expect("a directory"), directory);
    }
}
