//! Backups of a server: everything durable that it has, as a list of parts, each copied while the server works.
//!
//! Invariant: a backup is whole or it is not there: its folder gets its name when all of it is durable, and its list names each file with its
//! digest. Restoring changes nothing but a data directory that was not there, and a database that had no row. Rows are copied before what
//! they name, so that what a copied row names was there when it was copied. A thing that is durable and in no part is a defect: who adds one
//! adds its part.

mod access;
pub mod audit_notices;
mod files;
mod identity;
mod keys;
mod part;
mod parts;
mod releases;
mod rows;
mod staging;
mod stops;

pub use access::{Access, AccessOutcome, Identity};
use anyhow::{Context, bail, ensure};
use files::{blocking, write};
use midshift_bundle::digest::Digest;
use midshift_core::Boxed;
use midshift_core::time::Utc;
use midshift_store::{PostgresRestore, RestoreError, StoreId};
use part::{BackupFacts, Making, POSTGRES};
pub use part::{KEYS, Places};
use parts::PARTS;
use serde::{Deserialize, Serialize};
use staging::Staging;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// The list of a backup.
const LIST: &str = "backup.json";
/// How backups are laid out. Another number is another layout.
const FORMAT: u32 = 1;
/// A file of a backup has at most so many bytes.
const FILE_BYTES_MAX: u64 = 1 << 42;

/// The entry of one file in the list of a backup.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileEntry {
    bytes: u64,
    sha256: String,
}

/// What a backup is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    format: u32,
    /// Which release wrote it.
    midshift: String,
    /// The site that the server is of.
    site_id: String,
    /// When it was begun, unix milliseconds.
    begun_unix_ms: i64,
    /// Parts that are in it.
    parts: Vec<String>,
    /// Files by path.
    files: BTreeMap<String, FileEntry>,
}

/// What a backup holds, for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Summary {
    /// The site that the server is of.
    pub site_id: String,
    /// When it was begun.
    pub begun: Utc,
    /// Each part: its name, its files and their bytes.
    pub parts: Vec<(String, u64, u64)>,
}

/// Copies everything durable of `from` into the folder `to`, which must not be there. A server may be using it.
///
/// # Errors
/// If something cannot be read or written. Nothing is left at `to` then.
pub fn back_up<'a>(from: &'a Places, to: &'a Path, now: Utc) -> Boxed<'a, anyhow::Result<Summary>> {
    Box::pin(async move {
        let place = Staging::new(to)?;
        let mut names = Vec::new();
        let mut facts = BackupFacts::default();
        for part in PARTS {
            let folder = place.path().join(part.name());
            let copied = part.copy(from, &folder, &mut facts).await;
            if copied.with_context(|| format!("copying {}", part.name()))? {
                names.push(part.name().to_owned());
            }
        }
        let site_id = facts.site_id.with_context(|| format!("no server ever served from {}", from.data.display()))?;
        let root = place.path().to_owned();
        let files = blocking(move || listed(&root)).await?;
        let midshift = env!("CARGO_PKG_VERSION").to_owned();
        let list = List { format: FORMAT, midshift, site_id, begun_unix_ms: now.0, parts: names, files };
        write(&place.path().join(LIST), &serde_json::to_vec_pretty(&list)?)?;
        place.name(to).await?;
        Ok(list.summary())
    })
}

/// Whether everything of a backup is there, is what its list says, and hangs together. Changes nothing.
///
/// # Errors
/// With everything that is wrong with it.
pub fn verify(backup: &Path) -> Boxed<'_, anyhow::Result<Summary>> {
    Box::pin(async move {
        let path = backup.join(LIST);
        let bytes = fs::read(&path).with_context(|| format!("{} is no backup: reading {LIST}", backup.display()))?;
        let list: List =
            serde_json::from_slice(&bytes).with_context(|| format!("{} is not readable", path.display()))?;
        ensure!(list.format == FORMAT, "the backup has format {}, this release knows {FORMAT}", list.format);
        let root = backup.to_owned();
        let found = blocking(move || listed(&root)).await?;
        let mut wrong = differences(&list.files, &found);
        for name in &list.parts {
            let Some(part) = PARTS.iter().find(|part| part.name() == name) else {
                wrong.push(format!("this release knows no part {name}"));
                continue;
            };
            let folder = backup.join(name);
            match part.check(&folder).await {
                Ok(found) => wrong.extend(found.into_iter().map(|text| format!("{name}: {text}"))),
                Err(error) => wrong.push(format!("{name}: {error:#}")),
            }
        }
        if !wrong.is_empty() {
            bail!("the backup is not good: {}", wrong.join("; "));
        }
        Ok(list.summary())
    })
}

