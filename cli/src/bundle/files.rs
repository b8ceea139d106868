//! Files that release people hand to a command: keys, and what others signed.

use crate::client::Exit;
use crate::out::{Format, Out};
use midshift_bundle::folder::Error;
use midshift_bundle::keys::{PublicKey, SecretKey};
use midshift_core::limits::SIGNED_DOCUMENT_BYTES;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Prints what was done, for programs; people are told in words.
pub fn print_json(what: &serde_json::Value, out: &Out) {
    if matches!(out.format, Format::Json | Format::Jsonl) {
        out.line(&what.to_string());
    }
}

/// Reads secret keys.
pub fn read_keys(paths: &[PathBuf]) -> Result<Vec<SecretKey>, Exit> {
    Ok(paths.iter().map(|path| SecretKey::read(path)).collect::<Result<Vec<_>, _>>().map_err(Error::from)?)
}

/// A key of others by its file, secret or public. A file that is not there becomes a new secret key.
pub fn public_key(path: &Path, out: &Out) -> Result<PublicKey, Exit> {
    if !path.exists() {
        let key = SecretKey::draw();
        key.write(path).map_err(Error::from)?;
        out.inform(&format!("a new key, that only you can read: {}", path.display()));
    }
    let public = || SecretKey::read(path).map(|key| key.public());
    Ok(PublicKey::read(path).or_else(|_| public()).map_err(Error::from)?)
}

/// The bytes of a file, and one more than `most` if it is longer.
pub fn bytes_of(path: &Path, most: usize) -> Result<Vec<u8>, Exit> {
    let mut bytes = Vec::new();
    let read = File::open(path).and_then(|file| file.take(most as u64 + 1).read_to_end(&mut bytes));
    read.map_err(|source| Error::Io { doing: "reading", path: path.to_owned(), source })?;
    Ok(bytes)
}

/// Signed documents and bare signatures that others handed over.
pub fn read_signatures(paths: &[PathBuf]) -> Result<Vec<Vec<u8>>, Exit> {
    let read = |path: &PathBuf| {
        let bytes = bytes_of(path, SIGNED_DOCUMENT_BYTES)?;
        let is_one = bytes.len() <= SIGNED_DOCUMENT_BYTES;
        is_one.then_some(bytes).ok_or_else(|| Exit::usage(format!("{} is too long for a signature", path.display())))
    };
    paths.iter().map(read).collect()
}
