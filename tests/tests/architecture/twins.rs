//! Naive rules of tests: each breaks an invariant in a twin, and no program that is built for use has one in it.

use crate::{code, files, read, root};
use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

/// The feature that they are built with.
const FEATURE: &str = "seeded-bugs";

/// Invariants of the system by number, from I1 on: what holds whatever goes wrong, and what it takes to break it.
const INVARIANTS: u32 = 24;
/// Invariants without a naive rule, and what would break if they did not hold.
const WITHOUT: &[(u32, &str)] = &[
    (11, "model/stop, whose naive twins are refuted there"),
    (
        15,
        "simulation: the law is looked at after each step, and the launcher is no crate with rules that can be switched",
    ),
    (21, "the table of roles and methods, a cell at a time"),
    (22, "every byte of an audit is changed and found"),
];

/// A naive rule, the invariant that it breaks, and the file of the twin that shows it.
type Twin = (&'static str, u32, &'static str);

const FLEET: &str = "services/fleet/tests/fleet/twins.rs";
const ROLLOUTS: &str = "tests/tests/simulation/naive.rs";
const SEEDS: &str = "tests/tests/simulation/seeds.rs";
const AGENT: &str = "robot_agent/tests/agent/twins.rs";
const OFFERS: &str = "robot_agent/tests/agent/offers.rs";
const BUNDLES: &str = "ota_bundles/tests/bundle/twins.rs";

/// By the file that lists them.
const TWINS: &[(&str, &[Twin])] = &[
    ("core/src/task/bugs.rs", &[("ForgetsRequests", 1, "services/task/tests/task/intake.rs")]),
    (
        "core/src/fleet/bugs.rs",
        &[
            ("SilenceFreesTask", 2, FLEET),
            // Over a store where the last writer wins.
            ("EverybodyLeads", 2, FLEET),
            ("LateReportsCount", 3, FLEET),
            ("SuccessIsBelieved", 3, FLEET),
            ("HeartbeatOvertakesEvents", 3, FLEET),
            ("TimeoutFreesPlace", 6, FLEET),
            ("CapacityIsForgotten", 7, FLEET),
            ("GrantsOneByOne", 8, FLEET),
            ("NobodyIsPromoted", 8, FLEET),
            ("BudgetIsForgotten", 17, ROLLOUTS),
            ("UnknownStatesAreTaken", 24, FLEET),
            ("StepsAreNotTold", 8, SEEDS),
            ("DoubtIsKeptQuiet", 8, SEEDS),
            ("ClaimsAreBlamed", 7, SEEDS),
            ("HoldsComeAtOnce", 8, SEEDS),
            ("EachWordIsTold", 23, SEEDS),
            ("FencedReportsRebuild", 8, SEEDS),
        ],
    ),
    (
        "core/src/overload.rs",
        &[
            ("ClassesAreAlike", 10, "services/edge/tests/edge/asking.rs"),
            ("SeatsAreKept", 23, "services/edge/tests/edge/asking.rs"),
        ],
    ),
    (
        "core/src/rollout/bugs.rs",
        &[
            ("InFlightIsForgotten", 17, ROLLOUTS),
            ("PauseIsForgotten", 18, ROLLOUTS),
            ("TimeReleasesDrain", 19, ROLLOUTS),
            ("AnyDrainWillDo", 19, ROLLOUTS),
            // Alone it breaks nothing, which is what is shown: the store holds each decision against the rows that it was made of.
            ("EverybodyLeads", 17, "tests/tests/simulation/directed.rs"),
        ],
    ),
    (
        "ota_bundles/src/bugs.rs",
        &[
            ("StrangersSign", 16, BUNDLES),
            ("AnyRobotWillDo", 16, BUNDLES),
            ("DirectivesLiveForEver", 16, BUNDLES),
            ("LengthIsForgotten", 16, BUNDLES),
            ("RepositoriesLiveForEver", 16, BUNDLES),
            ("FloorIsForgotten", 16, BUNDLES),
        ],
    ),
    (
        "robot_agent/src/bugs.rs",
        &[
            ("NoEpochFence", 4, OFFERS),
            ("IgnoreHolder", 4, OFFERS),
            ("AuthorityFromReceipt", 5, OFFERS),
            ("GrantFromReceipt", 5, "robot_agent/tests/agent/drives.rs"),
            ("StopYieldsToDisk", 10, AGENT),
            ("ResetClearsAll", 12, "tests/tests/simulation/stopped.rs"),
            ("PatientSession", 13, "tests/tests/e2e/held.rs"),
            ("LastWordIsTheLimit", 14, AGENT),
            ("UnlistedIsFine", 16, AGENT),
            ("ActivatesAnyway", 19, ROLLOUTS),
            ("AnyDrainWillDo", 19, ROLLOUTS),
            ("ReplaysAreTaken", 20, AGENT),
            ("NewerWorkIsIgnored", 24, AGENT),
        ],
    ),
    (
        "services/telemetry/src/bugs.rs",
        &[
            ("NoCloneFence", 2, "services/telemetry/tests/link/sessions.rs"),
            ("AckBeforeCommit", 9, SEEDS),
            ("StatusAckBeforeWrite", 9, "services/telemetry/tests/link/status.rs"),
            ("HolesAreTaken", 9, "services/telemetry/tests/link/sessions.rs"),
        ],
    ),
];

