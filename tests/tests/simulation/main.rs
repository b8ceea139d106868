//! The whole system in one thread and one simulated time: server, ten agents and clients on a network that is cut, machines that crash,
//! clocks that are wrong and disks that fail, all drawn from one seed, with the invariants looked at after each step.

mod body;
mod client;
mod clock;
mod disk;
mod laws;
mod net;
mod observer;
mod plan;
mod room;
mod run;

use midshift::server::Naive as Server;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_core::fleet::bugs::SeededBug as Fleet;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// Seeds of a plain run. Each has a process of its own, so that nothing of one run reaches another.
const SEEDS: u64 = 200;
/// A naive rule must be seen to fail within this many seeds.
const TWIN_SEEDS: u64 = 40;
/// Each naive rule, and the law that it breaks.
const TWINS: [(&str, &str); 5] = [
    ("authority_from_receipt", "I5 no offer is taken late"),
    ("grant_from_receipt", "I5 no grant is used late"),
    ("ack_before_commit", "I9 what is acknowledged is kept"),
    ("silence_frees_task", "I6 a load stays with its robot"),
    ("timeout_frees_place", "I6 floor under a robot is not given away"),
];

fn naive(name: &str) -> room::Naive {
    let agent = |bug| room::Naive { agent: Bugs::of(&[bug]), ..room::Naive::default() };
    let server = |server| room::Naive { server, ..room::Naive::default() };
    let fleet = |bug| server(Server { fleet: midshift_core::fleet::bugs::Bugs::of(&[bug]), ..Server::default() });
    match name {
        "" => room::Naive::default(),
        "silence_frees_task" => fleet(Fleet::SilenceFreesTask),
        "timeout_frees_place" => fleet(Fleet::TimeoutFreesPlace),
        "authority_from_receipt" => agent(SeededBug::AuthorityFromReceipt),
        "grant_from_receipt" => agent(SeededBug::GrantFromReceipt),
        "ack_before_commit" => {
            let telemetry = midshift_telemetry::Bugs::of(&[midshift_telemetry::SeededBug::AckBeforeCommit]);
            server(Server { telemetry, ..Server::default() })
        }
        other => panic!("no naive rule is called {other}"),
    }
}

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok()?.parse().ok()
}

fn say(text: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Runs one seed in another process; its whole output, and whether every law held.
fn elsewhere(seed: u64, naive: &str) -> (String, bool) {
    let program = std::env::current_exe().expect("this test is a program");
    let mut command = std::process::Command::new(program);
    command.args(["--exact", "one_seed_keeps_every_law", "--nocapture"]);
    command.env("MIDSHIFT_SIM_SEED", seed.to_string()).env("MIDSHIFT_SIM_NAIVE", naive);
    let output = command.output().expect("a test that runs can be run again");
    (String::from_utf8_lossy(&output.stderr).into_owned(), output.status.success())
}

/// Runs seeds in processes of their own, as many at once as there are cores, until one of them `ends` it. Later ones may have run.
fn each(seeds: std::ops::Range<u64>, naive: &str, ends: impl Fn(u64, &str, bool) -> bool + Sync) {
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
                    let (text, held) = elsewhere(seed, naive);
                    if ends(seed, &text, held) {
                        over.store(true, Relaxed);
                    }
                }
            });
        }
    });
}

fn hash_of(text: &str) -> Option<&str> {
    text.lines().find(|line| line.starts_with("seed "))?.split_whitespace().nth(3)
}

#[test]
fn one_seed_keeps_every_law() {
    let seed = number("MIDSHIFT_SIM_SEED").unwrap_or(1);
    let outcome = run::run(seed, naive(&std::env::var("MIDSHIFT_SIM_NAIVE").unwrap_or_default()));
    say(&format!("seed {seed} hash {:016x} lasted {} ms", outcome.hash, outcome.lasted_ms));
    say(&format!("{:#?}\n{:#?}\n{:#?}", outcome.checks, outcome.counts, outcome.faults));
    assert!(outcome.findings.is_empty(), "seed {seed}: {:#?}", outcome.findings);
    assert!(outcome.faults.values().sum::<u64>() > 0, "seed {seed} met no fault");
}

#[test]
fn many_seeds_keep_every_law() {
    let first = number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    let seeds = first..first + number("MIDSHIFT_SEEDS").unwrap_or(SEEDS);
    let broken = Mutex::new(Vec::new());
    each(seeds, "", |seed, text, held| {
        if !held {
            say(text);
            broken.lock().expect("no thread panics with it").push(seed);
        }
        false
    });
    let broken = broken.into_inner().expect("no thread panics with it");
    assert!(
        broken.is_empty(),
        "again: MIDSHIFT_SIM_SEED=N cargo test -p midshift-tests --test simulation one_seed; broken: {broken:?}"
    );
}

#[test]
fn each_naive_rule_breaks_its_law() {
    for (rule, law) in TWINS {
        let seen = AtomicBool::new(false);
        each(1..1 + TWIN_SEEDS, rule, |seed, text, held| {
            let breaks = !held && text.contains(&format!("s: {law}"));
            if breaks {
                say(&format!("{rule}: seed {seed} breaks {law}"));
                seen.store(true, Relaxed);
            }
            breaks
        });
        assert!(seen.into_inner(), "{TWIN_SEEDS} seeds with {rule} never broke: {law}");
    }
}

#[test]
fn a_seed_is_the_same_run_in_another_process() {
    let (first, again) = (elsewhere(42, ""), elsewhere(42, ""));
    assert!(first.1 && again.1);
    let hash = hash_of(&first.0);
    assert!(hash.is_some() && hash == hash_of(&again.0), "{hash:?} {:?}", hash_of(&again.0));
}
