//! How long each test took, from the lines that its program prints.
//!
//! A test program says how many tests it runs, starts them in the order of their names as threads become free, and prints each one when it
//! ends. So the end of each is seen, and its start is the end of the one whose thread it got.

use std::time::Duration;

/// Tests of one run of `cargo test`, as they end.
#[derive(Debug)]
pub struct Slowest {
    threads: usize,
    /// When the program that runs began, on the caller's clock.
    begun: Duration,
    /// Name and end of each of its tests, in the order of the ends.
    ended: Vec<(String, Duration)>,
    /// Tests of all programs that are over, each with what it took.
    took: Vec<(Duration, String)>,
}

impl Slowest {
    /// For programs with so many threads.
    pub fn new(threads: usize) -> Self {
        Self { threads, begun: Duration::ZERO, ended: Vec::new(), took: Vec::new() }
    }

    /// Takes a line that a test program printed `at` this time.
    pub fn add(&mut self, line: &str, at: Duration) {
        if line.starts_with("running ") {
            self.begun = at;
            self.ended.clear();
        } else if line.starts_with("test result: ") {
            self.close();
        } else if let Some((name, _)) = line.strip_prefix("test ").and_then(|rest| rest.split_once(" ... ")) {
            self.ended.push((name.to_owned(), at));
        }
    }

    /// The program is over: the `n`-th name of all got the thread that was free `n`-th.
    fn close(&mut self) {
        let ended = std::mem::take(&mut self.ended);
        let mut names: Vec<&str> = ended.iter().map(|(name, _)| name.as_str()).collect();
        names.sort_unstable();
        let free = std::iter::repeat_n(self.begun, self.threads).chain(ended.iter().map(|(_, at)| *at));
        let began: std::collections::HashMap<&str, Duration> = names.into_iter().zip(free).collect();
        for (name, at) in &ended {
            let from = began.get(name.as_str()).copied().unwrap_or(self.begun);
            self.took.push((at.saturating_sub(from), name.clone()));
        }
    }

    /// All of them, longest first.
    pub fn list(mut self) -> Vec<(Duration, String)> {
        self.took.sort_by(|a, b| b.cmp(a));
        self.took
    }
}

#[cfg(test)]
mod tests {
    use super::Slowest;
    use std::time::Duration;

    #[test]
    fn a_test_began_when_a_thread_became_free_in_the_order_of_names() {
        let mut slowest = Slowest::new(2);
        let lines = [
            (10, "running 4 tests"),
            (13, "test b ... ok"),
            (20, "test a ... FAILED"),
            (21, "test d ... ok"),
            (30, "test c ... ok"),
            (30, "test result: FAILED. 3 passed; 1 failed; 0 ignored; 0 measured; 0 filtered out; finished in 20.00s"),
            (40, "running 1 test"),
            (42, "test e ... ok"),
            (42, "test result: ok. 1 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out; finished in 2.00s"),
        ];
        for (at, line) in lines {
            slowest.add(line, Duration::from_secs(at));
        }
        let list = slowest.list();
        let list: Vec<_> = list.iter().map(|(took, name)| (took.as_secs(), name.as_str())).collect();
        assert_eq!(list, [(17, "c"), (10, "a"), (3, "b"), (2, "e"), (1, "d")]);
    }
}
