//! Whether what is offered may be published: the chain of roots, the targets document, every file and bundle that it lists.
//!
//! Invariant: nothing is written here, and all that is wrong with an offer is told at once as far as it can be known.

use super::{Error, Kept, Release};
use crate::content::Content;
use midshift_bundle::digest::Digest;
use midshift_bundle::freshness::{root_edition, targets_edition};
use midshift_bundle::manifest::{MANIFEST_BYTES_MAX, Manifest};
use midshift_bundle::repository::{FileTarget, check_root, check_targets};
use midshift_bundle::trust::METADATA_BYTES_MAX;
use midshift_core::reason::Violations;
use midshift_core::task::raw::parse_version;
use midshift_core::time::Utc;
use std::collections::BTreeMap;
use tokio::io::AsyncReadExt;

/// The newest root of a chain: each is the next after the one before, and signed by it.
pub fn roots(before: Option<&Kept>, offered: &[Vec<u8>], now: Utc) -> Result<Kept, Error> {
    let mut bad = Violations::default();
    let mut newest = before.cloned();
    for (i, bytes) in offered.iter().enumerate() {
        let field = format!("roots[{i}]");
        check_size(&mut bad, &field, bytes);
        let Some(edition) = bad.take(&field, root_edition(bytes)) else { break };
        let next = newest.as_ref().map_or(1, |root| root.edition.version + 1);
        if edition.version != next {
            bad.add(&field, format!("is root {}; the next is {next}", edition.version));
            break;
        }
        let signers = newest.as_ref().map_or(bytes, |root| &root.bytes);
        bad.take(&field, check_root(signers, bytes));
        newest = Some(Kept { bytes: bytes.clone(), edition });
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
pub fn targets(root: &Kept, before: Option<&Kept>, offered: Vec<u8>, now: Utc) -> Result<Kept, Error> {
    let mut bad = Violations::default();
    check_size(&mut bad, "targets", &offered);
    bad.take("targets", check_targets(&root.bytes, &offered));
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
    Ok(Kept { edition: targets_edition(&offered)?, bytes: offered })
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
        let Some(manifest) = bad.take(&field, manifest(file, content).await?) else { continue };
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

/// Whether a listed file is the manifest of a bundle.
pub fn is_manifest(file: &FileTarget) -> bool {
    file.name.ends_with(".manifest")
}

/// Reads the manifest of a bundle; the inner error is what is wrong with it.
pub async fn manifest(file: &FileTarget, content: &dyn Content) -> Result<Result<Manifest, String>, Error> {
    let read = read_manifest(file.digest, content).await?;
    Ok(read.and_then(|manifest| {
        let target = manifest.target();
        if target == file.name { Ok(manifest) } else { Err(format!("is the manifest {target}")) }
    }))
}

/// Reads the manifest of a bundle, whatever its name; the inner error is what is wrong with it.
pub async fn read_manifest(digest: Digest, content: &dyn Content) -> Result<Result<Manifest, String>, Error> {
    // One byte too many is enough to know that it is too long.
    let range = 0..MANIFEST_BYTES_MAX as u64 + 1;
    let Some(mut reader) = content.read(digest, range).await? else { return Ok(Err("is gone".to_owned())) };
    let mut bytes = Vec::new();
    if let Err(error) = reader.read_to_end(&mut bytes).await {
        return Ok(Err(error.to_string()));
    }
    Ok(Manifest::from_bytes(&bytes).map_err(|refusal| refusal.to_string()))
}

/// By name, then by version as numbers, then as text.
pub fn sort(releases: &mut [Release]) {
    let order = |r: &Release| (r.manifest.name.clone(), parse_version(&r.manifest.version), r.manifest.version.clone());
    releases.sort_by_cached_key(order);
}
