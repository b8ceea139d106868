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
mod frame;
mod frames;
mod incidents;
mod law_names;
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
mod seeds;
mod skew;
mod software;
mod stderr;
mod stopped;
mod stops;
mod wall;
mod worker;
mod wrong_clock;

use seeds::{Twin, break_laws, elsewhere, every_seed_holds, hash_of, naive_of, own_seed, report_seed};
use std::collections::BTreeMap;

/// Seeds of a plain run. Each has a process of its own, so that nothing of one run reaches another.
const SEEDS: u64 = 40;
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
/// Each naive rule, and the law that it breaks.
const TWINS: [Twin<'_>; 6] = [
    Twin { rule: "claims_are_blamed", law: incidents::NOT_BLAMED, from: 1 },
    Twin { rule: "authority_from_receipt", law: "I5 no offer is taken late", from: 18 },
    Twin { rule: "grant_from_receipt", law: "I5 no grant is used late", from: 4 },
    Twin { rule: "ack_before_commit", law: "I9 what is acknowledged is kept", from: 1 },
    Twin { rule: "silence_frees_task", law: "I6 a load stays with its robot", from: 1 },
    Twin { rule: "timeout_frees_place", law: "I6 floor under a robot is not given away", from: 4 },
];

/// The test that runs one seed of a shift with faults.
const SHIFT: &str = "one_seed_keeps_every_law";

/// What is on the lists and never happened.
fn missed(sums: &BTreeMap<String, u64>) -> Vec<String> {
    let lists = [("hit", HITS.as_slice()), ("count", COUNTS.as_slice()), ("check", LAWS.as_slice())];
    let names = lists.into_iter().flat_map(|(kind, names)| names.iter().map(move |name| format!("{kind} {name}")));
    names.filter(|name| sums.get(name).copied().unwrap_or(0) == 0).collect()
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

#[test]
fn a_seed_is_the_same_run_in_another_process() {
    let (first, again) = (elsewhere(SHIFT, 42, ""), elsewhere(SHIFT, 42, ""));
    assert!(first.1 && again.1);
    let hash = hash_of(&first.0);
    assert!(hash.is_some() && hash == hash_of(&again.0), "{hash:?} {:?}", hash_of(&again.0));
}
