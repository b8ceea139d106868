//! The service's own mark on stops and resets: a signature by a key in its folder. By it the service knows a stop of its own again that a robot brings back, and
//! a robot believes a reset that comes by another way than its stop line.
//!
//! Invariant: what is signed is the stop as it is written on the wire, without its proof. The key never leaves the folder and is no credential of anybody.

use crate::audit;
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{DecodePrivateKey, EncodePrivateKey, KeypairBytes};
use ed25519_dalek::{Signature, Signer, SigningKey};
use midshift_core::limits;
use midshift_core::stop::{Reset, Stop};
use midshift_core::time::Utc;
use midshift_proto::convert::stop::signed_reset;
use midshift_proto::stop::v1;
use prost::Message;
use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

const DOMAIN: &[u8] = b"midshift stop 1\0";
/// Its name in the folder.
pub const NAME: &str = "key.pem";

/// The key.
pub struct Key(SigningKey);

/// How it is in a folder.
pub enum Found {
    /// It is there.
    There(Box<Key>),
    /// It is there and cannot be read.
    Torn,
    /// It is not there.
    Gone,
}

impl Key {
    /// Reads the key of a folder. Changes nothing. One that others may read is refused: whoever has it can mark resets.
    pub fn read(folder: &Path) -> io::Result<Found> {
        let path = folder.join(NAME);
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Found::Gone),
            Err(error) => return Err(error),
        };
        let key = std::str::from_utf8(&bytes).ok().and_then(|text| SigningKey::from_pkcs8_pem(text).ok());
        let Some(key) = key else { return Ok(Found::Torn) };
        let mode = fs::metadata(&path)?.permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            return Err(io::Error::other(format!(
                "the key is open to others (mode {mode:03o}): type `chmod go= {}`, after asking who may have read it",
                path.display()
            )));
        }
        Ok(Found::There(Box::new(Self(key))))
    }

    /// A new one, of which the disk knows nothing yet.
    pub fn draw() -> Self {
        Self(SigningKey::from_bytes(&rand::random()))
    }

    /// Writes it into the folder; one that is there, and is another, is moved aside.
    pub fn write_into(&self, folder: &Path, now: Utc) -> io::Result<()> {
        let path = folder.join(NAME);
        if path.try_exists()? {
            audit::set_aside(&path, now)?;
        }
        // Without the public half, so that other tools read it as well.
        let alone = KeypairBytes { secret_key: self.0.to_bytes(), public_key: None };
        let text = alone.to_pkcs8_pem(LineEnding::LF).map_err(io::Error::other)?;
        midshift_durable::replace_with(&path, text.as_bytes(), midshift_durable::PRIVATE)
    }

    /// Puts the mark on a stop.
    pub fn mark(&self, stop: &mut Stop) {
        stop.proof = self.0.sign(&signed_bytes(stop)).to_bytes().to_vec();
    }

    /// Puts the mark on a reset.
    pub fn mark_reset(&self, reset: &mut Reset) {
        reset.proof = self.0.sign(&signed_reset(reset)).to_bytes().to_vec();
    }

    /// Its public half, by which robots know a marked reset.
    pub fn public(&self) -> [u8; limits::STOP_KEY_BYTES] {
        self.0.verifying_key().to_bytes()
    }

    /// Whether this stop, as it is, was marked with this key.
    pub fn knows(&self, stop: &Stop) -> bool {
        let Ok(signature) = Signature::from_slice(&stop.proof) else { return false };
        self.0.verifying_key().verify_strict(&signed_bytes(stop), &signature).is_ok()
    }
}

