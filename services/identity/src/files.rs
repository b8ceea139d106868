//! Small files that others must not read: written whole or not at all, durable when it returns.
//!
//! Invariant: a key is never in a file that anybody but its owner may read, not even for a moment.

use crate::Error;
use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;

/// Owner alone.
pub const PRIVATE: u32 = 0o600;
/// Everybody reads.
pub const PUBLIC: u32 = 0o644;
/// What nobody but the owner may have of a folder with keys.
const OTHERS: u32 = 0o077;

/// Makes the folder for its owner alone; one that is there and open to others is refused.
pub fn make_folder(folder: &Path) -> Result<(), Error> {
    let at = |source| Error::Folder { path: folder.to_owned(), source };
    DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(at)?;
    let mode = folder.metadata().map_err(at)?.permissions().mode();
    if mode & OTHERS != 0 { Err(Error::Open { path: folder.to_owned(), mode: mode & 0o777 }) } else { Ok(()) }
}

/// The text of a file; none if there is none.
pub fn read(folder: &Path, name: &str) -> Result<Option<String>, Error> {
    let path = folder.join(name);
    match std::fs::read_to_string(&path) {
        Ok(text) => Ok(Some(text)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(Error::Folder { path, source }),
    }
}

/// Writes a file under its name once it is whole and durable.
pub fn write(folder: &Path, name: &str, text: &str, mode: u32) -> Result<(), Error> {
    let (path, new) = (folder.join(name), folder.join(format!(".{name}.new")));
    let written = || {
        match std::fs::remove_file(&new) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let mut file = OpenOptions::new().write(true).create_new(true).mode(mode).open(&new)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&new, &path)?;
        File::open(folder)?.sync_all()
    };
    written().map_err(|source| Error::Folder { path: path.clone(), source })
}
