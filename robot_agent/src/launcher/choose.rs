//! Which set starts next, and on which base the machine runs for it.
//!
//! Invariant: the launcher writes the switch record and the boot record here only, and only while no child runs; while
//! one runs, the agent writes them. Called by the launcher between two starts. What is decided stands in
//! [`super::start_policy`] and [`super::boot`]; here it is carried out.

use super::boot::{BASE, BOOT, Boot, Image, Slot};
use super::orders::Orders;
use super::record::{read_tries, report};
use super::start_policy::{self, Environment, Tries};
use super::switch::{self, Switch};
use super::terms::{PROGRAM, SWITCH};
use std::fs;
use std::io;
use std::path::Path;
use std::time::Duration;

/// What is started next.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Start {
    pub(super) set: String,
    pub(super) program: String,
    /// Counts this start.
    pub(super) tries: Tries,
    /// Of the switch record that lies on the disk.
    pub(super) number: u64,
}

/// A switch record that this launcher could not write, or does not yet: it holds as long as the one on the disk is the
/// one that it was to follow.
#[derive(Default)]
pub(super) struct Unwritten(Option<Switch>);

impl Unwritten {
    /// The record that holds, and the number of the one on the disk. One that could not be written is tried again.
    fn read(&mut self, path: &Path) -> io::Result<(Switch, u64)> {
        let on_disk = Switch::read(path).map_err(|e| named(e, path))?;
        let follows = |ours: &Switch| ours.number == on_disk.number + 1;
        let Some(mut ours) = self.0.take().filter(follows) else { return Ok((on_disk.clone(), on_disk.number)) };
        ours.number = on_disk.number;
        let number = self.write(&mut ours, path);
        Ok((ours, number))
    }
    /// Writes a record that follows the one on the disk, or keeps it; the number of the one that lies there then.
    fn write(&mut self, switch: &mut Switch, path: &Path) -> u64 {
        let before = switch.number;
        let Err(error) = switch.write(path) else { return switch.number };
        report(&format!(
            "{} cannot be written: {error}; set {} is started without it",
            path.display(),
            switch.running()
        ));
        self.0 = Some(switch.clone());
        before
    }
    /// Keeps a record that follows `switch`, to be written before the next start.
    fn hold(&mut self, switch: &Switch) {
        self.0 = Some(Switch { number: switch.number + 1, ..switch.clone() });
    }
    /// The record on the disk holds again.
    pub(super) fn forget(&mut self) {
        self.0 = None;
    }
}

/// The set that the record names. One on trial that has had its tries is put away first; one that its environment has
/// failed for long stands back for the kept set, and is put away only if that one is not failed the same way.
pub(super) fn choose(
    orders: &Orders,
    tries: &Tries,
    unwritten: &mut Unwritten,
    environment: &mut Environment,
    now: Duration,
) -> io::Result<Start> {
    let Some(sets) = &orders.sets else {
        let set = switch::FACTORY.to_owned();
        return Ok(Start { tries: tries.plus_one(&set), program: orders.program.clone(), set, number: 0 });
    };
    let path = sets.join(SWITCH);
    let (mut switch, mut number) = unwritten.read(&path)?;
    let tried = switch.running().to_owned();
    if let Some(had) = start_policy::put_away(&mut switch, tries) {
        report(&format!("set {tried} did not live in {had} tries; back to {}", switch.current));
        number = unwritten.write(&mut switch, &path);
    }
    let had = tries.count_of(switch.running());
    if environment.asks_kept(&switch, orders.patience, now) {
        report(&format!("set {} is failed by its environment: is {} too?", switch.running(), switch.current));
        switch.fall_back(had.max(1));
        unwritten.hold(&switch);
    }
    if !boot_into(sets, &switch, had)? {
        if switch.trial.is_some() {
            report(&format!("set {} has a base that does not start; back to {}", switch.running(), switch.current));
            switch.fall_back(had.max(1));
            switch.number = number;
            number = unwritten.write(&mut switch, &path);
            boot_into(sets, &switch, had)?;
        } else {
            report(&format!("set {} has no base that starts: it runs on the one that does", switch.running()));
        }
    }
    let set = switch.running().to_owned();
    let own = sets.join(&set).join(PROGRAM);
    // One that cannot be looked at is not absent: its start fails, and is a try of its set.
    let brings_none = matches!(own.try_exists(), Ok(false));
    let program = if brings_none { orders.program.clone() } else { own.to_string_lossy().into_owned() };
    Ok(Start { tries: tries.plus_one(&set), program, set, number })
}

