//! What a stack that runs is known by: a file with the ids of its processes, in a folder with their logs and volumes.

use anyhow::{Context, Result};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const FILE: &str = "state.json";

/// A process: its id, and the moment of its start, by which it is told from a later one with the same id.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mark {
    /// Its id.
    pub id: u32,
    started: Option<String>,
}

impl Mark {
    /// Of a process that runs now.
    pub fn new(id: u32) -> Self {
        Self { id, started: started(id) }
    }
    /// Whether it still runs, and is the same.
    pub fn runs(&self) -> bool {
        self.started.is_some() && started(self.id) == self.started
    }
    fn json(&self) -> Value {
        json!({"id": self.id, "started": self.started})
    }
    fn read(value: &Value) -> Option<Self> {
        let started = value["started"].as_str().map(str::to_owned);
        Some(Self { id: u32::try_from(value["id"].as_u64()?).ok()?, started })
    }
}

/// The moment a process began, in ticks since the machine did; none: it does not run, or has ended and nobody has looked.
fn started(id: u32) -> Option<String> {
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    // The name of the program is in parentheses and may have anything in it.
    let mut fields = stat.rsplit_once(") ")?.1.split(' ');
    let state = fields.next()?;
    fields.nth(18).filter(|_| state != "Z").map(str::to_owned)
}

/// The state of one stack.
#[derive(Clone, Debug)]
pub struct State {
    /// Its folder.
    pub folder: PathBuf,
    /// Where people and programs come in, host:port.
    pub public: String,
    /// All are healthy.
    pub ready: bool,
    /// The program that supervises.
    pub supervisor: Mark,
    processes: BTreeMap<String, Mark>,
}

impl State {
    /// Of a stack that begins in this process.
    pub fn begin(folder: &Path, public: String) -> Result<Self> {
        let supervisor = Mark::new(std::process::id());
        let state = Self { folder: folder.to_owned(), public, ready: false, supervisor, processes: BTreeMap::new() };
        state.write()?;
        Ok(state)
    }

    /// What is in the folder; none: nothing runs.
    pub fn find(folder: &Path) -> Option<Self> {
        let text = std::fs::read_to_string(folder.join(FILE)).ok()?;
        let value: Value = serde_json::from_str(&text).ok()?;
        let processes = value["processes"].as_object()?.iter();
        let state = Self {
            folder: folder.to_owned(),
            public: value["public"].as_str()?.to_owned(),
            ready: value["ready"].as_bool()?,
            supervisor: Mark::read(&value["supervisor"])?,
            processes: processes.filter_map(|(name, mark)| Some((name.clone(), Mark::read(mark)?))).collect(),
        };
        (state.supervisor.runs() || state.running().next().is_some()).then_some(state)
    }

    /// Processes that still run.
    pub fn running(&self) -> impl Iterator<Item = (&String, &Mark)> {
        self.processes.iter().filter(|(_, mark)| mark.runs())
    }

    /// Whether this one was started before.
    pub fn has(&self, name: &str) -> bool {
        self.processes.contains_key(name)
    }

    /// One more, or the same started again.
    pub fn add(&mut self, name: &str, mark: Mark) -> Result<()> {
        self.processes.insert(name.to_owned(), mark);
        self.write()
    }

    /// Writes the file whole or not at all.
    pub fn write(&self) -> Result<()> {
        let processes: serde_json::Map<_, _> =
            self.processes.iter().map(|(n, mark)| (n.clone(), mark.json())).collect();
        let value = json!({"public": self.public, "ready": self.ready, "supervisor": self.supervisor.json(), "processes": processes});
        let (part, file) = (self.folder.join("state.part"), self.folder.join(FILE));
        std::fs::write(&part, value.to_string()).with_context(|| format!("writing {}", part.display()))?;
        std::fs::rename(&part, &file).with_context(|| format!("writing {}", file.display()))
    }

    /// Nothing runs any more.
    pub fn remove(&self) {
        let _ = std::fs::remove_file(self.folder.join(FILE));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_known_until_it_ends_and_a_later_one_of_its_id_is_another() {
        let mut child = std::process::Command::new("sleep").arg("60").spawn().unwrap();
        let mark = Mark::new(child.id());
        assert!(mark.runs() && Mark::read(&mark.json()) == Some(mark.clone()));
        assert!(!Mark { started: Some("1".to_owned()), ..mark.clone() }.runs());
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(!mark.runs());
    }
}
