//! Sets of a robot in a folder.
//!
//! ```text
//! switch            which set runs (crate::launcher::switch)
//! boot              which base the machine starts from (crate::launcher::boot); base-a and base-b are its slots
//! switch.copy, boot.copy  the second copies of both
//! content/DIGEST    bytes that were checked; DIGEST.part and DIGEST.map while they come, DIGEST.made while they are made of a shorter
//!                   way, DIGEST.plain if no such way is to be tried
//! SET/NAME          hard link to a component's content; SET is the set's id
//! SET/set.program   hard link to the one of kind process
//! SET/set.base      name of its base, if it has one of its own
//! SET/set.json      what is in it; written last
//! ```
//! Invariant: a folder has the name of a set only when it is whole: it is made beside and renamed.

use super::content::{Part, remove};
use super::{CHUNK_BYTES, Error, FileRef, Holdings, Sets, base_name};
use crate::launcher::boot::{BASE, BOOT};
use crate::launcher::start_policy::TRIES_MAX;
use crate::launcher::switch::Switch;
use crate::launcher::{PROGRAM, SWITCH};
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding::{self, Base};
use midshift_bundle::manifest::{COMPONENT_BYTES_MAX, Component, ComponentKind, MANIFEST_BYTES_MAX};
use midshift_bundle::set::SetManifest;
use midshift_durable::record;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// What is in a set, as a file of it.
const SET_FILE: &str = "set.json";
/// Bytes of that file: a manifest's worth for each bundle it may have come from.
const SET_BYTES_MAX: u64 = 4 * MANIFEST_BYTES_MAX as u64;
/// Where content lies.
const CONTENT: &str = "content";

/// The sets in one folder. One owner at a time: the agent that runs.
#[derive(Debug)]
pub struct DiskSets {
    pub(super) folder: PathBuf,
    part: Option<Part>,
    /// Number of a switch record whose trial the launcher has put away and could not write so.
    overtaken: Option<u64>,
}

pub(super) fn io_error(doing: &'static str) -> impl FnOnce(io::Error) -> Error {
    move |source| Error::Io { doing, source }
}