/// Starts that did not run well before this launcher. A record that cannot be read speaks against a set that has proven
/// nothing, as if it had had all its tries; any other is started.
pub(super) fn tries_before(orders: &Orders) -> Tries {
    read_tries(&orders.record).unwrap_or_else(|error| {
        report(&format!("{} cannot be read: {error}; a set on probation is put away", orders.record.display()));
        let switch = orders.sets.as_ref().and_then(|sets| Switch::read(&sets.join(SWITCH)).ok());
        let unproven = switch.filter(|switch| !start_policy::is_trusted(switch));
        unproven.map_or_else(Tries::default, |switch| Tries::new(switch.running(), start_policy::TRIES_MAX))
    })
}

/// Writes a record that was held back, before the launcher ends.
pub(super) fn write_held(orders: &Orders, unwritten: &mut Unwritten) -> io::Result<()> {
    orders.sets.as_ref().map_or(Ok(()), |sets| unwritten.read(&sets.join(SWITCH)).map(drop))
}

/// Number of the switch record; it rises with each change.
pub(super) fn number(orders: &Orders) -> io::Result<u64> {
    let Some(sets) = &orders.sets else { return Ok(0) };
    let path = sets.join(SWITCH);
    Ok(Switch::read(&path).map_err(|e| named(e, &path))?.number)
}

fn named(error: io::Error, path: &Path) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

/// Reads the boot record, changes it, and writes it if it became another. The record that lies there then: the one
/// before, if it could not be written.
pub(super) fn change_boot(sets: &Path, change: impl FnOnce(&mut Boot)) -> io::Result<Boot> {
    let path = sets.join(BOOT);
    let before = Boot::read(&path).map_err(|e| named(e, &path))?;
    let mut boot = before.clone();
    change(&mut boot);
    let Err(error) = boot.write_over(&before, &path) else { return Ok(boot) };
    report(&format!("{} cannot be written: {error}; the machine stays on the base that it runs on", path.display()));
    Ok(before)
}

/// Whether a slot has the bytes that the record says. The factory's base is the machine itself.
fn starts_well(sets: &Path, slot: Slot, image: &Image) -> bool {
    image.name == switch::FACTORY || fs::metadata(sets.join(slot.file())).is_ok_and(|file| file.len() == image.length)
}

/// The launcher stands for the machine: when it starts, so does the boot loader.
pub(super) fn machine_starts(sets: &Path) -> io::Result<()> {
    change_boot(sets, |boot| boot.start(|slot, image| starts_well(sets, slot, image))).map(drop)
}

/// Starts the machine again if it runs on another base than the set that is to run. Whether it runs on that base now.
pub(super) fn boot_into(sets: &Path, switch: &Switch, tries: u32) -> io::Result<bool> {
    let named = fs::read_to_string(sets.join(switch.running()).join(BASE));
    let base = match named {
        Ok(name) => name.trim().to_owned(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => switch::FACTORY.to_owned(),
        Err(error) => return Err(error),
    };
    let boot = change_boot(sets, |boot| {
        match &switch.trial {
            None => boot.settle(&base),
            Some(_) => boot.try_out(&base),
        }
        let slot = boot.slot_of(&base);
        if slot == Some(boot.booted) {
            if tries == 0 {
                boot.ran_well();
            }
        } else if slot.is_some() {
            report(&format!("the machine starts again, for the base {base}"));
            boot.start(|slot, image| starts_well(sets, slot, image));
        }
    })?;
    Ok(boot.slot_of(&base) == Some(boot.booted))
}

/// Whether a program that runs well clears its tries: a set on probation is not believed before it is proven.
pub(super) fn is_trusted(orders: &Orders, start: &Start) -> bool {
    let Some(sets) = &orders.sets else { return true };
    // The record may name one on trial that was put away and could not be written so.
    Switch::read(&sets.join(SWITCH))
        .is_ok_and(|switch| start_policy::is_trusted(&switch) || switch.running() != start.set)
}
