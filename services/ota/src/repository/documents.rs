//! Documents as they are shown: what the timestamp of a folder leads to, and what another process that shares the folder made of it since.
//!
//! Invariant: nothing is written here. What is shown never goes back: a folder that says something older, or something else under the same
//! number, is damaged, and what was shown before stays. A file that the disk does not give at the moment is not gone: what was known of it
//! stays, and it is tried again at each look.

use super::{Error, Kept, Newest, Online, Release, TIMESTAMP, check, file, read, read_seen};
use crate::blocking;
use crate::content::Content;
use midshift_bundle::digest::Digest;
use midshift_bundle::freshness::{Stamp, check_online, newest_targets, root_edition, stamp, targets_edition};
use midshift_bundle::repository::{FileTarget, check_root, listed};
use midshift_core::time::Utc;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use tokio::sync::Mutex;

/// So often a folder is read anew that changed while it was read.
const READS_MAX: usize = 8;

/// Where the newest documents stand in memory.
pub type Place = Arc<RwLock<Option<Arc<Newest>>>>;

/// What is shown. Cheap to clone.
#[derive(Clone)]
pub struct Documents {
    folder: PathBuf,
    content: Arc<dyn Content>,
    newest: Place,
    /// Other processes change the folder.
    is_shared: bool,
    /// One reads it anew at a time.
    following: Arc<Mutex<()>>,
    /// The newest look came to nothing.
    is_failing: Arc<AtomicBool>,
}

impl Documents {
    /// What a folder shows, of which nobody but its repository may change anything unless it is shared.
    pub(super) async fn open(folder: &Path, content: Arc<dyn Content>, is_shared: bool) -> Result<Self, Error> {
        let this = Self {
            folder: folder.to_owned(),
            content,
            newest: Place::default(),
            is_shared,
            following: Arc::default(),
            is_failing: Arc::default(),
        };
        this.take().await?;
        Ok(this)
    }

    /// What a folder shows in which other processes sign. It need not be there yet.
    ///
    /// # Errors
    /// If it cannot be read, or what is there does not hang together.
    pub async fn reading(folder: &Path, content: Arc<dyn Content>) -> Result<Self, Error> {
        Self::open(folder, content, true).await
    }

    pub(super) fn place(&self) -> Place {
        self.newest.clone()
    }

    /// Whether other processes change them.
    pub(super) const fn is_shared(&self) -> bool {
        self.is_shared
    }

