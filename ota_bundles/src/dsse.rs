//! Envelopes that carry a signed payload: DSSE with ed25519.
//!
//! Invariant: what is checked are exactly the bytes that are read; nobody encodes a payload again to check it. Called by [`crate::directive`]
//! and [`crate::installed`].

use crate::keys::{KeyId, PublicKey, SecretKey};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};

/// Signatures of one envelope.
const SIGNATURES_MAX: usize = 8;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
struct Envelope {
    payload_type: String,
    payload: String,
    signatures: Vec<EnvelopeSignature>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct EnvelopeSignature {
    keyid: String,
    sig: String,
}

/// What cannot be read as an envelope.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Unreadable {
    TooLong,
    Malformed,
    OtherType,
}

/// An envelope that nobody has checked yet.
pub(crate) struct Opened {
    /// Not to be believed before [`Opened::is_signed_by`].
    pub(crate) payload: Vec<u8>,
    signed: Vec<u8>,
    signatures: Vec<(KeyId, Vec<u8>)>,
}

/// What is signed of a payload: DSSE's pre-authentication encoding.
fn encoding(payload_type: &str, payload: &[u8]) -> Vec<u8> {
    let mut bytes = format!("DSSEv1 {} {payload_type} {} ", payload_type.len(), payload.len()).into_bytes();
    bytes.extend_from_slice(payload);
    bytes
}

/// The envelope of a payload, signed with one key.
pub(crate) fn seal(payload_type: &str, payload: &[u8], key: &SecretKey) -> Vec<u8> {
    let sig = key.sign(&encoding(payload_type, payload));
    let envelope = Envelope {
        payload_type: payload_type.to_owned(),
        payload: STANDARD.encode(payload),
        signatures: vec![EnvelopeSignature { keyid: key.public().id().to_string(), sig: STANDARD.encode(sig) }],
    };
    serde_json::to_vec(&envelope).unwrap_or_else(|e| unreachable!("plain fields: {e}"))
}

/// Reads an envelope of at most `most` bytes with a payload of this type.
pub(crate) fn open(envelope: &[u8], most: usize, payload_type: &str) -> Result<Opened, Unreadable> {
    if envelope.len() > most {
        return Err(Unreadable::TooLong);
    }
    let envelope: Envelope = serde_json::from_slice(envelope).map_err(|_| Unreadable::Malformed)?;
    if envelope.payload_type != payload_type {
        return Err(Unreadable::OtherType);
    }
    let payload = STANDARD.decode(&envelope.payload).map_err(|_| Unreadable::Malformed)?;
    let read = |signature: &EnvelopeSignature| {
        Some((KeyId(signature.keyid.parse().ok()?), STANDARD.decode(&signature.sig).ok()?))
    };
    let signatures = envelope.signatures.iter().take(SIGNATURES_MAX).filter_map(read).collect();
    Ok(Opened { signed: encoding(payload_type, &payload), payload, signatures })
}

impl Opened {
    /// Ids under which there is a signature.
    pub(crate) fn signers(&self) -> impl Iterator<Item = KeyId> {
        self.signatures.iter().map(|(id, _)| *id)
    }
    /// Whether this key signed it.
    pub(crate) fn is_signed_by(&self, key: &PublicKey) -> bool {
        let id = key.id();
        self.signatures.iter().any(|(by, sig)| *by == id && key.verifies(&self.signed, sig))
    }
}