/// Naive rules that a file lists: `Name question;`, a line each.
fn listed(text: &str) -> BTreeSet<String> {
    let Some((_, list)) = text.split_once("seeded_bugs! {") else { return BTreeSet::new() };
    let named = list.lines().take_while(|line| line.trim() != "}").filter_map(|line| {
        let (name, question) = line.trim().strip_suffix(';')?.split_once(' ')?;
        let is_name = name.starts_with(char::is_uppercase) && name.chars().all(char::is_alphanumeric);
        (is_name && question.chars().all(|c| c.is_lowercase() || c == '_')).then(|| name.to_owned())
    });
    named.collect()
}

/// Files of the crates, without those of tests.
fn sources() -> Vec<String> {
    files("", "rs").into_iter().filter(|file| file.contains("/src/") && !file.starts_with("tests/")).collect()
}

#[test]
fn every_naive_rule_breaks_an_invariant_in_a_twin_that_names_it() {
    let all: BTreeMap<String, BTreeSet<String>> = sources()
        .into_iter()
        .filter(|file| file != "core/src/bugs.rs")
        .map(|file| (file.clone(), listed(&read(&file))))
        .filter(|(_, listed)| !listed.is_empty())
        .collect();
    let told: BTreeMap<String, BTreeSet<String>> = TWINS
        .iter()
        .map(|(file, twins)| ((*file).to_owned(), twins.iter().map(|(bug, ..)| (*bug).to_owned()).collect()))
        .collect();
    assert_eq!(told, all, "each list, each rule once");
    for (bug, _, file) in TWINS.iter().flat_map(|(_, twins)| *twins) {
        assert!(code(&read(file)).contains(bug), "{file} has no twin of {bug}");
    }
    let proven: BTreeSet<u32> =
        TWINS.iter().flat_map(|(_, twins)| *twins).map(|(_, invariant, _)| *invariant).collect();
    let without: BTreeSet<u32> = WITHOUT.iter().map(|(invariant, _)| *invariant).collect();
    assert!(proven.is_disjoint(&without));
    assert_eq!(&proven | &without, (1..=INVARIANTS).collect());
}

#[test]
fn rules_are_read_off_a_list_and_nothing_else_is() {
    let text = "x::seeded_bugs! {\n    /// Nothing; is.\n    OneRule one_rule;\n    Another another;\n}\nlet Some x;\n";
    assert_eq!(listed(text), BTreeSet::from(["Another", "OneRule"].map(str::to_owned)));
    assert_eq!(listed("let Some x;"), BTreeSet::new());
}

/// What cargo would build of these packages, a line for each feature of each package. With tests, features of tests too.
fn built(selection: &[&str], with_tests: bool) -> BTreeSet<String> {
    let edges = if with_tests { "normal,build,dev,features" } else { "normal,build,features" };
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args(["tree", "--offline", "--locked", "--prefix", "none", "--edges", edges]).args(selection);
    let output = cargo.current_dir(root()).output().expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).lines().map(|line| line.trim_end_matches(" (*)").to_owned()).collect()
}

/// Packages built with the naive rules of tests.
fn naive(built: &BTreeSet<String>) -> BTreeSet<&str> {
    let has = format!(" feature \"{FEATURE}\"");
    built.iter().filter_map(|line| line.split_once(has.as_str())).map(|(package, _)| package).collect()
}

#[test]
fn cargo_builds_no_program_for_use_with_a_naive_rule_and_programs_of_tests_with_all() {
    // `cargo build --release` in the root; and what `cargo xtask dist` builds.
    for selection in [&[][..], &["-p", "midshift", "-p", "midshift-stop", "-p", "midshift-agent"]] {
        let built = built(selection, false);
        assert!(built.iter().any(|line| line.starts_with("midshift-core feature")), "{built:?}");
        assert_eq!(naive(&built), BTreeSet::new(), "{selection:?}");
    }
    let crates = files("", "toml").into_iter().filter(|file| file.ends_with("Cargo.toml"));
    let with_rules = crates.filter(|file| read(file).contains(&format!("\n{FEATURE} = ["))).count();
    assert_eq!(naive(&built(&["--workspace"], true)).len(), with_rules, "the question can be answered with yes");
    // Nor is anything built for use with features that are not asked about here.
    for file in files("xtask/src", "rs").into_iter().chain(files("deploy", "Dockerfile")) {
        assert!(!read(&file).contains("-features") && !read(&file).contains(FEATURE), "{file}");
    }
}

#[test]
fn the_program_of_the_stop_service_has_no_store_in_it() {
    let store = |built: &BTreeSet<String>| {
        let names = ["midshift-store ", "midshift-agent ", "sqlx ", "sqlx-core ", "libsqlite3-sys "];
        names.iter().filter(|name| built.iter().any(|line| line.starts_with(**name))).count()
    };
    assert_eq!(store(&built(&["-p", "midshift-stop"], false)), 0);
    assert_eq!(store(&built(&["-p", "midshift"], false)), 5, "the question can be answered with yes");
}

#[test]
fn no_source_of_a_program_switches_a_naive_rule_on() {
    let switches = |text: &str| text.contains("Bugs::seeded(") || text.contains("SeededBug::");
    for file in sources().into_iter().filter(|file| file != "core/src/bugs.rs") {
        assert!(!switches(&code(&read(&file))), "{file}");
    }
    assert!(switches(&code(&read(FLEET))));
}
