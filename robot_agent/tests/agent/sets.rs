//! The contract of a robot's sets, over the disk and over memory.

use midshift_agent::launcher::{PROGRAM, SWITCH};
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::sets::{CHUNK_BYTES, CHUNKS_UNSYNCED_MAX, Error, FileRef, Sets};
use midshift_agent::switch::Switch;
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding;
use midshift_bundle::manifest::{Component, ComponentKind};
use midshift_bundle::set::SetManifest;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::Read;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;
use tempfile::TempDir;

/// Sets that can be opened again after a crash.
enum Place {
    Disk(TempDir),
    Memory(MemorySets),
}

impl Place {
    fn both() -> [Self; 2] {
        [Self::Disk(tempfile::tempdir().expect("a folder")), Self::Memory(MemorySets::new())]
    }
    fn open(&self) -> Box<dyn Sets> {
        match self {
            Self::Disk(folder) => Box::new(DiskSets::open(folder.path()).expect("opens")),
            Self::Memory(sets) => Box::new(sets.clone()),
        }
    }
    /// The power goes. A disk keeps what was written and not synced or not, as it likes; marks it keeps only if they
    /// were synced.
    fn cut(&self, sets: Box<dyn Sets>) -> Box<dyn Sets> {
        drop(sets);
        if let Self::Memory(sets) = self {
            sets.lose_power();
        }
        self.open()
    }
    /// One byte changes where it lies.
    fn rot(&self, digest: &Digest) {
        match self {
            Self::Disk(folder) => {
                let path = folder.path().join("content").join(digest.to_string());
                let mut bytes = fs::read(&path).expect("is there");
                bytes[0] ^= 1;
                fs::write(&path, bytes).expect("writes");
            }
            Self::Memory(sets) => sets.rot(digest),
        }
    }
}

fn only(range: std::ops::Range<u64>) -> Vec<std::ops::Range<u64>> {
    std::iter::once(range).collect()
}

pub fn bytes(seed: u8, length: u64) -> Vec<u8> {
    (0..length).map(|at| seed.wrapping_add((at % 251) as u8)).collect()
}

/// Bytes that do not become shorter by themselves.
pub fn noise(seed: u64, length: usize) -> Vec<u8> {
    let mut state = seed;
    let step = |_| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    (0..length).map(step).collect()
}

pub fn patch(old: &[u8], new: &[u8]) -> Vec<u8> {
    let (mut base, mut patch) = (std::io::Cursor::new(old), Vec::new());
    encoding::encode(Some(&mut base), &mut &*new, new.len() as u64, &mut patch, u64::MAX).expect("a patch");
    patch
}

/// Few bytes that become many.
pub fn bomb() -> Vec<u8> {
    let mut bomb = Vec::new();
    encoding::encode(None, &mut std::io::repeat(0).take(1 << 26), 1 << 26, &mut bomb, u64::MAX).expect("a bomb");
    bomb
}

pub fn wanted(content: &[u8]) -> FileRef {
    FileRef { digest: Digest::of_content(content), length: content.len() as u64 }
}

pub fn put_content(sets: &mut dyn Sets, content: &[u8]) -> FileRef {
    let wanted = wanted(content);
    for range in sets.missing(&wanted).expect("tells") {
        let part = &content[range.start as usize..range.end as usize];
        sets.write(&wanted, range.start, part).expect("writes");
    }
    sets.sync(&wanted).expect("syncs");
    sets.seal(&wanted).expect("seals");
    wanted
}

pub fn component(name: &str, kind: ComponentKind, content: &[u8]) -> Component {
    Component::new(name, "1.0.0", kind, content)
}

pub fn set(version: &str, program: &[u8], settings: &[u8]) -> SetManifest {
    let components =
        [component("gait", ComponentKind::Process, program), component("behaviour", ComponentKind::Config, settings)];
    SetManifest {
        bundle: Some(Digest::of_content(version.as_bytes())),
        version: version.to_owned(),
        components: components.into_iter().map(|c| (c.name.clone(), c)).collect(),
    }
}

fn staged(sets: &mut dyn Sets, version: &str, program: &[u8], settings: &[u8]) -> SetManifest {
    let set = set(version, program, settings);
    put_content(sets, program);
    put_content(sets, settings);
    sets.stage(&set).expect("stages");
    set
}

