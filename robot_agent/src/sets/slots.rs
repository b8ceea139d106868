//! Bases of sets on a disk: written to the spare slot, read back, and made good.
//!
//! Invariant: the good slot is never written to; a set that the switch record names is given up in the record before
//! the slot of its base is.

use super::disk::{DiskSets, io_error, optional};
use super::{Error, base_name};
use crate::launcher::SWITCH;
use crate::launcher::boot::{BOOT, Boot, Image, Slot};
use crate::launcher::switch::{FACTORY, Switch};
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{COMPONENT_BYTES_MAX, Component};
use midshift_bundle::set::SetManifest;
use std::fs::File;
use std::io;

impl DiskSets {
    fn boot(&self) -> Result<Boot, Error> {
        Boot::read(&self.folder.join(BOOT)).map_err(io_error("reading the boot record"))
    }

    fn write_boot(&self, before: &Boot, boot: &mut Boot) -> Result<(), Error> {
        boot.write_over(before, &self.folder.join(BOOT)).map_err(io_error("writing the boot record"))
    }

    /// The base of a set that is there, or of the factory's.
    fn base_of(&self, set: &str) -> Result<Option<String>, Error> {
        if set == FACTORY {
            return Ok(Some(FACTORY.to_owned()));
        }
        let Ok(id) = set.parse::<Digest>() else { return Ok(None) };
        Ok(self.sets()?.get(&id).map(base_name))
    }

    /// The base of the set committed last is good. The launcher says so too if the power goes before.
    pub(super) fn settle(&self, switch: &Switch) -> Result<(), Error> {
        let before = self.boot()?;
        if switch.trial.is_none()
            && let Some(base) = self.base_of(&switch.current)?
        {
            let mut boot = before.clone();
            boot.settle(&base);
            self.write_boot(&before, &mut boot)?;
        }
        Ok(())
    }

    /// Writes a base that lies whole in neither slot over the spare one: forgotten first, then written, read back, and
    /// named last.
    pub(super) fn install_base(&self, set: &SetManifest) -> Result<(), Error> {
        let Some(base) = set.base() else { return Ok(()) };
        let path = self.folder.join(SWITCH);
        let mut switch = self.switch()?;
        self.settle(&switch)?;
        let mut boot = self.boot()?;
        let spare = boot.spare();
        if let Some(slot) = boot.slot_of(&base_name(set)) {
            match self.verify_slot(slot, base) {
                // The good slot is not written to, whatever has become of it.
                Err(_) if slot == spare => {}
                whole_or_good => return whole_or_good,
            }
        }
        let previous = switch.previous.clone().map_or(Ok(None), |previous| self.base_of(&previous))?;
        if previous.is_some_and(|previous| boot.slot_of(&previous) == Some(spare)) {
            switch.forget_previous();
            switch.write(&path).map_err(io_error("writing the switch record"))?;
        }
        let before = boot.clone();
        boot.put_spare(None);
        self.write_boot(&before, &mut boot)?;
        let slot = self.folder.join(spare.file());
        let copy = || {
            let is_new = !slot.try_exists()?;
            let mut to = File::create(&slot)?;
            io::copy(&mut File::open(self.content(&base.digest))?, &mut to)?;
            to.sync_all()?;
            if is_new { midshift_durable::sync_folder_of(&slot) } else { Ok(()) }
        };
        copy().map_err(io_error("writing a base"))?;
        self.verify_slot(spare, base)?;
        let before = boot.clone();
        boot.put_spare(Some(Image { name: base_name(set), length: base.length }));
        self.write_boot(&before, &mut boot)
    }

    /// Reads the base of a set where the machine starts it from.
    pub(super) fn verify_base(&self, set: &SetManifest) -> Result<(), Error> {
        let Some(base) = set.base() else { return Ok(()) };
        let slot = self.boot()?.slot_of(&base_name(set)).ok_or(Error::Missing(base.digest))?;
        self.verify_slot(slot, base)
    }

    fn verify_slot(&self, slot: Slot, base: &Component) -> Result<(), Error> {
        let file = optional(File::open(self.folder.join(slot.file()))).map_err(io_error("reading a base"))?;
        let mut file = file.ok_or(Error::Missing(base.digest))?;
        let read = Digest::of_reader(&mut file, COMPONENT_BYTES_MAX).map_err(io_error("reading a base"))?;
        if read == (base.digest, base.length) { Ok(()) } else { Err(Error::Corrupt { digest: base.digest }) }
    }
}
