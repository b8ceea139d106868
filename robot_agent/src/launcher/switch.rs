//! The switch record: which set of software a robot runs, which it goes back to, and which one is on trial.
//!
//! Standard library only: the launcher reads it before anything that an update replaces has run. One small file,
//! replaced whole, with its checksum, and a second copy of it beside ([`midshift_durable::record`]). A newer version
//! adds lines, which an older one does not look at. Invariant: `current` is the set committed last and `previous` the
//! one before it; only [`Switch::commit`] changes either, so the way back from a trial always leads to a set that was
//! good; [`Switch::forget_previous`] may give up `previous`, never `current`. Written by the agent, and by the launcher
//! while no agent runs.

use midshift_durable::record;
use std::collections::BTreeMap;
use std::io;
use std::path::Path;

/// The set that a robot came with: the program on the launcher's command line.
pub const FACTORY: &str = "factory";
/// Format of the file.
const FORMAT: &str = "midshift-switch 1";
/// Letters of a set's name.
const NAME_MAX: usize = 64;

/// A set that runs and is not committed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trial {
    /// Its name.
    pub set: String,
    /// It came through its probation.
    pub is_proven: bool,
}

/// A set that the launcher put away because its program could not live.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FailedTrial {
    /// Its name.
    pub set: String,
    /// Starts that it was given.
    pub tries: u32,
}

/// What a robot runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Switch {
    /// Rises with each write.
    pub number: u64,
    /// Committed last.
    pub current: String,
    /// Committed before `current`.
    pub previous: Option<String>,
    /// Runs instead of `current`.
    pub trial: Option<Trial>,
    /// Put away by the launcher; stays until the next trial.
    pub fallen: Option<FailedTrial>,
}

impl Default for Switch {
    fn default() -> Self {
        Self { number: 0, current: FACTORY.to_owned(), previous: None, trial: None, fallen: None }
    }
}

impl Switch {
    /// The set that runs, or is to be started.
    pub fn running(&self) -> &str {
        self.trial.as_ref().map_or(&self.current, |trial| &trial.set)
    }
    /// The set that is gone back to.
    pub fn kept(&self) -> Option<&str> {
        if self.trial.is_some() { Some(&self.current) } else { self.previous.as_deref() }
    }
    /// Whether a set is named at all; one that is not may be deleted.
    pub fn names(&self, set: &str) -> bool {
        self.current == set || self.previous.as_deref() == Some(set) || self.running() == set
    }
    /// Runs `set` from the next start on. A trial under way ends without a trace.
    pub fn try_out(&mut self, set: &str) {
        self.trial = (set != self.current).then(|| Trial { set: set.to_owned(), is_proven: false });
        self.fallen = None;
    }
    /// The trial came through its probation.
    pub fn prove(&mut self) {
        if let Some(trial) = &mut self.trial {
            trial.is_proven = true;
        }
    }
    /// The trial is good: what was current is kept as previous.
    pub fn commit(&mut self) {
        if let Some(trial) = self.trial.take() {
            self.previous = Some(std::mem::replace(&mut self.current, trial.set));
        }
    }
    /// The trial is over: `current` runs from the next start on.
    pub fn go_back(&mut self) {
        self.trial = None;
    }
    /// Back to the set committed before; nothing to do without one or during a trial, which [`Switch::go_back`] ends.
    pub fn undo_commit(&mut self) {
        if self.trial.is_none()
            && let Some(previous) = self.previous.take()
        {
            self.current = previous;
        }
    }
    /// What `previous` needs goes: it is kept no more.
    pub fn forget_previous(&mut self) {
        self.previous = None;
    }
    /// The trial could not live: the launcher's [`Switch::go_back`].
    pub fn fall_back(&mut self, tries: u32) {
        self.fallen = self.trial.take().map(|trial| FailedTrial { set: trial.set, tries });
    }

    /// Reads a record, or its copy where it is missing or torn. Neither is there: what a robot came with.
    ///
    /// # Errors
    /// A file that cannot be read, or is none of ours: it is not taken for a new robot's.
    pub fn read(path: &Path) -> io::Result<Self> {
        let Some(text) = record::read(path)? else { return Ok(Self::default()) };
        Self::parse(&text).ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "it is no switch record of ours"))
    }

    /// Writes it with the next number, whole or not at all.
    ///
    /// # Errors
    /// If it could not be written: the old one or this is there.
    pub fn write(&mut self, path: &Path) -> io::Result<()> {
        self.number += 1;
        record::write(path, &self.text())
    }

    fn text(&self) -> String {
        let or_dash = |set: Option<&str>| set.unwrap_or("-").to_owned();
        let trial = self
            .trial
            .as_ref()
            .map_or("-".to_owned(), |t| format!("{} {}", t.set, if t.is_proven { "proven" } else { "on probation" }));
        let fallen = self.fallen.as_ref().map_or("-".to_owned(), |f| format!("{} {}", f.set, f.tries));
        format!(
            "{FORMAT}\nnumber {}\ncurrent {}\nprevious {}\ntrial {trial}\nfallen {fallen}\n",
            self.number,
            self.current,
            or_dash(self.previous.as_deref())
        )
    }

    fn parse(text: &str) -> Option<Self> {
        let lines = lines(text, FORMAT)?;
        let number = lines.get("number")?.parse().ok()?;
        let current = set_name(lines.get("current")?)?;
        let previous = optional(lines.get("previous")?, set_name)?;
        let trial = optional(lines.get("trial")?, |text| {
            let (set, stage) = text.split_once(' ')?;
            // A stage that nobody here knows has proven nothing.
            Some(Trial { set: set_name(set)?, is_proven: stage == "proven" })
        })?;
        let fallen = optional(lines.get("fallen")?, |text| {
            let (set, tries) = text.split_once(' ')?;
            Some(FailedTrial { set: set_name(set)?, tries: tries.parse().ok()? })
        })?;
        Some(Self { number, current, previous, trial, fallen })
    }
}