#[test]
fn a_download_goes_on_after_a_power_cut_where_it_was_durable() {
    for place in Place::both() {
        let content = bytes(1, 5 * CHUNK_BYTES + 77);
        let (wanted, chunk) = (wanted(&content), CHUNK_BYTES as usize);
        let mut sets = place.open();
        assert_eq!(sets.missing(&wanted).expect("tells"), only(0..wanted.length));
        sets.write(&wanted, 0, &content[..2 * chunk]).expect("writes");
        sets.sync(&wanted).expect("syncs");
        sets.write(&wanted, 3 * CHUNK_BYTES, &content[3 * chunk..4 * chunk]).expect("writes");
        let mut sets = place.cut(sets);
        assert_eq!(
            sets.missing(&wanted).expect("tells"),
            only(2 * CHUNK_BYTES..wanted.length),
            "the last was not synced"
        );
        put_content(&mut *sets, &content);
        assert_eq!(sets.missing(&wanted).expect("tells"), []);
        assert_eq!(sets.read(&wanted.digest, wanted.length).expect("reads"), content);
        assert!(sets.read(&wanted.digest, 10).is_err(), "longer than it may be");
    }
}

#[test]
fn a_long_download_is_durable_without_being_asked() {
    let place = Place::Disk(tempfile::tempdir().expect("a folder"));
    let content = bytes(1, (CHUNKS_UNSYNCED_MAX + 1) * CHUNK_BYTES);
    let wanted = wanted(&content);
    let mut sets = place.open();
    for (at, chunk) in content.chunks(CHUNK_BYTES as usize).enumerate() {
        sets.write(&wanted, at as u64 * CHUNK_BYTES, chunk).expect("writes");
    }
    let mut sets = place.cut(sets);
    assert_eq!(sets.missing(&wanted).expect("tells"), only(CHUNKS_UNSYNCED_MAX * CHUNK_BYTES..wanted.length));
}

#[test]
fn bytes_that_are_not_what_they_should_be_are_thrown_away_whole() {
    for place in Place::both() {
        let content = bytes(1, CHUNK_BYTES + 1);
        let (mut sets, wanted) = (place.open(), wanted(&content));
        sets.write(&wanted, 0, &bytes(2, wanted.length)).expect("writes");
        sets.sync(&wanted).expect("syncs");
        assert!(matches!(sets.seal(&wanted), Err(Error::Corrupt { .. })));
        assert_eq!(sets.missing(&wanted).expect("tells"), only(0..wanted.length));
        sets.write(&wanted, 0, &content[..CHUNK_BYTES as usize]).expect("writes");
        assert!(matches!(sets.seal(&wanted), Err(Error::Corrupt { .. })), "its end is missing");
        put_content(&mut *sets, &content);
    }
}

#[test]
fn bytes_beside_the_chunks_or_beyond_the_end_are_refused() {
    for place in Place::both() {
        let content = bytes(1, CHUNK_BYTES + 1);
        let (mut sets, wanted) = (place.open(), wanted(&content));
        for (offset, length) in [(1, CHUNK_BYTES), (0, 7), (CHUNK_BYTES, 2), (u64::MAX, 1)] {
            assert!(sets.write(&wanted, offset, &bytes(1, length)).is_err(), "{offset}+{length}");
        }
        assert_eq!(sets.missing(&wanted).expect("tells"), only(0..wanted.length));
    }
}

#[test]
fn a_set_is_made_of_content_that_is_there_and_read_back() {
    for place in Place::both() {
        let mut sets = place.open();
        let incomplete = set("v1", b"program", b"settings");
        put_content(&mut *sets, b"program");
        assert!(matches!(sets.stage(&incomplete), Err(Error::Missing(_))));
        assert_eq!(sets.holdings().expect("tells").sets, BTreeMap::new());
        let whole = staged(&mut *sets, "v1", b"program", b"settings");
        sets.stage(&whole).expect("again does nothing");
        sets.verify(&whole.id()).expect("is whole");
        let holdings = place.cut(sets).holdings().expect("tells");
        assert_eq!(holdings.sets, BTreeMap::from([(whole.id(), whole.clone())]));
        assert_eq!(holdings.set(&whole.id().to_string()), Some(whole));
        assert_eq!(holdings.set("factory"), Some(SetManifest::default()));
    }
}

