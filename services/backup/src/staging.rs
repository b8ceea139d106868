//! Folders that are whole or not there.
//!
//! Invariant: a folder gets its name when all of it is durable; until then it is under a name of its own beside it, and goes when it is dropped.
//! Of one whose name may not be durable the name is taken back, or what is there is said.

use super::files::blocking;
use anyhow::{Context, ensure};
use std::fs::{self, File};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// A folder under a name of its own until it is whole.
pub(super) struct Staging(tempfile::TempDir);

impl Staging {
    pub(super) fn new(to: &Path) -> anyhow::Result<Self> {
        ensure!(is_free(to)?, "{} is there already; name a folder that is not there", to.display());
        let beside = to.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::create_dir_all(beside).with_context(|| format!("making {}", beside.display()))?;
        // Rows prove robots' successions: they are for their owner alone.
        let private = fs::Permissions::from_mode(0o700);
        let place = tempfile::Builder::new().prefix(".midshift-").permissions(private).tempdir_in(beside);
        Ok(Self(place.with_context(|| format!("making a folder in {}", beside.display()))?))
    }
    pub(super) fn path(&self) -> &Path {
        self.0.path()
    }
    /// Makes all that is in it durable.
    pub(super) async fn sync(&self) -> anyhow::Result<()> {
        let folder = self.0.path().to_owned();
        blocking(move || sync_tree(&folder)).await
    }
    /// Makes all of it durable and gives it its name.
    pub(super) async fn name(self, to: &Path) -> anyhow::Result<()> {
        self.sync().await?;
        let (from, to) = (self.0.path().to_owned(), to.to_owned());
        blocking(move || name(&from, &to, File::sync_all)).await?;
        // Its old name is nobody's now.
        let _ = self.0.keep();
        Ok(())
    }
}

/// Renames, and makes the new name durable by `sync` of the folder that it is in. Where that fails it has its old name again.
fn name(from: &Path, to: &Path, sync: impl FnOnce(&File) -> std::io::Result<()>) -> anyhow::Result<()> {
    let beside = to.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // What cannot be opened cannot be synced: that is known before anything has its name.
    let folder = File::open(beside).with_context(|| format!("opening {}", beside.display()))?;
    fs::rename(from, to).with_context(|| format!("naming {}", to.display()))?;
    let Err(error) = sync(&folder) else { return Ok(()) };
    let error = anyhow::Error::from(error).context(format!("syncing {}", beside.display()));
    Err(match fs::rename(to, from) {
        Ok(()) => error,
        Err(back) => error.context(format!(
            "{} is there and whole, but it may be gone after a power cut, and its name cannot be taken back ({back}): remove it and try again",
            to.display()
        )),
    })
}

/// Whether nothing is there: also an empty folder may be what cannot be replaced, as where a disk is mounted.
fn is_free(path: &Path) -> anyhow::Result<bool> {
    match fs::symlink_metadata(path) {
        Ok(_) => Ok(false),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(true),
        Err(error) => Err(error).with_context(|| format!("reading {}", path.display())),
    }
}

fn sync_tree(folder: &Path) -> anyhow::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            sync_tree(&path)?;
        } else {
            midshift_durable::sync_file(&path).with_context(|| format!("syncing {}", path.display()))?;
        }
    }
    midshift_durable::sync_folder(folder).with_context(|| format!("syncing {}", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Error, ErrorKind};

    /// A folder with a file in it under a name of its own, and where it goes.
    fn placed(beside: &tempfile::TempDir) -> (Staging, std::path::PathBuf) {
        let to = beside.path().join("backup");
        let place = Staging::new(&to).expect("a folder");
        fs::write(place.path().join("rows"), b"rows").expect("written");
        (place, to)
    }

    fn full() -> std::io::Result<()> {
        Err(Error::from(ErrorKind::StorageFull))
    }

    #[test]
    fn a_folder_whose_name_is_not_durable_is_not_there() {
        let beside = tempfile::tempdir().expect("a folder");
        let (place, to) = placed(&beside);
        let error = name(place.path(), &to, |_| full()).expect_err("it is not durable");
        assert!(format!("{error:#}").starts_with("syncing "), "{error:#}");
        assert!(!to.exists() && place.path().join("rows").is_file(), "it is as it was before");
        drop(place);
        assert_eq!(fs::read_dir(beside.path()).expect("a folder").count(), 0, "nothing is left");
    }

    #[test]
    fn a_folder_whose_name_cannot_be_taken_back_is_said_to_be_there() {
        let beside = tempfile::tempdir().expect("a folder");
        let (place, to) = placed(&beside);
        let old = place.path().join("in the way");
        let error = name(place.path(), &to, |_| fs::create_dir_all(&old).and_then(|()| full()));
        let error = format!("{:#}", error.expect_err("it is not durable"));
        assert!(error.starts_with(&format!("{} is there and whole", to.display())), "{error}");
        assert!(error.contains("remove it and try again") && error.contains("syncing"), "{error}");
        assert_eq!(fs::read(to.join("rows")).expect("it is there"), b"rows");
    }
}
