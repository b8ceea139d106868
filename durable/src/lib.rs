//! Files and folders that stay when the power goes; [`record`] is for small records that also outlive the loss of one
//! file.
//!
//! Standard library only: the launcher uses it, and nothing that an update replaces is needed to start a robot.
//! Invariant: when a verb returned, what it wrote and the name that it has are on the disk; bytes are synced by the
//! handle that wrote them, so that an error of the disk is told to whoever wrote. Used by everybody who writes a file.
//! Absent on purpose: files that are written a piece at a time (a download, an audit, a latch); they sync their own
//! handle.

pub mod record;

use std::ffi::OsString;
use std::fs::{self, DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// Mode of a file that holds no secret: the process's mask decides.
pub const OPEN: u32 = 0o666;
/// Mode of a file with a secret: its owner reads and writes, nobody else.
pub const PRIVATE: u32 = 0o600;
/// What nobody but the owner may have of a folder with secrets.
const OTHERS: u32 = 0o077;
/// What images and repositories put into a folder that is there for something else.
const PLACEHOLDER: &str = "README";

/// Puts a small file in place of another, whole or not at all: a new file beside it, synced, renamed, and its folder
/// synced.
///
/// # Errors
/// If it could not be written: the old one or this is there.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_with(path, bytes, OPEN)
}

/// As [`replace`], for a file of this mode. Nobody whom the mode keeps out can read it at any moment.
///
/// # Errors
/// If it could not be written: the old one or this is there.
pub fn replace_with(path: &Path, bytes: &[u8], mode: u32) -> io::Result<()> {
    rename(&put_beside(path, bytes, mode)?, path)
}

/// Makes a file of this mode that is not there yet, whole or not at all as far as the process goes on; a power cut may
/// leave half of it.
///
/// # Errors
/// `AlreadyExists`, and what is there stays; or it could not be written, and nothing is there.
pub fn create(path: &Path, bytes: &[u8], mode: u32) -> io::Result<()> {
    let file = create_new(path, mode)?;
    if let Err(error) = fill(file, bytes) {
        // The first error is the one that tells.
        let _ = fs::remove_file(path);
        return Err(error);
    }
    sync_folder_of(path)
}

/// Writes the bytes of a file in a folder that is still being made: its name is durable once that folder is synced.
///
/// # Errors
/// If they could not be written: some of them are there, or none.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    fill(File::create(path)?, bytes)
}

/// Gives a file or a folder that is durable its name, in place of what had it.
///
/// # Errors
/// If it could not be named, or the name may be lost.
pub fn rename(from: &Path, to: &Path) -> io::Result<()> {
    fs::rename(from, to)?;
    sync_folder_of(to)
}

