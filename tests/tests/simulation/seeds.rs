//! Runs seeds of a test, each in a process of its own, and adds up what they met.

use crate::room::Naive;
use crate::run::Outcome;
use crate::stderr::print_line;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_core::fleet::bugs::SeededBug as Fleet;
use midshift_server::NaiveRules as Server;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// A naive rule must be seen to fail within this many seeds.
const TWIN_SEEDS: u64 = 40;

/// The naive rule of this name; of an empty one: none.
pub fn naive_of(name: &str) -> Naive {
    let agent = |bug| Naive { agent: Bugs::seeded(&[bug]), ..Naive::default() };
    let server = |server| Naive { server, ..Naive::default() };
    let fleet = |bug| server(Server { fleet: midshift_core::fleet::bugs::Bugs::seeded(&[bug]), ..Server::default() });
    match name {
        "" => Naive::default(),
        "silence_frees_task" => fleet(Fleet::SilenceFreesTask),
        "timeout_frees_place" => fleet(Fleet::TimeoutFreesPlace),
        "doubt_is_kept_quiet" => fleet(Fleet::DoubtIsKeptQuiet),
        "steps_are_not_told" => fleet(Fleet::StepsAreNotTold),
        "claims_are_blamed" => fleet(Fleet::ClaimsAreBlamed),
        "late_reports_count" => fleet(Fleet::LateReportsCount),
        "holds_come_at_once" => fleet(Fleet::HoldsComeAtOnce),
        "each_word_is_told" => fleet(Fleet::EachWordIsTold),
        "success_is_believed" => fleet(Fleet::SuccessIsBelieved),
        "fenced_reports_rebuild" => fleet(Fleet::FencedReportsRebuild),
        "authority_from_receipt" => agent(SeededBug::AuthorityFromReceipt),
        "grant_from_receipt" => agent(SeededBug::GrantFromReceipt),
        "ack_before_commit" => {
            let telemetry = midshift_telemetry::Bugs::seeded(&[midshift_telemetry::SeededBug::AckBeforeCommit]);
            server(Server { telemetry, ..Server::default() })
        }
        other => panic!("no naive rule is called {other}"),
    }
}

/// A number of the environment.
pub fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok()?.parse().ok()
}

/// Runs one seed of a test in another process; its whole output, and whether every law held.
pub fn elsewhere(test: &str, seed: u64, naive: &str) -> (String, bool) {
    let program = std::env::current_exe().expect("this test is a program");
    let mut command = std::process::Command::new(program);
    command.args(["--exact", test, "--nocapture"]);
    command.env("MIDSHIFT_SIM_SEED", seed.to_string()).env("MIDSHIFT_SIM_NAIVE", naive);
    let output = command.output().expect("a test that runs can be run again");
    (String::from_utf8_lossy(&output.stderr).into_owned(), output.status.success())
}

/// The seed of this process. None: no seed is asked for, and seed 1 of `test` has run and held in a process of its own, since counters of
/// the server that laws look at belong to a process.
pub fn own_seed(test: &str) -> Option<u64> {
    let seed = number("MIDSHIFT_SIM_SEED");
    if seed.is_none() {
        let (text, held) = elsewhere(test, 1, "");
        assert!(held, "{text}");
    }
    seed
}

/// Runs seeds in processes of their own, as many at once as there are cores, until one of them `ends` it. Later ones may have run.
fn each(test: &str, seeds: std::ops::Range<u64>, naive: &str, ends: impl Fn(u64, &str, bool) -> bool + Sync) {
    let (next, over) = (AtomicU64::new(seeds.start), AtomicBool::new(false));
    let at_once = std::thread::available_parallelism().map_or(2, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..at_once {
            scope.spawn(|| {
                while !over.load(Relaxed) {
                    let seed = next.fetch_add(1, Relaxed);
                    if seed >= seeds.end {
                        return;
                    }
                    let (text, held) = elsewhere(test, seed, naive);
                    if ends(seed, &text, held) {
                        over.store(true, Relaxed);
                    }
                }
            });
        }
    });
}

/// What a run says that it came to.
pub fn hash_of(text: &str) -> Option<&str> {
    text.lines().find(|line| line.starts_with("seed "))?.split_whitespace().nth(3)
}

/// Adds up what runs said of themselves: `check`, `count` or `hit`, a number, a name.
fn add_up(sums: &mut BTreeMap<String, u64>, text: &str) {
    for line in text.lines() {
        let mut words = line.splitn(3, ' ');
        let (Some(kind @ ("check" | "count" | "hit")), Some(n), Some(name)) =
            (words.next(), words.next(), words.next())
        else {
            continue;
        };
        *sums.entry(format!("{kind} {name}")).or_insert(0) += n.parse::<u64>().unwrap_or(0);
    }
}

/// Prints what a seed met; fails if it broke a law.
pub fn report_seed(seed: u64, outcome: &Outcome) {
    print_line(&format!("seed {seed} hash {:016x} lasted {} ms", outcome.hash, outcome.lasted_ms));
    outcome.checks.iter().for_each(|(name, n)| print_line(&format!("check {n} {name}")));
    outcome.counts.iter().for_each(|(name, n)| print_line(&format!("count {n} {name}")));
    outcome.hits.iter().for_each(|(name, n)| print_line(&format!("hit {n} {name}")));
    outcome.planned.iter().for_each(|(name, n)| print_line(&format!("planned {n} {name}")));
    assert!(outcome.findings.is_empty(), "seed {seed}: {:#?}", outcome.findings);
}

/// Runs the seeds that the environment names, or the first `seeds`, by the test `one`. Gives how many and what they counted; fails if one broke a law.
pub fn every_seed_holds(one: &str, again: &str, seeds: u64) -> (u64, BTreeMap<String, u64>) {
    let first = number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    let many = number("MIDSHIFT_SEEDS").unwrap_or(seeds);
    let (broken, sums) = (Mutex::new(Vec::new()), Mutex::new(BTreeMap::new()));
    each(one, first..first + many, "", |seed, text, held| {
        add_up(&mut sums.lock().expect("no thread panics with it"), text);
        if !held {
            print_line(text);
            broken.lock().expect("no thread panics with it").push(seed);
        }
        false
    });
    let (broken, sums) = (broken.into_inner(), sums.into_inner());
    let (broken, sums) = (broken.expect("no thread panics with it"), sums.expect("no thread panics with it"));
    assert!(
        broken.is_empty(),
        "again: MIDSHIFT_SIM_SEED=N cargo test --workspace --test simulation {again}; broken: {broken:?}"
    );
    sums.iter().for_each(|(name, n)| print_line(&format!("{n:>10} {name}")));
    (many, sums)
}

/// A naive rule that must be seen to fail.
#[derive(Clone, Copy)]
pub struct Twin<'a> {
    /// Its name.
    pub rule: &'a str,
    /// The law that it breaks.
    pub law: &'a str,
    /// The seed that is played first: one that broke the law when this was written.
    pub from: u64,
}

/// Runs seeds of a test with each naive rule until one breaks the law of that rule; fails if none does.
pub fn break_laws(one: &str, twins: &[Twin<'_>]) {
    for Twin { rule, law, from } in twins {
        let seen = AtomicBool::new(false);
        each(one, *from..*from + TWIN_SEEDS, rule, |seed, text, held| {
            let breaks = !held && text.contains(&format!("s: {law}"));
            if breaks {
                print_line(&format!("{rule}: seed {seed} breaks {law}"));
                seen.store(true, Relaxed);
            }
            breaks
        });
        assert!(seen.into_inner(), "{TWIN_SEEDS} seeds with {rule} never broke: {law}");
    }
}
