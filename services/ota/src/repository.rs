//! The repository that robots and foreign clients read: documents that people signed, and the word which of them are the newest.
//!
//! Invariant: a publication is checked as a robot would check it before anything of it is written; the timestamp is written last, and what
//! is shown is what it leads to, so that a cut at any write leaves the older or the newer repository whole. Versions never go back.

mod cannot_sign;
mod check;
mod documents;
mod error;
mod files;
mod newest;
mod online;

pub use cannot_sign::{CannotSign, SetLost};
pub use documents::Documents;
pub(crate) use documents::every_second;
pub use error::Error;
pub use files::raise_floor;
pub use newest::{Newest, Publishers, Release, SignedDocument};
pub use online::OnlineKeys;

use crate::content::Content;
use crate::disk::write_whole;
use crate::folder::{Gate, Turn};
use crate::threads::blocking;
use error::io;
use files::{BY, SEEN, TIMESTAMP, file, read, read_floor, read_publishers, read_seen};
use midshift_bundle::digest::Digest;
use midshift_bundle::freshness::{Stamp, newest_targets, root_edition, stamp};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::manifest::Manifest;
use midshift_bundle::repository::{FileTarget, Online, TIMESTAMP_LIFE_MS, listed};
use midshift_core::Boxed;
use midshift_core::identity::Actor;
use midshift_core::time::{Clock, Doubt, Utc};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// A timestamp this old is signed anew: half its life.
pub const FRESHEN_AFTER_MS: u64 = TIMESTAMP_LIFE_MS / 2;
/// Snapshots kept for clients that read an older timestamp a moment ago.
const SNAPSHOTS_KEPT: usize = 16;
/// Who publishes, and when.
#[derive(Clone, Debug)]
pub struct Act {
    /// The actor that publishes.
    pub by: Actor,
    /// When it publishes, UTC of the wall.
    pub at: Utc,
}

#[cfg(test)]
impl Act {
    /// Of whoever makes releases in tests.
    pub fn of_release(at: Utc) -> Self {
        Self { by: "release".into(), at }
    }
}

/// Documents by name, in the order in which they are to be written, and what is shown after the last.
struct Publication {
    writes: Vec<(String, Vec<u8>)>,
    newest: Newest,
}

/// The repository of a store, for one who signs.
pub struct Repository {
    folder: PathBuf,
    keys: Arc<OnlineKeys>,
    content: Arc<dyn Content>,
    documents: Documents,
    /// Says whether its wall may be signed by. None: times are given by whoever asks, and hold.
    clock: Option<Arc<dyn Clock>>,
    /// What was said last of why no order may be signed.
    told: Mutex<Option<CannotSign>>,
    /// One publication or signature at a time. Held to the end of its writes, whoever still waits for them.
    writing: Gate,
    /// Lowest version of a snapshot or timestamp that is signed.
    floor: u64,
}