/// The bytes of a stop that are signed: all of it but the proof.
fn signed_bytes(stop: &Stop) -> Vec<u8> {
    let wire = v1::Stop { proof: Vec::new(), ..stop.into() };
    let mut bytes = DOMAIN.to_vec();
    bytes.extend(wire.encode_to_vec());
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::StopId;
    use midshift_core::robot::StopLevel;
    use midshift_core::stop::{Region, Scope};

    fn stop() -> Stop {
        Stop {
            actor: "anna".to_owned(),
            reason: "drill".to_owned(),
            region: Some(Region::of_box(1, 2, 3, 4)),
            ..Stop::new(StopId::parse("STOP-1").unwrap(), Scope::Fleet, StopLevel::Halt, Utc(1))
        }
    }

    fn kept(folder: &Path) -> Key {
        assert!(matches!(Key::read(folder).unwrap(), Found::Gone));
        let key = Key::draw();
        key.write_into(folder, Utc(0)).unwrap();
        key
    }

    #[test]
    fn a_stop_is_known_again_over_the_wire_and_not_when_anything_of_it_changed() {
        let folder = tempfile::tempdir().unwrap();
        let key = kept(folder.path());
        let mut marked = stop();
        key.mark(&mut marked);
        let back: Stop = midshift_proto::parse(v1::Stop::from(&marked)).unwrap();
        let Found::There(key) = Key::read(folder.path()).unwrap() else { panic!("it is there") };
        assert!(key.knows(&back));
        for changed in [
            Stop { level: StopLevel::Slow, ..back.clone() },
            Stop { engaged_unix_ms: Utc(2), ..back.clone() },
            Stop { region: None, ..back.clone() },
            Stop { proof: vec![0; 64], ..back.clone() },
            Stop { proof: Vec::new(), ..back.clone() },
        ] {
            assert!(!key.knows(&changed), "{changed:?}");
        }
        let other = tempfile::tempdir().unwrap();
        assert!(!kept(other.path()).knows(&back), "another service's");
    }

    #[test]
    fn a_marked_reset_is_believed_by_the_public_key_over_the_wire() {
        let folder = tempfile::tempdir().unwrap();
        let key = kept(folder.path());
        let (actor, reason) = ("bert".to_owned(), "clear".to_owned());
        let mut reset = Reset { actor, reason, ..Reset::new(stop().stop_id, Utc(2)) };
        key.mark_reset(&mut reset);
        let back: Reset = midshift_proto::parse(v1::Reset::from(&reset)).unwrap();
        let public = ed25519_dalek::VerifyingKey::from_bytes(&key.public()).unwrap();
        let knows = |reset: &Reset| {
            let mark = Signature::from_slice(&reset.proof).unwrap();
            public.verify_strict(&signed_reset(reset), &mark).is_ok()
        };
        assert!(knows(&back));
        assert!(!knows(&Reset { reset_unix_ms: Utc(3), ..back }));
    }

    #[test]
    fn a_key_is_kept_without_its_public_half_and_read_with_it_too() {
        let folder = tempfile::tempdir().unwrap();
        let key = kept(folder.path());
        let path = folder.path().join(NAME);
        let text = fs::read_to_string(&path).unwrap();
        assert!(KeypairBytes::from_pkcs8_pem(&text).unwrap().public_key.is_none());
        let both = key.0.to_pkcs8_pem(LineEnding::LF).unwrap();
        assert_ne!(*both, text);
        fs::write(&path, both.as_bytes()).unwrap();
        let Found::There(older) = Key::read(folder.path()).unwrap() else { panic!("it is there") };
        assert_eq!(older.public(), key.public());
    }

    #[test]
    fn a_key_that_others_may_read_is_refused_with_what_to_type() {
        let folder = tempfile::tempdir().unwrap();
        kept(folder.path());
        fs::set_permissions(folder.path().join(NAME), fs::Permissions::from_mode(0o640)).unwrap();
        let Err(refused) = Key::read(folder.path()) else { panic!("it was read") };
        assert!(refused.to_string().contains("(mode 640): type `chmod go= "), "{refused}");
    }

    #[test]
    fn a_key_that_cannot_be_read_is_moved_aside_and_kept() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(NAME), "no key").unwrap();
        assert!(matches!(Key::read(folder.path()).unwrap(), Found::Torn));
        Key::draw().write_into(folder.path(), Utc(7)).unwrap();
        assert!(matches!(Key::read(folder.path()).unwrap(), Found::There(_)));
        assert_eq!(fs::read_to_string(folder.path().join("key.pem.broken-7")).unwrap(), "no key");
    }
}
