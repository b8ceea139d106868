//! The whole system in one thread and one simulated time: server, ten agents and clients on a network that is cut, machines that crash,
//! clocks that are wrong and disks that fail, while tasks are worked and software is rolled out, all drawn from one seed, with the
//! invariants looked at after each step. Directed runs of roll-outs and their twins are beside it.

mod agent;
mod astray;
mod body;
mod changes;
mod client;
mod clock;
mod counted;
mod directed;
mod disk;
mod incidents;
mod laws;
mod naive;
mod net;
mod newer;
mod observer;
mod old_status;
mod orders;
mod plan;
mod played;
mod room;
mod run;
mod skew;
mod software;
mod stopped;
mod stops;
mod wall;
mod worker;
mod wrong_clock;

use midshift::server::Naive as Server;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_core::fleet::bugs::SeededBug as Fleet;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// Seeds of a plain run. Each has a process of its own, so that nothing of one run reaches another.
const SEEDS: u64 = 120;
/// Runs with so many seeds or more must have met every fault and looked at every law; a few seeds cannot.
const ENOUGH: u64 = 40;
/// What must have been hit, each by evidence and not by plan.
const HITS: [&str; 14] = [
    "agent crash in a change of software",
    "agent crash with work in progress",
    "hardware stop in a roll-out",
    "server crash in a roll-out",
    "server crash with work in progress",
    "message of a robot lost",
    "message to a robot lost",
    "message held on its way",
    "message kept from a robot's ear",
    "commit without an answer",
    "call a disk refused",
    "commit on a slow disk",
    "answer a client never got",
    "status sent beside a session",
];
/// What the system must have come to by them.
const COUNTS: [&str; 12] = [
    "attempt uncertain",
    "task given again",
    "task CANCELED",
    "robot refused a stale grant",
    "rollout Completed",
    "rollout Aborted",
    "rollout Superseded",
    "rollout paused Operator",
    "robot Committed",
    "robot RolledBack PROGRAM_CRASHED",
    "robot RolledBack REVERT_ASKED",
    "program hung",
];
/// Every law, by the name under which it is looked at.
const LAWS: [&str; 37] = [
    counted::TOLD,
    incidents::NOT_BLAMED,
    "I1 no client is refused",
    "I1 one task a request",
    "I2 epochs rise",
    "I2 one lease a task and one holder a robot",
    "I3 an ended task stays ended",
    "I3 items are conserved",
    "I3 what succeeded was put down once",
    "I4 no passed epoch and no finished task is taken",
    "I4 no step is done twice",
    "I5 no grant is used late",
    "I5 no offer is taken late",
    "I5 nobody acts after the task was given on",
    "I6 a load stays with its robot",
    "I6 floor under a robot is not given away",
    "I7 bodies within capacity",
    "I7 grants within capacity",
    "I7 no place was too full",
    "I8 every drain is released",
    "I8 every roll-out ends",
    "I8 every task ends",
    "I9 events in order, once, without gaps",
    "I9 status in order, once, without gaps",
    "I9 what is acknowledged is kept",
    "I15 ledger and switch record agree",
    "I15 the kept set is the one committed last",
    "I15 who was touched by what was aborted is back on what it kept",
    "I16 only signed software runs that the robot was told to",
    "I17 no more change than the area spares",
    "I17 no more change than the wave has",
    "I18 no activation after the word to stand still",
    "I19 a robot activates in the drain of its roll-out",
    "I19 no activation with work, load, passage or stop",
    "I19 no work on probation or in a drain",
    "I19 nobody is given work on probation",
    "I19 permission follows the robot's own word in that drain",
];
/// A naive rule must be seen to fail within this many seeds.
const TWIN_SEEDS: u64 = 40;
/// Each naive rule, and the law that it breaks.
const TWINS: [(&str, &str); 6] = [
    ("claims_are_blamed", incidents::NOT_BLAMED),
    ("authority_from_receipt", "I5 no offer is taken late"),
    ("grant_from_receipt", "I5 no grant is used late"),
    ("ack_before_commit", "I9 what is acknowledged is kept"),
    ("silence_frees_task", "I6 a load stays with its robot"),
    ("timeout_frees_place", "I6 floor under a robot is not given away"),
];

