//! Whether what is offered may be published: the chain of roots, the targets document, every file and bundle that it lists.
//!
//! Invariant: nothing is written here, and all that is wrong with an offer is told at once as far as it can be known.

use super::error::{Error, io};
use super::newest::{Newest, Release, SignedDocument};
use super::online::OnlineKeys;
use crate::content::Content;
use midshift_bundle::digest::Digest;
use midshift_bundle::freshness::{root_edition, targets_edition};
use midshift_bundle::key_set::{ENVELOPE_BYTES_MAX, KeySet, SETS_MAX};
use midshift_bundle::manifest::{MANIFEST_BYTES_MAX, Manifest};
use midshift_bundle::repository::{FileTarget, check_root, check_targets};
use midshift_bundle::trust::METADATA_BYTES_MAX;
use midshift_core::reason::Violations;
use midshift_core::task::raw::parse_version;
use midshift_core::time::Utc;
use std::collections::BTreeMap;
use std::path::Path;
use tokio::io::AsyncReadExt;

/// The newest root of a chain: each is the next after the one before, and signed by it.
pub fn roots(before: Option<&SignedDocument>, offered: &[Vec<u8>], now: Utc) -> Result<SignedDocument, Error> {
    let mut bad = Violations::default();
    let mut newest = before.cloned();
    for (i, bytes) in offered.iter().enumerate() {
        let field = format!("roots[{i}]");
        check_size(&mut bad, &field, bytes);
        let Some(edition) = bad.accept(&field, root_edition(bytes)) else { break };
        let next = newest.as_ref().map_or(1, |root| root.edition.version + 1);
        if edition.version != next {
            bad.add(&field, format!("is root {}; the next is {next}", edition.version));
            break;
        }
        let signers = newest.as_ref().map_or(bytes, |root| &root.bytes);
        bad.accept(&field, check_root(signers, bytes));
        newest = Some(SignedDocument { bytes: bytes.clone(), edition });
    }
    if newest.is_none() && bad.0.is_empty() {
        bad.add("roots", "the server has no root yet: the first publication brings all of them, from 1.root.json on");
    }
    if let Some(root) = newest.as_ref().filter(|root| root.edition.expires <= now) {
        bad.add("roots", format!("root {} expired at {}", root.edition.version, root.edition.expires.rfc3339()));
    }
    bad.finish()?;
    newest.ok_or_else(|| midshift_core::reason::Refusal::field("roots", "is required").into())
}

/// The targets document that follows `before`, if `root` lets its signers sign.
pub fn targets(
    root: &SignedDocument,
    before: Option<&SignedDocument>,
    offered: Vec<u8>,
    now: Utc,
) -> Result<SignedDocument, Error> {
    let mut bad = Violations::default();
    check_size(&mut bad, "targets", &offered);
    bad.accept("targets", check_targets(&root.bytes, &offered));
    let edition = targets_edition(&offered).ok();
    if let (Some(edition), Some(before)) = (edition, before)
        && edition.version != before.edition.version + 1
    {
        let next = before.edition.version + 1;
        bad.add("targets", format!("is version {}; the next is {next}", edition.version));
    }
    if let Some(edition) = edition.filter(|edition| edition.expires <= now) {
        bad.add("targets", format!("expired at {}", edition.expires.rfc3339()));
    }
    bad.finish()?;
    Ok(SignedDocument { edition: targets_edition(&offered)?, bytes: offered })
}

fn check_size(bad: &mut Violations, field: &str, document: &[u8]) {
    if document.len() as u64 > METADATA_BYTES_MAX {
        bad.add(field, format!("has more than {METADATA_BYTES_MAX} bytes"));
    }
}

/// Bundles among listed files, once every file is here. `seen` is when each was seen first, and learns of the new ones.
pub async fn releases(
    files: &[FileTarget],
    content: &dyn Content,
    seen: &mut BTreeMap<Digest, Utc>,
    now: Utc,
) -> Result<Vec<Release>, Error> {
    let mut missing = Vec::new();
    for file in files {
        if content.length(file.digest).await? != Some(file.length) {
            missing.push(file.clone());
        }
    }
    if !missing.is_empty() {
        return Err(Error::Missing(missing));
    }
    let by_name: BTreeMap<&str, &FileTarget> = files.iter().map(|file| (file.name.as_str(), file)).collect();
    let mut bad = Violations::default();
    let mut releases = Vec::new();
    for file in files.iter().filter(|file| is_manifest(file)) {
        let field = format!("targets.{}", file.name);
        let Some(manifest) = bad.accept(&field, manifest(file, content).await?) else { continue };
        for component in &manifest.components {
            let target = component.target();
            let found = by_name.get(target.as_str()).map(|file| (file.digest, file.length));
            if found != Some((component.digest, component.length)) {
                bad.add(&field, format!("{target} is not listed with the bytes that the manifest names"));
            }
        }
        let seen = *seen.entry(file.digest).or_insert(now);
        releases.push(Release { digest: file.digest, manifest, seen });
    }
    bad.finish()?;
    sort(&mut releases);
    Ok(releases)
}

