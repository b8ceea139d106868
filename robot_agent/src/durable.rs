//! Files and folders that stay when the power goes.
//!
//! Standard library only: the launcher uses it too. Invariant: when a verb returned, what it wrote and the name it has are on the disk; bytes
//! are synced by the handle that wrote them, so that an error of the disk is told to whoever wrote.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

/// Puts a small file in place of another, whole or not at all: a new file beside it, synced, renamed, and its folder synced.
///
/// # Errors
/// If it could not be written: the old one or this is there.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let beside = path.with_extension("new");
    write(&beside, bytes)?;
    fs::rename(&beside, path)?;
    sync_folder_of(path)
}

/// Writes the bytes of a file. Its name is durable once its folder is synced.
///
/// # Errors
/// If they could not be written: some of them are there, or none.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Makes names in the folder of `path` durable.
///
/// # Errors
/// If the folder cannot be synced.
pub fn sync_folder_of(path: &Path) -> io::Result<()> {
    sync_folder(folder_of(path))
}

/// Makes the names in a folder durable.
///
/// # Errors
/// If it cannot be synced.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Makes a folder that is not there, and those above it. Of two who make it at once both succeed.
///
/// # Errors
/// If it cannot be made or synced: some of those above it are there.
pub fn make_folder(folder: &Path) -> io::Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    let above = folder_of(folder);
    if above != folder {
        make_folder(above)?;
    }
    match fs::create_dir(folder) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists || !folder.is_dir() => Err(error),
        _ => sync_folder(above),
    }
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_made_with_those_above_it_and_one_that_is_there_is_left_alone() {
        let place = tempfile::tempdir().expect("a folder");
        let folder = place.path().join("a/b/c");
        for _ in 0..2 {
            make_folder(&folder).expect("makes");
            fs::write(folder.join("file"), "1").expect("writes");
        }
        assert!(make_folder(&folder.join("file/d")).is_err(), "a file is no folder");
        assert!(make_folder(&folder.join("file")).is_err());
        make_folder(Path::new(".")).expect("is there");
    }

    #[test]
    fn a_file_is_replaced_whole() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("record");
        for text in ["a longer text", "short"] {
            replace(&path, text.as_bytes()).expect("writes");
            assert_eq!(fs::read_to_string(&path).expect("reads"), text);
        }
        assert_eq!(fs::read_dir(place.path()).expect("is there").count(), 1);
    }
}
