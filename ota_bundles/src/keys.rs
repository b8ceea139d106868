//! Keys of release people and of the rollout service: ed25519, kept as PKCS#8 PEM, so that other tools can make and read them.
//!
//! Written is version 1, RFC 5208, which has the secret alone: OpenSSL, Node and Python read no other. Version 2, which has the public key beside
//! it, is read too. Invariant: a secret key is never shown, logged or sent; its file is readable by its owner only.

use crate::digest::Digest;
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{DecodePrivateKey, DecodePublicKey, EncodePrivateKey, EncodePublicKey, KeypairBytes};
use ed25519_dalek::{Signer, SigningKey, VerifyingKey};
use serde_json::json;
use std::fmt;
use std::fs;
use std::io;
use std::ops::Deref;
use std::path::{Path, PathBuf};

/// A key file that is none, or could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file.
    #[error("{doing} {path}: {source}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// With which file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Its content.
    #[error("{path} holds no ed25519 key in PEM")]
    NoKey {
        /// Which file.
        path: PathBuf,
    },
}

/// Which key: SHA-256 of its public form as TUF writes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
pub struct KeyId(pub Digest);

impl fmt::Display for KeyId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// A key that others can check with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PublicKey(VerifyingKey);

/// A key that signs.
pub struct SecretKey(SigningKey);

impl fmt::Debug for SecretKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SecretKey({})", self.public().id())
    }
}

impl PublicKey {
    /// The key as TUF writes it.
    pub fn tuf(&self) -> serde_json::Value {
        json!({"keytype": "ed25519", "scheme": "ed25519", "keyval": {"public": hex(self.0.as_bytes())}})
    }
    /// From what [`PublicKey::tuf`] wrote, and nothing beside it.
    pub fn from_tuf(value: &serde_json::Value) -> Option<Self> {
        let text = value.get("keyval")?.get("public")?.as_str()?;
        Self::from_hex(text).filter(|key| key.tuf() == *value)
    }
    /// Its 32 bytes as 64 lower-case hexadecimal digits.
    pub fn hex(&self) -> String {
        hex(self.0.as_bytes())
    }
    /// From what [`PublicKey::hex`] wrote.
    pub fn from_hex(text: &str) -> Option<Self> {
        let digits: Option<Vec<u8>> = text.chars().map(|c| c.to_digit(16).map(|d| d as u8)).collect();
        let bytes: Vec<u8> =
            digits?.chunks(2).map(|pair| pair.iter().fold(0, |byte, digit| byte << 4 | digit)).collect();
        Self::from_bytes(&bytes).filter(|key| key.hex() == text)
    }
    /// Its id. The members are in canonical order: sorted, with no spaces.
    pub fn id(&self) -> KeyId {
        let public = hex(self.0.as_bytes());
        let canonical = format!(r#"{{"keytype":"ed25519","keyval":{{"public":"{public}"}},"scheme":"ed25519"}}"#);
        KeyId(Digest::of_content(canonical.as_bytes()))
    }
    /// From its 32 bytes.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        VerifyingKey::from_bytes(bytes.try_into().ok()?).ok().map(Self)
    }
    /// Its 32 bytes.
    pub fn bytes(&self) -> [u8; 32] {
        self.0.to_bytes()
    }
    /// Whether this key signed these bytes. Strict: a signature has one form.
    pub fn verifies(&self, message: &[u8], signature: &[u8]) -> bool {
        ed25519_dalek::Signature::from_slice(signature).is_ok_and(|s| self.0.verify_strict(message, &s).is_ok())
    }
    /// Reads a PEM file.
    ///
    /// # Errors
    /// If it cannot be read or is none.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let text = read(path)?;
        VerifyingKey::from_public_key_pem(&text).map(Self).map_err(|_| Error::NoKey { path: path.to_owned() })
    }
    /// Writes a new PEM file.
    ///
    /// # Errors
    /// If it is there already or cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let text = self.0.to_public_key_pem(LineEnding::LF).map_err(|_| Error::NoKey { path: path.to_owned() })?;
        write(path, text.as_bytes(), 0o644)
    }
}

impl SecretKey {
    /// A new key from the system's randomness.
    pub fn draw() -> Self {
        Self(SigningKey::from_bytes(&rand::random()))
    }
    /// A key that is always the same, for tests and throw-away samples.
    pub fn of_seed(seed: [u8; 32]) -> Self {
        Self(SigningKey::from_bytes(&seed))
    }
    /// What others check with.
    pub fn public(&self) -> PublicKey {
        PublicKey(self.0.verifying_key())
    }
    /// The 64 bytes of a signature.
    pub fn sign(&self, message: &[u8]) -> [u8; 64] {
        self.0.sign(message).to_bytes()
    }
    /// As PEM of version 1, for whoever keeps it where nobody else reads.
    pub fn to_pem(&self) -> String {
        String::clone(&self.pem())
    }
    fn pem(&self) -> impl Deref<Target = String> {
        let alone = KeypairBytes { secret_key: self.0.to_bytes(), public_key: None };
        alone.to_pkcs8_pem(LineEnding::LF).unwrap_or_else(|e| unreachable!("32 bytes: {e}"))
    }
    /// From what [`SecretKey::to_pem`] or another tool wrote, of either version.
    pub fn from_pem(text: &str) -> Option<Self> {
        SigningKey::from_pkcs8_pem(text).ok().map(Self)
    }
    /// Reads a PEM file.
    ///
    /// # Errors
    /// If it cannot be read or is none.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let text = read(path)?;
        SigningKey::from_pkcs8_pem(&text).map(Self).map_err(|_| Error::NoKey { path: path.to_owned() })
    }
    /// Writes a new PEM file that only its owner can read.
    ///
    /// # Errors
    /// If it is there already or cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        write(path, self.pem().as_bytes(), 0o600)
    }
}

/// Lower-case hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn read(path: &Path) -> Result<String, Error> {
    fs::read_to_string(path).map_err(|source| Error::Io { doing: "reading", path: path.to_owned(), source })
}

fn write(path: &Path, bytes: &[u8], mode: u32) -> Result<(), Error> {
    let io = |source| Error::Io { doing: "writing", path: path.to_owned(), source };
    midshift_durable::create(path, bytes, mode).map_err(io)
}