fn naive_of(name: &str) -> room::Naive {
    let agent = |bug| room::Naive { agent: Bugs::of(&[bug]), ..room::Naive::default() };
    let server = |server| room::Naive { server, ..room::Naive::default() };
    let fleet = |bug| server(Server { fleet: midshift_core::fleet::bugs::Bugs::of(&[bug]), ..Server::default() });
    match name {
        "" => room::Naive::default(),
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

/// The test that runs one seed of a shift with faults.
const SHIFT: &str = "one_seed_keeps_every_law";

/// Runs one seed of a test in another process; its whole output, and whether every law held.
fn elsewhere(test: &str, seed: u64, naive: &str) -> (String, bool) {
    let program = std::env::current_exe().expect("this test is a program");
    let mut command = std::process::Command::new(program);
    command.args(["--exact", test, "--nocapture"]);
    command.env("MIDSHIFT_SIM_SEED", seed.to_string()).env("MIDSHIFT_SIM_NAIVE", naive);
    let output = command.output().expect("a test that runs can be run again");
    (String::from_utf8_lossy(&output.stderr).into_owned(), output.status.success())
}

/// The seed of this process. None: no seed is asked for, and seed 1 of `test` has run and held in a process of its own, since counters of
/// the server that laws look at belong to a process.
fn own_seed(test: &str) -> Option<u64> {
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

fn hash_of(text: &str) -> Option<&str> {
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

/// What is on the lists and never happened.
fn missed(sums: &BTreeMap<String, u64>) -> Vec<String> {
    let lists = [("hit", HITS.as_slice()), ("count", COUNTS.as_slice()), ("check", LAWS.as_slice())];
    let names = lists.into_iter().flat_map(|(kind, names)| names.iter().map(move |name| format!("{kind} {name}")));
    names.filter(|name| sums.get(name).copied().unwrap_or(0) == 0).collect()
}

/// Prints what a seed met; fails if it broke a law.
fn report_seed(seed: u64, outcome: &run::Outcome) {
    say(&format!("seed {seed} hash {:016x} lasted {} ms", outcome.hash, outcome.lasted_ms));
    outcome.checks.iter().for_each(|(name, n)| say(&format!("check {n} {name}")));
    outcome.counts.iter().for_each(|(name, n)| say(&format!("count {n} {name}")));
    outcome.hits.iter().for_each(|(name, n)| say(&format!("hit {n} {name}")));
    outcome.planned.iter().for_each(|(name, n)| say(&format!("planned {n} {name}")));
    assert!(outcome.findings.is_empty(), "seed {seed}: {:#?}", outcome.findings);
}

/// Runs the seeds that the environment names, or the first `seeds`, by the test `one`. Gives how many and what they counted; fails if one broke a law.
fn every_seed_holds(one: &str, again: &str, seeds: u64) -> (u64, BTreeMap<String, u64>) {
    let first = number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    let many = number("MIDSHIFT_SEEDS").unwrap_or(seeds);
    let (broken, sums) = (Mutex::new(Vec::new()), Mutex::new(BTreeMap::new()));
    each(one, first..first + many, "", |seed, text, held| {
        add_up(&mut sums.lock().expect("no thread panics with it"), text);
        if !held {
            say(text);
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
    sums.iter().for_each(|(name, n)| say(&format!("{n:>10} {name}")));
    (many, sums)
}

#[test]
fn one_seed_keeps_every_law() {
    let Some(seed) = own_seed(SHIFT) else { return };
    let outcome = run::run(seed, naive_of(&std::env::var("MIDSHIFT_SIM_NAIVE").unwrap_or_default()));
    report_seed(seed, &outcome);
    assert!(outcome.hits.values().sum::<u64>() > 0, "seed {seed} met no fault");
}

#[test]
fn many_seeds_keep_every_law() {
    let (many, sums) = every_seed_holds(SHIFT, "one_seed", SEEDS);
    let checks = sums.keys().filter_map(|name| name.strip_prefix("check "));
    let unlisted: Vec<&str> = checks.filter(|law| !LAWS.contains(law)).collect();
    assert!(unlisted.is_empty(), "put them into LAWS: {unlisted:?}");
    let missed = missed(&sums);
    assert!(missed.is_empty() || many < ENOUGH, "{many} seeds and never: {missed:#?}");
}

#[test]
fn each_naive_rule_breaks_its_law() {
    break_laws(SHIFT, &TWINS);
}

/// Runs seeds of a test with each naive rule until one breaks the law of that rule; fails if none does.
fn break_laws(one: &str, twins: &[(&str, &str)]) {
    for (rule, law) in twins {
        let seen = AtomicBool::new(false);
        each(one, 1..1 + TWIN_SEEDS, rule, |seed, text, held| {
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
    let (first, again) = (elsewhere(SHIFT, 42, ""), elsewhere(SHIFT, 42, ""));
    assert!(first.1 && again.1);
    let hash = hash_of(&first.0);
    assert!(hash.is_some() && hash == hash_of(&again.0), "{hash:?} {:?}", hash_of(&again.0));
}
