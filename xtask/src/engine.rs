//! End-to-end tests that run a second time, with PostgreSQL behind the store of every server that they start.
//!
//! Invariant: a test stands here with what it shows of PostgreSQL that the store's contract suite cannot. A name here that no test has
//! any more fails, and so does one that finds PostgreSQL by itself and would run twice there.

use crate::run;

/// What the tests of the suite read; see tests/tests/e2e/engine.rs.
pub const VARIABLE: (&str, &str) = ("MIDSHIFT_TEST_ENGINE", "postgres");

/// Modules (`name::`) and single tests that run again, and what they show there.
const AGAIN: &[(&str, &str)] = &[
    ("audited::what_was_asked_for_", "chains grow and are read back in the database's order"),
    ("golden_cli::", "each command of a person prints the same"),
    ("handed_over::", "a thousand sessions are written and handed over"),
    ("identity::a_copied_key_", "a session is fenced by rows, and a revoked robot is cut"),
    ("identity::a_token_that_was_revoked_", "a revocation reaches every reader by a wake"),
    ("mid_shift::a_fleet_takes_a_release_", "the server is killed while fleet and ota both write"),
    (
        "minimal_robot::a_robot_from_the_proto_files_alone_outlives_",
        "a foreign robot's events survive kills of the server",
    ),
    ("rolled_out::", "a roll-out goes on after the server was killed"),
    ("stopped::a_stopped_fleet_", "holds survive kills"),
    ("unheard::a_server_that_is_killed_", "the lease of the planner is taken over after each kill"),
    ("watched::", "cursors of watches go on after a kill"),
];

/// Targets and filters of `cargo test`.
pub fn selection() -> Vec<&'static str> {
    let mut selection = vec!["--test", "e2e", "--"];
    for (name, why) in AGAIN {
        run::print_line(&format!("again on PostgreSQL: {name}*: {why}"));
        selection.push(name);
    }
    selection
}

#[cfg(test)]
mod tests {
    use super::AGAIN;
    use std::path::Path;

    /// What a test has in its name, or its module, that starts PostgreSQL whatever the engine.
    const ALREADY: &[&str] = &["postgresql", "split::", "split_stack", "partition::", "while_the_database_"];

    /// Names of all tests of the suite, `module::name`.
    fn names() -> Vec<String> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/tests/e2e");
        let mut names = Vec::new();
        for entry in std::fs::read_dir(folder).expect("the suite").flatten() {
            let text = std::fs::read_to_string(entry.path()).expect("a file");
            let module = entry.path().file_stem().expect("a name").to_string_lossy().into_owned();
            for marked in text.split("#[test]").flat_map(|part| part.split("#[tokio::test")).skip(1) {
                let name =
                    marked.split("fn ").nth(1).and_then(|rest| rest.split('(').next()).expect("a test has a name");
                names.push(format!("{module}::{name}"));
            }
        }
        names
    }

    #[test]
    fn what_runs_again_on_postgresql_is_there_and_did_not_run_there_before() {
        let names = names();
        for (again, why) in AGAIN {
            // A filter takes whatever has the text anywhere in its name.
            let has: Vec<_> = names.iter().filter(|name| name.contains(again)).collect();
            assert!(!has.is_empty(), "no test is called {again}* any more ({why})");
            assert!(has.iter().all(|name| name.starts_with(again)), "{again} takes too much: {has:?}");
            let twice: Vec<_> = has.iter().filter(|name| ALREADY.iter().any(|a| name.contains(a))).collect();
            assert!(twice.is_empty(), "{twice:?} run on PostgreSQL already");
        }
    }
}
