//! Shows the newest signed documents: those that the folder's timestamp leads to, also when another process published.
//!
//! Invariants:
//! 1. Nothing is written here.
//! 2. What is shown never goes back. A folder with an older document, or with another one under the same number, is
//!    damaged, and the documents shown before stay.
//! 3. A file that the disk fails to give is not gone. What was known of it stays, and it is tried again once a second,
//!    whenever the folder is followed; a request never tries it.

use super::cannot_sign::SetLost;
use super::check;
use super::error::Error;
use super::files::{TIMESTAMP, file, read, read_publishers, read_seen};
use super::newest::{Newest, Publishers, Release, SignedDocument};
use crate::content::Content;
use crate::threads::blocking;
use midshift_bundle::digest::Digest;
use midshift_bundle::freshness::{Stamp, check_online, newest_targets, root_edition, stamp, targets_edition};
use midshift_bundle::key_set::KeySet;
use midshift_bundle::repository::{FileTarget, Online, check_root, listed};
use midshift_core::limits;
use midshift_core::time::Utc;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;
use tokio::sync::Mutex;
use tokio_util::sync::CancellationToken;

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
        this.read_folder(Unread::Again).await?;
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

    /// Learns what other processes published, and tries files again that could not be read. For one who does so now and then: a disk may take
    /// its time to say that it does not give a file.
    ///
    /// # Errors
    /// If it cannot be read, does not hang together, or is older than what was shown. Then that is shown still.
    pub async fn follow(&self) -> Result<(), Error> {
        if !self.is_shared && self.newest().is_none_or(|newest| newest.unread.is_empty()) {
            return Ok(());
        }
        let _one = self.following.lock().await;
        self.read_folder(Unread::Again).await
    }

    /// As [`Documents::follow`]; if it begins to fail, that is logged.
    pub async fn follow_if_possible(&self) {
        let followed = self.follow().await;
        self.tell_failing(followed);
    }

    /// Learns what other processes published, for somebody who asks for something: what could not be read is not tried again. If it begins to
    /// fail, that is logged.
    pub async fn look_if_possible(&self) {
        if !self.is_shared {
            return;
        }
        let looked = {
            let _one = self.following.lock().await;
            self.read_folder(Unread::Left).await
        };
        self.tell_failing(looked);
    }

    fn tell_failing(&self, followed: Result<(), Error>) {
        let failed_before = self.is_failing.swap(followed.is_err(), Ordering::Relaxed);
        match followed {
            Err(error) if !failed_before => {
                tracing::error!(%error, "what other processes published cannot be read: what was published before is shown");
            }
            Ok(()) if failed_before => tracing::info!("what other processes published can be read again"),
            _ => {}
        }
    }

    async fn read_folder(&self, unread: Unread) -> Result<(), Error> {
        let mut tries = 1;
        loop {
            let before = self.newest();
            let (folder, known) = (self.folder.clone(), before.clone());
            let read = blocking(move || {
                let timestamp = read(&folder.join(TIMESTAMP))?;
                if timestamp.as_ref() == known.as_ref().map(|known| &known.timestamp) {
                    let again = known.filter(|known| unread == Unread::Again && !known.unread.is_empty());
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
                        self.show(before.as_ref(), newest).map(|()| tell_unread(before.as_deref(), &unread))
                    }
                    Err(error) => Err(error),
                },
                Err(error) => Err(error),
            };
            let Err(error) = taken else { return Ok(()) };
            let folder = self.folder.clone();
            let now = blocking(move || super::files::read(&folder.join(TIMESTAMP))).await?;
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
        self.look_if_possible().await;
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

/// What is done about listed files that could not be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Unread {
    /// They are tried again.
    Again,
    /// They are left for the next time.
    Left,
}

/// Why a listed file that is tried again could not be read.
enum Why {
    /// The disk does not give it, though it is there.
    Disk(Error),
    /// It is the newest set of directive keys, and gone or not what it must be. Without it nothing is signed, so it is waited for.
    Lost(String),
}

/// Listed files that are tried again, with their names and why.
type MissingFiles = BTreeMap<Digest, (String, Why)>;

/// Documents that the timestamp of a folder leads to.
struct Found {
    root: SignedDocument,
    targets: SignedDocument,
    timestamp: Vec<u8>,
    stamp: Stamp,
    seen: BTreeMap<Digest, Utc>,
    by: Publishers,
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
            by: read_publishers(folder)?,
        })
    }

    /// With its bundles, `before` being what is shown until now. A file that is gone is told and left out: the rest can be had still. One that the
    /// disk does not give, and the newest set of directive keys also if it is gone, is what it was in `before`, since its name is its digest,
    /// and is noted as unread.
    async fn complete(self, content: &dyn Content, before: Option<&Newest>) -> Result<(Newest, MissingFiles), Error> {
        let files = listed(&self.targets.bytes)?;
        let again = before.filter(|before| before.timestamp == self.timestamp);
        let is_known = |file: &FileTarget| again.is_some_and(|again| !again.unread.contains(&file.digest));
        let (mut releases, mut unread) = (Vec::new(), MissingFiles::new());
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
                    unread.insert(file.digest, (file.name.clone(), Why::Disk(error)));
                }
            }
        }
        check::sort(&mut releases);
        let (mut key_set, mut set_lost) = (None, None);
        if let Some(file) = check::newest_set(&files) {
            if is_known(file) {
                key_set = again.and_then(|again| again.key_set.clone());
            } else {
                let why = match check::key_set(file, content).await {
                    Ok(Ok((set, _))) => {
                        key_set = Some(set);
                        None
                    }
                    Ok(Err(problem)) => Some(Why::Lost(problem)),
                    Err(error) => Some(Why::Disk(error)),
                };
                if let Some(why) = why {
                    let known = before.filter(|before| before.files.get(&file.name) == Some(file));
                    key_set = known.and_then(|before| before.key_set.clone());
                    let is_lost = key_set.is_none() && matches!(why, Why::Lost(_));
                    set_lost = KeySet::number_of(&file.name).filter(|_| is_lost).map(|number| SetLost { number });
                    unread.insert(file.digest, (file.name.clone(), why));
                }
            }
        }
        let newest = Newest::new(self.root, self.targets, self.stamp, files, releases, self.timestamp);
        Ok((Newest { key_set, set_lost, by: self.by, unread: unread.keys().copied().collect(), ..newest }, unread))
    }
}

