//! Makes the encoded targets of a new release before it is signed: compressed files, and patches from the releases that
//! robots are likely to have.
//!
//! Invariant: one that is listed is never made again, since another release of this program may make other bytes of it; one is kept only if it is
//! worth it.

use super::{Error, Folder, io};
use crate::encoded_target::EncodedTarget;
use crate::encoding::{Base, ENCODED_BYTES_MAX, ENCODED_BYTES_MIN, Encoded, encode};
use crate::manifest::{Component, Manifest};
use crate::repository::{FileTarget, listed};
use midshift_core::reason::Refusal;
use midshift_core::task::raw::parse_version;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self as stdio, BufWriter};
use std::path::Path;

/// Releases of a bundle, the newest by version, from which robots are expected to come.
const RELEASES_BEFORE: usize = 3;
/// An encoded target is worth it up to this share of the file, percent: above it asking costs more than it saves.
const WORTH_PERCENT: u64 = 95;

impl Folder {
    /// Makes what robots will fetch instead of the files of `bundle`, and puts it beside them.
    pub(super) fn make_encoded_targets(
        &self,
        bundle: &Path,
        manifest: &Manifest,
        previous: Option<&[u8]>,
        from: &[String],
    ) -> Result<Vec<FileTarget>, Error> {
        let known = previous.map(listed).transpose()?.unwrap_or_default();
        let names: BTreeSet<&str> = known.iter().map(|file| file.name.as_str()).collect();
        let releases = self.likely(manifest, &known, from)?;
        let mut made = Vec::new();
        for component in &manifest.components {
            if !(ENCODED_BYTES_MIN..=ENCODED_BYTES_MAX).contains(&component.length) {
                continue;
            }
            let file = bundle.join(component.target());
            let mut most = component.length / 100 * WORTH_PERCENT;
            let whole = EncodedTarget { to: component.digest, from: None };
            if let Some(listed) = known.iter().find(|file| file.name == whole.target()) {
                most = most.min(listed.length - 1);
            } else if let Some(shorter) = self.make(whole, &file, component.length, None, most)? {
                // A patch is worth it if it is shorter than that.
                most = shorter.length - 1;
                made.push(shorter);
            }
            for base in bases(component, &releases) {
                let patch = EncodedTarget { to: component.digest, from: Some(base.digest) };
                let is_there =
                    names.contains(patch.target().as_str()) || made.iter().any(|file| file.name == patch.target());
                if !is_there {
                    let base = self.file(&base.target(), base.digest);
                    made.extend(self.make(patch, &file, component.length, Some(&base), most)?);
                }
            }
        }
        Ok(made)
    }

    /// The newest releases of the same bundle, and those that are named.
    fn likely(&self, manifest: &Manifest, known: &[FileTarget], from: &[String]) -> Result<Vec<Manifest>, Error> {
        let mut all = Vec::new();
        for file in known.iter().filter(|file| file.name.ends_with(".manifest")) {
            let path = self.file(&file.name, file.digest);
            all.push(Manifest::from_bytes(&fs::read(&path).map_err(io("reading", &path))?)?);
        }
        let named = |release: &Manifest, name: &String| format!("{}-{}", release.name, release.version) == *name;
        if let Some(name) = from.iter().find(|name| !all.iter().any(|release| named(release, name))) {
            return Err(
                Refusal::field("from", format!("no release lists {name}; bundle verify lists those it has")).into()
            );
        }
        all.sort_by_key(|release| std::cmp::Reverse(parse_version(&release.version)));
        let mut before = 0;
        all.retain(|release| {
            let is_other = release.name == manifest.name && release.version != manifest.version;
            before += usize::from(is_other);
            (is_other && before <= RELEASES_BEFORE) || from.iter().any(|name| named(release, name))
        });
        Ok(all)
    }

    fn make(
        &self,
        target: EncodedTarget,
        file: &Path,
        length: u64,
        base: Option<&Path>,
        most: u64,
    ) -> Result<Option<FileTarget>, Error> {
        let beside = self.targets().join("way.new");
        let write = || -> stdio::Result<Option<Encoded>> {
            let mut base = base.map(File::open).transpose()?;
            let mut out = BufWriter::new(File::create(&beside)?);
            let base = base.as_mut().map(|base| base as &mut dyn Base);
            let encoded = encode(base, &mut File::open(file)?, length, &mut out, most)?;
            out.into_inner()?.sync_all()?;
            Ok(encoded)
        };
        let Some(Encoded { digest, length }) = write().map_err(io("writing", &beside))? else {
            fs::remove_file(&beside).map_err(io("removing", &beside))?;
            return Ok(None);
        };
        let name = target.target();
        let path = self.file(&name, digest);
        midshift_durable::rename(&beside, &path).map_err(io("naming", &path))?;
        Ok(Some(FileTarget { name, digest, length }))
    }
}

/// Other bytes of the same component in these releases.
fn bases<'a>(component: &'a Component, releases: &'a [Manifest]) -> impl Iterator<Item = &'a Component> {
    let others = releases.iter().flat_map(|release| &release.components);
    others.filter(move |other| other.name == component.name && other.digest != component.digest)
}