/// The lines of a record of this format, by their first word.
pub(crate) fn lines<'a>(text: &'a str, format: &str) -> Option<BTreeMap<&'a str, &'a str>> {
    let lines = text.strip_prefix(format)?.strip_prefix('\n')?;
    Some(lines.lines().filter_map(|line| line.split_once(' ')).collect())
}

fn optional<T>(text: &str, read: impl Fn(&str) -> Option<T>) -> Option<Option<T>> {
    if text == "-" { Some(None) } else { read(text).map(Some) }
}

fn set_name(text: &str) -> Option<String> {
    is_set_name(text).then(|| text.to_owned())
}

/// Whether this may name a set: it becomes a folder.
pub fn is_set_name(text: &str) -> bool {
    (1..=NAME_MAX).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// What may happen to a robot's software.
    #[derive(Clone, Copy, Debug)]
    enum Event {
        Try,
        Prove,
        Commit,
        Back,
        Fall,
    }

    /// All orders of so many events, over ever newer sets.
    fn walk(
        depth: usize,
        switch: &Switch,
        committed: &[String],
        newest: u32,
        look: &mut impl FnMut(&Switch, &[String]),
    ) {
        look(switch, committed);
        if depth == 0 {
            return;
        }
        for event in [Event::Try, Event::Prove, Event::Commit, Event::Back, Event::Fall] {
            let (mut next, mut committed, mut newest) = (switch.clone(), committed.to_vec(), newest);
            match event {
                Event::Try => {
                    newest += 1;
                    next.try_out(&format!("v{newest}"));
                }
                Event::Prove => next.prove(),
                Event::Commit => {
                    committed.extend(next.trial.as_ref().map(|trial| trial.set.clone()));
                    next.commit();
                }
                Event::Back => next.go_back(),
                Event::Fall => next.fall_back(2),
            }
            walk(depth - 1, &next, &committed, newest, look);
        }
    }

    #[test]
    fn in_all_orders_the_kept_set_is_the_one_committed_last() {
        let mut looked = 0;
        walk(7, &Switch::default(), &[FACTORY.to_owned()], 0, &mut |switch, committed| {
            looked += 1;
            let [.., last] = committed else { unreachable!("begins with one") };
            let before = committed.len().checked_sub(2).map(|at| committed[at].as_str());
            match &switch.trial {
                Some(trial) => assert_eq!((switch.running(), switch.kept()), (trial.set.as_str(), Some(last.as_str()))),
                None => assert_eq!((switch.running(), switch.kept()), (last.as_str(), before)),
            }
            assert_eq!(Switch::parse(&switch.text()).as_ref(), Some(switch));
        });
        assert_eq!(looked, (5_usize.pow(8) - 1) / 4, "every order was walked");
    }

    #[test]
    fn a_commit_that_is_undone_brings_the_set_before_it_back() {
        let mut switch = Switch::default();
        for set in ["v1", "v2"] {
            switch.try_out(set);
            switch.commit();
        }
        switch.undo_commit();
        assert_eq!((switch.running(), switch.kept()), ("v1", None));
        switch.undo_commit();
        assert_eq!(switch.running(), "v1", "there is nothing before it any more");
    }

    #[test]
    fn a_damaged_record_is_no_new_robot() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("switch");
        assert_eq!(Switch::read(&path).expect("none is there"), Switch::default());
        let mut switch = Switch::default();
        switch.try_out("v1");
        switch.write(&path).expect("writes");
        assert_eq!(Switch::read(&path).expect("reads"), switch);
        let text = switch.text();
        for wrong in
            [text.replace("v1", "../v1"), text.replace("switch 1", "switch 2"), text.replace("v1 on probation", "v1")]
        {
            record::write(&path, &wrong).expect("writes");
            assert!(Switch::read(&path).is_err(), "{wrong}");
        }
        for length in 0..text.len() {
            fs::write(&path, &text[..length]).expect("writes");
            fs::write(record::copy_of(&path), &text[..length]).expect("writes");
            assert!(Switch::read(&path).is_err(), "{length} bytes of it are a record");
        }
    }

    #[test]
    fn a_record_that_is_torn_or_gone_is_read_from_its_copy_and_one_that_cannot_be_read_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("switch");
        let mut switch = Switch::default();
        switch.try_out("v1");
        switch.write(&path).expect("writes");
        fs::write(&path, &switch.text()[..20]).expect("writes");
        assert_eq!(Switch::read(&path).expect("reads"), switch);
        fs::remove_file(&path).expect("removes");
        assert_eq!(Switch::read(&path).expect("reads"), switch);
        fs::create_dir(&path).expect("makes");
        assert!(Switch::read(&path).is_err(), "it is there, whatever it says");
    }

    #[test]
    fn lines_and_words_of_a_newer_version_start_no_other_set_and_prove_nothing() {
        let mut switch = Switch::default();
        switch.try_out("v1");
        let newer = switch.text().replace("trial v1 on probation", "trial v1 half proven\nmood v2 curious");
        assert_eq!(Switch::parse(&newer), Some(switch));
    }
}