/// Removes a file for good. Whether there was one.
///
/// # Errors
/// If it is there still, or may come back.
pub fn remove(path: &Path) -> io::Result<bool> {
    match fs::remove_file(path) {
        Ok(()) => sync_folder_of(path).map(|()| true),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Makes a file durable that another program or a copy has written.
///
/// # Errors
/// If it cannot be opened or synced.
pub fn sync_file(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
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

/// The text of a file of at most so many bytes.
///
/// # Errors
/// It cannot be read, is larger, or is no text.
pub fn read_text(path: &Path, bytes_max: u64) -> io::Result<String> {
    if fs::metadata(path)?.len() > bytes_max {
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, format!("it is larger than {bytes_max} bytes")));
    }
    fs::read_to_string(path)
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

/// Makes the folder for its owner alone. One that is there and open to others is closed if there is nothing in it yet,
/// as a new volume is, and refused if there is: somebody may have read it.
///
/// # Errors
/// It cannot be made or looked at, or others may look into it: then the error says what to type.
pub fn make_private_folder(folder: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
    let mode = folder.metadata()?.permissions().mode();
    if mode & OTHERS == 0 {
        return Ok(());
    }
    for entry in folder.read_dir()? {
        if entry?.file_name() != PLACEHOLDER {
            let (mode, path) = (mode & 0o777, folder.display());
            return Err(io::Error::new(
                io::ErrorKind::PermissionDenied,
                format!(
                    "it has keys or other secrets and is open to others (mode {mode:03o}): type `chmod go= {path}`, after asking who may have read it"
                ),
            ));
        }
    }
    fs::set_permissions(folder, Permissions::from_mode(0o700))
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes what is to become `path`, durable, beside it. What was left there by a writer that did not come to its end
/// goes.
fn put_beside(path: &Path, bytes: &[u8], mode: u32) -> io::Result<PathBuf> {
    let beside = with_ending(path, ".new");
    let file = match create_new(&beside, mode) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            fs::remove_file(&beside)?;
            create_new(&beside, mode)
        }
        created => created,
    }?;
    fill(file, bytes)?;
    Ok(beside)
}

fn create_new(path: &Path, mode: u32) -> io::Result<File> {
    OpenOptions::new().write(true).create_new(true).mode(mode).open(path)
}

fn fill(mut file: File, bytes: &[u8]) -> io::Result<()> {
    file.write_all(bytes)?;
    file.sync_all()
}

fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(ending);
    PathBuf::from(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    fn mode(path: &Path) -> u32 {
        fs::metadata(path).expect("is there").permissions().mode() & 0o777
    }

    fn count(folder: &Path) -> usize {
        fs::read_dir(folder).expect("is there").count()
    }

    #[test]
    fn a_folder_is_its_owners_alone_and_one_that_others_may_have_read_is_refused_with_what_to_type() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        let mode = |name: &str| at(name).metadata().expect("a folder").permissions().mode() & 0o777;
        make_private_folder(&at("made/below")).expect("made");
        assert_eq!(mode("made/below"), 0o700);
        for name in ["volume", "used"] {
            DirBuilder::new().mode(0o755).create(at(name)).expect("a folder");
            fs::set_permissions(at(name), Permissions::from_mode(0o755)).expect("open");
        }
        fs::write(at("volume/README"), "of the image").expect("written");
        make_private_folder(&at("volume")).expect("nothing of ours was in it yet");
        assert_eq!(mode("volume"), 0o700);
        fs::write(at("used/control.db"), "rows").expect("written");
        let refused = make_private_folder(&at("used")).expect_err("others may look into it").to_string();
        assert!(refused.contains("(mode 755)") && refused.contains(&format!("chmod go= {}", at("used").display())));
        assert_eq!(mode("used"), 0o755, "that is for a person to decide");
    }

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
    fn a_file_is_replaced_whole_and_nothing_is_left_beside_it() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("record.json");
        fs::write(place.path().join("record.json.new"), "half of one that was left behind").expect("writes");
        for text in ["a longer text", "short"] {
            replace(&path, text.as_bytes()).expect("writes");
            assert_eq!(fs::read_to_string(&path).expect("reads"), text);
        }
        assert_eq!(count(place.path()), 1);
    }

    #[test]
    fn a_secret_is_its_owners_alone_also_where_an_open_file_was_left_beside_it() {
        let place = tempfile::tempdir().expect("a folder");
        let (path, left) = (place.path().join("key"), place.path().join("key.new"));
        fs::write(&left, "open to all").expect("writes");
        fs::set_permissions(&left, fs::Permissions::from_mode(0o666)).expect("opens");
        replace_with(&path, b"hush", PRIVATE).expect("writes");
        assert_eq!((fs::read(&path).expect("reads"), mode(&path)), (b"hush".to_vec(), PRIVATE));
    }

    #[test]
    fn a_file_that_cannot_be_written_beside_stays_as_it_was() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("record");
        replace(&path, b"old").expect("writes");
        fs::create_dir(place.path().join("record.new")).expect("makes");
        assert!(replace(&path, b"new").is_err());
        assert_eq!(fs::read(&path).expect("reads"), b"old");
    }

    #[test]
    fn a_file_that_is_there_is_not_created_over() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("key");
        create(&path, b"first", PRIVATE).expect("writes");
        let error = create(&path, b"second", PRIVATE).expect_err("is there");
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
        assert_eq!((fs::read(&path).expect("reads"), mode(&path)), (b"first".to_vec(), PRIVATE));
    }

    #[test]
    fn what_is_removed_is_told_from_what_was_not_there() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("first");
        write(&path, b"1").expect("writes");
        assert!(remove(&path).expect("removes"));
        assert!(!remove(&path).expect("is gone"));
        assert!(remove(place.path()).is_err(), "a folder is no file");
    }

    #[test]
    fn a_folder_gets_its_name() {
        let place = tempfile::tempdir().expect("a folder");
        let (from, to) = (place.path().join("made"), place.path().join("named"));
        make_folder(&from).expect("makes");
        write(&from.join("page"), b"1").expect("writes");
        sync_file(&from.join("page")).expect("syncs");
        rename(&from, &to).expect("names");
        assert_eq!(fs::read(to.join("page")).expect("reads"), b"1");
        assert!(rename(&from, &to).is_err(), "it is gone");
    }
}