#[test]
fn a_set_whose_bytes_changed_on_the_disk_is_found_out_and_can_come_again() {
    for place in Place::both() {
        let mut sets = place.open();
        let set = staged(&mut *sets, "v1", b"program", b"settings");
        place.rot(&Digest::of_content(b"settings"));
        assert!(matches!(sets.verify(&set.id()), Err(Error::Corrupt { .. })));
        assert!(matches!(sets.stage(&set), Err(Error::Corrupt { .. })));
        put_content(&mut *sets, b"settings");
        sets.stage(&set).expect("stages");
    }
}

#[test]
fn only_what_nobody_names_is_deleted() {
    for place in Place::both() {
        let mut sets = place.open();
        let old = staged(&mut *sets, "v1", b"program", b"one");
        let kept = staged(&mut *sets, "v2", b"program", b"two");
        let running = staged(&mut *sets, "v3", b"program", b"three");
        let incoming = staged(&mut *sets, "v4", b"program", b"four");
        let mut switch = Switch::default();
        for set in [&kept, &running] {
            switch.try_out(&set.id().to_string());
            switch.commit();
        }
        sets.write_switch(&mut switch).expect("writes");
        let coming = wanted(&bytes(3, 10));
        sets.write(&coming, 0, &bytes(3, 10)).expect("writes");
        sets.sync(&coming).expect("syncs");
        sets.collect(&BTreeSet::from([incoming.id(), coming.digest])).expect("collects");
        let ids: Vec<Digest> = sets.holdings().expect("tells").sets.into_keys().collect();
        let expected: BTreeSet<Digest> = [&kept, &running, &incoming].map(SetManifest::id).into();
        assert_eq!(ids, expected.into_iter().collect::<Vec<_>>());
        assert!(sets.read(&Digest::of_content(b"one"), 10).is_err(), "nobody else has it");
        assert!(sets.read(&Digest::of_content(b"program"), 10).is_ok(), "others have it");
        assert_eq!(sets.missing(&coming).expect("tells"), [], "a download is kept");
        assert!(sets.verify(&old.id()).is_err());
        for set in [&kept, &running, &incoming] {
            sets.verify(&set.id()).expect("is whole");
        }
    }
}

#[test]
fn the_switch_record_survives_and_counts_its_writes() {
    for place in Place::both() {
        let mut sets = place.open();
        let mut switch = sets.holdings().expect("tells").switch;
        switch.try_out("v1");
        sets.write_switch(&mut switch).expect("writes");
        switch.commit();
        sets.write_switch(&mut switch).expect("writes");
        let found = place.cut(sets).holdings().expect("tells").switch;
        assert_eq!((found.number, found.running(), found.kept()), (2, "v1", Some("factory")));
    }
}

#[test]
fn a_program_can_be_run_where_the_launcher_looks_for_it_and_takes_no_second_room() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    let set = staged(&mut sets, "v1", b"#!/bin/sh\nexit 7\n", b"settings");
    let program = folder.path().join(set.id().to_string()).join(PROGRAM);
    let file = fs::metadata(&program).expect("is there");
    assert_eq!(file.permissions().mode() & 0o777, 0o755);
    assert_eq!(file.nlink(), 3, "content, component and program are one file");
    assert_eq!(fs::read(sets.component(&set.id().to_string(), "behaviour")).expect("reads"), b"settings");
}

#[test]
fn a_set_that_was_half_deleted_or_half_made_is_none_and_is_made_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    let set = staged(&mut sets, "v1", b"program", b"settings");
    let lies = folder.path().join(set.id().to_string());
    fs::remove_file(lies.join("set.json")).expect("removes");
    fs::create_dir(lies.with_extension("new")).expect("makes");
    assert_eq!(sets.holdings().expect("tells").sets, BTreeMap::new());
    sets.stage(&set).expect("stages");
    sets.collect(&BTreeSet::from([set.id()])).expect("collects");
    assert!(!Path::new(&lies.with_extension("new")).exists());
    sets.verify(&set.id()).expect("is whole");
}

