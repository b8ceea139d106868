//! Kills a process at one of its calls that change the disk. `strace` counts the calls of a whole run that touch a folder, and then another run of the same is
//! ended at one of them: as it enters it if one thread makes them all, since `strace` counts for each thread by itself; else right after it.
//!
//! The process is one test of the program at hand, started again with something in its environment. Invariant: a kill that did not happen fails. A kill loses
//! nothing that was written and not synced: that takes a look at the trace. Uses the standard library and `tempfile` alone, so that any crate's tests can include this file.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use tempfile::NamedTempFile;

/// Calls that change what is on a disk. One that opens a new file leaves the same as the next one that writes to it finds.
pub const CALLS: &str = "write,pwrite64,fsync,fdatasync,rename,renameat,renameat2,link,linkat,unlink,unlinkat,rmdir,mkdir,mkdirat,ftruncate,copy_file_range,chmod,fchmod,fchmodat";

/// What is killed.
pub struct Victim<'a> {
    /// The whole name of the test.
    pub test: &'a str,
    /// What its process finds in its environment.
    pub environment: &'a [(&'a str, OsString)],
    /// The folder that counts.
    pub folder: &'a Path,
}

/// Calls that change a folder, as one whole run made them.
pub struct Sites {
    /// The name of each, and the how manieth of that name it is.
    pub calls: Vec<(String, usize)>,
    /// What they touched, below the folder.
    pub paths: BTreeSet<String>,
}

/// `strace` with these arguments, and where the trace comes.
pub fn strace(arguments: &[String]) -> (Command, NamedTempFile) {
    let log = NamedTempFile::new().expect("a file");
    let mut command =
        Command::new(std::env::var_os("MIDSHIFT_TEST_STRACE").unwrap_or_else(|| OsString::from("strace")));
    command.args(["-f", "-qq", "-y", "-o"]).arg(log.path()).args(arguments);
    (command, log)
}

/// The same with one test of the program at hand in a process of its own.
fn under(arguments: &[String], victim: &Victim<'_>, entry: &[&str]) -> (Command, NamedTempFile) {
    let (mut command, log) = strace(arguments);
    command.args(entry).arg(std::env::current_exe().expect("this test"));
    command.args(["--nocapture", "--exact", victim.test]);
    command.envs(victim.environment.iter().map(|(name, value)| (name, value)));
    (command, log)
}

/// What it said and how it ended, and the trace.
pub fn run(mut command: Command, log: &NamedTempFile) -> (Output, String) {
    let output = command.output();
    let program = command.get_program().display();
    let output = output.unwrap_or_else(|e| panic!("{program}: {e}: run `cargo xtask test --install`"));
    (output, fs::read_to_string(log.path()).expect("a trace"))
}

/// The test in a process of its own, under `strace` with these arguments.
pub fn traced(victim: &Victim<'_>, arguments: &[String]) -> (Output, String) {
    let (command, log) = under(arguments, victim, &[]);
    run(command, &log)
}

/// Runs it to its end and finds the calls that touch its folder.
pub fn sites(victim: &Victim<'_>) -> Sites {
    let (output, trace) = traced(victim, &["-e".to_owned(), format!("trace={CALLS}")]);
    assert!(output.status.success(), "{}: {}{trace}", output.status, String::from_utf8_lossy(&output.stdout));
    let folder = victim.folder.to_string_lossy();
    let mut count: BTreeMap<&str, usize> = BTreeMap::new();
    let mut sites = Sites { calls: Vec::new(), paths: BTreeSet::new() };
    for line in trace.lines().filter(|line| line.contains(&*folder)) {
        // strace fills a thread's number up to five places: of a small one more than one space follows.
        let name =
            line.split_whitespace().nth(1).and_then(|call| call.split('(').next()).expect("a thread, then a call");
        let number = count.entry(name).or_default();
        *number += 1;
        sites.calls.push((name.to_owned(), *number));
        let below = line.match_indices(&*folder).map(|(at, _)| &line[at + folder.len()..]);
        sites.paths.extend(below.filter_map(|rest| rest.split(['>', '"']).next()).map(str::to_owned));
    }
    sites
}

fn only(victim: &Victim<'_>, paths: &BTreeSet<String>) -> Vec<String> {
    let whole = victim.folder.to_string_lossy();
    paths.iter().flat_map(|path| ["-P".to_owned(), format!("{whole}{path}")]).collect()
}

/// Kills it as it enters a call; what it had said before. One thread makes all calls of this name.
pub fn killed_at(victim: &Victim<'_>, paths: &BTreeSet<String>, (name, number): &(String, usize)) -> String {
    let whole = victim.folder.to_string_lossy();
    let mut arguments = only(victim, paths);
    let inject = format!("inject={name}:signal=SIGKILL:when={number}");
    arguments.extend(["-e".to_owned(), format!("trace={name}"), "-e".to_owned(), inject]);
    let (output, trace) = traced(victim, &arguments);
    let last = trace.lines().rev().find(|line| line.contains('('));
    let is_there = last.is_some_and(|call| call.contains(&*whole) && call.ends_with("= ?"));
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        is_there && output.status.signal() == Some(9),
        "not killed at {name} {number}: {}: {said}{trace}",
        output.status
    );
    said
}

/// Kills it when so many of its calls have been made, whichever of its threads made them; what it had said before. It stands after each until then.
pub fn killed_after(victim: &Victim<'_>, paths: &BTreeSet<String>, calls: usize) -> String {
    let process = NamedTempFile::new().expect("a file");
    let mut arguments = only(victim, paths);
    let inject = format!("inject={CALLS}:signal=SIGSTOP");
    arguments.extend(["-e".to_owned(), format!("trace={CALLS}"), "-e".to_owned(), inject]);
    let path = process.path().to_string_lossy().into_owned();
    let entry = ["sh", "-c", "echo $$ > $0; exec \"$@\"", &path];
    let (mut command, log) = under(&arguments, victim, &entry);
    let mut running = command.stdout(Stdio::piped()).spawn().expect("strace");
    let (mut stood, mut said) = (0, String::new());
    loop {
        let number = fs::read_to_string(process.path()).expect("a number");
        let trace = fs::read_to_string(log.path()).expect("a trace");
        // All threads stand; the first one says so once.
        let is_stop = |line: &&str| {
            line.split_whitespace().next() == Some(number.trim()) && line.ends_with("--- stopped by SIGSTOP ---")
        };
        let stands = trace.lines().filter(is_stop).count();
        let ended = running.try_wait().expect("a child");
        assert!(ended.is_none(), "it ended after {stood} of {calls} calls: {ended:?}: {trace}");
        if stands > stood {
            stood = stands;
            let signal = if stood >= calls { "KILL" } else { "CONT" };
            let sent = Command::new("kill").args(["-s", signal, number.trim()]).status().expect("kill");
            assert!(sent.success(), "kill -s {signal} {number}");
            if signal == "KILL" {
                break;
            }
        }
        std::thread::yield_now();
    }
    running.stdout.take().map(|mut stdout| stdout.read_to_string(&mut said).expect("what it said"));
    let status = running.wait().expect("its end");
    assert_eq!(status.signal(), Some(9), "{status}");
    said
}
