//! From a draft and its files to a bundle: a folder with the manifest and every component under its target name.
//!
//! Invariant: the bytes that are hashed are the bytes that are written, and the folder appears whole or not at all.

use crate::digest::Digest;
use crate::manifest::{COMPONENT_BYTES_MAX, Component, Draft, FORMAT, MANIFEST_BYTES_MAX, Manifest};
use midshift_core::reason::{Refusal, Violations};
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Component as PathPart, Path, PathBuf};

/// The draft in a folder.
pub const DRAFT_FILE: &str = "bundle.toml";

/// Why nothing was built.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The draft breaks rules.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// A file could not be read or written.
    #[error("{doing} {path}: {source}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// With which file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
}

fn io(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { doing, path, source }
}

/// Nothing is ever written over.
pub(crate) fn taken() -> io::Error {
    io::Error::new(io::ErrorKind::AlreadyExists, "it is there already; name a new folder")
}

/// Reads `bundle.toml` in `folder`.
///
/// # Errors
/// If it cannot be read or is none.
pub fn read_draft(folder: &Path) -> Result<Draft, Error> {
    let path = folder.join(DRAFT_FILE);
    let text = fs::read_to_string(&path).map_err(io("reading", &path))?;
    if text.len() > MANIFEST_BYTES_MAX {
        return Err(Refusal::field(DRAFT_FILE, format!("has more than {MANIFEST_BYTES_MAX} bytes")).into());
    }
    toml::from_str(&text).map_err(|e| Refusal::field(DRAFT_FILE, e.to_string().trim().to_owned()).into())
}

/// Builds the draft in `folder` into the new folder `out`. `progress` hears the bytes of each piece that was written.
///
/// # Errors
/// Everything that is wrong with the draft at once; a file that is missing; an `out` that is there already.
pub fn build(folder: &Path, out: &Path, progress: &mut dyn FnMut(u64)) -> Result<Manifest, Error> {
    let draft = read_draft(folder)?;
    check_files(&draft)?;
    // The rules first, with lengths and digests that stand in: nobody waits for gigabytes to hear of a typing error.
    manifest(&draft, |_| (Digest::of_content(b""), 1)).check()?;
    if out.exists() {
        return Err(Error::Io { doing: "making", path: out.to_owned(), source: taken() });
    }
    let parent = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let staging =
        tempfile::Builder::new().prefix(".bundle-").tempdir_in(parent).map_err(io("making a folder in", parent))?;
    let mut written = Vec::new();
    for component in &draft.components {
        let target = format!("{}-{}.component", component.name, component.version);
        written.push(copy(&folder.join(&component.file), &staging.path().join(target), progress)?);
    }
    let manifest = manifest(&draft, |i| written[i]);
    manifest.check()?;
    let path = staging.path().join(manifest.target());
    midshift_durable::write(&path, &manifest.to_bytes()).map_err(io("writing", &path))?;
    midshift_durable::sync_folder(staging.path()).map_err(io("writing", staging.path()))?;
    midshift_durable::rename(&staging.keep(), out).map_err(io("making", out))?;
    Ok(manifest)
}

fn check_files(draft: &Draft) -> Result<(), Refusal> {
    let mut bad = Violations::default();
    for (i, component) in draft.components.iter().enumerate() {
        let inside = Path::new(&component.file).components().all(|part| matches!(part, PathPart::Normal(_)));
        if component.file.is_empty() || !inside {
            bad.add(format!("component[{i}].file"), "must be a path below the folder of the draft");
        }
    }
    bad.finish()
}

fn manifest(draft: &Draft, content: impl Fn(usize) -> (Digest, u64)) -> Manifest {
    let components = draft.components.iter().enumerate().map(|(i, c)| {
        let (digest, length) = content(i);
        Component {
            name: c.name.clone(),
            version: c.version.clone(),
            kind: c.kind,
            hardware: c.hardware.iter().cloned().collect(),
            capabilities: c.capabilities.iter().cloned().collect(),
            requires: c.requires.clone(),
            conflicts: c.conflicts.clone(),
            work_level: c.work_level,
            rollback_index: c.rollback_index,
            safety_class: c.safety_class,
            needs: c.needs,
            data_migration: c.data_migration,
            digest,
            length,
        }
    });
    Manifest {
        format: FORMAT,
        name: draft.name.clone(),
        version: draft.version.clone(),
        description: draft.description.clone(),
        hard_stop_codes: draft.hard_stop_codes.iter().copied().collect(),
        raises_floor: draft.raises_floor,
        components: components.collect(),
    }
}

/// Copies a file through the hash: one reading gives both the digest and the bytes.
fn copy(from: &Path, to: &Path, progress: &mut dyn FnMut(u64)) -> Result<(Digest, u64), Error> {
    struct Tee<'a> {
        from: File,
        to: File,
        progress: &'a mut dyn FnMut(u64),
    }
    impl Read for Tee<'_> {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            let count = self.from.read(buffer)?;
            self.to.write_all(&buffer[..count])?;
            (self.progress)(count as u64);
            Ok(count)
        }
    }
    let source = File::open(from).map_err(io("reading", from))?;
    let target = File::create_new(to).map_err(io("writing", to))?;
    let mut tee = Tee { from: source, to: target, progress };
    let found = Digest::of_reader(&mut tee, COMPONENT_BYTES_MAX).map_err(io("reading", from))?;
    tee.to.sync_all().map_err(io("writing", to))?;
    Ok(found)
}

/// Reads the manifest in a built folder and holds every component against it.
///
/// # Errors
/// A file that is missing, too long or another; all of them at once.
pub fn inspect(folder: &Path) -> Result<Manifest, Error> {
    let mut manifests = Vec::new();
    for entry in fs::read_dir(folder).map_err(io("reading", folder))? {
        let path = entry.map_err(io("reading", folder))?.path();
        if path.extension().is_some_and(|e| e == "manifest") {
            manifests.push(path);
        }
    }
    let [path] = &manifests[..] else {
        let text = format!("there must be one .manifest in {}, not {}", folder.display(), manifests.len());
        return Err(Refusal::field("manifest", text).into());
    };
    let manifest = Manifest::from_bytes(&fs::read(path).map_err(io("reading", path))?)?;
    let mut bad = Violations::default();
    for (i, component) in manifest.components.iter().enumerate() {
        let path = folder.join(component.target());
        let mut file = File::open(&path).map_err(io("reading", &path))?;
        match Digest::of_reader(&mut file, component.length) {
            Ok(found) if found == (component.digest, component.length) => {}
            Ok((digest, length)) => bad.add(
                format!("component[{i}]"),
                format!("{} has {length} bytes with digest {digest}, not what the manifest says", component.target()),
            ),
            Err(e) if e.kind() == io::ErrorKind::InvalidData => {
                bad.add(format!("component[{i}]"), format!("{} has {e}", component.target()));
            }
            Err(e) => return Err(io("reading", &path)(e)),
        }
    }
    bad.finish()?;
    Ok(manifest)
}
