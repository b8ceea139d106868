//! Judges a trace of system calls: would all that a process relies on be there if the power went? A kill cannot tell,
//! since the kernel writes later what a killed process wrote.
//!
//! The disk that is thought of promises what POSIX does and no more: the bytes of a file are there once it was synced,
//! a name once its folder was, and what was not synced may be there or not, in any order.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Calls that change files or make them durable, and the start of a program.
pub const CALLS: &str = "open,openat,creat,write,pwrite64,writev,pwritev,copy_file_range,sendfile,ftruncate,fallocate,fsync,fdatasync,\
                         rename,renameat,renameat2,link,linkat,unlink,unlinkat,rmdir,mkdir,mkdirat,chmod,fchmod,fchmodat,execve";
/// Page of a set: without it the folder is none.
const PAGE: &str = "set.json";
/// Ends the name of a record's second copy.
const COPY: &str = ".copy";

/// What a call did.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// Bytes, length or mode of a file became others.
    Changed(String),
    /// A file was opened that is made if it is not there.
    Opened(String),
    /// A file or a folder was synced.
    Synced(String),
    /// A name was given in place of another.
    Renamed(String, String),
    /// A second name was given.
    Linked(String, String),
    /// A name went.
    Removed(String),
    /// A folder was made.
    Made(String),
    /// A program was started.
    Started,
}

/// The calls of a trace that did something below `root`, in order, and the starts of programs but the first, which is
/// `strace`'s own.
pub fn events(trace: &str, root: &str) -> Vec<Event> {
    let mut calls: Vec<String> = Vec::new();
    let mut begun: BTreeMap<&str, (usize, String)> = BTreeMap::new();
    for line in trace.lines() {
        let Some((thread, call)) = line.split_once(char::is_whitespace) else { continue };
        let call = call.trim_start();
        if let Some(head) = call.strip_suffix("<unfinished ...>") {
            begun.insert(thread, (calls.len(), head.trim_end().to_owned()));
            calls.push(String::new());
        } else if let Some((_, tail)) = call.strip_prefix("<... ").and_then(|rest| rest.split_once("resumed>")) {
            let Some((at, head)) = begun.remove(thread) else { continue };
            let whole = format!("{head}{tail}");
            // What is made durable is so when the call returns; whatever is changed may be so once it was called.
            match calls.get_mut(at) {
                Some(slot) if !whole.starts_with('f') || !whole.contains("sync(") => *slot = whole,
                _ => calls.push(whole),
            }
        } else {
            calls.push(call.to_owned());
        }
    }
    let is_below = |path: &String| path.starts_with(root) && !path.ends_with(" (deleted)");
    let mut events: Vec<Event> = calls.iter().filter_map(|call| event(call)).collect();
    if let Some(at) = events.iter().position(|event| *event == Event::Started) {
        events.remove(at);
    }
    events.retain(|event| match event {
        Event::Changed(path) | Event::Opened(path) | Event::Synced(path) | Event::Removed(path) | Event::Made(path) => {
            is_below(path)
        }
        Event::Renamed(_, path) | Event::Linked(_, path) => is_below(path),
        Event::Started => true,
    });
    events
}

/// One whole call: `name(arguments) = result`.
fn event(call: &str) -> Option<Event> {
    let (name, rest) = call.split_once('(')?;
    let (arguments, result) = rest.rsplit_once(" = ")?;
    if result.starts_with('-') || result.starts_with('?') {
        return None;
    }
    if name == "execve" {
        return Some(Event::Started);
    }
    let (handles, paths) = operands(arguments);
    let path = |at: usize| paths.get(at).cloned();
    Some(match name {
        "open" | "openat" | "creat" => {
            let is_made = name == "creat" || arguments.contains("O_CREAT");
            let is_emptied = name == "creat" || arguments.contains("O_TRUNC");
            match (is_made, is_emptied) {
                (true, _) => Event::Opened(path(0)?),
                (false, true) => Event::Changed(path(0)?),
                (false, false) => return None,
            }
        }
        "write" | "pwrite64" | "writev" | "pwritev" | "sendfile" | "ftruncate" | "fallocate" | "fchmod" => {
            Event::Changed(handles.first()?.clone())
        }
        "copy_file_range" => Event::Changed(handles.get(1)?.clone()),
        "chmod" | "fchmodat" => Event::Changed(path(0)?),
        "fsync" | "fdatasync" => Event::Synced(handles.first()?.clone()),
        "rename" | "renameat" | "renameat2" => Event::Renamed(path(0)?, path(1)?),
        "link" | "linkat" => Event::Linked(path(0)?, path(1)?),
        "unlink" | "unlinkat" | "rmdir" => Event::Removed(path(0)?),
        "mkdir" | "mkdirat" => Event::Made(path(0)?),
        _ => return None,
    })
}