impl Repository {
    /// Opens the folder, made if it is not there, and finds what its timestamp leads to.
    ///
    /// # Errors
    /// If it cannot be read, or what is there does not hang together.
    pub fn open(folder: &Path, keys: OnlineKeys, content: Arc<dyn Content>) -> Boxed<'_, Result<Self, Error>> {
        Box::pin(async move { Self::opened(folder, keys, content, None).await })
    }

    /// As [`Repository::open`], for a folder in which other processes sign too: all that have a file at `lock` take turns.
    ///
    /// # Errors
    /// As there.
    pub async fn join(
        folder: &Path,
        keys: OnlineKeys,
        content: Arc<dyn Content>,
        lock: PathBuf,
    ) -> Result<Self, Error> {
        Self::opened(folder, keys, content, Some(lock)).await
    }

    async fn opened(
        folder: &Path,
        keys: OnlineKeys,
        content: Arc<dyn Content>,
        lock: Option<PathBuf>,
    ) -> Result<Self, Error> {
        let path = folder.to_owned();
        let floor = blocking(move || {
            fs::create_dir_all(&path).map_err(io("making", &path))?;
            read_floor(&path)
        })
        .await?;
        let is_shared = lock.is_some();
        let documents = Documents::open(folder, content.clone(), is_shared).await?;
        let (folder, writing) = (folder.to_owned(), Gate::new(lock));
        let (clock, told) = (None, Mutex::default());
        Ok(Self { folder, keys: Arc::new(keys), content, documents, clock, told, writing, floor })
    }

    /// Signs nothing while the wall of this clock is in doubt.
    pub fn with_clock(self, clock: Arc<dyn Clock>) -> Self {
        Self { clock: Some(clock), ..self }
    }

    fn doubt(&self) -> Option<Doubt> {
        self.clock.as_ref().and_then(|clock| clock.doubt())
    }

    /// That nobody else publishes or signs, here or elsewhere, and what is the newest then.
    async fn turn(&self) -> Result<(Turn, Option<Arc<Newest>>), Error> {
        let turn = self.writing.take_turn().await?;
        self.documents.follow().await?;
        Ok((turn, self.newest()))
    }

    /// The key that orders to robots are signed with: the first of the newest set of directive keys that is here; without a set the first by
    /// name.
    ///
    /// # Errors
    /// Robots take no orders of any key that is here, or the wall is in doubt; so none may be signed.
    pub fn directive_key(&self) -> Result<Arc<SecretKey>, CannotSign> {
        match self.doubt() {
            Some(_) => Err(CannotSign::Clock),
            None => self.keys.directive(self.newest().as_deref()),
        }
    }

    /// As [`Repository::directive_key`], for one who asks now and then. If there is none, the folder of keys is looked at again; that there is none is said once until
    /// there is one again.
    ///
    /// # Errors
    /// As there.
    pub async fn find_directive_key(&self) -> Result<Arc<SecretKey>, CannotSign> {
        let mut found = self.directive_key();
        if found.is_err() {
            let keys = self.keys.clone();
            // A file that is being written is read the next time.
            if blocking(move || keys.read_directives()).await.is_ok() {
                found = self.directive_key();
            }
        }
        let keyless = found.as_ref().err().copied();
        let before = std::mem::replace(&mut *self.told.lock().unwrap_or_else(PoisonError::into_inner), keyless);
        metrics::gauge!("midshift_ota_keyless").set(f64::from(u8::from(keyless.is_some())));
        match keyless {
            Some(keyless) if before != Some(keyless) => tracing::error!(
                why = ?keyless,
                advice = keyless.advice(),
                "this process may sign with no directive key, so it signs no orders to robots"
            ),
            None if before.is_some() => tracing::info!("this process signs orders to robots again"),
            _ => {}
        }
        found
    }

    /// That there is no directive key is said anew.
    pub fn forget_told(&self) {
        *self.told.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// What it says now; none: nothing was ever published.
    pub fn newest(&self) -> Option<Arc<Newest>> {
        self.documents.newest()
    }

    /// A document by its name; none: there is none, or it was never made the newest.
    ///
    /// # Errors
    /// The disk's.
    pub async fn document(&self, name: &str) -> Result<Option<Vec<u8>>, Error> {
        self.documents.document(name).await
    }

    /// What is shown of it, also to those who may not sign.
    pub const fn documents(&self) -> &Documents {
        &self.documents
    }

    /// Makes documents the newest if `expected` is still the version of the newest targets document, 0 of none. A publication that is
    /// the newest already is no error: somebody lost our answer.
    ///
    /// # Errors
    /// Why not; nothing has changed then, or nobody knows and the next start does.
    pub fn publish(
        &self,
        roots: Vec<Vec<u8>>,
        targets: Vec<u8>,
        expected: u64,
        act: Act,
    ) -> Boxed<'_, Result<Arc<Newest>, Error>> {
        Box::pin(async move {
            let (writing, before) = self.turn().await?;
            let newest = before.as_ref().map_or(0, |b| b.targets.edition.version);
            if newest != expected {
                return match before {
                    Some(before) if before.targets.bytes == targets && self.has_all(&before, &roots).await? => {
                        Ok(before)
                    }
                    _ => Err(Error::Moved { newest, expected }),
                };
            }
            let publication = self.prepare(before.as_deref(), roots, targets, act).await?;
            self.commit(writing, publication).await
        })
    }

    /// Signs anew that everything is as it was, if that was said long ago. How long until it is due, ms; none: there is nothing to say.
    ///
    /// # Errors
    /// Why it was not signed.
    pub fn freshen(&self, now: Utc) -> Boxed<'_, Result<Option<u64>, Error>> {
        Box::pin(async move {
            let (writing, before) = self.turn().await?;
            let Some(before) = before else { return Ok(None) };
            let issued = before.stamp.issued;
            let age_ms = now.ms_since(issued);
            // A clock that went back says nothing of the age.
            if now >= issued && age_ms < FRESHEN_AFTER_MS && before.stamp.version >= self.floor {
                return Ok(Some(FRESHEN_AFTER_MS - age_ms));
            }
            let (online, stamp) = self.sign(Some(&before), &before.root, &before.targets.bytes, now)?;
            let writes = vec![
                (file(stamp.snapshot_version, "snapshot"), online.snapshot),
                (TIMESTAMP.to_owned(), online.timestamp),
            ];
            let timestamp = writes[1].1.clone();
            let newest = Newest { stamp, timestamp, ..(*before).clone() };
            self.commit(writing, Publication { writes, newest }).await?;
            Ok(Some(FRESHEN_AFTER_MS))
        })
    }

    /// What it says now, and that it says nothing else as long as the turn lasts.
    ///
    /// # Errors
    /// If nobody knows what it says.
    pub async fn still(&self) -> Result<(Option<Arc<Newest>>, Turn), Error> {
        let (turn, newest) = self.turn().await?;
        Ok((newest, turn))
    }

    /// Files that a bundle consists of: its manifest and its components. None: the manifest is not here. A file of that digest that
    /// is no manifest is all there is of it: robots say by themselves what they run, and any file may be named so.
    ///
    /// # Errors
    /// The disk's, and a manifest of a release that cannot be read any more.
    pub async fn files_of(&self, bundle: Digest) -> Result<Option<Vec<Digest>>, Error> {
        if let Some(newest) = self.newest()
            && let Some(release) = newest.releases.iter().find(|release| release.digest == bundle)
        {
            return Ok(Some(files_of(bundle, &release.manifest)));
        }
        if self.content.length(bundle).await?.is_none() {
            return Ok(None);
        }
        match check::read_manifest(bundle, self.content.as_ref()).await? {
            Ok(manifest) => Ok(Some(files_of(bundle, &manifest))),
            Err(text) if self.seen().await?.contains_key(&bundle) => {
                Err(Error::Damaged { folder: self.folder.clone(), text: format!("the manifest {bundle}: {text}") })
            }
            Err(_) => Ok(Some(vec![bundle])),
        }
    }

    /// Documents of a publication, in the order in which they would be written.
    #[cfg(test)]
    pub(crate) async fn prepared(
        &self,
        roots: Vec<Vec<u8>>,
        targets: Vec<u8>,
        now: Utc,
    ) -> Result<Vec<(String, Vec<u8>)>, Error> {
        let publication = self.prepare(self.newest().as_deref(), roots, targets, Act::of_release(now)).await?;
        Ok(publication.writes)
    }

    /// Whether the repository has these roots already.
    async fn has_all(&self, newest: &Newest, roots: &[Vec<u8>]) -> Result<bool, Error> {
        for root in roots {
            let version = root_edition(root)?.version;
            let known = version <= newest.root.edition.version;
            if !known || self.document(&file(version, "root")).await?.as_ref() != Some(root) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Checks everything and signs it; nothing is written yet.
    async fn prepare(
        &self,
        before: Option<&Newest>,
        roots: Vec<Vec<u8>>,
        targets: Vec<u8>,
        Act { by, at }: Act,
    ) -> Result<Publication, Error> {
        let now = self.undoubted(at)?;
        let known = match before {
            // A root that came before is no news.
            Some(newest) => {
                let mut known = Vec::new();
                for root in &roots {
                    known.push(self.has_all(newest, std::slice::from_ref(root)).await.unwrap_or(false));
                }
                known
            }
            None => vec![false; roots.len()],
        };
        let roots: Vec<Vec<u8>> = roots.into_iter().zip(known).filter(|(_, known)| !known).map(|(r, _)| r).collect();
        let root = check::roots(before.map(|b| &b.root), &roots, now)?;
        let targets = check::targets(&root, before.map(|b| &b.targets), targets, now)?;
        let files = listed(&targets.bytes)?;
        if self.documents.is_shared() {
            // What another process brought is durable under its name from here on.
            self.content.list().await?;
        }
        let mut seen = self.seen().await?;
        let releases = check::releases(&files, self.content.as_ref(), &mut seen, now).await?;
        let key_set = check::key_sets(&files, before, self.content.as_ref(), &self.keys).await?;
        seen = self.known_of(seen, &files).await?;
        let (online, stamp) = self.sign(before, &root, &targets.bytes, now)?;
        let first_root = root.edition.version + 1 - roots.len() as u64;
        let mut writes: Vec<(String, Vec<u8>)> =
            (first_root..).map(|version| file(version, "root")).zip(roots).collect();
        let seen = serde_json::to_vec(&seen).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
        writes.push((SEEN.to_owned(), seen));
        let by = self.by().await?.after(&by, &releases);
        writes.push((BY.to_owned(), serde_json::to_vec(&by).unwrap_or_else(|e| unreachable!("plain fields: {e}"))));
        writes.push((file(targets.edition.version, "targets"), targets.bytes.clone()));
        writes.push((file(stamp.snapshot_version, "snapshot"), online.snapshot));
        writes.push((TIMESTAMP.to_owned(), online.timestamp.clone()));
        let newest = Newest { key_set, by, ..Newest::new(root, targets, stamp, files, releases, online.timestamp) };
        Ok(Publication { writes, newest })
    }

    /// Signs by the time at which it signs, not by the one at which somebody asked: the wall may have been wrong then.
    fn sign(
        &self,
        before: Option<&Newest>,
        root: &SignedDocument,
        targets: &[u8],
        asked: Utc,
    ) -> Result<(Online, Stamp), Error> {
        let (snapshot, timestamp) = before.map_or((1, 1), |b| (b.stamp.snapshot_version + 1, b.stamp.version + 1));
        let versions = (snapshot.max(self.floor), timestamp.max(self.floor));
        let online = self.keys.sign(root, targets, versions, self.undoubted(asked)?)?;
        let stamp = stamp(&online.timestamp)?;
        Ok((online, stamp))
    }

    /// The time to sign by now; `given` where times are given by whoever asks.
    fn undoubted(&self, given: Utc) -> Result<Utc, Error> {
        match &self.clock {
            Some(clock) => clock.undoubted().map(|now| now.wall).map_err(Error::Clock),
            None => Ok(given),
        }
    }

    /// Those bundles whose manifest is listed or still here: of the others nobody asks.
    async fn known_of(
        &self,
        mut seen: BTreeMap<Digest, Utc>,
        files: &[FileTarget],
    ) -> Result<BTreeMap<Digest, Utc>, Error> {
        let listed: BTreeSet<Digest> = files.iter().map(|file| file.digest).collect();
        for digest in seen.keys().copied().filter(|digest| !listed.contains(digest)).collect::<Vec<_>>() {
            if self.content.length(digest).await?.is_none() {
                seen.remove(&digest);
            }
        }
        Ok(seen)
    }

    async fn seen(&self) -> Result<BTreeMap<Digest, Utc>, Error> {
        let folder = self.folder.clone();
        blocking(move || read_seen(&folder)).await
    }

    async fn by(&self) -> Result<Publishers, Error> {
        let folder = self.folder.clone();
        blocking(move || read_publishers(&folder)).await
    }

    /// Writes one document after the other, each whole and durable, and shows the result: also if nobody waits for it any more.
    async fn commit(&self, writing: Turn, publication: Publication) -> Result<Arc<Newest>, Error> {
        let (folder, newest) = (self.folder.clone(), Arc::new(publication.newest));
        let (place, shown) = (self.documents.place(), newest.clone());
        blocking(move || {
            publication.writes.iter().try_for_each(|(name, bytes)| write_whole(&folder.join(name), bytes))?;
            if let Err(error) = prune(&folder) {
                // Nobody reads them any more; the next publication tries again.
                tracing::warn!(%error, "older documents stay");
            }
            *place.write().unwrap_or_else(PoisonError::into_inner) = Some(shown);
            drop(writing);
            Ok::<_, Error>(())
        })
        .await?;
        Ok(newest)
    }
}

fn files_of(bundle: Digest, manifest: &Manifest) -> Vec<Digest> {
    std::iter::once(bundle).chain(manifest.components.iter().map(|component| component.digest)).collect()
}

/// Removes snapshots but for the last [`SNAPSHOTS_KEPT`], and targets documents that none of those left names. Roots stay: a robot that was away
/// goes from each to the next.
fn prune(folder: &Path) -> Result<(), Error> {
    let (mut snapshots, mut targets) = (BTreeSet::new(), BTreeSet::new());
    for entry in fs::read_dir(folder).map_err(io("reading", folder))? {
        let name = entry.map_err(io("reading", folder))?.file_name();
        let number = |role: &str| name.to_str()?.strip_suffix(&format!(".{role}.json"))?.parse::<u64>().ok();
        snapshots.extend(number("snapshot"));
        targets.extend(number("targets"));
    }
    let stale = snapshots.len().saturating_sub(SNAPSHOTS_KEPT);
    let Some(oldest) = snapshots.iter().nth(stale) else { return Ok(()) };
    // Both rise together, so the oldest snapshot names the oldest targets.
    let Some(oldest) = read(&folder.join(file(*oldest, "snapshot")))? else { return Ok(()) };
    let named = newest_targets(&oldest)?;
    let gone = snapshots.iter().take(stale).map(|number| file(*number, "snapshot"));
    let gone = gone.chain(targets.range(..named).map(|number| file(*number, "targets")));
    gone.map(|name| folder.join(name)).try_for_each(|path| fs::remove_file(&path).map_err(io("removing", &path)))
}

#[cfg(test)]
mod tests;