/// None for what is not there.
pub(super) fn optional<T>(result: io::Result<T>) -> io::Result<Option<T>> {
    match result {
        Ok(value) => Ok(Some(value)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

impl DiskSets {
    /// Opens a folder, or makes it.
    ///
    /// # Errors
    /// The disk's.
    pub fn open(folder: &Path) -> Result<Self, Error> {
        midshift_durable::make_folder(&folder.join(CONTENT)).map_err(io_error("making the folder of sets"))?;
        Ok(Self { folder: folder.to_owned(), part: None, overtaken: None })
    }

    /// Tells it which set the launcher has started. If the record names another one, which is on trial, the launcher
    /// has put that away and could not write it down: it is taken as written, and written with whatever is written
    /// next.
    ///
    /// # Errors
    /// A disk that cannot be read, or a damaged switch record.
    pub fn started_from(&mut self, set: &str) -> Result<(), Error> {
        let switch = self.switch()?;
        let is_put_away = switch.trial.is_some() && switch.current == set;
        self.overtaken = is_put_away.then_some(switch.number);
        Ok(())
    }

    /// The switch record as it holds.
    pub(super) fn switch(&self) -> Result<Switch, Error> {
        let path = self.folder.join(SWITCH);
        let mut switch = Switch::read(&path).map_err(io_error("reading the switch record"))?;
        if self.overtaken == Some(switch.number) {
            switch.fall_back(TRIES_MAX);
        }
        Ok(switch)
    }

    pub(super) fn content(&self, digest: &Digest) -> PathBuf {
        self.folder.join(CONTENT).join(digest.to_string())
    }

    /// The file that a running program may read: settings of its own set.
    pub fn component(&self, set: &str, name: &str) -> PathBuf {
        self.folder.join(set).join(name)
    }

    fn has(&self, wanted: &FileRef) -> Result<bool, Error> {
        let there = optional(fs::metadata(self.content(&wanted.digest))).map_err(io_error("looking for content"))?;
        Ok(there.is_some_and(|file| file.len() == wanted.length))
    }

    fn part(&mut self, wanted: &FileRef) -> Result<&mut Part, Error> {
        if self.part.as_ref().is_none_or(|part| part.wanted() != wanted) {
            if let Some(mut other) = self.part.take() {
                other.sync()?;
            }
            self.part = Some(Part::open(&self.folder.join(CONTENT), wanted)?);
        }
        match &mut self.part {
            Some(part) => Ok(part),
            None => unreachable!("was opened above"),
        }
    }

    /// Whole sets: folders with a name of one and a page that is what the name says.
    pub(super) fn sets(&self) -> Result<BTreeMap<Digest, SetManifest>, Error> {
        let list = || {
            let mut sets = BTreeMap::new();
            for entry in fs::read_dir(&self.folder)? {
                let entry = entry?;
                let Some(id) = entry.file_name().to_str().and_then(|name| name.parse::<Digest>().ok()) else {
                    continue;
                };
                let Some(page) = optional(read_limited(&entry.path().join(SET_FILE), SET_BYTES_MAX))? else { continue };
                if let Some(set) = serde_json::from_slice::<SetManifest>(&page).ok().filter(|set| set.id() == id) {
                    sets.insert(id, set);
                }
            }
            Ok(sets)
        };
        list().map_err(io_error("listing sets"))
    }

    /// Makes content beside and gives it its name once it was read back by the handle it was written with.
    fn make(&self, wanted: &FileRef, base: Option<&Digest>, way: &Path, to: &Path) -> Result<(), Error> {
        let open = |digest: &Digest| {
            let file = optional(File::open(self.content(digest))).map_err(io_error("opening content"))?;
            file.ok_or(Error::Missing(*digest))
        };
        let mut base = base.map(open).transpose()?;
        let mut way = File::open(way).map_err(io_error("opening a way"))?;
        let beside = to.with_extension("made");
        let mut options = OpenOptions::new();
        let file = options.read(true).write(true).create(true).truncate(true).open(&beside);
        let mut out = BufWriter::with_capacity(CHUNK_BYTES as usize, file.map_err(io_error("making content"))?);
        let base = base.as_mut().map(|base| base as &mut dyn Base);
        let written = encoding::decode(base, &mut way, wanted.length, &mut out).and_then(|()| out.flush());
        match written {
            Err(error) if error.kind() == io::ErrorKind::StorageFull => return Err(io_error("making content")(error)),
            // Whatever else it is: this way does not lead there.
            Err(_) => return Err(Error::Corrupt { digest: wanted.digest }),
            Ok(()) => {}
        }
        let file = out.get_mut();
        let mut read = || {
            file.seek(SeekFrom::Start(0))?;
            Digest::of_reader(file, wanted.length)
        };
        if read().map_err(io_error("reading what was made"))? != (wanted.digest, wanted.length) {
            return Err(Error::Corrupt { digest: wanted.digest });
        }
        let name = || {
            out.get_ref().sync_all()?;
            midshift_durable::rename(&beside, to)?;
            remove(&to.with_extension("map"))?;
            remove(&to.with_extension("part"))?;
            remove(&to.with_extension("plain"))
        };
        name().map_err(io_error("naming content"))
    }

    /// Reads every file of a set.
    fn verify_files(&self, id: &Digest) -> Result<SetManifest, Error> {
        let folder = self.folder.join(id.to_string());
        let set = self.sets()?.remove(id).ok_or(Error::Missing(*id))?;
        let program = set.program().map(|program| (PROGRAM.to_owned(), program));
        for (name, component) in set.components.iter().map(|(name, c)| (name.clone(), c)).chain(program) {
            verify_file(&folder.join(name), component)?;
        }
        Ok(set)
    }

    /// Links all of a set into its folder, in place of what lies there; its page comes last.
    fn link_anew(&self, set: &SetManifest, folder: &Path) -> io::Result<()> {
        midshift_durable::make_folder(folder)?;
        let link = |digest: &Digest, name: &str| {
            let beside = folder.join(format!("{name}.new"));
            remove(&beside)?;
            fs::hard_link(self.content(digest), &beside)?;
            midshift_durable::rename(&beside, &folder.join(name))?;
            // Two names of one file: nothing was renamed.
            remove(&beside)
        };
        for component in set.components.values() {
            link(&component.digest, &component.name)?;
        }
        if let Some(program) = set.program() {
            self.make_callable(&program.digest)?;
            link(&program.digest, PROGRAM)?;
        }
        if set.base().is_some() {
            midshift_durable::replace(&folder.join(BASE), base_name(set).as_bytes())?;
        }
        midshift_durable::replace(&folder.join(SET_FILE), &set.to_bytes())
    }

    /// A program that lost its mode with the power could not be started.
    fn make_callable(&self, program: &Digest) -> io::Result<()> {
        let content = self.content(program);
        fs::set_permissions(&content, Permissions::from_mode(0o755))?;
        midshift_durable::sync_file(&content)
    }

    /// Links all of a set into a folder beside and gives it its name.
    fn assemble(&self, set: &SetManifest, folder: &Path) -> io::Result<()> {
        let beside = folder.with_extension("new");
        for half in [folder, &beside] {
            optional(fs::remove_dir_all(half))?;
        }
        fs::create_dir(&beside)?;
        for component in set.components.values() {
            fs::hard_link(self.content(&component.digest), beside.join(&component.name))?;
        }
        if let Some(program) = set.program() {
            self.make_callable(&program.digest)?;
            fs::hard_link(self.content(&program.digest), beside.join(PROGRAM))?;
        }
        if set.base().is_some() {
            midshift_durable::write(&beside.join(BASE), base_name(set).as_bytes())?;
        }
        midshift_durable::write(&beside.join(SET_FILE), &set.to_bytes())?;
        midshift_durable::sync_folder(&beside)?;
        midshift_durable::rename(&beside, folder)
    }
}

/// Reads a file that is to have the bytes of a component.
fn verify_file(path: &Path, component: &Component) -> Result<(), Error> {
    let file = optional(File::open(path)).map_err(io_error("reading a set"))?;
    let mut file = file.ok_or(Error::Missing(component.digest))?;
    let read = match Digest::of_reader(&mut file, COMPONENT_BYTES_MAX) {
        Err(error) if error.kind() != io::ErrorKind::InvalidData => return Err(io_error("reading a set")(error)),
        read => read.ok(),
    };
    let is_right = read == Some((component.digest, component.length));
    if is_right { Ok(()) } else { Err(Error::Corrupt { digest: component.digest }) }
}

/// Deletes the folder of a set. Its page goes first and for good: without it the folder is no set, whatever else of it
/// is left.
fn delete_set(folder: &Path) -> io::Result<()> {
    remove(&folder.join(SET_FILE))?;
    midshift_durable::sync_folder(folder)?;
    fs::remove_dir_all(folder)
}

fn read_limited(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    File::open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most { Err(io::ErrorKind::FileTooLarge.into()) } else { Ok(bytes) }
}

impl Sets for DiskSets {
    fn holdings(&mut self) -> Result<Holdings, Error> {
        let switch = self.switch()?;
        let room = rustix::fs::statvfs(&self.folder).map_err(io::Error::from).map_err(io_error("asking for room"))?;
        let free_bytes = room.f_bavail.saturating_mul(room.f_frsize);
        Ok(Holdings { switch, sets: self.sets()?, free_bytes })
    }

    fn missing(&mut self, wanted: &FileRef) -> Result<Vec<Range<u64>>, Error> {
        if self.has(wanted)? { Ok(Vec::new()) } else { Ok(self.part(wanted)?.missing()) }
    }

    fn write(&mut self, wanted: &FileRef, offset: u64, bytes: &[u8]) -> Result<(), Error> {
        self.part(wanted)?.write(offset, bytes)
    }

    fn sync(&mut self, wanted: &FileRef) -> Result<(), Error> {
        if self.has(wanted)? { Ok(()) } else { self.part(wanted)?.sync() }
    }

    fn seal(&mut self, wanted: &FileRef) -> Result<(), Error> {
        if self.has(wanted)? {
            return Ok(());
        }
        self.part(wanted)?;
        let to = self.content(&wanted.digest);
        match self.part.take() {
            Some(part) => part.seal(&to),
            None => unreachable!("was opened above"),
        }
    }

    fn decode(&mut self, wanted: &FileRef, base: Option<&Digest>, encoded: &FileRef) -> Result<(), Error> {
        self.part = None;
        let (way, to) = (self.content(&encoded.digest), self.content(&wanted.digest));
        let made = if self.has(wanted)? { Ok(()) } else { self.make(wanted, base, &way, &to) };
        remove(&to.with_extension("made")).and_then(|()| remove(&way)).map_err(io_error("throwing a way away"))?;
        made
    }

    fn fetch_as_it_is(&mut self, wanted: &FileRef) -> Result<(), Error> {
        let note = self.content(&wanted.digest).with_extension("plain");
        File::create(&note).and_then(|_| midshift_durable::sync_folder_of(&note)).map_err(io_error("noting a way"))
    }

    fn is_fetched_as_it_is(&mut self, wanted: &FileRef) -> Result<bool, Error> {
        self.content(&wanted.digest).with_extension("plain").try_exists().map_err(io_error("looking for a note"))
    }

    fn read(&mut self, digest: &Digest, most: u64) -> Result<Vec<u8>, Error> {
        let bytes = optional(read_limited(&self.content(digest), most)).map_err(io_error("reading content"))?;
        let bytes = bytes.ok_or(Error::Missing(*digest))?;
        if Digest::of_content(&bytes) == *digest { Ok(bytes) } else { Err(Error::Corrupt { digest: *digest }) }
    }

    fn stage(&mut self, set: &SetManifest) -> Result<(), Error> {
        let id = set.id();
        let folder = self.folder.join(id.to_string());
        if !self.sets()?.contains_key(&id) {
            for component in set.components.values() {
                if !self.has(&FileRef { digest: component.digest, length: component.length })? {
                    return Err(Error::Missing(component.digest));
                }
            }
            self.assemble(set, &folder).map_err(io_error("making a set"))?;
        }
        let read_back = self.verify_files(&id).map(|_| ());
        if let Err(Error::Corrupt { digest }) = read_back {
            // The disk has changed it since it was checked: it must come again.
            let forget = || delete_set(&folder).and_then(|()| remove(&self.content(&digest)));
            forget().map_err(io_error("throwing a set away"))?;
        }
        read_back.and_then(|()| self.install_base(set)).and_then(|()| self.verify_base(set))
    }

    fn verify(&mut self, id: &Digest) -> Result<(), Error> {
        let set = self.verify_files(id)?;
        self.verify_base(&set)
    }

    fn check(&mut self, id: &Digest, file: &str) -> Result<(), Error> {
        let set = self.sets()?.remove(id).ok_or(Error::Missing(*id))?;
        let component = if file == PROGRAM { set.program() } else { set.components.get(file) };
        let component = component.ok_or(Error::Missing(*id))?;
        verify_file(&self.folder.join(id.to_string()).join(file), component)?;
        if component.kind == ComponentKind::Base { self.verify_base(&set) } else { Ok(()) }
    }

    fn discard(&mut self, wanted: &FileRef) -> Result<(), Error> {
        let read = |path: &Path| Digest::of_reader(&mut File::open(path)?, COMPONENT_BYTES_MAX);
        let path = self.content(&wanted.digest);
        let read = match read(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) if error.kind() == io::ErrorKind::InvalidData => None,
            read => Some(read.map_err(io_error("reading content"))?),
        };
        if read == Some((wanted.digest, wanted.length)) {
            return Ok(());
        }
        midshift_durable::remove(&path).map(drop).map_err(io_error("throwing content away"))
    }

    fn mend(&mut self, set: &SetManifest) -> Result<(), Error> {
        let id = set.id();
        self.link_anew(set, &self.folder.join(id.to_string())).map_err(io_error("mending a set"))?;
        self.verify(&id)
    }

    fn program(&mut self, set: &Digest) -> Option<PathBuf> {
        Some(self.component(&set.to_string(), PROGRAM))
    }

    fn write_switch(&mut self, switch: &mut Switch) -> Result<(), Error> {
        switch.write(&self.folder.join(SWITCH)).map_err(io_error("writing the switch record"))?;
        self.settle(switch)
    }

    fn collect(&mut self, keep: &BTreeSet<Digest>) -> Result<(), Error> {
        let switch = self.switch()?;
        self.settle(&switch)?;
        // Both copies name the same sets before anything is deleted.
        for name in [SWITCH, BOOT] {
            record::mend(&self.folder.join(name)).map_err(io_error("mending a record"))?;
        }
        let mut named: BTreeSet<Digest> = keep.clone();
        for (id, set) in self.sets()? {
            // The record on the disk names it still.
            let is_put_away = self.overtaken == Some(switch.number)
                && switch.fallen.as_ref().is_some_and(|fallen| fallen.set == id.to_string());
            if switch.names(&id.to_string()) || is_put_away || keep.contains(&id) {
                named.insert(id);
                named.extend(set.components.values().map(|c| c.digest));
            }
        }
        self.part = None;
        let collect = || {
            for entry in fs::read_dir(&self.folder)? {
                let entry = entry?;
                let name = entry.file_name().to_string_lossy().into_owned();
                let half = name.strip_suffix(".new").is_some_and(|name| name.parse::<Digest>().is_ok());
                // A set that the record names stays, also if its page cannot be read.
                if half || name.parse::<Digest>().is_ok_and(|id| !named.contains(&id) && !switch.names(&name)) {
                    delete_set(&entry.path())?;
                }
            }
            for entry in fs::read_dir(self.folder.join(CONTENT))? {
                let entry = entry?;
                let name = entry.file_name().to_string_lossy().into_owned();
                let digest = name.split('.').next().and_then(|name| name.parse::<Digest>().ok());
                // The power may have gone between giving content its name and removing its marks.
                let is_left_over = |digest: &Digest| name.contains('.') && self.content(digest).exists();
                if digest.is_none_or(|digest| !named.contains(&digest) || is_left_over(&digest)) {
                    remove(&entry.path())?;
                }
            }
            Ok(())
        };
        collect().map_err(io_error("deleting what nobody needs"))
    }
}
