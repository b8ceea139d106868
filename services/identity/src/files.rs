//! Small files that others must not read: written whole or not at all, durable when it returns.
//!
//! Invariant: a key is never in a file that anybody but its owner may read, not even for a moment.

use crate::error::Error;
use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

pub use midshift_core::identity::FOLDER;

/// Owner alone.
pub const PRIVATE: u32 = midshift_durable::PRIVATE;
/// Everybody reads.
pub const PUBLIC: u32 = 0o644;
/// What nobody but the owner may have of a file with keys.
const OTHERS: u32 = 0o077;

/// Makes the folder for its owner alone; see [`midshift_durable::make_private_folder`].
///
/// # Errors
/// It cannot be made or looked at, or others may look into it.
pub fn make_folder(folder: &Path) -> Result<(), Error> {
    midshift_durable::make_private_folder(folder).map_err(|source| Error::Folder { path: folder.to_owned(), source })
}

/// The text of a file of its owner's alone; none if there is none. One that others may read is refused, in whatever folder it lies.
pub fn read(folder: &Path, name: &str) -> Result<Option<String>, Error> {
    let path = folder.join(name);
    let read = || -> io::Result<(u32, String)> {
        let mut file = File::open(&path)?;
        let mode = file.metadata()?.permissions().mode() & 0o777;
        let mut text = String::new();
        file.read_to_string(&mut text)?;
        Ok((mode, text))
    };
    match read() {
        Ok((mode, _)) if mode & OTHERS != 0 => Err(Error::Open { path, mode }),
        Ok((_, text)) => Ok(Some(text)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(Error::Folder { path, source }),
    }
}

/// Writes a file under its name once it is whole and durable.
pub fn write(folder: &Path, name: &str, text: &str, mode: u32) -> Result<(), Error> {
    let path = folder.join(name);
    midshift_durable::replace_with(&path, text.as_bytes(), mode).map_err(|source| Error::Folder { path, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::Permissions;

    #[test]
    fn a_key_file_that_others_may_read_is_refused_by_its_name_though_its_folder_is_closed() {
        let dir = tempfile::tempdir().expect("a folder");
        write(dir.path(), "server.key", "hush", PRIVATE).expect("written");
        assert_eq!(read(dir.path(), "server.key").expect("its owner's alone").as_deref(), Some("hush"));
        assert_eq!(read(dir.path(), "other.key").expect("none"), None);
        for mode in [0o640, 0o604, 0o660] {
            let path = dir.path().join("server.key");
            std::fs::set_permissions(&path, Permissions::from_mode(mode)).expect("open");
            let refused = read(dir.path(), "server.key").expect_err("others may read it").to_string();
            assert!(refused.contains(&format!("(mode {mode:03o})")) && refused.contains("chmod go= "), "{refused}");
            assert!(refused.contains("server.key") && !refused.contains("hush"), "{refused}");
        }
    }
}