#[test]
fn a_file_that_was_changed_is_found_thrown_away_and_put_in_place_anew() {
    for place in Place::both() {
        let mut sets = place.open();
        let (program, settings) = (b"program of a robot", b"its settings");
        let set = staged(&mut *sets, "v1", program, settings);
        let (id, gait) = (set.id(), &set.components["gait"]);
        let files = ["gait", "behaviour", PROGRAM];
        files.iter().for_each(|file| sets.check(&id, file).expect("is whole"));
        place.rot(&gait.digest);
        for file in ["gait", PROGRAM] {
            assert!(matches!(sets.check(&id, file), Err(Error::Corrupt { digest }) if digest == gait.digest), "{file}");
        }
        sets.check(&id, "behaviour").expect("is whole");
        sets.discard(&wanted(settings)).expect("is right");
        sets.discard(&wanted(program)).expect("goes");
        assert!(sets.mend(&set).is_err(), "its content is not there");
        assert_eq!(put_content(&mut *sets, program).digest, gait.digest);
        sets.mend(&set).expect("mends");
        files.iter().for_each(|file| sets.check(&id, file).expect("is whole"));
        sets.mend(&set).expect("nothing to do");
        sets.verify(&id).expect("is whole");
        assert!(matches!(sets.check(&id, "wings"), Err(Error::Missing(_))));
    }
}

#[test]
fn a_program_and_a_page_that_were_put_in_place_of_a_sets_own_are_found_and_replaced() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    let set = staged(&mut sets, "v1", b"#!/bin/sh\nexit 7\n", b"settings");
    let lies = folder.path().join(set.id().to_string());
    let program = lies.join(PROGRAM);
    fs::remove_file(&program).expect("removes");
    fs::write(&program, b"#!/bin/sh\nexit 6\n").expect("writes");
    assert!(matches!(sets.check(&set.id(), PROGRAM), Err(Error::Corrupt { .. })));
    sets.check(&set.id(), "gait").expect("the component is another file");
    let page = fs::read_to_string(lies.join("set.json")).expect("reads");
    fs::write(lies.join("set.json"), page.replace("v1", "v7")).expect("writes");
    assert!(matches!(sets.check(&set.id(), PROGRAM), Err(Error::Missing(_))), "it is no set of that name");
    sets.mend(&set).expect("mends");
    assert_eq!(fs::read(&program).expect("reads"), b"#!/bin/sh\nexit 7\n");
    assert_eq!(fs::metadata(&program).expect("is there").permissions().mode() & 0o777, 0o755);
    sets.check(&set.id(), PROGRAM).expect("is whole");
    let mut names: Vec<_> = fs::read_dir(&lies).expect("lists").map(|e| e.expect("an entry").file_name()).collect();
    names.sort();
    assert_eq!(names, ["behaviour", "gait", "set.json", PROGRAM], "nothing is left beside");
}

#[test]
fn a_damaged_switch_record_is_an_error_and_deletes_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    let set = staged(&mut sets, "v1", b"program", b"settings");
    fs::write(folder.path().join(SWITCH), "midshift-switch 1\n").expect("writes");
    assert!(sets.holdings().is_err());
    assert!(sets.collect(&BTreeSet::new()).is_err());
    sets.verify(&set.id()).expect("is whole");
}

#[test]
fn a_record_that_was_torn_or_lost_is_mended_before_anything_is_deleted_and_one_that_cannot_be_mended_keeps_everything()
{
    let folder = tempfile::tempdir().expect("a folder");
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    let set = staged(&mut sets, "v1", b"program", b"settings");
    let spare = staged(&mut sets, "v0", b"older program", b"older settings");
    let mut switch = sets.holdings().expect("tells").switch;
    switch.try_out(&set.id().to_string());
    sets.write_switch(&mut switch).expect("writes");
    let [path, copy] = [SWITCH, "switch.copy"].map(|name| folder.path().join(name));
    let whole = fs::read(&path).expect("is there");
    for (broken, other) in [(&path, &copy), (&copy, &path)] {
        fs::write(broken, &whole[..20]).expect("tears");
        assert_eq!(sets.holdings().expect("tells").switch, switch);
        // Nobody can write it anew: in its place would be put what lies beside it.
        let beside = folder.path().join(format!("{}.new", broken.file_name().unwrap_or_default().to_string_lossy()));
        fs::create_dir(&beside).expect("makes");
        assert!(sets.collect(&BTreeSet::new()).is_err());
        sets.verify(&spare.id()).expect("nothing was deleted");
        fs::remove_dir(&beside).expect("removes");
        sets.collect(&BTreeSet::from([spare.id()])).expect("collects");
        assert_eq!(fs::read(broken).expect("reads"), fs::read(other).expect("reads"));
    }
    sets.collect(&BTreeSet::new()).expect("collects");
    assert!(sets.verify(&spare.id()).is_err(), "nobody needs it");
    sets.verify(&set.id()).expect("is whole");
}

