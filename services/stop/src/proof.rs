//! The service's own mark on a stop: a signature by a key in its folder, so that it knows a stop of its own again that a robot brings back.
//!
//! Invariant: what is signed is the stop as it is written on the wire, without its proof. The key never leaves the folder and is no credential of anybody.

use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{DecodePrivateKey, EncodePrivateKey};
use ed25519_dalek::{Signature, Signer, SigningKey};
use midshift_core::stop::Stop;
use midshift_core::time::Utc;
use midshift_proto::stop::v1;
use prost::Message;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

const DOMAIN: &[u8] = b"midshift stop 1\0";
/// Its name in the folder.
pub const NAME: &str = "key.pem";

/// The key.
pub struct Key(SigningKey);

/// How it was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Found {
    /// Made just now.
    Made,
    /// It was there.
    There,
    /// It could not be read, was moved aside, and another one was made.
    Replaced,
}

impl Key {
    /// Reads the key of a folder; makes one if there is none.
    pub fn open(folder: &Path, now: Utc) -> io::Result<(Self, Found)> {
        let path = folder.join(NAME);
        let found = match fs::read_to_string(&path) {
            Ok(text) => match SigningKey::from_pkcs8_pem(&text) {
                Ok(key) => return Ok((Self(key), Found::There)),
                Err(_) => {
                    fs::rename(&path, folder.join(format!("{NAME}.broken-{}", now.0)))?;
                    Found::Replaced
                }
            },
            Err(e) if e.kind() == io::ErrorKind::NotFound => Found::Made,
            Err(e) => return Err(e),
        };
        let key = SigningKey::from_bytes(&rand::random());
        let text = key.to_pkcs8_pem(LineEnding::LF).map_err(io::Error::other)?;
        let part = folder.join(format!("{NAME}.part"));
        let mut file = OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(&part)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&part, &path)?;
        File::open(folder)?.sync_all()?;
        Ok((Self(key), found))
    }

    /// Puts the mark on a stop.
    pub fn mark(&self, stop: &mut Stop) {
        stop.proof = self.0.sign(&told(stop)).to_bytes().to_vec();
    }

    /// Whether this stop, as it is, was marked with this key.
    pub fn knows(&self, stop: &Stop) -> bool {
        let Ok(signature) = Signature::from_slice(&stop.proof) else { return false };
        self.0.verifying_key().verify_strict(&told(stop), &signature).is_ok()
    }
}

fn told(stop: &Stop) -> Vec<u8> {
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
            stop_id: StopId::parse("STOP-1").unwrap(),
            scope: Scope::Fleet,
            level: StopLevel::Halt,
            engaged: Utc(1),
            actor: "anna".to_owned(),
            reason: "drill".to_owned(),
            region: Some(Region::of_box(1, 2, 3, 4)),
            proof: Vec::new(),
        }
    }

    #[test]
    fn a_stop_is_known_again_over_the_wire_and_not_when_anything_of_it_changed() {
        let folder = tempfile::tempdir().unwrap();
        let (key, found) = Key::open(folder.path(), Utc(0)).unwrap();
        assert_eq!(found, Found::Made);
        let mut marked = stop();
        key.mark(&mut marked);
        let back: Stop = midshift_proto::parse(v1::Stop::from(&marked)).unwrap();
        let (key, found) = Key::open(folder.path(), Utc(0)).unwrap();
        assert_eq!((key.knows(&back), found), (true, Found::There));
        for changed in [
            Stop { level: StopLevel::Slow, ..back.clone() },
            Stop { engaged: Utc(2), ..back.clone() },
            Stop { region: None, ..back.clone() },
            Stop { proof: vec![0; 64], ..back.clone() },
            Stop { proof: Vec::new(), ..back.clone() },
        ] {
            assert!(!key.knows(&changed), "{changed:?}");
        }
        let other = tempfile::tempdir().unwrap();
        assert!(!Key::open(other.path(), Utc(0)).unwrap().0.knows(&back), "another service's");
    }

    #[test]
    fn a_key_that_cannot_be_read_is_moved_aside_and_kept() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(NAME), "no key").unwrap();
        assert_eq!(Key::open(folder.path(), Utc(7)).unwrap().1, Found::Replaced);
        assert_eq!(fs::read_to_string(folder.path().join("key.pem.broken-7")).unwrap(), "no key");
    }
}
