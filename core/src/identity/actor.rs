//! On whose behalf something is written: a name, the token that was shown, and the person behind it.
//!
//! Invariant: the name is what people read. A name may come again with another token: the token tells two of them apart,
//! and the person tells two people apart.

use super::caller::{Caller, Principal};
use super::token::TokenId;
use std::fmt;
use std::sync::Arc;

/// Who did something: as it is recorded with a decision.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Actor {
    name: Arc<str>,
    token: Option<TokenId>,
    person: Option<Arc<str>>,
}

impl Actor {
    /// A name with the token that was shown under it, where no more was kept.
    pub fn new(name: &str, token: Option<TokenId>) -> Self {
        Self { name: name.into(), token, person: None }
    }
    /// As people read it.
    pub const fn name(&self) -> &Arc<str> {
        &self.name
    }
    /// The token that was shown; none: a robot, a service, or a port without login.
    pub const fn token(&self) -> Option<&TokenId> {
        self.token.as_ref()
    }
    /// The person that the token was made for; none: none was named, and the name stands for itself.
    pub const fn person(&self) -> Option<&Arc<str>> {
        self.person.as_ref()
    }
}

impl fmt::Display for Actor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

impl From<&Caller> for Actor {
    fn from(caller: &Caller) -> Self {
        let token = match caller.principal() {
            Principal::Holder { token, .. } => Some(token.clone()),
            Principal::Nobody | Principal::Local | Principal::Robot(_) => None,
        };
        Self { name: caller.to_string().into(), token, person: caller.named_person().cloned() }
    }
}

impl From<&Self> for Actor {
    fn from(actor: &Self) -> Self {
        actor.clone()
    }
}

macro_rules! from_names {
    ($($text:ty),*) => { $(
        impl From<$text> for Actor {
            fn from(name: $text) -> Self {
                Self { name: Arc::from(name.as_ref() as &str), token: None, person: None }
            }
        }
    )* };
}

from_names!(&str, &String, &Arc<str>);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::RobotId;

    #[test]
    fn a_holder_is_its_name_its_token_and_its_person_and_others_are_a_name_alone() {
        let token = TokenId::new("t1").expect("an id");
        let caller = Caller::holder(token.clone(), "anna-laptop".into(), Arc::default(), false);
        let actor = Actor::from(&caller.with_person(Some("anna".into())));
        assert_eq!((actor.to_string().as_str(), actor.token()), ("anna-laptop", Some(&token)));
        assert_eq!(actor.person().map(|person| &**person), Some("anna"));
        let robot = Caller::robot(RobotId::parse("r7").expect("an id"));
        for (other, name) in [(robot, "robot:r7"), (Caller::local(), "anonymous"), (Caller::nobody(), "nobody")] {
            assert_eq!(Actor::from(&other), Actor::from(name));
        }
    }
}
