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

/// Seeds of a plain run. Each has a process of its own, so that nothing of one run reaches another.
const SEEDS: u64 = 12;
/// Processes at once.
const AT_ONCE: usize = 2;

fn say(text: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Runs one seed in another process; its whole output, and whether every law held.
fn elsewhere(seed: u64) -> (String, bool) {
    let program = std::env::current_exe().expect("this test is a program");
    let mut command = std::process::Command::new(program);
    command.args(["--exact", "one_seed_keeps_every_law", "--nocapture"]).env("MIDSHIFT_SIM_SEED", seed.to_string());
    let output = command.output().expect("a test that runs can be run again");
    (String::from_utf8_lossy(&output.stderr).into_owned(), output.status.success())
}

fn hash_of(text: &str) -> Option<&str> {
    text.lines().find(|line| line.starts_with("seed "))?.split_whitespace().nth(3)
}

#[test]
fn one_seed_keeps_every_law() {
    let seed = number("MIDSHIFT_SIM_SEED").unwrap_or(1);
    let outcome = run::run(seed, room::Naive::default());
    say(&format!("seed {seed} hash {:016x} lasted {} ms", outcome.hash, outcome.lasted_ms));
    say(&format!("{:#?}\n{:#?}\n{:#?}", outcome.checks, outcome.counts, outcome.faults));
    assert!(outcome.findings.is_empty(), "seed {seed}: {:#?}", outcome.findings);
    assert!(outcome.faults.values().sum::<u64>() > 0, "seed {seed} met no fault");
}

#[test]
fn many_seeds_keep_every_law() {
    let first = number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    let seeds: Vec<u64> = (first..first + number("MIDSHIFT_SEEDS").unwrap_or(SEEDS)).collect();
    let next = std::sync::atomic::AtomicUsize::new(0);
    let broken = std::sync::Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(|| {
                while let Some(seed) = seeds.get(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed)) {
                    let (text, held) = elsewhere(*seed);
                    if !held {
                        say(&text);
                        broken.lock().expect("no thread panics with it").push(*seed);
                    }
                }
            });
        }
    });
    let broken = broken.into_inner().expect("no thread panics with it");
    assert!(
        broken.is_empty(),
        "again: MIDSHIFT_SIM_SEED=N cargo test -p midshift-tests --test simulation one_seed; broken: {broken:?}"
    );
}

#[test]
fn a_seed_is_the_same_run_in_another_process() {
    let (first, again) = (elsewhere(42), elsewhere(42));
    assert!(first.1 && again.1);
    let hash = hash_of(&first.0);
    assert!(hash.is_some() && hash == hash_of(&again.0), "{hash:?} {:?}", hash_of(&again.0));
}