/// What open handles lead to, and the paths that are named, each whole.
fn operands(arguments: &str) -> (Vec<String>, Vec<String>) {
    let (mut handles, mut paths): (Vec<String>, Vec<String>) = Default::default();
    let mut rest = arguments;
    while let Some(at) = rest.find(['<', '"']) {
        let (is_handle, end) = if rest[at..].starts_with('<') { (true, '>') } else { (false, '"') };
        let Some((inside, after)) = rest[at + 1..].split_once(end) else { break };
        if is_handle {
            handles.push(inside.to_owned());
        } else {
            let folder = handles.last().filter(|_| !inside.starts_with('/'));
            paths.push(folder.map_or(inside.to_owned(), |folder| format!("{folder}/{inside}")));
        }
        rest = after;
    }
    (handles, paths)
}

/// All names below a folder, and its own.
pub fn names(folder: &Path) -> BTreeSet<String> {
    let mut names = BTreeSet::from([folder.to_string_lossy().into_owned()]);
    for entry in fs::read_dir(folder).expect("is there") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            names.extend(self::names(&path));
        } else {
            names.insert(path.to_string_lossy().into_owned());
        }
    }
    names
}

fn split(path: &str) -> (&str, &str) {
    path.rsplit_once('/').unwrap_or(("", path))
}

/// What is on its way is begun anew if its name is lost.
fn is_on_its_way(path: &str) -> bool {
    [".part", ".made", ".new"].iter().any(|end| path.ends_with(end))
}

/// Nothing in it has to stay: SQLite's index of its log, and the lock of its file.
fn is_passing(path: &str) -> bool {
    path.ends_with("-shm") || path.ends_with(".lock")
}

/// A disk as a process made it, with what of it might be lost.
#[derive(Default)]
struct Disk {
    /// Files by name; a file that has two names stands there twice.
    files: BTreeMap<String, usize>,
    /// Files that were changed since they were synced.
    unsynced: BTreeSet<usize>,
    /// Names that were given since their folder was synced, by folder.
    unsure: BTreeMap<String, BTreeSet<String>>,
    /// Folders of sets whose page went and may come back.
    undead: BTreeSet<String>,
    /// Second copies that went and may come back: older than what they are copies of, once that is replaced.
    going: BTreeSet<String>,
    /// The name given last, whose folder must be synced before anything else is done.
    named: Option<String>,
    count: usize,
    holes: Vec<String>,
}

impl Disk {
    fn file(&mut self, path: &str) -> usize {
        self.count += 1;
        *self.files.entry(path.to_owned()).or_insert(self.count)
    }
    fn is_synced(&self, path: &str) -> bool {
        self.files.get(path).is_none_or(|file| !self.unsynced.contains(file))
    }
    fn is_there(&self, path: &str) -> bool {
        self.files.contains_key(path)
    }
    fn give(&mut self, path: &str) {
        let (folder, name) = split(path);
        self.unsure.entry(folder.to_owned()).or_default().insert(name.to_owned());
    }
    fn remove_file(&mut self, path: &str) {
        let (folder, name) = split(path);
        self.files.remove(path);
        self.unsure.remove(path);
        self.undead.remove(path);
        self.going.remove(path);
        if let Some(names) = self.unsure.get_mut(folder) {
            names.remove(name);
        }
    }
    /// Everything that was done so far must stay when `old` becomes `new`.
    fn must_stay(&mut self, what: &str, (old, new): (&str, &str)) {
        // Bytes on their way are relied on by their marks alone, and by what they become; a database while it has no
        // log.
        let is_marked =
            |path: &str| path.strip_suffix(".part").is_none_or(|stem| old == path || new == format!("{stem}.map"));
        let relies = |path: &str| is_marked(path) && !self.is_there(&format!("{path}-wal"));
        let relied_on = self.files.iter().filter(|(path, _)| !is_passing(path) && relies(path));
        let unsynced = relied_on.filter(|(path, _)| !self.is_synced(path));
        let mut lost: Vec<String> = unsynced.map(|(path, _)| format!("{what}: {path} is not synced")).collect();
        for (folder, names) in &self.unsure {
            for name in names.iter().filter(|name| !is_on_its_way(name) && !is_passing(name)) {
                lost.push(format!("{what}: {folder} is not synced since {name} is in it"));
            }
        }
        self.holes.extend(lost);
    }
    /// A row is on the ledger: the folders that it lies in must be sure.
    fn must_lie(&mut self, log: &str) {
        let (own, _) = split(log);
        for (folder, names) in self.unsure.iter().filter(|(folder, _)| *folder != own) {
            let is_above = |name: &&String| log.starts_with(&format!("{folder}/{name}/"));
            let given = names.iter().filter(is_above);
            self.holes
                .extend(given.map(|name| format!("{log} is relied on: {folder} is not synced since {name} is in it")));
        }
    }
    /// What was named last must be sure.
    fn must_be_named(&mut self, what: &str) {
        if let Some(name) = self.named.take() {
            self.holes.push(format!("{what}: the folder of {name} is not synced since it has this name"));
        }
    }

