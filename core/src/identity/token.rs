//! Secrets as text, and what is kept of them.
//!
//! Invariant: a secret has no Debug, no serde and no Clone; whoever needs its text asks for it by name.

use serde::{Deserialize, Serialize};
use std::fmt::{self, Write};
use std::str::FromStr;
use std::sync::Arc;

/// Bytes of a secret: it cannot be guessed, so a plain SHA-256 of it is kept.
const SECRET_BYTES: usize = 32;
/// Characters of a token's id at most.
const ID_MAX: usize = 32;

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(bytes.len() * 2), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn unhex(text: &str) -> Option<[u8; 32]> {
    let text = text.as_bytes();
    if text.len() != 64 {
        return None;
    }
    let digit = |c: u8| match c {
        b'0'..=b'9' => Some(c - b'0'),
        b'a'..=b'f' => Some(c - b'a' + 10),
        _ => None,
    };
    let mut bytes = [0; 32];
    for (byte, pair) in bytes.iter_mut().zip(text.chunks_exact(2)) {
        *byte = digit(pair[0])? << 4 | digit(pair[1])?;
    }
    Some(bytes)
}

/// A SHA-256, of a secret or of a public key.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Digest(pub [u8; 32]);

/// A digest that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("must be 64 lower-case hexadecimal digits")]
pub struct BadDigest;

impl FromStr for Digest {
    type Err = BadDigest;
    fn from_str(text: &str) -> Result<Self, BadDigest> {
        unhex(text).map(Self).ok_or(BadDigest)
    }
}
impl TryFrom<String> for Digest {
    type Error = BadDigest;
    fn try_from(text: String) -> Result<Self, BadDigest> {
        text.parse()
    }
}
impl From<Digest> for String {
    fn from(digest: Digest) -> Self {
        digest.to_string()
    }
}
impl fmt::Display for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex(&self.0))
    }
}
impl fmt::Debug for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Which token: a public name, fit for logs.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct TokenId(Arc<str>);

impl TokenId {
    /// Of 1-32 lower-case letters and digits; none otherwise.
    pub fn new(text: &str) -> Option<Self> {
        let is_fit = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit();
        let fits = (1..=ID_MAX).contains(&text.len()) && text.chars().all(is_fit);
        fits.then(|| Self(text.into()))
    }
    /// As text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for TokenId {
    type Error = &'static str;
    fn try_from(text: String) -> Result<Self, Self::Error> {
        Self::new(&text).ok_or("must be 1-32 of [a-z0-9]")
    }
}
impl From<TokenId> for String {
    fn from(id: TokenId) -> Self {
        id.0.to_string()
    }
}
impl fmt::Display for TokenId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What somebody shows to be let in: `KIND.ID.SECRET`, e.g. `mst.k3f9a2.5d…`. The first parts are no secret; they say which digest to hold the last one against.
pub struct Secret {
    id: TokenId,
    bytes: [u8; SECRET_BYTES],
}

impl Secret {
    /// Kind of a token of a person or a program.
    pub const TOKEN: &str = "mst";
    /// Kind of a secret that enrols one robot once.
    pub const ENROLMENT: &str = "mse";

    /// Of bytes that were drawn for it.
    pub const fn new(id: TokenId, bytes: [u8; SECRET_BYTES]) -> Self {
        Self { id, bytes }
    }
    /// Reads what was shown; none if it is nothing of this kind.
    pub fn read(kind: &str, text: &str) -> Option<Self> {
        let (id, secret) = text.trim().strip_prefix(kind)?.strip_prefix('.')?.split_once('.')?;
        Some(Self { id: TokenId::new(id)?, bytes: unhex(secret)? })
    }
    /// Which one it claims to be.
    pub const fn id(&self) -> &TokenId {
        &self.id
    }
    /// What is hashed, so that the store keeps nothing that lets anybody in.
    pub const fn bytes(&self) -> &[u8; SECRET_BYTES] {
        &self.bytes
    }
    /// The text, for the one answer that hands it out.
    pub fn reveal(&self, kind: &str) -> String {
        format!("{kind}.{}.{}", self.id, hex(&self.bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_reads_back_from_the_text_that_was_handed_out() {
        let id = TokenId::new("k3f9").expect("an id");
        let text = Secret::new(id.clone(), [0xa7; 32]).reveal(Secret::TOKEN);
        let read = Secret::read(Secret::TOKEN, &text).expect("a secret");
        assert_eq!((read.id(), read.bytes()), (&id, &[0xa7; 32]));
    }

    #[test]
    fn what_is_no_secret_of_the_kind_is_none() {
        let good = Secret::new(TokenId::new("k3f9").expect("an id"), [1; 32]).reveal(Secret::TOKEN);
        let shouted = good.to_uppercase();
        for text in ["", "mst", "mst.", "mst.k3f9", "mst.k3f9.", "mst..00", &good[..good.len() - 1], &shouted] {
            assert!(Secret::read(Secret::TOKEN, text).is_none(), "{text}");
        }
        assert!(Secret::read(Secret::ENROLMENT, &good).is_none(), "of another kind");
    }

    #[test]
    fn a_digest_reads_back_and_only_from_all_of_its_digits() {
        let digest = Digest([0x5a; 32]);
        assert_eq!(digest.to_string().parse(), Ok(digest));
        assert_eq!("5a".parse::<Digest>(), Err(BadDigest));
        assert_eq!("Z".repeat(64).parse::<Digest>(), Err(BadDigest));
    }
}
