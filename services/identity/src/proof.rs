//! What this server process proves itself with: a key of its own in a file, and a certificate that it asks of whoever has the site's authority, through the rows.
//!
//! Invariant: the key never leaves its file. A process that shares the store with others is one of the site's servers: who may write there may ask for a
//! certificate, so the store is as private as the authority (docs/security.md).

use crate::certificate_authority::read_signing_request;
use crate::register::{Register, written};
use crate::{Error, files};
use midshift_core::identity::{Digest, ServerCertificate, ServerProof};
use midshift_core::limits;
use midshift_core::time::Utc;
use rcgen::{CertificateParams, KeyPair};
use std::path::Path;

const KEY_FILE: &str = "server.key";

/// Writes certificates and key as one file into `folder`, for its owner alone, whole or not at all. Whether it was
/// another one before.
///
/// # Errors
/// The disk.
pub fn write_proof(proof: &ServerProof, folder: &Path, name: &str) -> Result<bool, Error> {
    let text = format!("{}{}", proof.chain_pem, proof.key_pem);
    if files::read(folder, name)?.as_ref() == Some(&text) {
        return Ok(false);
    }
    files::write(folder, name, &text, files::PRIVATE)?;
    Ok(true)
}

/// The key of this process, and what it asks to be called.
pub struct OwnKey {
    key: KeyPair,
    names: Vec<String>,
    digest: Digest,
    request_pem: String,
}

impl OwnKey {
    /// The one in `folder`, made if it is not there.
    ///
    /// # Errors
    /// The folder cannot be used, or a name is none.
    pub fn open(folder: &Path, names: Vec<String>) -> Result<Self, Error> {
        let key = match files::read(folder, KEY_FILE)? {
            Some(text) => {
                let unreadable = |source| Error::Unreadable { path: folder.join(KEY_FILE), source };
                KeyPair::from_pem(&text).map_err(unreadable)?
            }
            None => {
                let key = KeyPair::generate().map_err(Error::Signing)?;
                files::write(folder, KEY_FILE, &key.serialize_pem(), files::PRIVATE)?;
                key
            }
        };
        let params = CertificateParams::new(names.as_slice()).map_err(|source| Error::Names { source })?;
        let request_pem = params.serialize_request(&key).and_then(|r| r.pem()).map_err(Error::Signing)?;
        let digest = read_signing_request(&request_pem).map_err(Error::Refused)?.key;
        Ok(Self { key, names, digest, request_pem })
    }

    /// What the rows answered; none: nothing yet.
    ///
    /// # Errors
    /// The store does not answer.
    pub async fn proof(&self, register: &Register) -> Result<Option<ServerProof>, Error> {
        let found = register.ask(|view| {
            let (row, _) = view.servers.get(&self.digest.to_string())?;
            let (authority, _) = view.authority.as_ref()?;
            Some((row.chain_pem.clone()?, authority.certificate_pem.clone()))
        });
        let found = found.await.map_err(Error::Store)?;
        let key_pem = self.key.serialize_pem();
        Ok(found.map(|(chain_pem, authority_pem)| ServerProof { chain_pem, key_pem, authority_pem }))
    }

    /// Asks for a certificate, if it has none under its names or the one it has is past half of its life.
    ///
    /// # Errors
    /// The store does not answer.
    pub async fn ask(&self, register: &Register, now: Utc) -> Result<(), Error> {
        let asked = register.decide(|view| {
            let (row, at) =
                view.servers.get(&self.digest.to_string()).map_or((None, None), |(row, at)| (Some(row), Some(*at)));
            let half = limits::SERVER_CERTIFICATE_VALID.as_ms().cast_signed() / 2;
            let is_good = |row: &&ServerCertificate| {
                row.names == self.names && (row.chain_pem.is_none() || row.expires_unix_ms - half > now.0)
            };
            if row.filter(is_good).is_some() {
                return Ok((None, ()));
            }
            let wanted = ServerCertificate {
                key: self.digest,
                names: self.names.clone(),
                request_pem: self.request_pem.clone(),
                // An old certificate serves until there is a new one.
                chain_pem: None,
                expires_unix_ms: 0,
            };
            Ok((Some(written(&wanted, at, "midshift", "server.asked")), ()))
        });
        asked.await.map_err(Error::Refused)
    }
}
