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

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok()?.parse().ok()
}

#[test]
fn one_seed_keeps_every_law() {
    let seed = number("MIDSHIFT_SIM_SEED").unwrap_or(1);
    let outcome = run::run(seed, room::Naive::default());
    eprintln!("seed {seed} hash {:016x} lasted {} ms", outcome.hash, outcome.lasted_ms);
    eprintln!("{:#?}\n{:#?}\n{:#?}", outcome.checks, outcome.counts, outcome.faults);
    assert!(outcome.findings.is_empty(), "seed {seed}: {:#?}", outcome.findings);
}
