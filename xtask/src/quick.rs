//! The daily loop: what shows most of a change in five minutes, beside the tests inside the crates.
//!
//! Invariant: it proves nothing that the suite does not prove again.

use crate::e2e::{self, RoundOptions};
use crate::programs::{self, Choice};
use crate::round::{Count, Round};
use anyhow::Result;

/// Shifts that are simulated: some five seconds a core.
const SEEDS: (&str, &str) = ("MIDSHIFT_SEEDS", "24");
/// End-to-end tests, one for each thing that a change is likely to break.
const HANDFUL: [&str; 5] = [
    "begin_and_end::dev_prints_its_ports_",
    "rolled_out::",
    "stopped::a_stopped_fleet_",
    "kill::nothing_is_lost_and_nothing_done_twice_when_server_and_agents_",
    "watched::",
];

/// Runs it; whether all passed. Nothing is left out after a test that failed.
pub fn run(round: &Round<'_>, count: &mut Count) -> Result<bool> {
    let named = |name| programs::named(round.programs()?, name);
    let pages = round.play(&[named("architecture")?, named("model")?], Choice::default(), count)?;
    let seeds = Choice { filter: Some("many_seeds_keep_every_law"), variable: Some(SEEDS) };
    let shifts = round.play(&[named("simulation")?], seeds, count)?;
    let programs = e2e::play(round, &RoundOptions { only: Some(HANDFUL.to_vec()), ..RoundOptions::default() }, count)?;
    Ok(pages && shifts && programs)
}

#[cfg(test)]
mod tests {
    use super::HANDFUL;

    #[test]
    fn each_of_the_handful_is_there() {
        let names = crate::e2e::in_sources();
        for begin in HANDFUL {
            assert!(names.iter().any(|(name, _)| name.starts_with(begin)), "no test is called {begin}* any more");
        }
    }
}
