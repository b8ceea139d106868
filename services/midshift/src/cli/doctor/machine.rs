//! What can be said of the machine that `doctor` runs on, and of a data folder on it.

use super::Finding;
use crate::serve::IDENTITY;
use crate::stop;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Descriptors a server for a thousand robots should have.
const DESCRIPTORS_WANTED: u64 = 4_096;
/// Connections of one robot at most: its session, bulk, and its line to the stop service.
const CONNECTIONS_A_ROBOT: u64 = 3;
/// Descriptors for people, programs, files and the database.
const DESCRIPTORS_BESIDE: u64 = 512;
/// A disk with less than this free wants a look, percent ...
const FREE_PERCENT: u64 = 10;
/// ... and bytes.
const FREE_BYTES: u64 = 1 << 30;

/// How many files may be open here, beside what the robots that are known need.
pub fn descriptors(robots: Option<usize>) -> Finding {
    let text = fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let limit = text
        .lines()
        .find(|l| l.starts_with("Max open files"))
        .and_then(|l| l.split_whitespace().nth(3))
        .and_then(|n| n.parse::<u64>().ok());
    match limit {
        None => Finding::good("descriptors", "limit unknown on this system"),
        Some(n) => of_descriptors(n, robots.map_or(0, |robots| robots as u64)),
    }
}

fn of_descriptors(limit: u64, robots: u64) -> Finding {
    let wanted = DESCRIPTORS_WANTED.max(robots * CONNECTIONS_A_ROBOT + DESCRIPTORS_BESIDE);
    let text = format!(
        "{limit} open files allowed in this shell; a server of {robots} robots should have {wanted}, {CONNECTIONS_A_ROBOT} for each robot"
    );
    match limit >= wanted {
        true => Finding::good("descriptors", text),
        false => Finding::look("descriptors", format!("{text}: LimitNOFILE= in its unit, or ulimit -n")),
    }
}

/// Disk and rights of a data folder; a word that it is not here, if it is not.
pub fn data(folder: &Path) -> Vec<Finding> {
    if !folder.is_dir() {
        let text = format!("no data folder {} here; on the server's machine name it with --data", folder.display());
        return vec![Finding::good("disk", text)];
    }
    let mut found = vec![disk(folder)];
    let private = [folder.to_owned(), folder.join(IDENTITY), folder.join(stop::FOLDER)];
    let open: Vec<String> = private.iter().filter_map(|folder| is_open(folder)).collect();
    found.push(match open.is_empty() {
        true => Finding::good("exposure", format!("{} is for its owner alone", folder.display())),
        false => Finding::look(
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
    (mode & 0o007 != 0).then(|| format!("{} has mode {mode:03o}", folder.display()))
}

fn disk(folder: &Path) -> Finding {
    match rustix::fs::statvfs(folder) {
        Ok(disk) => {
            let [free, all] = [disk.f_bavail, disk.f_blocks].map(|blocks| blocks.saturating_mul(disk.f_frsize));
            of_disk(folder, free, all)
        }
        Err(error) => Finding::look("disk", format!("{}: {error}", folder.display())),
    }
}

fn of_disk(folder: &Path, free: u64, all: u64) -> Finding {
    let percent = free.saturating_mul(100) / all.max(1);
    let text = format!("{} MiB ({percent} %) free for {}", free >> 20, folder.display());
    match percent >= FREE_PERCENT && free >= FREE_BYTES {
        true => Finding::good("disk", text),
        false => Finding::look(
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
        assert_eq!([of_descriptors(4_095, 12).good, of_descriptors(4_096, 12).good], [false, true]);
        assert_eq!([of_descriptors(30_511, 10_000).good, of_descriptors(30_512, 10_000).good], [false, true]);
        let found = of_descriptors(1_024, 12);
        assert!(found.text.contains("should have 4096") && found.text.contains("LimitNOFILE"), "{}", found.text);
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
        let keys = folder.path().join(IDENTITY);
        fs::create_dir(&keys).expect("a folder");
        open(&keys, 0o755);
        assert!(!told().good && told().text.contains("identity has mode 755"), "{}", told().text);
        open(&keys, 0o700);
        open(folder.path(), 0o704);
        assert!(!told().good);
        assert!(data(&folder.path().join("elsewhere"))[0].text.contains("--data"));
    }
}
