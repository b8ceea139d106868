//! The boot record of a robot's machine: two slots for its operating system, the base, and which of them it starts
//! from.
//!
//! The boot loader is simulated: [`Boot::start`] is what it does whenever the machine starts, and the launcher is what
//! starts the machine. Standard library only, as the launcher. One small file, replaced whole, with its checksum, and a
//! second copy of it beside ([`midshift_durable::record`]). A newer version adds lines, which an older one does not
//! look at. Invariant: the good slot is never written to; a slot is named as holding a base only once all of it is
//! durable. Written by the agent, and by the launcher while no agent runs.

use super::switch::{FACTORY, is_set_name, lines};
use midshift_durable::record;
use std::io;
use std::path::Path;

/// The record in the folder of the sets. There is none before the first base was staged.
pub const BOOT: &str = "boot";
/// File of a set that names its base; without one it runs on the base that the robot came with.
pub const BASE: &str = "set.base";
/// A slot that is being tried is left after so many starts that did not run well.
pub const TRIES_MAX: u32 = 2;
/// Format of the file.
const FORMAT: &str = "midshift-boot 1";

/// One of the two places for a base.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Slot {
    /// The one that the robot came with in use.
    A,
    /// The other.
    B,
}

impl Slot {
    /// Both slots, in the order of their names.
    pub const ALL: [Self; 2] = [Self::A, Self::B];

    /// The one beside it.
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }
    /// Its file in the folder of the sets; it stands for a partition.
    pub const fn file(self) -> &'static str {
        match self {
            Self::A => "base-a",
            Self::B => "base-b",
        }
    }
    const fn letter(self) -> &'static str {
        match self {
            Self::A => "a",
            Self::B => "b",
        }
    }
    fn parse(text: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|slot| slot.letter() == text)
    }
}

/// A base in a slot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Digest of its bytes, or [`FACTORY`].
    pub name: String,
    /// Bytes; the factory's are not counted and lie in no file.
    pub length: u64,
}

/// A slot that is started from and not yet good.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trying {
    /// The slot that is tried.
    pub slot: Slot,
    /// Starts that it was given since it last ran well.
    pub tries: u32,
}

/// What a machine starts from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Boot {
    /// Rises with each write.
    pub number: u64,
    /// What the slots hold, A first.
    images: [Option<Image>; 2],
    /// What is gone back to.
    pub good: Slot,
    /// What is started from instead.
    pub trying: Option<Trying>,
    /// What the machine was started from last.
    pub booted: Slot,
}

impl Default for Boot {
    fn default() -> Self {
        let factory = Image { name: FACTORY.to_owned(), length: 0 };
        Self { number: 0, images: [Some(factory), None], good: Slot::A, trying: None, booted: Slot::A }
    }
}

impl Boot {
    /// What a slot holds; none: nothing that can be started.
    pub fn image(&self, slot: Slot) -> Option<&Image> {
        self.images[slot as usize].as_ref()
    }
    /// Where a base lies.
    pub fn slot_of(&self, base: &str) -> Option<Slot> {
        Slot::ALL.into_iter().find(|slot| self.image(*slot).is_some_and(|image| image.name == base))
    }
    /// The slot that may be written to.
    pub fn spare(&self) -> Slot {
        self.good.other()
    }
    /// Says what the spare slot holds; none while it is written to.
    pub fn put_spare(&mut self, image: Option<Image>) {
        let spare = self.spare();
        self.trying = self.trying.filter(|trying| trying.slot != spare);
        self.images[spare as usize] = image;
    }
    /// The machine is to start from this base, which a set on trial needs.
    pub fn try_out(&mut self, base: &str) {
        if let Some(slot) = self.slot_of(base).filter(|slot| *slot != self.good)
            && self.trying.is_none()
        {
            self.trying = Some(Trying { slot, tries: 0 });
        }
    }
    /// The set that needs this base is committed: its slot is good.
    pub fn settle(&mut self, base: &str) {
        if let Some(slot) = self.slot_of(base) {
            self.good = slot;
            self.trying = None;
        }
    }
    /// What is being tried ran well: its starts count from 0 again.
    pub fn ran_well(&mut self) {
        let booted = self.booted;
        if let Some(trying) = self.trying.as_mut().filter(|trying| trying.slot == booted) {
            trying.tries = 0;
        }
    }
    /// The machine starts, as its boot loader has it: from the slot that is tried while it has tries left and `boots`,
    /// else from the good one. That a slot has used its tries up stays written until its set is put away or committed.
    pub fn start(&mut self, boots: impl Fn(Slot, &Image) -> bool) {
        self.booted = self.good;
        while let Some(Trying { slot, tries }) = self.trying.filter(|trying| trying.tries < TRIES_MAX) {
            self.trying = Some(Trying { slot, tries: tries + 1 });
            if self.image(slot).is_some_and(|image| boots(slot, image)) {
                self.booted = slot;
                return;
            }
        }
    }

