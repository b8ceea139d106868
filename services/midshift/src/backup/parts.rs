//! The registry of everything durable that a server keeps, in the order in which it is copied.

use super::{Places, blocking};
use anyhow::{Context, ensure};
use async_trait::async_trait;
use midshift_bundle::digest::Digest;
use midshift_bundle::repository::listed;
use midshift_core::time::Utc;
use midshift_ota::folder::mark;
use midshift_ota::repository::raise_floor;
use midshift_store::Database;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// All parts. Rows come first: what they name is copied after them and never taken away while a copied row may name it.
pub const PARTS: [&dyn Part; 4] = [&Rows(Database::Control), &Rows(Database::Telemetry), &Releases, &OnlineKeys];

/// A durable thing of a server. `folder` is its own in a backup.
#[async_trait]
pub trait Part: Send + Sync {
    /// Its name, and that of its folder.
    fn name(&self) -> &'static str;
    /// Copies it; false: the server has none.
    async fn copy(&self, from: &Places, folder: &Path) -> anyhow::Result<bool>;
    /// The site that it says it is of.
    async fn site_id(&self, _folder: &Path) -> anyhow::Result<Option<String>> {
        Ok(None)
    }
    /// What is wrong with a copy.
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>>;
    /// Makes it what a server can start from.
    async fn put_back(&self, folder: &Path, to: &Places, now: Utc) -> anyhow::Result<()>;
}

/// One of the two databases.
struct Rows(Database);

impl Rows {
    fn file(&self, folder: &Path) -> PathBuf {
        folder.join(self.0.file())
    }
}

#[async_trait]
impl Part for Rows {
    fn name(&self) -> &'static str {
        match self.0 {
            Database::Control => "control",
            Database::Telemetry => "telemetry",
        }
    }
    async fn copy(&self, from: &Places, folder: &Path) -> anyhow::Result<bool> {
        if !from.data.join(self.0.file()).is_file() {
            return Ok(false);
        }
        fs::create_dir_all(folder)?;
        self.0.copy(&from.data, &self.file(folder)).await?;
        Ok(true)
    }
    async fn site_id(&self, folder: &Path) -> anyhow::Result<Option<String>> {
        Ok(self.0.inspect(&self.file(folder)).await?.0.site_id)
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        Ok(self.0.inspect(&self.file(folder)).await?.1)
    }
    async fn put_back(&self, folder: &Path, to: &Places, _now: Utc) -> anyhow::Result<()> {
        let (from, to_file) = (self.file(folder), self.file(&to.data));
        blocking(move || fs::copy(from, to_file).context("copying")).await?;
        if self.0 == Database::Control {
            midshift_store::renew_identity(&to.data).await?;
        }
        Ok(())
    }
}

/// Signed documents and the files of releases. What is made of them for the way to robots is made again.
struct Releases;

/// Folder of releases in a data directory.
const RELEASES: &str = "ota";
const DOCUMENTS: &str = "metadata";
const FILES: &str = "content";
/// Names the newest of all documents.
const TIMESTAMP: &str = "timestamp.json";
/// A lost server signed at most so many times after the copy, whatever this machine's clock says: it does so twice a day and at each push.
const VERSIONS_AHEAD: u64 = 1_000_000;

#[async_trait]
impl Part for Releases {
    fn name(&self) -> &'static str {
        RELEASES
    }
    async fn copy(&self, from: &Places, folder: &Path) -> anyhow::Result<bool> {
        let (from, folder) = (from.data.join(RELEASES), folder.to_owned());
        blocking(move || {
            if !from.is_dir() {
                return Ok(false);
            }
            let (documents, files) = (folder.join(DOCUMENTS), folder.join(FILES));
            fs::create_dir_all(&documents)?;
            fs::create_dir_all(&files)?;
            // The timestamp first: whatever is published meanwhile, what this one leads to is kept.
            copy_if_there(&from.join(DOCUMENTS).join(TIMESTAMP), &documents.join(TIMESTAMP))?;
            for path in entries(&from.join(DOCUMENTS))? {
                let name = path.file_name().unwrap_or_default();
                if name != TIMESTAMP && path.extension().is_some_and(|e| e == "json") {
                    copy_if_there(&path, &documents.join(name))?;
                }
            }
            for path in entries(&from.join(FILES))? {
                // What is not whole yet has another name, and is brought again.
                if let Some(digest) = digest_of(&path) {
                    copy_if_there(&path, &files.join(digest.to_string()))?;
                }
            }
            Ok(true)
        })
        .await
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        let folder = folder.to_owned();
        blocking(move || {
            let mut wrong = Vec::new();
            for path in entries(&folder.join(FILES))? {
                let Some(named) = digest_of(&path) else {
                    wrong.push(format!("{} is no file of a release", path.display()));
                    continue;
                };
                let (found, _) = Digest::of_reader(&mut File::open(&path)?, u64::MAX)?;
                if found != named {
                    wrong.push(format!("file {named} has other bytes"));
                }
            }
            if let Some(targets) = newest_targets(&folder.join(DOCUMENTS))? {
                let absent = |digest: &Digest| !folder.join(FILES).join(digest.to_string()).is_file();
                let missing = listed(&targets)?.into_iter().filter(|file| absent(&file.digest));
                wrong.extend(missing.map(|file| format!("{} is listed and not there", file.name)));
            }
            Ok(wrong)
        })
        .await
    }
    async fn put_back(&self, folder: &Path, to: &Places, now: Utc) -> anyhow::Result<()> {
        // The rows were put back before it, under an id of their own.
        let store_id = midshift_store::identity(&to.data).await?;
        let (from, to) = (folder.to_owned(), to.data.join(RELEASES));
        blocking(move || {
            if let Some(store_id) = store_id {
                mark(&to, &store_id)?;
            }
            for part in [DOCUMENTS, FILES] {
                fs::create_dir_all(to.join(part))?;
                for path in entries(&from.join(part))? {
                    copy(&path, &to.join(part).join(path.file_name().unwrap_or_default()))?;
                }
            }
            // Robots may have seen what was signed after the copy, and take nothing with a lower number.
            let seconds = u64::try_from(now.0 / 1_000).unwrap_or(1);
            raise_floor(
                &to.join(DOCUMENTS),
                seconds.max(version_of(&to.join(DOCUMENTS))?.saturating_add(VERSIONS_AHEAD)),
            )?;
            Ok(())
        })
        .await
    }
}

