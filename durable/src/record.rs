//! A small text that is kept twice, each time with its checksum.
//!
//! Invariant: the second copy counts only where the first is missing or torn, and it is never older than the first: it
//! goes for good before the first is replaced, and is written when that is durable. A file that cannot be read is an
//! error, never one that is not there. Called for what a robot cannot be started without: the switch record and the
//! boot record.

use crate::{OPEN, put_beside, remove, rename, replace, with_ending};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Begins the last line.
const CHECK: &str = "check ";
/// CRC-64/XZ, its bits turned round.
const POLYNOMIAL: u64 = 0xC96C_5795_D787_0F42;

/// One of the two files.
enum Found {
    Whole(String),
    Torn,
    Missing,
}

/// The text of a record; none: it was never written.
///
/// # Errors
/// A file that cannot be read; `InvalidData`: no whole copy is left.
pub fn read(path: &Path) -> io::Result<Option<String>> {
    let first = match read_copy(path)? {
        Found::Whole(text) => return Ok(Some(text)),
        other => other,
    };
    match (first, read_copy(&copy_of(path))?) {
        (_, Found::Whole(text)) => Ok(Some(text)),
        (Found::Missing, Found::Missing) => Ok(None),
        _ => Err(io::Error::new(io::ErrorKind::InvalidData, "the record is damaged, and no whole copy of it is left")),
    }
}

/// Writes a record: `text` is lines, each ended. A copy that cannot be written is no error, since the record holds:
/// [`mend`] writes it.
///
/// # Errors
/// If it could not be written: the old one or this is there. As [`read`]: what is damaged is not written over.
pub fn write(path: &Path, text: &str) -> io::Result<()> {
    // The copy may be the only whole one: it does not go before the first is whole.
    if !matches!(read_copy(path)?, Found::Whole(_))
        && let Some(before) = read(path)?
    {
        replace(path, seal(&before).as_bytes())?;
    }
    let (sealed, copy) = (seal(text), copy_of(path));
    let beside = put_beside(path, sealed.as_bytes(), OPEN)?;
    remove(&copy)?;
    rename(&beside, path)?;
    let _ = replace(&copy, sealed.as_bytes());
    Ok(())
}

/// Makes both files hold what [`read`] gives. Nothing to do if they do.
///
/// # Errors
/// As [`read`]; or one of them cannot be written, and the record holds as it did.
pub fn mend(path: &Path) -> io::Result<()> {
    let Some(text) = read(path)? else { return Ok(()) };
    for file in [path, &copy_of(path)] {
        match read_copy(file)? {
            Found::Whole(found) if found == text => {}
            _ => replace(file, seal(&text).as_bytes())?,
        }
    }
    Ok(())
}

/// The second file of a record.
pub fn copy_of(path: &Path) -> PathBuf {
    with_ending(path, ".copy")
}

/// A text as it stands in both files.
pub fn seal(text: &str) -> String {
    format!("{text}{CHECK}{:016x}\n", check(text.as_bytes()))
}

fn read_copy(path: &Path) -> io::Result<Found> {
    match fs::read(path) {
        Ok(bytes) => Ok(String::from_utf8(bytes).ok().and_then(opened).map_or(Found::Torn, Found::Whole)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Found::Missing),
        Err(error) => Err(error),
    }
}

/// The text of a whole file.
fn opened(mut sealed: String) -> Option<String> {
    let at = sealed.trim_end_matches('\n').rfind('\n').map_or(0, |at| at + 1);
    let is_whole = seal(&sealed[..at]) == sealed;
    sealed.truncate(at);
    is_whole.then_some(sealed)
}

