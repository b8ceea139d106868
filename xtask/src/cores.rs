//! Tells whether the cores of this machine have time left, by what the system counts.

use std::time::{Duration, Instant};

/// What is looked back at.
pub const WINDOW: Duration = Duration::from_secs(2);

/// What the cores did since the last look.
pub struct Cores {
    since: Instant,
    /// None where the system counts nothing, or other cores.
    counted: Option<Counted>,
}

/// Ticks of all cores since the start of the system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Counted {
    all: u64,
    /// Without those in which something waited for a disk.
    idle: u64,
}

impl Cores {
    /// Looks for the first time.
    #[expect(clippy::disallowed_methods, reason = "tests are started by the wall")]
    pub fn new() -> Self {
        Self { since: Instant::now(), counted: Counted::now() }
    }

    /// Whether they were idle for half of the time since the last look, which was a window ago. The answer to one that comes earlier is no.
    pub fn are_idle(&mut self) -> bool {
        if self.since.elapsed() < WINDOW {
            return false;
        }
        let before = std::mem::replace(self, Self::new()).counted;
        before.zip(self.counted).is_some_and(|(before, now)| now.is_idle_since(before))
    }
}

impl Counted {
    fn now() -> Option<Self> {
        let cores = std::thread::available_parallelism().ok()?.get();
        Self::read(&std::fs::read_to_string("/proc/stat").ok()?, cores)
    }

    /// The first line of /proc/stat, as proc(5) has it: user, nice, system, idle, iowait, … None if it counts other cores than the `cores` that
    /// this process may use: those of the host of a container are idle while its own are full.
    fn read(text: &str, cores: usize) -> Option<Self> {
        let is_core =
            |line: &&str| line.strip_prefix("cpu").is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit()));
        if text.lines().filter(is_core).count() != cores {
            return None;
        }
        let ticks = text.lines().next()?.strip_prefix("cpu ")?.split_whitespace().map(str::parse);
        let ticks: Vec<u64> = ticks.take(8).collect::<Result<_, _>>().ok()?;
        Some(Self { all: ticks.iter().sum(), idle: *ticks.get(3)? })
    }

    fn is_idle_since(self, before: Self) -> bool {
        2 * self.idle.saturating_sub(before.idle) >= self.all.saturating_sub(before.all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cores_that_wait_for_a_disk_are_not_idle() {
        let counted = |text| Counted::read(&format!("{text}\ncpu0 1 1 1 1\ncpu1 1 1 1 1\nintr 7"), 2).unwrap();
        let before = counted("cpu  100 0 100 1000 50 0 0 0 0 0");
        assert_eq!(before, Counted { all: 1250, idle: 1000 });
        assert!(counted("cpu  120 0 120 1050 60 0 0 0 0 0").is_idle_since(before));
        assert!(!counted("cpu  120 0 120 1040 70 0 0 0 0 0").is_idle_since(before));
        assert_eq!([Counted::read("", 0), Counted::read("cpu  1 2", 0), Counted::read("cpu  a b c d", 0)], [None; 3]);
    }

    #[test]
    fn cores_of_a_host_say_nothing_of_those_that_a_container_may_use() {
        let host = "cpu  1 2 3 4 5\ncpu0 1 1 1 1\ncpu1 1 1 1 1\ncpu2 1 1 1 1";
        assert_eq!(Counted::read(host, 2), None);
        assert_eq!(Counted::read(host, 3), Some(Counted { all: 15, idle: 4 }));
    }

    #[test]
    fn a_look_that_comes_too_early_says_no() {
        assert!(!Cores::new().are_idle());
    }
}