    /// Reads a record, or its copy where it is missing or torn. Neither is there: a machine as it came.
    ///
    /// # Errors
    /// A file that cannot be read, or is none of ours: it is not taken for a new machine's.
    pub fn read(path: &Path) -> io::Result<Self> {
        let Some(text) = record::read(path)? else { return Ok(Self::default()) };
        Self::parse(&text).ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "it is no boot record of ours"))
    }

    /// Writes it with the next number, whole or not at all, if it is another than `before`.
    ///
    /// # Errors
    /// If it could not be written: the old one or this is there.
    pub fn write_over(&mut self, before: &Self, path: &Path) -> io::Result<()> {
        if self == before {
            return Ok(());
        }
        self.number += 1;
        record::write(path, &self.text())
    }

    fn text(&self) -> String {
        let image =
            |slot| self.image(slot).map_or("-".to_owned(), |image: &Image| format!("{} {}", image.name, image.length));
        let trying = self.trying.map_or("-".to_owned(), |t| format!("{} {}", t.slot.letter(), t.tries));
        format!(
            "{FORMAT}\nnumber {}\na {}\nb {}\ngood {}\ntrying {trying}\nbooted {}\n",
            self.number,
            image(Slot::A),
            image(Slot::B),
            self.good.letter(),
            self.booted.letter()
        )
    }

    fn parse(text: &str) -> Option<Self> {
        let lines = lines(text, FORMAT)?;
        let number = lines.get("number")?.parse().ok()?;
        let images = [image(lines.get("a")?)?, image(lines.get("b")?)?];
        let good = Slot::parse(lines.get("good")?)?;
        let trying = match *lines.get("trying")? {
            "-" => None,
            text => {
                let (slot, tries) = text.split_once(' ')?;
                Some(Trying { slot: Slot::parse(slot)?, tries: tries.parse().ok()? })
            }
        };
        let booted = Slot::parse(lines.get("booted")?)?;
        Some(Self { number, images, good, trying, booted })
    }
}