fn check(bytes: &[u8]) -> u64 {
    let bit = |sum: u64, _| (sum >> 1) ^ (POLYNOMIAL & (sum & 1).wrapping_neg());
    !bytes.iter().fold(u64::MAX, |sum, byte| (0..8).fold(sum ^ u64::from(*byte), bit))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tempfile::TempDir;

    const OLD: &str = "number 1\nruns v1\n";
    const NEW: &str = "number 2\nruns v2\n";

    /// A record that was written twice, and its two files.
    fn written() -> (TempDir, PathBuf, PathBuf) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("switch");
        write(&path, OLD).expect("writes");
        write(&path, NEW).expect("writes");
        let copy = copy_of(&path);
        (folder, path, copy)
    }

    #[test]
    fn the_checksum_is_the_known_one() {
        assert_eq!(check(b"123456789"), 0x995d_c9bb_df19_39fa);
        assert_eq!(seal(""), "check 0000000000000000\n");
    }

    #[test]
    fn a_record_is_read_back_and_lies_there_twice() {
        let folder = tempfile::tempdir().expect("a folder");
        assert_eq!(read(&folder.path().join("switch")).expect("reads"), None, "it was never written");
        let (folder, path, copy) = written();
        assert_eq!(read(&path).expect("reads").as_deref(), Some(NEW));
        assert_eq!(fs::read(&path).expect("reads"), fs::read(&copy).expect("reads"));
        assert_eq!(fs::read_dir(folder.path()).expect("is there").count(), 2);
    }

    #[test]
    fn a_record_that_is_missing_or_torn_anywhere_is_read_from_its_copy_and_mended() {
        let (_folder, path, copy) = written();
        let whole = fs::read(&copy).expect("reads");
        for length in 0..whole.len() {
            fs::write(&path, &whole[..length]).expect("writes");
            assert_eq!(read(&path).expect("reads").as_deref(), Some(NEW), "{length} bytes of it");
        }
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x81;
            fs::write(&path, bytes).expect("writes");
            assert_eq!(read(&path).expect("reads").as_deref(), Some(NEW), "byte {at} of it is another");
        }
        fs::remove_file(&path).expect("removes");
        assert_eq!(read(&path).expect("reads").as_deref(), Some(NEW), "it is gone");
        mend(&path).expect("mends");
        assert_eq!(fs::read(&path).expect("reads"), whole);
    }

    #[test]
    fn the_first_one_wins_over_a_copy_that_says_something_else_and_mending_makes_them_agree() {
        let (_folder, path, copy) = written();
        fs::write(&copy, seal(OLD)).expect("writes");
        assert_eq!(read(&path).expect("reads").as_deref(), Some(NEW));
        for torn in [true, false] {
            if torn {
                fs::write(&copy, "number").expect("writes");
            } else {
                fs::remove_file(&copy).expect("removes");
            }
            assert_eq!(read(&path).expect("reads").as_deref(), Some(NEW));
            mend(&path).expect("mends");
            assert_eq!(fs::read(&copy).expect("reads"), seal(NEW).as_bytes());
        }
    }

    #[test]
    fn without_a_whole_copy_a_damaged_record_is_an_error_and_not_a_new_one() {
        let (_folder, path, copy) = written();
        fs::write(&path, "number").expect("writes");
        for text in ["", "number 2\nruns v2\n", "check 0\n"] {
            fs::write(&copy, text).expect("writes");
            assert_eq!(read(&path).expect_err("is damaged").kind(), io::ErrorKind::InvalidData, "{text}");
        }
        fs::remove_file(&copy).expect("removes");
        assert_eq!(read(&path).expect_err("is damaged").kind(), io::ErrorKind::InvalidData);
        assert!(mend(&path).is_err() && write(&path, NEW).is_err());
        fs::remove_file(&path).expect("removes");
        fs::write(&copy, "number").expect("writes");
        assert_eq!(read(&path).expect_err("is damaged").kind(), io::ErrorKind::InvalidData, "something was there");
    }

    #[test]
    fn a_file_that_cannot_be_read_is_an_error_though_the_other_is_whole() {
        let (_folder, path, copy) = written();
        fs::remove_file(&path).expect("removes");
        fs::create_dir(&path).expect("makes");
        assert_eq!(read(&path).expect_err("is a folder").kind(), io::ErrorKind::IsADirectory);
        fs::remove_dir(&path).expect("removes");
        fs::remove_file(&copy).expect("removes");
        fs::create_dir(&copy).expect("makes");
        assert!(read(&path).is_err(), "nobody knows what the copy says");
    }

    #[test]
    fn a_copy_is_never_older_than_its_record_wherever_a_write_ends() {
        let (_folder, path, copy) = written();
        // The new one cannot be put beside: both are as they were.
        fs::create_dir(path.with_extension("new")).expect("makes");
        assert!(write(&path, OLD).is_err());
        assert_eq!(fs::read(&copy).expect("reads"), seal(NEW).as_bytes());
        fs::remove_dir(path.with_extension("new")).expect("removes");
        // The copy cannot be written: the record holds, and no older copy is left.
        fs::create_dir(with_ending(&copy, ".new")).expect("makes");
        write(&path, OLD).expect("writes");
        assert!(!copy.exists());
        assert_eq!(read(&path).expect("reads").as_deref(), Some(OLD));
        fs::remove_dir(with_ending(&copy, ".new")).expect("removes");
        mend(&path).expect("mends");
        assert_eq!(fs::read(&copy).expect("reads"), seal(OLD).as_bytes());
    }
}
