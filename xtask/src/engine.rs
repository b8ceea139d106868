//! End-to-end tests that run a second time, with PostgreSQL behind the store of every server that they start.
//!
//! Invariant: a test stands here with what it shows of PostgreSQL that neither the store's contract suite nor a split stack can: a lease, a
//! takeover, a wake, a kill. A name here that no test has any more fails, and so does one that finds PostgreSQL by itself and would run
//! twice there. Every night all tests run so.

use crate::e2e::RoundOptions;
use crate::round::Scope;
use crate::run;

/// What the tests of the suite read; see tests/tests/e2e/engine.rs.
const VARIABLE: (&str, &str) = ("MIDSHIFT_TEST_ENGINE", "postgres");

/// Modules (`name::`) and single tests that run again, and what they show there.
const AGAIN: &[(&str, &str)] = &[
    ("handed_over::", "takeover: a thousand sessions are written and handed over"),
    ("identity::a_copied_key_", "lease: a session is fenced by rows, and a revoked robot is cut"),
    ("identity::a_token_that_was_revoked_", "wake: a revocation reaches every reader"),
    ("stopped::a_stopped_fleet_", "kill: holds survive each one of the server"),
    ("unheard::a_server_that_is_killed_", "takeover: the lease of the planner is taken over after each kill"),
    ("watched::", "kill: cursors of watches go on after one"),
];

/// The tests that run again, and how.
pub fn round_options(scope: Scope) -> RoundOptions<'static> {
    let listed = || {
        for (name, why) in AGAIN {
            run::tell_person(&format!("again on PostgreSQL: {name}*: {why}"));
        }
        AGAIN.iter().map(|(name, _)| *name).collect()
    };
    RoundOptions { only: (scope == Scope::Daily).then(listed), variable: Some(VARIABLE), is_loaded: false }
}

#[cfg(test)]
mod tests {
    use super::AGAIN;
    use crate::e2e;

    /// What a test has in its name, or its module, that starts PostgreSQL whatever the engine.
    const ALREADY: &[&str] =
        &["postgresql", "released::", "split::", "split_stack", "partition::", "while_the_database_"];

    #[test]
    fn what_runs_again_on_postgresql_is_there_and_did_not_run_there_before() {
        let names = e2e::in_sources();
        for (again, why) in AGAIN {
            let has: Vec<_> = names.iter().map(|(name, _)| name).filter(|name| name.starts_with(again)).collect();
            assert!(!has.is_empty(), "no test is called {again}* any more ({why})");
            let twice: Vec<_> = has.iter().filter(|name| ALREADY.iter().any(|a| name.contains(a))).collect();
            assert!(twice.is_empty(), "{twice:?} run on PostgreSQL already");
        }
    }
}