/// Says once that files cannot be read, and once that they can again.
fn tell_unread(before: Option<&Newest>, unread: &MissingFiles) {
    let is_known = |digest: &Digest| before.is_some_and(|before| before.unread.contains(digest));
    for (digest, (file, why)) in unread.iter().filter(|(digest, _)| !is_known(digest)) {
        match why {
            Why::Disk(error) => tracing::warn!(
                file,
                %error,
                "a signed file is there and cannot be read: what was known of it stays, and it is tried again each second; see to the disk, and to \
                 who may read its folder `content`"
            ),
            Why::Lost(problem) => tracing::error!(
                file,
                problem,
                %digest,
                "the newest set of directive keys is not here: put its file back into the folder `content` under its SHA-256, from a backup or \
                 from the repository that was pushed; it is tried again each second"
            ),
        }
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
        root: SignedDocument { edition: root_edition(&root)?, bytes: root },
        targets: SignedDocument { edition: targets_edition(&targets)?, bytes: targets },
        timestamp: online.timestamp,
        stamp,
        seen: read_seen(folder)?,
        by: read_publishers(folder)?,
    }))
}

/// Follows what other processes publish.
pub(crate) async fn every_second<F: Future<Output = ()>>(shutdown: &CancellationToken, follow: impl Fn() -> F) {
    loop {
        follow().await;
        tokio::select! {
            () = shutdown.cancelled() => return,
            () = tokio::time::sleep(Duration::from_millis(limits::SOFTWARE_FOLLOW_EVERY_MS)) => {}
        }
    }
}