    /// What they say now; none: nothing was ever published.
    pub fn newest(&self) -> Option<Arc<Newest>> {
        self.newest.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Learns what other processes published, and tries files again that the disk did not give.
    ///
    /// # Errors
    /// If it cannot be read, does not hang together, or is older than what was shown. Then that is shown still.
    pub async fn follow(&self) -> Result<(), Error> {
        if !self.is_shared && self.newest().is_none_or(|newest| newest.unread.is_empty()) {
            return Ok(());
        }
        let _one = self.following.lock().await;
        self.take().await
    }

    /// As [`Documents::follow`]; if it begins to fail, that is logged.
    pub async fn follow_if_possible(&self) {
        let followed = self.follow().await;
        let failed_before = self.is_failing.swap(followed.is_err(), Ordering::Relaxed);
        match followed {
            Err(error) if !failed_before => {
                tracing::error!(%error, "what other processes published cannot be read: what was published before is shown");
            }
            Ok(()) if failed_before => tracing::info!("what other processes published can be read again"),
            _ => {}
        }
    }

    async fn take(&self) -> Result<(), Error> {
        let mut tries = 1;
        loop {
            let before = self.newest();
            let (folder, known) = (self.folder.clone(), before.clone());
            let read = blocking(move || {
                let timestamp = read(&folder.join(TIMESTAMP))?;
                if timestamp.as_ref() == known.as_ref().map(|known| &known.timestamp) {
                    let again = known.filter(|known| !known.unread.is_empty());
                    let again = again.map(|known| Found::again(&known, &folder)).transpose();
                    return Ok((timestamp, again));
                }
                Ok::<_, Error>((timestamp, find(&folder)))
            });
            let (timestamp, found) = read.await?;
            let taken = match found {
                Ok(None) if timestamp.is_some() || before.is_none() => return Ok(()),
                Ok(None) => Err(self.damaged(format!("{TIMESTAMP} is gone"))),
                Ok(Some(found)) => match found.complete(self.content.as_ref(), before.as_deref()).await {
                    Ok((newest, unread)) => {
                        self.show(before.as_ref(), newest).map(|()| tell(before.as_deref(), &unread))
                    }
                    Err(error) => Err(error),
                },
                Err(error) => Err(error),
            };
            let Err(error) = taken else { return Ok(()) };
            let folder = self.folder.clone();
            let now = blocking(move || super::read(&folder.join(TIMESTAMP))).await?;
            // Somebody published while it was read.
            if now == timestamp || tries >= READS_MAX {
                return Err(error);
            }
            tries += 1;
        }
    }

    fn damaged(&self, text: String) -> Error {
        Error::Damaged { folder: self.folder.clone(), text }
    }

    /// Shows what was read after `before` was shown.
    fn show(&self, before: Option<&Arc<Newest>>, read: Newest) -> Result<(), Error> {
        let mut place = self.newest.write().unwrap_or_else(PoisonError::into_inner);
        let is_again = before.is_some_and(|before| before.timestamp == read.timestamp);
        if let Some(shown) = place.as_deref() {
            let versions = |n: &Newest| {
                [n.stamp.version, n.stamp.snapshot_version, n.targets.edition.version, n.root.edition.version]
            };
            let (shown, read) = (versions(shown), versions(&read));
            let is_older = read.iter().zip(shown).any(|(read, shown)| *read < shown) || read[0] == shown[0];
            let is_as_before = before.is_some_and(|before| place.as_ref().is_some_and(|p| Arc::ptr_eq(p, before)));
            let is_older = is_older && !(is_as_before && is_again);
            if is_older && is_as_before {
                let text = format!(
                    "timestamp, snapshot, targets and root were {shown:?} and are {read:?}: the folder was put back under a server at work; restart all processes that share it once it is what it should be"
                );
                return Err(self.damaged(text));
            }
            if is_older {
                // This process published meanwhile.
                return Ok(());
            }
        }
        *place = Some(Arc::new(read));
        Ok(())
    }

    /// A document by its name; none: there is none, or it was never made the newest.
    ///
    /// # Errors
    /// The disk's.
    pub async fn document(&self, name: &str) -> Result<Option<Vec<u8>>, Error> {
        self.follow_if_possible().await;
        let Some(newest) = self.newest() else { return Ok(None) };
        if name == TIMESTAMP {
            return Ok(Some(newest.timestamp.clone()));
        }
        let shown = [
            ("root", newest.root.edition.version),
            ("targets", newest.targets.edition.version),
            ("snapshot", newest.stamp.snapshot_version),
        ];
        let number = |role: &str| name.strip_suffix(&format!(".{role}.json"))?.parse::<u64>().ok();
        let is_shown = |(role, most): (&str, u64)| number(role).is_some_and(|n| n <= most && name == file(n, role));
        if !shown.into_iter().any(is_shown) {
            return Ok(None);
        }
        let path = self.folder.join(name);
        blocking(move || read(&path)).await
    }
}

/// Listed files that the disk does not give, with their names and why.
type Unread = BTreeMap<Digest, (String, Error)>;

/// Documents that the timestamp of a folder leads to.
struct Found {
    root: Kept,
    targets: Kept,
    timestamp: Vec<u8>,
    stamp: Stamp,
    seen: BTreeMap<Digest, Utc>,
}

impl Found {
    /// What was shown already, to try again what the disk did not give.
    fn again(known: &Newest, folder: &Path) -> Result<Self, Error> {
        Ok(Self {
            root: known.root.clone(),
            targets: known.targets.clone(),
            timestamp: known.timestamp.clone(),
            stamp: known.stamp,
            seen: read_seen(folder)?,
        })
    }