/// Makes a data directory of a backup, which is verified first, and where its rows are of PostgreSQL an empty database. Neither `to.data`
/// nor `to.ota_keys` may be there.
///
/// # Errors
/// If the backup is not good or of the other engine, the clock is before it, the database is not empty, or something cannot be written.
/// Nothing is left at `to` then, unless the database went silent at its last word: the error says so, and what to do.
pub fn restore<'a>(
    backup: &'a Path,
    to: &'a Places,
    access: &'a Access,
    now: Utc,
) -> Boxed<'a, anyhow::Result<(Summary, AccessOutcome)>> {
    Box::pin(async move {
        let revocations = access.list()?;
        let summary = verify(backup).await?;
        match (summary.has(POSTGRES), &to.store) {
            (true, None) => bail!(
                "the backup has rows of PostgreSQL and no database is named: add --store; it cannot become files of SQLite"
            ),
            (false, Some(_)) => bail!(
                "the backup has rows of SQLite and cannot go into PostgreSQL: restore it without --store, with MIDSHIFT_STORE unset"
            ),
            _ => {}
        }
        ensure!(now >= summary.begun, "this machine's clock is before the moment of the backup; set it first");
        let place = Staging::new(&to.data)?;
        // Keys that do not go into the data directory are made whole beside their own place.
        let mut keys = None;
        let mut within = Places { data: place.path().to_owned(), ota_keys: None, store: to.store.clone() };
        if let Some(folder) = &to.ota_keys {
            ensure!(summary.has(KEYS), "the backup has no online keys");
            within.ota_keys = Some(match folder.strip_prefix(&to.data) {
                Ok(inside) => place.path().join(inside),
                Err(_) => keys.insert((Staging::new(folder)?, folder.clone())).0.path().to_owned(),
            });
        }
        let mut making = Making { places: within, store_id: StoreId::fresh(), now, rows: None };
        for part in PARTS.iter().rev().filter(|part| summary.has(part.name())) {
            let put_back = part.put_back(&backup.join(part.name()), &mut making).await;
            put_back.with_context(|| format!("restoring {}", part.name()))?;
            // Before a database waits for its last word.
            place.sync().await?;
        }
        let settled =
            access.put_right(&revocations, &summary.site_id, &mut making).await.context("restoring who is known")?;
        let places = keys.into_iter().chain([(place, to.data.clone())]);
        name_all(places, making.rows).await?;
        Ok((summary, settled))
    })
}

/// Gives folders their names and commits the rows last: they alone make a server of it, and a folder without them belongs to no store.
async fn name_all(
    places: impl Iterator<Item = (Staging, PathBuf)>,
    rows: Option<PostgresRestore>,
) -> anyhow::Result<()> {
    let mut named = Vec::new();
    let named_all = async {
        for (place, folder) in places {
            place.name(&folder).await?;
            named.push(folder);
        }
        match rows {
            Some(rows) => rows.commit().await.map_err(anyhow::Error::from),
            None => Ok(()),
        }
    };
    let Err(error) = named_all.await else { return Ok(()) };
    if matches!(error.downcast_ref(), Some(RestoreError::Unknown(_))) {
        let folders: Vec<String> = named.iter().map(|folder| folder.display().to_string()).collect();
        return Err(error.context(format!(
            "if the database has rows of midshift now, all is restored; if it has none, remove {} and restore again",
            folders.join(" and ")
        )));
    }
    for folder in named {
        fs::remove_dir_all(&folder).with_context(|| format!("removing {}", folder.display()))?;
    }
    Err(error)
}

impl Summary {
    /// Whether online keys are in it.
    pub fn has_keys(&self) -> bool {
        self.has(KEYS)
    }
    /// Whether it has a part of this name.
    fn has(&self, part: &str) -> bool {
        self.parts.iter().any(|(name, ..)| name == part)
    }
}

impl List {
    fn summary(&self) -> Summary {
        let of = |name: &String| {
            let inside = self.files.iter().filter(|(path, _)| path.split('/').next() == Some(name));
            let (files, bytes) = inside.fold((0, 0), |(files, bytes), (_, kept)| (files + 1, bytes + kept.bytes));
            (name.clone(), files, bytes)
        };
        Summary {
            site_id: self.site_id.clone(),
            begun: Utc(self.begun_unix_ms),
            parts: self.parts.iter().map(of).collect(),
        }
    }
}

/// Files of a folder by their path in it, all but the list.
fn listed(root: &Path) -> anyhow::Result<BTreeMap<String, FileEntry>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).with_context(|| format!("reading {}", folder.display()))? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let inside = path.strip_prefix(root)?.to_string_lossy().into_owned();
            if inside != LIST {
                let mut file = File::open(&path).with_context(|| format!("reading {}", path.display()))?;
                let (digest, bytes) = Digest::of_reader(&mut file, FILE_BYTES_MAX)?;
                found.insert(inside, FileEntry { bytes, sha256: digest.to_string() });
            }
        }
    }
    Ok(found)
}

fn differences(list: &BTreeMap<String, FileEntry>, found: &BTreeMap<String, FileEntry>) -> Vec<String> {
    let missing = list.keys().filter(|path| !found.contains_key(*path)).map(|path| format!("{path} is missing"));
    let strange = found.keys().filter(|path| !list.contains_key(*path)).map(|path| format!("{path} is not listed"));
    let other = list.iter().filter(|(path, kept)| found.get(*path).is_some_and(|f| f != *kept));
    missing.chain(strange).chain(other.map(|(path, _)| format!("{path} is not what was copied"))).collect()
}

#[cfg(test)]
#[path = "../../../tests/src/postgres.rs"]
#[expect(dead_code, reason = "other tests need more of it")]
mod postgres_server;
#[cfg(test)]
mod tests;