#[test]
fn no_room_is_told_from_other_errors() {
    let sets = MemorySets::new();
    sets.limit(100);
    let error = sets.clone().missing(&wanted(&bytes(1, 101))).expect_err("does not fit");
    assert!(error.is_full());
    assert!(!Error::Missing(Digest::of_content(b"")).is_full());
}

#[test]
fn sizes_around_2_31_and_2_32_are_files_like_others() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    for length in [(1_u64 << 31) - 1, 1 << 31, (1 << 31) + 1, (1 << 32) - 1, 1 << 32, (1 << 32) + 1] {
        let wanted = FileRef { digest: Digest::of_content(&length.to_be_bytes()), length };
        let last = (length - 1) / CHUNK_BYTES * CHUNK_BYTES;
        sets.write(&wanted, last, &bytes(1, length - last)).expect("writes");
        sets.sync(&wanted).expect("syncs");
        assert_eq!(sets.missing(&wanted).expect("tells"), only(0..last));
        let part = folder.path().join("content").join(format!("{}.part", wanted.digest));
        assert_eq!(fs::metadata(part).expect("is there").len(), length);
        let mut again = DiskSets::open(folder.path()).expect("opens");
        assert_eq!(again.missing(&wanted).expect("tells"), only(0..last), "{length}");
    }
}

#[test]
fn content_is_made_of_a_patch_and_what_is_there_and_stays_after_a_power_cut() {
    for place in Place::both() {
        let mut sets = place.open();
        let (old, new) = (noise(1, 300_000), [noise(2, 77), noise(1, 300_000)].concat());
        let base = put_content(&mut *sets, &old);
        let encoded = put_content(&mut *sets, &patch(&old, &new));
        let new_one = wanted(&new);
        assert_eq!(sets.missing(&new_one).expect("tells"), only(0..new_one.length));
        sets.decode(&new_one, Some(&base.digest), &encoded).expect("leads there");
        let mut sets = place.cut(sets);
        assert_eq!(sets.read(&new_one.digest, new_one.length).expect("reads"), new);
        assert_eq!(sets.missing(&new_one).expect("tells"), []);
        assert!(sets.read(&encoded.digest, encoded.length).is_err(), "the patch went");
        sets.decode(&new_one, Some(&base.digest), &encoded).expect("again does nothing");
    }
}

#[test]
fn a_way_that_leads_elsewhere_makes_no_content_and_goes() {
    for place in Place::both() {
        let (old, new) = (noise(1, 300_000), [noise(2, 77), noise(1, 300_000)].concat());
        let (right, new_one) = (patch(&old, &new), wanted(&new));
        let mut tampered = right.clone();
        tampered[100] ^= 4;
        let mut sets = place.open();
        let [base, other] = [&old, &noise(5, 300_000)].map(|content| put_content(&mut *sets, content).digest);
        let cases = [
            (tampered, Some(base), new_one),
            (right.clone(), Some(other), new_one),
            (right.clone(), None, new_one),
            (right.clone(), Some(base), FileRef { length: new_one.length - 1, ..new_one }),
            (right.clone(), Some(base), FileRef { length: new_one.length + 1, ..new_one }),
            (right, Some(base), FileRef { digest: Digest::of_content(b"another"), ..new_one }),
            (bomb(), None, new_one),
        ];
        for (way, base, wanted) in cases {
            let encoded = put_content(&mut *sets, &way);
            let made = sets.decode(&wanted, base.as_ref(), &encoded);
            assert!(matches!(made, Err(Error::Corrupt { digest }) if digest == wanted.digest), "{made:?}");
            assert_eq!(sets.missing(&wanted).expect("tells"), only(0..wanted.length));
            assert!(sets.read(&encoded.digest, encoded.length).is_err(), "the way went");
        }
        let encoded = put_content(&mut *sets, &patch(&old, &new));
        let nothing = Digest::of_content(b"of nobody");
        assert!(
            matches!(sets.decode(&new_one, Some(&nothing), &encoded), Err(Error::Missing(digest)) if digest == nothing)
        );
    }
}

