//! The end-to-end suite a second time, with PostgreSQL behind the store of every server that a test starts.
//!
//! Invariant: a test runs again unless it stands here with its reason, which is printed. A name here that no test has any more fails.

use crate::run;

/// What the tests of the suite read; see tests/tests/e2e/engine.rs.
pub const VARIABLE: (&str, &str) = ("MIDSHIFT_TEST_ENGINE", "postgres");

/// What `midshift dev` keeps is in memory.
const DEV: &str = "it starts no server but `dev`, which has no such store";
/// The engine is not chosen there.
const ALWAYS: &str = "it is on PostgreSQL in the first run already";
/// Robots, programs and files alone.
const NO_SERVER: &str = "no server takes part";

/// Modules (`name::`) and single tests that do not run again, and why.
const LEFT_OUT: &[(&str, &str)] = &[
    (
        "audited::what_is_changed_",
        "it changes a file of SQLite; what PostgreSQL holds is changed in the contract of the store",
    ),
    ("begin_and_end::a_second_server_on_the_same_data_", "a data directory has one server; a database may have many"),
    ("begin_and_end::dev_", DEV),
    ("kill::nothing_is_lost_and_nothing_done_twice_on_postgresql_", ALWAYS),
    ("languages::each_client_keeps_its_own_rules", NO_SERVER),
    ("languages::each_client_and_foreign_ones_do_the_same_with_a_split_stack", ALWAYS),
    ("languages::each_client_gives_up_in_time_and_outlives_a_split_stack_", ALWAYS),
    ("launched::a_set_that_", NO_SERVER),
    ("launched::sets_and_trust_", NO_SERVER),
    ("measured::", DEV),
    ("partition::", ALWAYS),
    ("public_address::", DEV),
    ("secrets::", NO_SERVER),
    ("restored::", "it has a drill for each engine in the first run"),
    ("split::", ALWAYS),
    ("stop_alone::", "the stop service has files of its own; the server beside it has the store of one box"),
    ("stopped::a_stop_that_is_engaged_while_the_database_", ALWAYS),
    ("story::", DEV),
    ("swarm_software::", NO_SERVER),
];

/// Targets and filters of `cargo test`.
pub fn selection() -> Vec<&'static str> {
    let mut selection = vec!["--test", "e2e", "--"];
    for (name, why) in LEFT_OUT {
        run::say(&format!("not again: {name}*: {why}"));
        selection.extend(["--skip", name]);
    }
    selection
}

#[cfg(test)]
mod tests {
    use super::LEFT_OUT;
    use std::path::Path;

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
    fn what_does_not_run_on_postgresql_is_named_once_and_there() {
        let names = names();
        assert!(names.iter().any(|name| name.starts_with("kill::")), "{names:?}");
        for (left_out, why) in LEFT_OUT {
            // `--skip` leaves out whatever has the text anywhere in its name.
            let has: Vec<_> = names.iter().filter(|name| name.contains(left_out)).collect();
            assert!(!has.is_empty(), "no test is called {left_out}* any more ({why})");
            assert!(has.iter().all(|name| name.starts_with(left_out)), "{left_out} leaves out too much: {has:?}");
        }
        let runs = |name: &&String| !LEFT_OUT.iter().any(|(left_out, _)| name.contains(left_out));
        for module in ["golden_cli", "held", "kill", "languages", "ledger_cuts", "minimal_robot", "rolled_out", "tuf"] {
            let of_module = |name: &&String| name.starts_with(&format!("{module}::"));
            assert!(names.iter().filter(of_module).any(|name| runs(&name)), "nothing of {module} runs on PostgreSQL");
        }
    }
}
