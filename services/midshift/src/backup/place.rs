//! Folders that are whole or not there.
//!
//! Invariant: a folder gets its name when all of it is durable; until then it is under a name of its own beside it, and goes when it is dropped.

use super::blocking;
use anyhow::{Context, ensure};
use std::fs::{self, File};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// A folder under a name of its own until it is whole.
pub(super) struct Place(tempfile::TempDir);

impl Place {
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
        blocking(move || {
            fs::rename(&from, &to).with_context(|| format!("naming {}", to.display()))?;
            let beside = to.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
            File::open(beside)?.sync_all().with_context(|| format!("syncing {}", beside.display()))
        })
        .await?;
        // Its old name is nobody's now.
        let _ = self.0.keep();
        Ok(())
    }
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
            File::open(&path)?.sync_all().with_context(|| format!("syncing {}", path.display()))?;
        }
    }
    File::open(folder)?.sync_all().with_context(|| format!("syncing {}", folder.display()))
}
