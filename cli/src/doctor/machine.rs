//! What can be said of the machine that `doctor` runs on, and of a data folder on it.

use super::finding::Finding;
use crate::stop_service;
use midshift_core::{identity, limits};
use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;

/// Descriptors a server for a thousand robots should have.
const DESCRIPTORS_WANTED: u64 = 4_096;
/// Connections of one robot to the server at most: its session, and bulk.
const OF_SERVER: u64 = 2;
/// And to the stop service: its line.
const OF_STOP: u64 = 1;
/// Descriptors for files, the database, people and programs.
const DESCRIPTORS_BESIDE: u64 = limits::DESCRIPTORS_KEPT as u64;
/// A disk with less than this free wants a look, percent ...
const FREE_PERCENT: u64 = 10;
/// ... and bytes.
const FREE_BYTES: u64 = 1 << 30;

/// How many files the server of this data folder and its stop service may have open, beside what the robots that are known need.
pub fn descriptors(folder: &Path, robots: Option<usize>) -> Vec<Finding> {
    let robots = robots.map_or(0, |robots| robots as u64);
    let processes =
        [("server", folder.to_owned(), OF_SERVER), ("stop service", folder.join(stop_service::FOLDER), OF_STOP)];
    let held = processes.into_iter().filter_map(|(whose, folder, each)| {
        let limit = limit_of(&format!("/proc/{}/limits", holder(&folder)?))?;
        Some(of_descriptors(whose, limit, robots, each))
    });
    let found: Vec<Finding> = held.collect();
    if found.is_empty() {
        let text = format!("nobody here holds {}, so that the server's limit cannot be read", folder.display());
        return vec![Finding::good(
            "descriptors",
            format!("{text}; look on its machine, with --data and as its user or root"),
        )];
    }
    found
}

/// The process that holds a lock of a file in this folder, as a server and a stop service do for as long as they run.
fn holder(folder: &Path) -> Option<u32> {
    let files: BTreeSet<u64> =
        fs::read_dir(folder).ok()?.filter_map(|file| Some(file.ok()?.metadata().ok()?.ino())).collect();
    holder_of(&fs::read_to_string("/proc/locks").ok()?, &files)
}

/// `locks` as in proc(5): `1: FLOCK ADVISORY WRITE 4711 08:01:131 0 EOF`.
fn holder_of(locks: &str, files: &BTreeSet<u64>) -> Option<u32> {
    locks.lines().find_map(|line| {
        let mut words = line.split_whitespace().skip(1);
        let (kind, pid, file) = (words.next()?, words.nth(2)?, words.next()?);
        let inode = file.rsplit(':').next()?.parse().ok()?;
        (kind == "FLOCK" && files.contains(&inode)).then(|| pid.parse().ok())?
    })
}

fn limit_of(limits: &str) -> Option<u64> {
    let text = fs::read_to_string(limits).ok()?;
    let line = text.lines().find(|line| line.starts_with("Max open files"))?;
    match line.split_whitespace().nth(3)? {
        "unlimited" => Some(u64::MAX),
        number => number.parse().ok(),
    }
}

fn of_descriptors(whose: &str, limit: u64, robots: u64, each: u64) -> Finding {
    let wanted = DESCRIPTORS_WANTED.max(robots * each + DESCRIPTORS_BESIDE);
    let text = format!(
        "the {whose} may have {limit} files open; for {robots} robots it should be {wanted}, {each} for each robot"
    );
    match limit >= wanted {
        true => Finding::good("descriptors", text),
        false => Finding::wants_look(
            "descriptors",
            format!("{text}: LimitNOFILE= in its unit, or ulimit -n before it is started"),
        ),
    }
}

/// Disk and rights of a data folder; a word that it is not here, if it is not.
pub fn data(folder: &Path) -> Vec<Finding> {
    if !folder.is_dir() {
        let text = format!("no data folder {} here; on the server's machine name it with --data", folder.display());
        return vec![Finding::good("disk", text)];
    }
    let mut found = vec![disk(folder)];
    let private = [folder.to_owned(), folder.join(identity::FOLDER), folder.join(stop_service::FOLDER)];
    let open: Vec<String> = private.iter().filter_map(|folder| is_open(folder)).collect();
    found.push(match open.is_empty() {
        true => Finding::good("exposure", format!("{} is for its owner alone", folder.display())),
        false => Finding::wants_look(
            "exposure",
            format!(
                "{}: others on this machine can read what proves who is who; chmod 700, and ask who may have",
                open.join(", ")
            ),
        ),
    });
    found
}