fn image(text: &str) -> Option<Option<Image>> {
    if text == "-" {
        return Some(None);
    }
    let (name, length) = text.split_once(' ')?;
    is_set_name(name).then_some(())?;
    Some(Some(Image { name: name.to_owned(), length: length.parse().ok()? }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn base(name: &str) -> Option<Image> {
        Some(Image { name: name.to_owned(), length: 7 })
    }

    /// A machine that tries the base v1.
    fn trying() -> Boot {
        let mut boot = Boot::default();
        boot.put_spare(base("v1"));
        boot.try_out("v1");
        boot
    }

    #[test]
    fn a_base_is_tried_twice_and_left_unless_it_runs_well() {
        let mut boot = trying();
        let started = |boot: &mut Boot| {
            boot.start(|_, _| true);
            boot.booted
        };
        assert_eq!([(); 4].map(|()| started(&mut boot)), [Slot::B, Slot::B, Slot::A, Slot::A]);
        boot.try_out("v1");
        assert_eq!(started(&mut boot), Slot::A, "it is not tried anew");
        let mut boot = trying();
        for _ in 0..5 {
            assert_eq!(started(&mut boot), Slot::B);
            boot.ran_well();
        }
    }

    #[test]
    fn a_slot_that_does_not_boot_uses_its_tries_up_and_the_good_one_is_started() {
        let mut boot = trying();
        boot.start(|slot, _| slot != Slot::B);
        assert_eq!((boot.booted, boot.trying), (Slot::A, Some(Trying { slot: Slot::B, tries: TRIES_MAX })));
    }

    #[test]
    fn a_committed_base_is_good_and_the_next_one_takes_the_other_slot() {
        let mut boot = trying();
        boot.start(|_, _| true);
        boot.settle("v1");
        boot.start(|_, _| true);
        assert_eq!((boot.good, boot.booted, boot.trying, boot.spare()), (Slot::B, Slot::B, None, Slot::A));
        boot.put_spare(None);
        assert_eq!((boot.slot_of(FACTORY), boot.slot_of("v1")), (None, Some(Slot::B)));
        boot.put_spare(base("v2"));
        boot.try_out("v2");
        boot.settle("v0");
        assert_eq!((boot.good, boot.trying.map(|t| t.slot)), (Slot::B, Some(Slot::A)), "nobody has v0");
    }

    #[test]
    fn whatever_happens_in_whatever_order_the_machine_starts_from_a_slot_that_holds_something() {
        fn walk(depth: usize, boot: &Boot, newest: u32, looked: &mut usize) {
            *looked += 1;
            assert!(boot.image(boot.good).is_some(), "{boot:?}");
            assert_eq!(Boot::parse(&boot.text()).as_ref(), Some(boot));
            let mut started = boot.clone();
            started.start(|_, _| true);
            assert!(started.image(started.booted).is_some(), "{started:?}");
            let changes: [fn(&mut Boot, u32); 7] = [
                |boot, _| boot.put_spare(None),
                |boot, newest| boot.put_spare(base(&format!("v{newest}"))),
                |boot, newest| boot.try_out(&format!("v{newest}")),
                |boot, newest| boot.settle(&format!("v{newest}")),
                |boot, newest| boot.settle(&format!("v{}", newest.saturating_sub(1))),
                |boot, _| boot.start(|_, _| true),
                |boot, _| boot.start(|_, _| false),
            ];
            for (at, change) in changes.iter().enumerate().filter(|_| depth > 0) {
                let (mut next, newest) = (boot.clone(), newest + u32::from(at == 1));
                change(&mut next, newest);
                walk(depth - 1, &next, newest, looked);
            }
        }
        let mut looked = 0;
        walk(6, &Boot::default(), 0, &mut looked);
        assert_eq!(looked, (7_usize.pow(7) - 1) / 6, "every order was walked");
    }

    #[test]
    fn a_damaged_record_is_no_new_machine_and_one_without_change_is_not_written() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join(BOOT);
        let before = Boot::read(&path).expect("none is there");
        before.clone().write_over(&before, &path).expect("nothing to do");
        assert!(!path.exists());
        let mut boot = trying();
        boot.write_over(&before, &path).expect("writes");
        assert_eq!(Boot::read(&path).expect("reads"), boot);
        let text = boot.text();
        let newer = format!("{text}mood curious\n");
        assert_eq!(Boot::parse(&newer).as_ref(), Some(&boot), "a newer version has added a line");
        for wrong in [text.replace("v1", "../v1"), text.replace("boot 1", "boot 2"), text.replace("good a", "good c")] {
            record::write(&path, &wrong).expect("writes");
            assert!(Boot::read(&path).is_err(), "{wrong}");
        }
        record::write(&path, &text).expect("writes");
        for length in 0..text.len() {
            fs::write(&path, &text[..length]).expect("writes");
            assert_eq!(Boot::read(&path).expect("its copy is whole"), boot, "{length} bytes of it");
        }
        fs::remove_file(&path).expect("removes");
        assert_eq!(Boot::read(&path).expect("its copy is whole"), boot);
        fs::create_dir(&path).expect("makes");
        assert!(Boot::read(&path).is_err(), "it is there, whatever it says");
        fs::remove_dir(&path).expect("removes");
        for length in 0..text.len() {
            fs::write(&path, &text[..length]).expect("writes");
            fs::write(record::copy_of(&path), &text[..length]).expect("writes");
            assert!(Boot::read(&path).is_err(), "{length} bytes of it are a record");
        }
    }
}