    fn take_in(&mut self, event: &Event) {
        match event {
            Event::Synced(path) => {
                if path.ends_with("-wal") {
                    self.must_lie(path);
                }
                if let Some(file) = self.files.get(path) {
                    self.unsynced.remove(file);
                }
                self.unsure.remove(path);
                self.undead.remove(path);
                self.going.retain(|copy| split(copy).0 != path);
                self.named.take_if(|name| split(name).0 == path);
            }
            Event::Changed(path) => {
                self.must_be_named(&format!("{path} is changed"));
                let file = self.file(path);
                self.unsynced.insert(file);
            }
            Event::Opened(path) if self.is_there(path) => {}
            Event::Opened(path) => {
                self.must_be_named(&format!("{path} is made"));
                self.file(path);
                self.give(path);
            }
            Event::Made(path) => {
                self.must_be_named(&format!("{path} is made"));
                self.give(path);
            }
            Event::Linked(old, new) => {
                self.must_be_named(&format!("{new} is linked"));
                let file = self.file(old);
                self.files.insert(new.clone(), file);
                self.give(new);
            }
            Event::Removed(path) => {
                self.must_be_named(&format!("{path} goes"));
                let (folder, name) = split(path);
                if name == PAGE {
                    self.undead.insert(folder.to_owned());
                } else if self.undead.contains(folder) {
                    self.holes.push(format!("{path} goes: {folder} is not synced since its page went"));
                }
                self.remove_file(path);
                if path.ends_with(COPY) {
                    self.going.insert(path.clone());
                }
                if let Some(database) = path.strip_suffix("-wal").filter(|database| !self.is_synced(database)) {
                    self.holes.push(format!("{path} goes: {database} is not synced"));
                }
            }
            Event::Renamed(old, new) => self.rename(old, new),
            Event::Started => {
                self.must_be_named("a program starts");
                self.must_stay("a program starts", ("", ""));
            }
        }
    }

    fn rename(&mut self, old: &str, new: &str) {
        let what = format!("{old} becomes {}", split(new).1);
        self.must_be_named(&what);
        self.must_stay(&what, (old, new));
        if self.going.contains(&format!("{new}{COPY}")) {
            self.holes.push(format!("{what}: its copy of before may come back"));
        }
        let below = format!("{old}/");
        let moved = |path: &str| path.strip_prefix(&below).map(|rest| format!("{new}/{rest}"));
        let files: Vec<(String, usize)> =
            self.files.iter().filter_map(|(path, file)| Some((moved(path)?, *file))).collect();
        self.files.retain(|path, _| moved(path).is_none());
        let own = self.files.get(old).copied();
        self.remove_file(old);
        self.remove_file(new);
        self.files.extend(files);
        self.files.extend(own.map(|own| (new.to_owned(), own)));
        self.give(new);
        self.named = Some(new.to_owned());
    }
}

/// What would be missing if the power went at a moment when something else relies on it. `there` was on the disk
/// before.
pub fn judge(events: &[Event], there: &BTreeSet<String>) -> Vec<String> {
    let mut disk = Disk::default();
    for path in there {
        disk.file(path);
    }
    for event in events {
        disk.take_in(event);
    }
    disk.must_be_named("the end");
    disk.must_stay("the end", ("", ""));
    // Each once: what relies on it first.
    let mut said = BTreeSet::new();
    disk.holes.retain(|hole| said.insert(hole.split_once(": ").map_or(hole.clone(), |(_, why)| why.to_owned())));
    disk.holes
}