/// Keys that the server signs with by itself. Whoever has the backup has them.
struct OnlineKeys;

/// Where keys go if nobody says where.
pub const KEYS: &str = "ota-keys";
const ROLES: [&str; 3] = ["snapshot-", "timestamp-", "directive-"];

#[async_trait]
impl Part for OnlineKeys {
    fn name(&self) -> &'static str {
        KEYS
    }
    async fn copy(&self, from: &Places, folder: &Path) -> anyhow::Result<bool> {
        let Some(keys) = from.ota_keys.clone() else { return Ok(false) };
        let folder = folder.to_owned();
        blocking(move || {
            fs::create_dir_all(&folder)?;
            let mut some = false;
            for path in entries(&keys)? {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                if name.ends_with(".pem") && ROLES.iter().any(|role| name.starts_with(role)) {
                    copy(&path, &folder.join(name))?;
                    some = true;
                }
            }
            ensure!(some, "{} has no key of a server", keys.display());
            Ok(true)
        })
        .await
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        let keys = folder.to_owned();
        let read = blocking(move || Ok(midshift_ota::repository::OnlineKeys::read(&keys).err())).await?;
        Ok(read.iter().map(ToString::to_string).collect())
    }
    async fn put_back(&self, folder: &Path, to: &Places, _now: Utc) -> anyhow::Result<()> {
        let (from, to) = (folder.to_owned(), to.ota_keys.clone().unwrap_or_else(|| to.data.join(KEYS)));
        blocking(move || {
            fs::create_dir_all(&to)?;
            fs::set_permissions(&to, fs::Permissions::from_mode(0o700))?;
            for path in entries(&from)? {
                copy(&path, &to.join(path.file_name().unwrap_or_default()))?;
            }
            Ok(())
        })
        .await
    }
}

/// Highest version that a folder's timestamp says; 0: nothing was ever published.
fn version_of(documents: &Path) -> anyhow::Result<u64> {
    let Some(timestamp) = read(&documents.join(TIMESTAMP))? else { return Ok(0) };
    let stamp = midshift_bundle::freshness::stamp(&timestamp)?;
    Ok(stamp.version.max(stamp.snapshot_version))
}

/// Targets document that a folder's timestamp leads to; none: nothing was ever published.
fn newest_targets(documents: &Path) -> anyhow::Result<Option<Vec<u8>>> {
    let Some(timestamp) = read(&documents.join(TIMESTAMP))? else { return Ok(None) };
    let snapshot = midshift_bundle::freshness::stamp(&timestamp)?.snapshot_version;
    let snapshot = must(documents, &format!("{snapshot}.snapshot.json"))?;
    let targets = midshift_bundle::freshness::newest_targets(&snapshot)?;
    must(documents, &format!("{targets}.targets.json")).map(Some)
}

fn must(folder: &Path, name: &str) -> anyhow::Result<Vec<u8>> {
    read(&folder.join(name))?.with_context(|| format!("{name} is missing"))
}

fn read(path: &Path) -> anyhow::Result<Option<Vec<u8>>> {
    match fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).with_context(|| format!("reading {}", path.display())),
    }
}

/// Files of a folder, by name; none if it is not there.
fn entries(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error).with_context(|| format!("reading {}", folder.display())),
    };
    let mut paths = Vec::new();
    for entry in entries {
        let path = entry?.path();
        if path.is_file() {
            paths.push(path);
        }
    }
    paths.sort();
    Ok(paths)
}

fn digest_of(path: &Path) -> Option<Digest> {
    path.file_name()?.to_str()?.parse().ok()
}

/// Copies a file, with whom it may be read by.
fn copy(from: &Path, to: &Path) -> anyhow::Result<()> {
    fs::copy(from, to).map(drop).with_context(|| format!("copying {}", from.display()))
}

/// As [`copy`] from a server at work: a file that went meanwhile is left out.
fn copy_if_there(from: &Path, to: &Path) -> anyhow::Result<()> {
    match copy(from, to) {
        Err(error) if error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == ErrorKind::NotFound) => Ok(()),
        copied => copied,
    }
}
