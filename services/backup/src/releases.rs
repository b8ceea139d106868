//! Signed documents of releases, and their files.

use super::files::{blocking, copy, copy_if_there, entries, must, read};
use super::part::{BackupFacts, Making, Part, Places};
use anyhow::ensure;
use async_trait::async_trait;
use midshift_bundle::digest::Digest;
use midshift_bundle::repository::listed;
use midshift_ota::folder::{mark, must_be_of};
use midshift_ota::repository::raise_floor;
use std::fs::{self, File};
use std::path::Path;

/// Signed documents and the files of releases. What is made of them for the way to robots is made again.
pub struct Releases;

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
    async fn copy(&self, from: &Places, folder: &Path, facts: &mut BackupFacts) -> anyhow::Result<bool> {
        let (from, folder) = (from.data.join(RELEASES), folder.to_owned());
        let (owner, bundles) = (facts.store_id.clone(), facts.bundles);
        blocking(move || {
            let is_begun = || [DOCUMENTS, FILES].iter().any(|part| from.join(part).is_dir());
            if !from.is_dir() || (owner.is_some() && !is_begun()) {
                ensure!(
                    bundles == 0,
                    "the store knows {bundles} bundles and {} has none: name with --data the directory that processes with role ota have, or mount its volume",
                    from.display()
                );
                return Ok(false);
            }
            // Rows that are not beside it may be another store's.
            owner.map_or(Ok(()), |owner| must_be_of(&from, &owner))?;
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
    async fn put_back(&self, folder: &Path, to: &mut Making) -> anyhow::Result<()> {
        let (from, now, store_id) = (folder.to_owned(), to.now, to.store_id.clone());
        let to = to.places.data.join(RELEASES);
        blocking(move || {
            mark(&to, &store_id)?;
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

fn digest_of(path: &Path) -> Option<Digest> {
    path.file_name()?.to_str()?.parse().ok()
}