/// A record that is replaced whole, as the trace of a process says it.
const REPLACED: &str = "\
7 execve(\"/bin/agent\", [\"agent\"], 0x7f /* 3 vars */) = 0
7 openat(AT_FDCWD</tmp>, \"/r/switch.new\", O_WRONLY|O_CREAT|O_TRUNC|O_CLOEXEC, 0666) = 3</r/switch.new>
7 write(3</r/switch.new>, \"\"..., 80) = 80
7 fsync(3</r/switch.new>) = 0
7 rename(\"/r/switch.new\", \"/r/switch\") = 0
7 openat(AT_FDCWD</tmp>, \"/r\", O_RDONLY|O_CLOEXEC) = 3</r>
7 fsync(3</r>) = 0
";

/// Holes in that trace, then `more`, without the lines that have `left_out` in them.
fn holes(more: &str, left_out: &str) -> Vec<String> {
    let lines = REPLACED.lines().chain(more.lines());
    let kept: Vec<&str> = lines.filter(|line| left_out.is_empty() || !line.contains(left_out)).collect();
    judge(&events(&kept.join("\n"), "/r"), &BTreeSet::from(["/r".to_owned(), "/r/switch".to_owned()]))
}

#[test]
fn a_record_that_is_replaced_whole_stays_and_one_that_misses_a_sync_does_not() {
    assert_eq!(holes("", ""), Vec::<String>::new());
    let unsynced = "/r/switch.new becomes switch: /r/switch.new is not synced";
    assert_eq!(holes("", "fsync(3</r/switch.new>)")[0], unsynced);
    let unnamed = "the end: the folder of /r/switch is not synced since it has this name";
    assert_eq!(holes("", "fsync(3</r>)")[0], unnamed);
    // Sync and then write more, or change its mode.
    for late in ["write(3</r/switch>, \"\"..., 1) = 1", "chmod(\"/r/switch\", 0755) = 0"] {
        assert_eq!(holes(&format!("7 {late}\n"), ""), ["the end: /r/switch is not synced"]);
    }
    assert_eq!(holes("7 fsync(3</r/switch>) = -1 EIO (Input/output error)\n", ""), Vec::<String>::new());
    let failed =
        REPLACED.replace("fsync(3</r/switch.new>) = 0", "fsync(3</r/switch.new>) = -1 EIO (Input/output error)");
    assert_eq!(judge(&events(&failed, "/r"), &BTreeSet::new())[0], unsynced, "a sync that failed is none");
}

#[test]
fn an_older_copy_is_gone_for_good_before_its_record_is_replaced() {
    let removed = "7 unlink(\"/r/switch.copy\") = 0\n7 fsync(3</r>) = 0\n";
    let all = |removed: &str| {
        let there = ["/r", "/r/switch", "/r/switch.copy"].map(str::to_owned);
        judge(&events(&REPLACED.replace("7 rename", &format!("{removed}7 rename")), "/r"), &there.into())
    };
    assert_eq!(all(removed), Vec::<String>::new());
    let hole = "/r/switch.new becomes switch: its copy of before may come back";
    assert_eq!(all("7 unlink(\"/r/switch.copy\") = 0\n"), [hole]);
}

#[test]
fn the_next_step_waits_for_the_name_and_a_program_for_everything() {
    let next = "7 mkdir(\"/r/next\", 0777) = 0\n7 fsync(3</r>) = 0\n";
    let late = [REPLACED, next].concat().replacen("7 fsync(3</r>) = 0\n", "", 1);
    let there = BTreeSet::from(["/r".to_owned()]);
    assert_eq!(
        judge(&events(&late, "/r"), &there),
        ["/r/next is made: the folder of /r/switch is not synced since it has this name"]
    );
    let starts = "8 execve(\"/r/next/program\", [\"x\"], 0x7f /* 3 vars */) = 0\n";
    assert_eq!(holes(starts, ""), Vec::<String>::new());
    assert_eq!(
        holes(starts, "fsync(3</r>)")[0],
        "a program starts: the folder of /r/switch is not synced since it has this name"
    );
    // In PATH a program is looked for where it is not.
    assert_eq!(
        events("7 execve(\"/a\", [], 0x0) = 0\n8 execve(\"/no\", [], 0x0) = -1 ENOENT (No such file)\n", "/r"),
        []
    );
}

#[test]
fn a_folder_gets_its_name_when_all_in_it_is_sure_and_loses_its_page_before_the_rest() {
    let set = "\
7 mkdir(\"/r/s.new\", 0777) = 0
7 linkat(AT_FDCWD</tmp>, \"/r/c\", AT_FDCWD</tmp>, \"/r/s.new/walk\", 0) = 0
7 chmod(\"/r/c\", 0755) = 0
7 fsync(4</r/s.new/walk>) = 0
7 fsync(5</r/s.new>) = 0
7 rename(\"/r/s.new\", \"/r/s\") = 0
7 fdatasync(3</r>) = 0
7 write(9</r/s/walk>, \"\"..., 1) = 1
7 fsync(9</r/c>) = 0
7 unlinkat(6</r/s>, \"set.json\", 0) = 0
7 fsync(6</r/s>) = 0
7 unlinkat(6</r/s>, \"walk\", 0) = 0
7 unlinkat(AT_FDCWD</tmp>, \"/r/s\", AT_REMOVEDIR) = 0
";
    assert_eq!(holes(set, ""), Vec::<String>::new());
    assert_eq!(
        holes(set, "fsync(4<"),
        ["/r/s.new becomes s: /r/c is not synced", "/r/s.new becomes s: /r/s.new/walk is not synced"]
    );
    assert_eq!(holes(set, "fsync(5<"), ["/r/s.new becomes s: /r/s.new is not synced since walk is in it"]);
    assert_eq!(holes(set, "fsync(6<"), ["/r/s/walk goes: /r/s is not synced since its page went"]);
    assert_eq!(
        holes(set, "fdatasync")[0],
        "/r/s/walk is changed: the folder of /r/s is not synced since it has this name"
    );
}

#[test]
fn a_side_effect_waits_for_the_ledger_also_where_the_trace_is_torn() {
    let row = "\
9 openat(AT_FDCWD</tmp>, \"/r/db-wal\", O_RDWR|O_CREAT|O_NOFOLLOW|O_CLOEXEC, 0600) = 8</r/db-wal>
9 pwrite64(8</r/db-wal>, \"\"..., 24, 4096 <unfinished ...>
7 write(1</dev/null>, \"\", 0) = 0
9 <... pwrite64 resumed>) = 24
9 fdatasync(8</r/db-wal> <unfinished ...>
7 write(1</dev/null>, \"\", 0) = 0
9 <... fdatasync resumed>) = 0
9 fdatasync(10</r>) = 0
9 pwrite64(6</r/db>, \"\"..., 4096, 0) = 4096
";
    let all = |row: &str| {
        let trace = ["1 execve(\"/a\", [], 0x0) = 0\n", row, REPLACED.split_once('\n').expect("lines").1].concat();
        judge(&events(&trace, "/r"), &BTreeSet::from(["/r".to_owned()]))
    };
    assert_eq!(all(row), Vec::<String>::new());
    let unsynced =
        row.replace("9 <... fdatasync resumed>) = 0", "9 <... fdatasync resumed>) = -1 EIO (Input/output error)");
    assert_eq!(all(&unsynced)[0], "/r/switch.new becomes switch: /r/db-wal is not synced");
    let late = row.replace("9 <... fdatasync resumed>) = 0\n", "");
    assert_eq!(all(&late)[0], "/r/switch.new becomes switch: /r/db-wal is not synced", "it had not returned");
    let made =
        format!("7 mkdir(\"/r/d\", 0777) = 0\n{}", row.replace("/r/db", "/r/d/db").replace("10</r>", "10</r/d>"));
    assert_eq!(all(&made)[0], "/r/d/db-wal is relied on: /r is not synced since d is in it");
    let gone = |synced: &str| all(&format!("{row}{synced}9 unlink(\"/r/db-wal\") = 0\n"));
    assert_eq!(gone("9 fsync(6</r/db>) = 0\n"), Vec::<String>::new());
    assert_eq!(gone("")[0], "/r/db-wal goes: /r/db is not synced");
}

#[test]
fn bytes_on_their_way_are_synced_before_their_marks_and_before_they_are_content() {
    let marks = "\
7 openat(AT_FDCWD</tmp>, \"/r/c.part\", O_RDWR|O_CREAT|O_CLOEXEC, 0666) = 4</r/c.part>
7 ftruncate(4</r/c.part>, 9) = 0
7 rename(\"/r/d.new\", \"/r/d.map\") = 0
7 fsync(3</r>) = 0
7 write(4</r/c.part>, \"\"..., 9) = 9
7 fdatasync(4</r/c.part>) = 0
7 rename(\"/r/c.new\", \"/r/c.map\") = 0
7 fsync(3</r>) = 0
7 fchmod(4</r/c.part>, 0644) = 0
7 fsync(4</r/c.part>) = 0
7 rename(\"/r/c.part\", \"/r/c\") = 0
7 fsync(3</r>) = 0
";
    assert_eq!(holes(marks, ""), Vec::<String>::new());
    assert_eq!(holes(marks, "fdatasync"), ["/r/c.new becomes c.map: /r/c.part is not synced"]);
    assert_eq!(
        holes(marks, "fsync(4"),
        ["/r/c.part becomes c: /r/c.part is not synced", "the end: /r/c is not synced"]
    );
}