#[test]
fn that_a_file_comes_as_it_is_is_remembered_until_it_is_there() {
    for place in Place::both() {
        let mut sets = place.open();
        let content = bytes(1, 1_000);
        let file = wanted(&content);
        assert!(!sets.is_fetched_as_it_is(&file).expect("tells"));
        sets.fetch_as_it_is(&file).expect("notes");
        let mut sets = place.cut(sets);
        assert!(sets.is_fetched_as_it_is(&file).expect("tells"));
        sets.collect(&BTreeSet::from([file.digest])).expect("collects");
        assert!(sets.is_fetched_as_it_is(&file).expect("tells"), "it is still wanted");
        put_content(&mut *sets, &content);
        sets.collect(&BTreeSet::from([file.digest])).expect("collects");
        assert!(!sets.is_fetched_as_it_is(&file).expect("tells"));
    }
}

/// A set with a base of these bytes, on the disk.
pub fn based(sets: &mut dyn Sets, version: &str, base: &[u8]) -> SetManifest {
    let mut set = set(version, b"program", b"settings");
    let os = component("os", ComponentKind::Base, base);
    set.components.insert(os.name.clone(), os);
    for content in [&b"program"[..], b"settings", base] {
        put_content(sets, content);
    }
    sets.stage(&set).expect("stages");
    set
}

fn commit(sets: &mut dyn Sets, set: &SetManifest) {
    let mut switch = sets.holdings().expect("tells").switch;
    switch.try_out(&set.id().to_string());
    sets.write_switch(&mut switch).expect("writes");
    switch.commit();
    sets.write_switch(&mut switch).expect("writes");
}

#[test]
fn a_base_takes_the_slot_that_does_not_run_and_the_set_that_needed_it_is_kept_no_more() {
    for place in Place::both() {
        let mut sets = place.open();
        let kept = |sets: &mut dyn Sets| sets.holdings().expect("tells").switch.kept().map(str::to_owned);
        let first = based(&mut *sets, "v1", b"base 1");
        commit(&mut *sets, &first);
        assert_eq!(kept(&mut *sets).as_deref(), Some("factory"), "its slot is the other one");
        let same = based(&mut *sets, "v2", b"base 1");
        commit(&mut *sets, &same);
        assert_eq!(kept(&mut *sets), Some(first.id().to_string()));
        let third = based(&mut *sets, "v3", b"base 3");
        assert_eq!(kept(&mut *sets), Some(first.id().to_string()), "it runs on the base of v2, which stays");
        commit(&mut *sets, &third);
        let mut sets = place.cut(sets);
        for set in [&first, &same, &third] {
            sets.verify(&set.id()).expect("its base is in a slot");
        }
        based(&mut *sets, "v4", b"base 4");
        assert_eq!(kept(&mut *sets), None, "v2 cannot be gone back to");
        assert!(
            matches!(sets.verify(&same.id()), Err(Error::Missing(digest)) if digest == Digest::of_content(b"base 1"))
        );
        sets.verify(&third.id()).expect("what runs is untouched");
    }
}

#[test]
fn a_base_that_rotted_in_its_slot_is_found_out_and_only_the_spare_one_is_written_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    let first = based(&mut sets, "v1", b"base 1");
    let slot = folder.path().join("base-b");
    assert_eq!(fs::read(&slot).expect("is there"), b"base 1");
    fs::write(&slot, b"base X").expect("writes");
    assert!(matches!(sets.verify(&first.id()), Err(Error::Corrupt { .. })));
    sets.stage(&first).expect("is written again");
    sets.verify(&first.id()).expect("is whole");
    commit(&mut sets, &first);
    fs::write(&slot, b"base X").expect("writes");
    assert!(matches!(sets.stage(&first), Err(Error::Corrupt { .. })), "the machine runs on it");
    assert_eq!(fs::read(&slot).expect("is there"), b"base X");
}