    /// With its bundles, `before` being what is shown until now. A file that is gone is told and left out: the rest can be had still. One that the
    /// disk does not give is what it was in `before`, since its name is its digest, and is noted as unread.
    async fn complete(self, content: &dyn Content, before: Option<&Newest>) -> Result<(Newest, Unread), Error> {
        let files = listed(&self.targets.bytes)?;
        let again = before.filter(|before| before.timestamp == self.timestamp);
        let is_known = |file: &FileTarget| again.is_some_and(|again| !again.unread.contains(&file.digest));
        let (mut releases, mut unread) = (Vec::new(), Unread::new());
        for file in files.iter().filter(|file| check::is_manifest(file)) {
            let known = |newest: &Newest| newest.releases.iter().find(|r| r.digest == file.digest).cloned();
            if is_known(file) {
                // Nothing is read twice for the sake of others.
                releases.extend(again.and_then(known));
                continue;
            }
            match check::manifest(file, content).await {
                Ok(Ok(manifest)) => {
                    let seen = self.seen.get(&file.digest).copied().unwrap_or_default();
                    releases.push(Release { digest: file.digest, manifest, seen });
                }
                Ok(Err(problem)) => tracing::error!(file = file.name, problem, "a signed bundle cannot be read"),
                Err(error) => {
                    releases.extend(before.and_then(known));
                    unread.insert(file.digest, (file.name.clone(), error));
                }
            }
        }
        check::sort(&mut releases);
        let key_set = match check::newest_set(&files) {
            Some(file) if is_known(file) => again.and_then(|again| again.key_set.clone()),
            Some(file) => match check::key_set(file, content).await {
                Ok(Ok((set, _))) => Some(set),
                Ok(Err(problem)) => {
                    tracing::error!(file = file.name, problem, "the newest set of directive keys cannot be read");
                    None
                }
                Err(error) => {
                    unread.insert(file.digest, (file.name.clone(), error));
                    let known = before.filter(|before| before.files.get(&file.name) == Some(file));
                    known.and_then(|before| before.key_set.clone())
                }
            },
            None => None,
        };
        let newest = Newest::of(self.root, self.targets, self.stamp, files, releases, self.timestamp);
        Ok((Newest { key_set, unread: unread.keys().copied().collect(), ..newest }, unread))
    }
}

/// Says once that the disk does not give files, and once that it does again.
fn tell(before: Option<&Newest>, unread: &Unread) {
    let is_known = |digest: &Digest| before.is_some_and(|before| before.unread.contains(digest));
    for (file, error) in unread.iter().filter(|(digest, _)| !is_known(digest)).map(|(_, why)| why) {
        tracing::warn!(
            file,
            %error,
            "a signed file is there and cannot be read: what was known of it stays, and it is tried again at each look; see to the disk, and to who \
             may read its folder `content`"
        );
    }
    if unread.is_empty() && before.is_some_and(|before| !before.unread.is_empty()) {
        tracing::info!("all signed files can be read again");
    }
}

/// Reads a folder. Of the roots the newest counts under which everything else holds: a later one came with a publication that was cut.
fn find(folder: &Path) -> Result<Option<Found>, Error> {
    let Some(timestamp) = read(&folder.join(TIMESTAMP))? else { return Ok(None) };
    let damaged = |text: String| Error::Damaged { folder: folder.to_owned(), text };
    let must = |name: String| read(&folder.join(&name))?.ok_or_else(|| damaged(format!("{name} is gone")));
    let stamp = stamp(&timestamp)?;
    let snapshot = must(file(stamp.snapshot_version, "snapshot"))?;
    let targets = must(file(newest_targets(&snapshot)?, "targets"))?;
    let online = Online { snapshot, timestamp };
    let (mut before, mut root): (Option<Vec<u8>>, _) = (None, None);
    let mut objection = "1.root.json is gone".to_owned();
    for version in 1.. {
        let Some(bytes) = read(&folder.join(file(version, "root")))? else { break };
        if let Err(error) = check_root(before.as_ref().unwrap_or(&bytes), &bytes) {
            objection = format!("{}: {error}", file(version, "root"));
            break;
        }
        match check_online(&bytes, &targets, &online) {
            Ok(()) => root = Some(bytes.clone()),
            Err(error) => objection = error.to_string(),
        }
        before = Some(bytes);
    }
    let root = root.ok_or_else(|| damaged(objection))?;
    Ok(Some(Found {
        root: Kept { edition: root_edition(&root)?, bytes: root },
        targets: Kept { edition: targets_edition(&targets)?, bytes: targets },
        timestamp: online.timestamp,
        stamp,
        seen: read_seen(folder)?,
    }))
}
