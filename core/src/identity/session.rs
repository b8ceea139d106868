//! The secret of a robot's session: whoever has it may say that it is the one that had that session.
//!
//! Invariant: its Debug says nothing, so that no log of whatever holds it has it; whoever needs its text asks for it by name.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// The secret of a Welcome; as JSON its text.
#[derive(Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub struct SessionSecret(Arc<str>);

impl SessionSecret {
    /// The text, for the wire.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl From<String> for SessionSecret {
    fn from(text: String) -> Self {
        Self(text.into())
    }
}
impl From<&str> for SessionSecret {
    fn from(text: &str) -> Self {
        Self(text.into())
    }
}
impl From<SessionSecret> for String {
    fn from(secret: SessionSecret) -> Self {
        secret.reveal().to_owned()
    }
}
impl fmt::Debug for SessionSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SessionSecret(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_session_secret_is_its_text_in_a_row_and_nothing_in_a_log() {
        let secret = SessionSecret::from("s3cret");
        assert_eq!(serde_json::to_string(&secret).expect("JSON"), "\"s3cret\"");
        assert_eq!(serde_json::from_str::<SessionSecret>("\"s3cret\"").expect("its text"), secret);
        assert!(!format!("{secret:?} {:#?}", Some(&secret)).contains("s3cret"));
    }
}
