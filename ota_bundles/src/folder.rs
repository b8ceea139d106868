//! A repository as release people keep it: a folder with `metadata/` and `targets/` that they sign into and push from.
//!
//! Invariant: a targets document gets its number only once enough people have signed it; until then it is `pending.targets.json` and
//! nobody believes it. Files are in place before the document that names them. A key that is not asked for signs nothing here.

mod encoded_targets;
mod roots;

pub use crate::roots::WaitingRoot;

use crate::build::{self, inspect};
use crate::digest::Digest;
use crate::encoded_target::targets_of_gone;
use crate::key_set::KeySet;
use crate::keys::{self, SecretKey};
use crate::manifest::{Component, Manifest};
use crate::repository::{
    self, FileTarget, PEOPLE_LIFE_MS, Profile, RootDraft, Signers, add_signatures, check_root, check_targets, listed,
    sign_root, sign_targets, version_of,
};
use crate::roots::{RequiredSigners, merge_targets};
use midshift_core::reason::{Refusal, Violations};
use midshift_core::time::Utc;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// A targets document that is not signed by enough people yet.
const PENDING: &str = "pending.targets.json";

/// Why the folder stays as it was.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder.
    #[error("{doing} {path}: {source}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// With what.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A key file.
    #[error(transparent)]
    Key(#[from] keys::Error),
    /// A bundle.
    #[error(transparent)]
    Bundle(#[from] build::Error),
    /// A document.
    #[error(transparent)]
    Document(#[from] repository::Error),
    /// What was asked breaks a rule.
    #[error("{0}")]
    Refused(#[from] Refusal),
}

fn io(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { doing, path, source }
}

/// A document that waits follows the newest one.
fn must_be_next(role: &str, version: u64, next: u64) -> Result<(), Refusal> {
    if version == next {
        return Ok(());
    }
    let text =
        format!("{role} {version} waits and the next is {next}: remove metadata/pending.{role}.json and begin anew");
    Err(Refusal::field("repository", text))
}

/// Copies a file that is not there yet.
fn copy(from: &Path, to: &Path) -> Result<(), Error> {
    if to.try_exists().map_err(io("looking for", to))? {
        return Ok(());
    }
    let beside = to.with_extension("new");
    let copy = || {
        fs::copy(from, &beside)?;
        midshift_durable::sync_file(&beside)?;
        midshift_durable::rename(&beside, to)
    };
    copy().map_err(io("writing", to))
}

/// What signing came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signed {
    /// The document has its number, and all signatures that it needs.
    Published(u64),
    /// More people must sign it.
    Pending,
}

/// What a check of the folder found.
#[derive(Clone, Debug)]
pub struct Checked {
    /// Newest root.
    pub root_version: u64,
    /// Newest targets document; none: nothing was ever signed.
    pub targets_version: Option<u64>,
    /// Bundles, by name in the repository.
    pub bundles: Vec<Manifest>,
    /// The newest set of keys that sign directives; none: robots have them from their `trust.json` alone.
    pub key_set: Option<KeySet>,
}

/// A folder of release people.
pub struct Folder {
    path: PathBuf,
}

impl Folder {
    /// Makes keys and the first root: secret keys into `keys`, documents into `path`. The root is signed by all its keys.
    ///
    /// # Errors
    /// If one of the two folders is there already: keys are never written over.
    pub fn create(path: &Path, keys: &Path, profile: Profile, now: Utc) -> Result<Self, Error> {
        for folder in [path, keys] {
            if folder.try_exists().map_err(io("looking for", folder))? {
                return Err(io("making", folder)(build::taken()));
            }
        }
        fs::create_dir_all(keys).map_err(io("making", keys))?;
        let draw = |role: &str, count: usize| -> Result<Vec<SecretKey>, Error> {
            (1..=count)
                .map(|number| {
                    let key = SecretKey::draw();
                    key.write(&keys.join(format!("{role}-{number}.pem")))?;
                    Ok(key)
                })
                .collect()
        };
        let (root, targets) = (draw("root", profile.keys())?, draw("targets", profile.keys())?);
        let (snapshot, timestamp) = (draw("snapshot", 1)?, draw("timestamp", 1)?);
        draw("directive", 1)?;
        let signers =
            |keys: &[SecretKey], threshold| Signers { keys: keys.iter().map(SecretKey::public).collect(), threshold };
        let draft = RootDraft {
            version: 1,
            expires: now.plus_ms(PEOPLE_LIFE_MS),
            root: signers(&root, profile.threshold()),
            targets: signers(&targets, profile.threshold()),
            snapshot: signers(&snapshot, 1),
            timestamp: signers(&timestamp, 1),
        };
        let document = sign_root(&draft, &root.iter().collect::<Vec<_>>())?;
        let this = Self { path: path.to_owned() };
        for folder in [this.metadata(), this.targets()] {
            fs::create_dir_all(&folder).map_err(io("making", &folder))?;
        }
        this.write("1.root.json", &document)?;
        Ok(this)
    }
    /// The folder that is there.
    ///
    /// # Errors
    /// If it has no root.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let this = Self { path: path.to_owned() };
        this.newest("root")?.map(|_| this).ok_or_else(|| {
            Refusal::field("repository", format!("{} has no metadata/1.root.json", path.display())).into()
        })
    }

    fn metadata(&self) -> PathBuf {
        self.path.join("metadata")
    }
    fn targets(&self) -> PathBuf {
        self.path.join("targets")
    }
    /// Where the bytes of a target are.
    pub fn file(&self, name: &str, digest: Digest) -> PathBuf {
        self.targets().join(format!("{digest}.{name}"))
    }
    /// A document by its name, e.g. `2.targets.json`; none: there is none.
    ///
    /// # Errors
    /// If it is there and cannot be read.
    pub fn document(&self, name: &str) -> Result<Option<Vec<u8>>, Error> {
        match self.read(name) {
            Err(Error::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
            read => read.map(Some),
        }
    }
    fn read(&self, name: &str) -> Result<Vec<u8>, Error> {
        let path = self.metadata().join(name);
        fs::read(&path).map_err(io("reading", &path))
    }
    /// A document, whole or not at all.
    fn write(&self, name: &str, document: &[u8]) -> Result<(), Error> {
        let path = self.metadata().join(name);
        midshift_durable::replace(&path, document).map_err(io("writing", &path))
    }
    /// Newest document of a role that has numbers.
    fn newest(&self, role: &str) -> Result<Option<(u64, Vec<u8>)>, Error> {
        let folder = self.metadata();
        let suffix = format!(".{role}.json");
        let mut newest = None;
        for entry in fs::read_dir(&folder).map_err(io("reading", &folder))? {
            let name = entry.map_err(io("reading", &folder))?.file_name();
            let number = name.to_str().and_then(|n| n.strip_suffix(&suffix)).and_then(|n| n.parse::<u64>().ok());
            newest = newest.max(number);
        }
        newest.map(|number| Ok((number, self.read(&format!("{number}{suffix}"))?))).transpose()
    }
    /// Number of the newest targets document; none: nothing was ever signed.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn targets_version(&self) -> Result<Option<u64>, Error> {
        Ok(self.newest("targets")?.map(|(number, _)| number))
    }
    /// The newest root, and its number.
    ///
    /// # Errors
    /// If there is none, or it cannot be read.
    pub fn root(&self) -> Result<(u64, Vec<u8>), Error> {
        self.newest("root")?.ok_or_else(|| Refusal::field("repository", "has no root").into())
    }

    /// Adds a built bundle and signs the targets document that lists it.
    ///
    /// # Errors
    /// A bundle that is not what its manifest says, a name that stands for other bytes, a document that waits for signatures.
    pub fn add(&self, bundle: &Path, keys: &[&SecretKey], now: Utc) -> Result<(Manifest, Signed), Error> {
        self.add_and(bundle, keys, now, |_, _| Ok(Vec::new()))
    }

    /// As [`Folder::add`], with encoded targets of its files: alone, from the newest releases of the same bundle, and from those that `from` names as
    /// NAME-VERSION.
    ///
    /// # Errors
    /// As there; a release that is not listed; files of releases before that are not in this folder.
    pub fn add_with_encoded_targets(
        &self,
        bundle: &Path,
        from: &[String],
        keys: &[&SecretKey],
        now: Utc,
    ) -> Result<(Manifest, Signed), Error> {
        self.add_and(bundle, keys, now, |manifest, previous| {
            self.make_encoded_targets(bundle, manifest, previous, from)
        })
    }

    fn add_and(
        &self,
        bundle: &Path,
        keys: &[&SecretKey],
        now: Utc,
        beside: impl FnOnce(&Manifest, Option<&[u8]>) -> Result<Vec<FileTarget>, Error>,
    ) -> Result<(Manifest, Signed), Error> {
        self.must_not_wait(keys)?;
        let manifest = inspect(bundle)?;
        let document = manifest.to_bytes();
        let mut files = vec![FileTarget {
            name: manifest.target(),
            digest: Digest::of_content(&document),
            length: document.len() as u64,
        }];
        files.extend(manifest.components.iter().map(|c| FileTarget {
            name: c.target(),
            digest: c.digest,
            length: c.length,
        }));
        let previous = self.newest("targets")?.map(|(_, document)| document);
        let expires = now.plus_ms(PEOPLE_LIFE_MS);
        // What may not be listed is refused before anything is made of it.
        sign_targets(previous.as_deref(), &files, &[], expires, &[])?;
        let encoded_targets = beside(&manifest, previous.as_deref())?;
        for file in &files {
            copy(&bundle.join(&file.name), &self.file(&file.name, file.digest))?;
        }
        files.extend(encoded_targets);
        Ok((manifest, self.store_signed(&sign_targets(previous.as_deref(), &files, &[], expires, keys)?)?))
    }

    /// Signs a targets document that lists a bundle no more, nor files that only it has. The files stay in this folder: the document
    /// before, which may still have to be pushed, lists them. Which bundle that was.
    ///
    /// # Errors
    /// A bundle that the newest document does not list, a document that waits for signatures, a folder that does not hold together.
    pub fn withdraw(&self, bundle: &str, keys: &[&SecretKey], now: Utc) -> Result<(Manifest, Signed), Error> {
        self.must_not_wait(keys)?;
        let is_meant = |m: &Manifest| {
            format!("{}-{}", m.name, m.version) == bundle || Digest::of_content(&m.to_bytes()).to_string() == bundle
        };
        let (meant, others): (Vec<Manifest>, Vec<Manifest>) = self.check()?.bundles.into_iter().partition(is_meant);
        let Some(withdrawn) = meant.into_iter().next() else {
            let text = format!("the newest targets document lists no {bundle}; bundle verify lists those it has");
            return Err(Refusal::field("bundle", text).into());
        };
        let needed: BTreeSet<String> = others.iter().flat_map(|m| m.components.iter().map(Component::target)).collect();
        let own = withdrawn.components.iter().map(Component::target).filter(|name| !needed.contains(name));
        let mut gone: Vec<String> = own.chain([withdrawn.target()]).collect();
        let kept: BTreeSet<Digest> = others.iter().flat_map(|m| m.components.iter().map(|c| c.digest)).collect();
        let lost = withdrawn.components.iter().map(|c| c.digest).filter(|digest| !kept.contains(digest)).collect();
        let previous = self.newest("targets")?.map(|(_, document)| document);
        let known = previous.as_deref().map(listed).transpose()?.unwrap_or_default();
        gone.extend(targets_of_gone(&lost, &known).map(str::to_owned));
        let signed = sign_targets(previous.as_deref(), &[], &gone, now.plus_ms(PEOPLE_LIFE_MS), keys)?;
        Ok((withdrawn, self.store_signed(&signed)?))
    }

    /// Adds a set of keys that sign directives, as `bundle rekey` made it, and signs the targets document that lists it.
    ///
    /// # Errors
    /// A file that is no such set, is not the next one, or is signed by no key of the set before nor of its own; a document that waits for
    /// signatures.
    pub fn add_keys(&self, envelope: &[u8], keys: &[&SecretKey], now: Utc) -> Result<(KeySet, Signed), Error> {
        self.must_not_wait(keys)?;
        let refused = |text: String| Refusal::field("bundle", text);
        let set = KeySet::read(envelope).map_err(|e| refused(e.to_string()))?;
        let before = self.check()?.key_set;
        let next = before.as_ref().map_or(1, |before| before.number + 1);
        if set.number != next {
            return Err(refused(format!("is set {} of directive keys; the next is {next}", set.number)).into());
        }
        // The first one is signed by a key that only robots and the server know.
        if let Some(before) = &before {
            KeySet::open(envelope, next, before.keys.iter().chain(&set.keys)).map_err(|e| refused(e.to_string()))?;
        }
        let file =
            FileTarget { name: set.target(), digest: Digest::of_content(envelope), length: envelope.len() as u64 };
        let previous = self.newest("targets")?.map(|(_, document)| document);
        let add = std::slice::from_ref(&file);
        let signed = sign_targets(previous.as_deref(), add, &[], now.plus_ms(PEOPLE_LIFE_MS), keys)?;
        let path = self.file(&file.name, file.digest);
        midshift_durable::replace(&path, envelope).map_err(io("writing", &path))?;
        Ok((set, self.store_signed(&signed)?))
    }

    /// Signs the newest targets document anew, with the next number and a year of its own: after a root that changes who signs, or when it ends.
    ///
    /// # Errors
    /// If none was signed, or one waits for signatures.
    pub fn renew(&self, keys: &[&SecretKey], now: Utc) -> Result<Signed, Error> {
        self.must_not_wait(keys)?;
        let Some((_, previous)) = self.newest("targets")? else {
            return Err(Refusal::field("repository", "no targets document was signed yet").into());
        };
        self.store_signed(&sign_targets(Some(&previous), &[], &[], now.plus_ms(PEOPLE_LIFE_MS), keys)?)
    }

    /// No document waits, and each of `keys` is asked for.
    fn must_not_wait(&self, keys: &[&SecretKey]) -> Result<(), Error> {
        let pending = self.metadata().join(PENDING);
        if pending.try_exists().map_err(io("looking for", &pending))? {
            let text = "a document waits for signatures: sign that first, or remove metadata/pending.targets.json";
            return Err(Refusal::field("repository", text).into());
        }
        Ok(RequiredSigners::for_targets(&self.root()?.1)?.must_name(keys)?)
    }

    /// Adds signatures to the document that waits for them: by `keys`, and those that others handed over. Where none waits yet, the first
    /// document that was handed over does from now on.
    ///
    /// # Errors
    /// If none waits; a key that is not asked for; what was handed over and is no signature of this document. Nothing is added then.
    pub fn cosign(&self, keys: &[&SecretKey], handed: &[Vec<u8>]) -> Result<Signed, Error> {
        let required = RequiredSigners::for_targets(&self.root()?.1)?;
        required.must_name(keys)?;
        let mut document = match (self.document(PENDING)?, handed.first()) {
            (Some(waiting), _) => waiting,
            (None, Some(handed)) => {
                let next = self.targets_version()?.unwrap_or_default() + 1;
                must_be_next("targets", version_of(handed)?, next)?;
                handed.clone()
            }
            (None, None) => return Err(Refusal::field("pending", "no targets document waits for signatures").into()),
        };
        for handed in handed {
            document = merge_targets(&document, handed, &required)?;
        }
        self.store_signed(&add_signatures(&document, keys)?)
    }

    fn store_signed(&self, document: &[u8]) -> Result<Signed, Error> {
        if check_targets(&self.root()?.1, document).is_err() {
            self.write(PENDING, document)?;
            return Ok(Signed::Pending);
        }
        let version = version_of(document)?;
        self.write(&format!("{version}.targets.json"), document)?;
        let pending = self.metadata().join(PENDING);
        midshift_durable::remove(&pending).map_err(io("removing", &pending))?;
        Ok(Signed::Published(version))
    }

    /// Holds everything against everything: each root against the one before, targets against the root, every file against its digest.
    ///
    /// # Errors
    /// A chain that is broken; or all files that are missing or are not what was signed.
    pub fn check(&self) -> Result<Checked, Error> {
        let Some((root_version, root)) = self.newest("root")? else {
            return Err(Refusal::field("repository", "has no root").into());
        };
        let mut before = self.read("1.root.json")?;
        check_root(&before, &before)?;
        for version in 2..=root_version {
            let next = self.read(&format!("{version}.root.json"))?;
            check_root(&before, &next)?;
            before = next;
        }
        let Some((targets_version, targets)) = self.newest("targets")? else {
            return Ok(Checked { root_version, targets_version: None, bundles: Vec::new(), key_set: None });
        };
        check_targets(&root, &targets)?;
        let mut bad = Violations::default();
        let mut bundles = Vec::new();
        let mut key_set: Option<KeySet> = None;
        for target in listed(&targets)? {
            let path = self.file(&target.name, target.digest);
            let found = File::open(&path).and_then(|mut file| Digest::of_reader(&mut file, target.length));
            match found {
                Ok(found) if found == (target.digest, target.length) => {}
                Ok(_) => bad.add(&target.name, "is not what was signed"),
                Err(e) => bad.add(&target.name, e.to_string()),
            }
            if target.name.ends_with(".manifest") && path.exists() {
                let bytes = fs::read(&path).map_err(io("reading", &path))?;
                bundles.extend(bad.accept(&target.name, Manifest::from_bytes(&bytes)));
            }
            if KeySet::is_named(&target.name) && path.exists() {
                let bytes = fs::read(&path).map_err(io("reading", &path))?;
                let set = bad.accept(&target.name, KeySet::read(&bytes));
                key_set = key_set.into_iter().chain(set).max_by_key(|set| set.number);
            }
        }
        bad.finish()?;
        Ok(Checked { root_version, targets_version: Some(targets_version), bundles, key_set })
    }
}