/// The folder with its mode, if it is open to others.
fn is_open(folder: &Path) -> Option<String> {
    let mode = fs::metadata(folder).ok()?.permissions().mode() & 0o777;
    (mode & 0o077 != 0).then(|| format!("{} has mode {mode:03o}", folder.display()))
}

fn disk(folder: &Path) -> Finding {
    match rustix::fs::statvfs(folder) {
        Ok(disk) => {
            let [free, all] = [disk.f_bavail, disk.f_blocks].map(|blocks| blocks.saturating_mul(disk.f_frsize));
            of_disk(folder, free, all)
        }
        Err(error) => Finding::wants_look("disk", format!("{}: {error}", folder.display())),
    }
}

fn of_disk(folder: &Path, free: u64, all: u64) -> Finding {
    let percent = free.saturating_mul(100) / all.max(1);
    let text = format!("{} MiB ({percent} %) free for {}", free >> 20, folder.display());
    match percent >= FREE_PERCENT && free >= FREE_BYTES {
        true => Finding::good("disk", text),
        false => Finding::wants_look(
            "disk",
            format!(
                "{text}: nothing is acknowledged any more when it is full; make room, or move the folder to a larger disk"
            ),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_of_open_files_is_held_against_the_robots_of_the_site() {
        let good = |limit, robots| of_descriptors("server", limit, robots, 2).good;
        assert_eq!([good(4_095, 12), good(4_096, 12)], [false, true]);
        assert_eq!([good(20_511, 10_000), good(20_512, 10_000)], [false, true]);
        let found = of_descriptors("stop service", 1_024, 12, 1);
        assert!(found.text.contains("should be 4096") && found.text.contains("LimitNOFILE"), "{}", found.text);
    }

    #[test]
    fn the_limit_is_that_of_the_process_that_holds_the_folder_and_not_of_this_shell() {
        let folder = tempfile::tempdir().expect("a folder");
        let found = descriptors(folder.path(), None);
        assert!(found.len() == 1 && found[0].text.starts_with("nobody here holds"), "{found:?}");
        let lock = fs::File::create(folder.path().join("rows.lock")).expect("a file");
        lock.try_lock().expect("nobody has it");
        let found = descriptors(folder.path(), None);
        assert!(found.len() == 1 && found[0].text.starts_with("the server may have "), "{found:?}");
        let locks = "1: POSIX  ADVISORY  READ 17 08:01:131 0 EOF\n2: -> FLOCK ADVISORY WRITE 18 08:01:131 0 EOF\n3: FLOCK  ADVISORY  WRITE 19 08:01:131 0 EOF\n";
        assert_eq!([holder_of(locks, &[131].into()), holder_of(locks, &[132].into())], [Some(19), None]);
    }

    #[test]
    fn a_disk_that_is_nearly_full_is_told_of() {
        let found = |free, all| of_disk(Path::new("data"), free, all);
        assert!(found(100 << 30, 1_000 << 30).good);
        assert!(!found(99 << 30, 1_000 << 30).good && !found(1 << 29, 1 << 30).good && !found(0, 0).good);
        assert!(found(0, 1 << 40).text.starts_with("0 MiB (0 %) free for data: nothing is acknowledged"));
    }

    #[test]
    fn a_folder_with_keys_that_others_can_read_is_told_of() {
        let folder = tempfile::tempdir().expect("a folder");
        let told = || data(folder.path()).pop().expect("rights");
        let open = |path: &Path, mode| fs::set_permissions(path, fs::Permissions::from_mode(mode)).expect("a mode");
        open(folder.path(), 0o700);
        assert!(told().good, "{}", told().text);
        let keys = folder.path().join(identity::FOLDER);
        fs::create_dir(&keys).expect("a folder");
        open(&keys, 0o755);
        assert!(!told().good && told().text.contains("identity has mode 755"), "{}", told().text);
        open(&keys, 0o700);
        for mode in [0o704, 0o750, 0o710] {
            open(folder.path(), mode);
            assert!(!told().good, "{mode:o}");
        }
        assert!(data(&folder.path().join("elsewhere"))[0].text.contains("--data"));
    }
}