/// The newest of the listed sets of directive keys, if robots can go from each to the next and this server can sign by it.
pub async fn key_sets(
    files: &[FileTarget],
    before: Option<&Newest>,
    content: &dyn Content,
    own: &OnlineKeys,
) -> Result<Option<KeySet>, Error> {
    let mut bad = Violations::default();
    let mut numbered = BTreeMap::new();
    for file in files.iter().filter(|file| KeySet::is_named(&file.name)) {
        match KeySet::number_of(&file.name) {
            Some(number) => drop(numbered.insert(number, file)),
            None => bad.add(
                format!("targets.{}", file.name),
                "a set of directive keys is listed as N.directive-keys, N from 1 on",
            ),
        }
    }
    let known = before.and_then(|before| before.key_set.as_ref());
    let first = numbered.keys().next().copied().unwrap_or(1);
    let newest = numbered.keys().last().copied().unwrap_or_default();
    let gone = before.iter().flat_map(|before| before.files.keys()).filter(|name| KeySet::is_named(name));
    for name in gone.filter(|name| !files.iter().any(|file| file.name == **name)) {
        bad.add(format!("targets.{name}"), "is no longer listed; robots that were away need it");
    }
    if numbered.len() > SETS_MAX {
        bad.add("targets", format!("lists more than {SETS_MAX} sets of directive keys"));
    }
    if first != 1 || numbered.len() as u64 != newest {
        bad.add(
            "targets",
            format!("lists {} sets of directive keys up to {newest}.directive-keys; one is left out", numbered.len()),
        );
    }
    bad.finish()?;
    let mut last: Option<KeySet> = known.cloned();
    let new = numbered.range(known.map_or(0, |known| known.number) + 1..);
    let mut bad = Violations::default();
    for (number, file) in new {
        let field = format!("targets.{}", file.name);
        let Some((set, envelope)) = bad.accept(&field, key_set(file, content).await?) else { break };
        // Only robots know who signed the first one of a repository that is new here.
        let is_known = before.is_some() || last.is_some();
        let can_sign = |last: &&KeySet| before.is_none() || own.named_by(last).is_some();
        let signers = match last.as_ref().filter(can_sign) {
            Some(last) => last.keys.clone(),
            // The first one, or all keys of the one before are lost: robots have this server's from their trust files.
            None => own.directives().iter().map(|key| key.public()).collect(),
        };
        if is_known && let Err(rejection) = KeySet::open(&envelope, *number, &signers) {
            bad.add(&field, rejection.to_string());
        } else if set.number != *number {
            bad.add(&field, format!("is set {}", set.number));
        }
        last = Some(set);
    }
    if let Some(set) = last.as_ref().filter(|set| Some(*set) != known)
        && own.named_by(set).is_none()
    {
        bad.add(
            format!("targets.{}", set.target()),
            "names no directive key of this server: put it into the folder of --ota-keys and start the server first",
        );
    }
    bad.finish()?;
    Ok(last)
}

/// The newest set of directive keys among listed files.
pub fn newest_set(files: &[FileTarget]) -> Option<&FileTarget> {
    files.iter().filter_map(|file| Some((KeySet::number_of(&file.name)?, file))).max_by_key(|(n, _)| *n).map(|(_, f)| f)
}

/// The bytes of a listed file, as many as one may have and one more: enough to know that it is too long. None: it is not here.
///
/// # Errors
/// The disk's, of which nobody knows whether they are there the next time: the file is no worse for it.
async fn bytes_of(digest: Digest, most: u64, content: &dyn Content) -> Result<Option<Vec<u8>>, Error> {
    let Some(mut reader) = content.read(digest, 0..most + 1).await? else { return Ok(None) };
    let mut bytes = Vec::new();
    let read = reader.read_to_end(&mut bytes).await;
    read.map_err(io("reading", Path::new(&digest.to_string())))?;
    Ok(Some(bytes))
}

/// Reads a set of directive keys and its envelope; the inner error is what is wrong with it. Who signed it is not looked at.
///
/// # Errors
/// The disk's.
pub async fn key_set(file: &FileTarget, content: &dyn Content) -> Result<Result<(KeySet, Vec<u8>), String>, Error> {
    let Some(bytes) = bytes_of(file.digest, ENVELOPE_BYTES_MAX as u64, content).await? else {
        return Ok(Err("is gone".to_owned()));
    };
    Ok(KeySet::read(&bytes).map(|set| (set, bytes)).map_err(|rejection| rejection.to_string()))
}

/// Whether a listed file is the manifest of a bundle.
pub fn is_manifest(file: &FileTarget) -> bool {
    file.name.ends_with(".manifest")
}

/// Reads the manifest of a bundle; the inner error is what is wrong with it.
///
/// # Errors
/// The disk's.
pub async fn manifest(file: &FileTarget, content: &dyn Content) -> Result<Result<Manifest, String>, Error> {
    let read = read_manifest(file.digest, content).await?;
    Ok(read.and_then(|manifest| {
        let target = manifest.target();
        if target == file.name { Ok(manifest) } else { Err(format!("is the manifest {target}")) }
    }))
}

/// Reads the manifest of a bundle, whatever its name; the inner error is what is wrong with it.
///
/// # Errors
/// The disk's.
pub async fn read_manifest(digest: Digest, content: &dyn Content) -> Result<Result<Manifest, String>, Error> {
    let Some(bytes) = bytes_of(digest, MANIFEST_BYTES_MAX as u64, content).await? else {
        return Ok(Err("is gone".to_owned()));
    };
    Ok(Manifest::from_bytes(&bytes).map_err(|refusal| refusal.to_string()))
}

/// By name, then by version as numbers, then as text.
pub fn sort(releases: &mut [Release]) {
    let order = |r: &Release| (r.manifest.name.clone(), parse_version(&r.manifest.version), r.manifest.version.clone());
    releases.sort_by_cached_key(order);
}
