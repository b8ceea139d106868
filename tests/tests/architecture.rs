//! Holds the tree to its own pages: who imports whom (ARCHITECTURE.md), who writes which rows (docs/rows.md), what may not be there.
//!
//! Invariant: reads files only; nothing is built, and nothing is run but cargo that is asked what it would build. Each rule is a function of text, tried on a
//! text that breaks it.

#[path = "architecture/circles.rs"]
mod circles;
#[path = "architecture/dependencies.rs"]
mod dependencies;
#[path = "architecture/logs.rs"]
mod logs;
#[path = "architecture/metrics.rs"]
mod metrics;
#[path = "architecture/newer_words.rs"]
mod newer_words;
#[path = "architecture/pages.rs"]
mod pages;
#[path = "architecture/released.rs"]
mod released;
#[path = "architecture/serde_types.rs"]
mod serde_types;
#[path = "architecture/source.rs"]
mod source;
#[path = "architecture/stored_keys.rs"]
mod stored_keys;
#[path = "architecture/tidy.rs"]
mod tidy;
#[path = "architecture/twins.rs"]
mod twins;

use midshift_core::rows::{Log, Table};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Tasks are spawned in a crate's `lib.rs`. Elsewhere only here, each for a reason.
const SPAWNS: &[(&str, &str)] = &[
    (
        "services/midshift/src/commands/mod.rs",
        "a server runs on the runtime's own threads, not on the one that waits for them",
    ),
    ("services/telemetry/src/link.rs", "one task a session: it must outlive the handler that opened it"),
    ("services/telemetry/src/facts.rs", "one fact: the robot's stream may be gone before it is written"),
    ("services/telemetry/src/grpc.rs", "one task a watching stream, ended by its reader or by shutdown"),
    ("services/task/src/grpc.rs", "one task a watching stream, ended by its reader or by shutdown"),
    ("services/identity/src/audit/grpc.rs", "one task an export or verification, ended by its reader or by shutdown"),
    ("services/identity/src/revocation_list.rs", "lines are appended beside the runtime's threads"),
    ("services/ota/src/threads.rs", "files are read and written beside the runtime's threads"),
    ("services/ota/src/rollouts/grpc.rs", "one task a watching stream, ended by its reader or by shutdown"),
    ("services/stop/src/line.rs", "one task a robot's line: it must outlive the handler that opened it"),
    ("services/stop/src/grpc.rs", "one task a watching stream, ended by its reader or by shutdown"),
    ("services/stop/src/threads.rs", "files of the stop service are read and written beside the threads that answer"),
    ("services/dev/src/scenario.rs", "`dev` makes releases for a story"),
    ("services/dev/src/scenario/watch.rs", "`dev` looks at robots while a story is played"),
    ("services/backup/src/files.rs", "files are copied and read beside the runtime's threads"),
    ("services/server/src/stop_follower.rs", "files of the stop service are read beside the runtime's threads"),
    (
        "services/midshift/src/enrol_simulated.rs",
        "the binary enrols many machines side by side and renews what they got",
    ),
    ("services/stop/src/program/manager.rs", "a service manager that hangs must not hold up the stop service"),
    ("services/stop/src/program/principals.rs", "who is known is followed as long as the port is open"),
    ("services/midshift/src/robots.rs", "the binary lets a person walk beside its robot"),
    ("services/store/src/sqlite/mod.rs", "the one writer of a file and its checkpoints"),
    ("services/store/src/sqlite/frames.rs", "the one writer of a file and its checkpoints"),
    ("services/store/src/postgres/mod.rs", "the one writer of a process, and what hears of the others"),
    ("services/store/src/postgres/frames.rs", "the one writer of a process"),
    ("services/dev/src/run.rs", "`dev` wires the parts"),
    ("services/midshift/src/commands/interrupts.rs", "the binary listens for Ctrl-C"),
];

/// Files are made durable, and given their names, by the crate `durable`. Elsewhere only here, each for a reason.
const SYNCED_BY_HAND: &[(&str, &str)] = &[
    ("cli/src/audit.rs", "an export comes a record at a time"),
    ("cli/src/samples.rs", "a second name for a file that is there"),
    ("latch/src/lib.rs", "a slot is written where it lies"),
    ("ota_bundles/src/build.rs", "a component goes through its hash as it is copied"),
    ("ota_bundles/src/folder/encoded_targets.rs", "an encoded target is made a piece at a time"),
    ("robot_agent/src/sets/content.rs", "a download comes a piece at a time"),
    ("robot_agent/src/sets/disk.rs", "content is made a piece at a time and read back by the same handle"),
    ("robot_agent/src/sets/slots.rs", "a slot stands for a partition, which has no other beside it"),
    ("robot_sim/src/body/files.rs", "a simulated body notes where it stands at each turn of its way"),
    ("services/identity/src/revocation_list.rs", "a line at a time"),
    ("services/backup/src/staging.rs", "a name that may not stay is taken back"),
    ("services/ota/src/content.rs", "an upload comes a piece at a time"),
    ("services/ota/src/folder.rs", "a number is written where it lies, under the lock on its file"),
    ("services/ota/src/fixture.rs", "a test puts a file aside and back"),
    ("services/stop/src/audit.rs", "a line at a time"),
    (
        "services/store/src/sqlite/copy.rs",
        "SQLite writes the copy; only its bytes are made durable, and its folder by whoever asked",
    ),
];

/// Words that say nothing, and the names that may have them.
const EMPTY_WORDS: [&str; 6] = ["Manager", "Helper", "Util", "Common", "Data", "Info"];
const NAMES_KEPT: &[(&str, &str)] = &[
    ("ConnectInfo", "tonic's name in `Connected`"),
    ("Data", "http-body's name in `Body`"),
    ("DataClass", "the word of those who answer for data for what something is"),
    ("DataFile", "a file of the data directory, beside its lock file"),
];

const LINES_MAX: usize = 600;

/// Folders of what runs on servers, at people's and on robots: not tests, benchmarks and xtask.
const ROOMS: [&str; 10] =
    ["cli", "core", "durable", "latch", "os", "ota_bundles", "proto", "robot_agent", "robot_sim", "services"];

/// Sources of these rooms that are compiled into programs, and tests that stand among them.
fn of_rooms(rooms: &[&str]) -> impl Iterator<Item = String> {
    rooms.iter().flat_map(|room| files(room, "rs")).filter(|path| path.contains("/src/"))
}

/// Files that are still longer, below a folder, with how many of them there are. It only shrinks.
const KNOWN_LONG: &[(&str, usize)] = &[("core/", 1), ("proto/", 2), ("tests/", 3)];

/// What runs of releases left: nobody writes it and nobody cuts it.
const RECORDED: &str = "tests/fixtures/";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(path: impl AsRef<Path>) -> String {
    let path = root().join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Files below `under` whose names end in `.ext`, as paths from the root; build output and hidden folders left out.
fn files(under: &str, ext: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut open = vec![root().join(under)];
    while let Some(dir) = open.pop() {
        for entry in std::fs::read_dir(&dir).unwrap_or_else(|e| panic!("{}: {e}", dir.display())) {
            let path = entry.expect("an entry").path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() && name != "target" && !name.starts_with('.') {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == ext) {
                let relative = path.strip_prefix(root()).expect("below the root");
                found.push(relative.to_string_lossy().trim_start_matches("./").to_owned());
            }
        }
    }
    found.sort();
    found
}

/// Cells of the rows of the Markdown table whose header begins with `first`.
fn table(page: &str, first: &str) -> Vec<Vec<String>> {
    let header = format!("| {first} |");
    let lines = page.lines().skip_while(|l| !l.starts_with(&header)).skip(2).take_while(|l| l.starts_with('|'));
    lines.map(|l| l.trim_matches('|').split('|').map(|c| c.trim().trim_matches('`').to_owned()).collect()).collect()
}

// --- who may import whom

/// Short name of a crate of ours: `midshift-core` → `core`; the binary's crate and xtask keep theirs.
fn short(name: &str) -> Option<&str> {
    match name {
        "midshift" | "xtask" => Some(name),
        _ => name.strip_prefix("midshift-"),
    }
}

/// What each crate may import, as ARCHITECTURE.md says; none: everything.
fn allowed(page: &str) -> BTreeMap<String, Option<BTreeSet<String>>> {
    let names = |cell: &str| cell.split(',').map(|n| n.trim().to_owned()).filter(|n| n != "–").collect::<BTreeSet<_>>();
    let mut rules = BTreeMap::new();
    for row in table(page, "crate") {
        for name in names(&row[0]) {
            rules.insert(name, (row[1] != "all").then(|| names(&row[1])));
        }
    }
    rules
}

/// Names in every dependency section of a manifest, those for tests and build scripts included.
fn dependencies(manifest: &toml::Table) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (section, value) in manifest {
        match (section.as_str(), value.as_table()) {
            ("dependencies" | "dev-dependencies" | "build-dependencies", Some(names)) => {
                found.extend(names.keys().cloned())
            }
            ("target", Some(targets)) => {
                found.extend(targets.values().filter_map(|t| t.as_table()).flat_map(dependencies));
            }
            _ => {}
        }
    }
    found
}

fn package(manifest: &toml::Table) -> String {
    manifest["package"]["name"].as_str().expect("a name").to_owned()
}

/// Arrows between our crates that no rule allows.
fn foreign_arrows(rules: &BTreeMap<String, Option<BTreeSet<String>>>, manifests: &[toml::Table]) -> Vec<String> {
    let mut foreign = Vec::new();
    for manifest in manifests {
        let name = package(manifest);
        let Some(from) = short(&name) else {
            foreign.push(format!("{name} is not named like a crate of ours"));
            continue;
        };
        let Some(rule) = rules.get(from) else {
            foreign.push(format!("{from} stands in no row of the table"));
            continue;
        };
        for dependency in dependencies(manifest) {
            let to = short(&dependency).filter(|to| *to != from);
            if let (Some(to), Some(rule)) = (to, rule)
                && !rule.contains(to)
            {
                foreign.push(format!("{from} -> {to}"));
            }
        }
    }
    foreign
}

fn manifests() -> Vec<toml::Table> {
    let workspace: toml::Table = read("Cargo.toml").parse().expect("a manifest");
    let members = workspace["workspace"]["members"].as_array().expect("members");
    let paths = members.iter().map(|m| format!("{}/Cargo.toml", m.as_str().expect("a path")));
    paths.map(|path| read(path).parse().expect("a manifest")).collect()
}

#[test]
fn every_arrow_between_crates_stands_in_the_table_of_the_architecture_page() {
    let rules = allowed(&read("ARCHITECTURE.md"));
    let manifests = manifests();
    assert!(manifests.len() >= 12 && rules.len() >= manifests.len(), "{rules:?}");
    assert_eq!(foreign_arrows(&rules, &manifests), Vec::<String>::new());
    for name in rules.keys() {
        assert!(
            manifests.iter().any(|m| short(&package(m)) == Some(name)),
            "the table names {name}, which is no crate"
        );
    }
}

#[test]
fn the_table_itself_lets_nothing_up_and_no_service_into_another() {
    let rules = allowed(&read("ARCHITECTURE.md"));
    assert_eq!(rules["core"], Some(BTreeSet::new()), "core imports none of ours");
    let services = ["task", "fleet", "telemetry", "ota", "stop", "identity"];
    let above = ["server", "dev", "midshift", "bench", "tests", "xtask"];
    for (name, rule) in rules.iter().filter(|(name, _)| !above.contains(&name.as_str())) {
        let rule = rule.as_ref().unwrap_or_else(|| panic!("{name} may import everything"));
        let copied: &[&str] = if name == "backup" { &["identity", "ota", "stop"] } else { &[] };
        for service in services.iter().filter(|service| !copied.contains(*service)) {
            assert!(!rule.contains(*service), "{name} may import the service {service}");
        }
        assert!(!rule.contains("backup"), "{name} may import backup");
        for above in above {
            assert!(!rule.contains(above), "{name} may import {above}");
        }
    }
}

#[test]
fn an_arrow_that_is_not_allowed_is_found_wherever_it_stands() {
    let rules = allowed("| crate | may import |\n|---|---|\n| core | – |\n| task, fleet | core |\n| tests | all |\n");
    let manifest = |text: &str| text.parse::<toml::Table>().expect("a manifest");
    let bad = [
        manifest("[package]\nname='midshift-core'\n[dependencies]\nmidshift-task.workspace=true"),
        manifest(
            "[package]\nname='midshift-task'\n[dev-dependencies]\nmidshift-fleet.workspace=true\nmidshift-core.workspace=true",
        ),
        manifest("[package]\nname='midshift-fleet'\n[target.'cfg(unix)'.dependencies]\nmidshift = {path='x'}"),
        manifest("[package]\nname='midshift-tests'\n[dependencies]\nmidshift-fleet.workspace=true"),
        manifest("[package]\nname='midshift-more'\n"),
    ];
    let found = foreign_arrows(&rules, &bad);
    assert_eq!(found, ["core -> task", "task -> fleet", "fleet -> midshift", "more stands in no row of the table"]);
}

#[test]
fn only_the_store_and_the_agent_know_sql_and_core_knows_no_runtime_and_no_wire() {
    for manifest in manifests() {
        let name = package(&manifest);
        let imports = dependencies(&manifest);
        // Figures stand beside what PostgreSQL can do by itself, which is asked without the store; old sites are put into its tables (0089).
        if !["midshift-store", "midshift-agent", "midshift-bench", "midshift-tests"].contains(&name.as_str()) {
            assert!(!imports.contains("sqlx"), "{name} imports sqlx");
        }
        if name == "midshift-core" {
            for banned in ["tokio", "tonic", "prost", "rand", "sqlx", "tracing", "async-trait", "futures"] {
                assert!(!imports.contains(banned), "core imports {banned}");
            }
        }
        let programs = [
            "midshift",
            "midshift-backup",
            "midshift-cli",
            "midshift-dev",
            "midshift-process",
            "midshift-server",
            "midshift-stop",
            "midshift-bench",
            "midshift-tests",
            "xtask",
        ];
        if !programs.contains(&name.as_str()) {
            assert!(!imports.contains("anyhow"), "{name} imports anyhow");
        }
    }
}

#[test]
fn the_service_of_stops_knows_its_errors_and_only_its_program_has_anyhow() {
    let programs = ["services/stop/src/port.rs", "services/stop/src/program/"];
    for path in files("services/stop/src", "rs").iter().filter(|path| !programs.iter().any(|p| path.starts_with(p))) {
        assert!(!code(&read(path)).contains("anyhow"), "{path}");
    }
}

#[test]
fn no_crate_is_a_drawer_for_everything() {
    for manifest in manifests() {
        let name = package(&manifest);
        for drawer in ["common", "utils", "util", "types", "shared", "helpers"] {
            assert!(!name.split('-').any(|part| part == drawer), "{name}");
        }
    }
}

// --- who writes which rows

#[test]
fn the_page_of_rows_is_what_the_store_enforces() {
    let page = read("docs/rows.md");
    let written: Vec<[String; 3]> =
        table(&page, "table").into_iter().map(|r| [r[0].clone(), r[1].clone(), r[2].clone()]).collect();
    let enforced: Vec<[String; 3]> = Table::ALL
        .iter()
        .map(|t| [t.name().to_owned(), t.writer().as_str().to_owned(), t.born_by().as_str().to_owned()])
        .collect();
    assert_eq!(written, enforced, "docs/rows.md, and core::rows");
    let written: Vec<[String; 2]> = table(&page, "log").into_iter().map(|r| [r[0].clone(), r[1].clone()]).collect();
    let enforced: Vec<[String; 2]> =
        Log::ALL.iter().map(|l| [l.name().to_owned(), l.writer().as_str().to_owned()]).collect();
    assert_eq!(written, enforced, "docs/rows.md, and core::rows");
    let exceptions: Vec<Table> = Table::ALL.iter().copied().filter(|t| t.born_by() != t.writer()).collect();
    assert_eq!(exceptions, [Table::TaskState], "the one declared exception");
}

#[test]
fn a_service_names_no_writer_but_itself() {
    for service in ["task", "fleet", "telemetry"] {
        for path in files(&format!("services/{service}/src"), "rs") {
            let text = read(&path);
            for (other, word) in
                [("task", "Writer::Task"), ("fleet", "Writer::Fleet"), ("telemetry", "Writer::Telemetry")]
            {
                assert!(other == service || !text.contains(word), "{path} writes as {other}");
            }
        }
    }
}

// --- files

#[test]
fn no_file_is_longer_than_a_person_reads() {
    let all = ["rs", "proto", "sql"].into_iter().flat_map(|ext| files(".", ext));
    let all: Vec<String> = all.filter(|path| !path.starts_with(RECORDED)).collect();
    assert!(all.len() > 100);
    let written = all.into_iter().filter(|path| !path.contains("/golden/"));
    let long = written.map(|p| (read(&p).lines().count(), p)).filter(|(lines, _)| *lines > LINES_MAX);
    let mut long: Vec<(usize, String)> = long.collect();
    for (folder, known) in KNOWN_LONG {
        let here: Vec<_> = long.extract_if(.., |(_, path)| path.starts_with(folder)).collect();
        assert_eq!(here.len(), *known, "below {folder}: split what came, or lower the number: {here:#?}");
    }
    assert_eq!(long, []);
}

#[test]
fn every_proto_file_says_in_its_header_how_to_try_it() {
    let all = files("proto", "proto");
    assert!(all.len() >= 9, "{all:?}");
    for path in all {
        let text = read(&path);
        let header: Vec<&str> = text.lines().take_while(|l| l.starts_with("//")).collect();
        assert!(header.iter().any(|l| l.contains("grpcurl ")), "{path}: no grpcurl line in its header");
    }
}

// --- tasks and queues

/// Code without its comments and without its own tests.
fn code(text: &str) -> String {
    let body = text.split("\n#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    let kept = body.lines().filter(|l| !l.trim_start().starts_with("//"));
    kept.collect::<Vec<_>>().join("\n")
}

#[test]
fn tasks_are_spawned_where_a_service_runs_and_nowhere_else() {
    let spawns = ["tokio::spawn(", "task::spawn(", "spawn_blocking(", "spawn_local(", "thread::spawn(", "JoinSet"];
    let is_test = |path: &String| path.ends_with("/tests.rs") || path.contains("/tests/");
    for path in of_rooms(&["cli", "services"]).filter(|path| !is_test(path)) {
        let text = code(&read(&path));
        let found = spawns.iter().find(|s| text.contains(*s));
        let may = path.ends_with("/src/lib.rs") || SPAWNS.iter().any(|(known, _)| *known == path);
        assert!(found.is_none() || may, "{path} has {found:?}; spawn in lib.rs, or say in this test why here");
    }
    for (known, _) in SPAWNS {
        assert!(
            spawns.iter().any(|s| code(&read(known)).contains(s)),
            "{known} spawns nothing any more: strike it here"
        );
    }
    for path in files("core/src", "rs") {
        let text = code(&read(&path));
        for word in [
            "async fn",
            ".await;",
            ".await?",
            "tokio::",
            "std::fs",
            "std::net",
            "std::thread",
            "SystemTime::now",
            "Instant::now",
        ] {
            assert!(!text.contains(word), "{path} has {word}: core decides, it does not act");
        }
    }
}

#[test]
fn files_are_made_durable_by_one_crate() {
    let words = ["fs::rename(", ".sync_all()", ".sync_data()"];
    let by_hand = |path: &str| {
        let text = code(&read(path));
        words.iter().find(|word| text.contains(**word)).copied()
    };
    let rooms = ROOMS.into_iter().filter(|room| *room != "durable").collect::<Vec<_>>();
    for path in of_rooms(&rooms).filter(|path| !path.contains("/tests")) {
        let found = by_hand(&path);
        let may = SYNCED_BY_HAND.iter().any(|(known, _)| *known == path);
        assert!(found.is_none() || may, "{path} has {found:?}: use `durable`, or say in this test why not");
    }
    for (known, _) in SYNCED_BY_HAND {
        assert!(by_hand(known).is_some(), "{known} makes nothing durable any more: strike it here");
    }
}

#[test]
fn there_is_no_unbounded_queue() {
    let words =
        ["unbounded_channel", "UnboundedSender", "UnboundedReceiver", "mpsc::unbounded", "std::sync::mpsc::channel"];
    for path in of_rooms(&ROOMS) {
        let text = code(&read(&path));
        for word in words {
            assert!(!text.contains(word), "{path} has {word}");
        }
    }
}

#[test]
fn wall_and_monotonic_clocks_are_read_by_the_binaries_alone() {
    // The launcher is a program of its own, kept beside the switch record that it reads. Others have the clock of `os`.
    let binaries = ["robot_agent/src/bin/", "robot_agent/src/launcher/mod.rs"];
    let rooms = ROOMS.into_iter().filter(|room| *room != "os").collect::<Vec<_>>();
    for path in of_rooms(&rooms).filter(|path| !binaries.iter().any(|binary| path.starts_with(binary))) {
        assert!(!code(&read(&path)).contains("SystemTime::now"), "{path} reads the wall clock");
    }
}

// --- names

/// Names of types in a source text, Rust or proto.
fn type_names(text: &str) -> Vec<String> {
    let mut names = Vec::new();
    for line in code(text).lines() {
        let words: Vec<&str> =
            line.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|w| !w.is_empty()).collect();
        for pair in words.windows(2).take(4) {
            if ["struct", "enum", "trait", "type", "union", "message"].contains(&pair[0]) {
                names.push(pair[1].to_owned());
            }
        }
    }
    names
}

/// Words of a name in camel case.
fn words(name: &str) -> Vec<String> {
    let mut words: Vec<String> = Vec::new();
    for c in name.chars() {
        match words.last_mut() {
            Some(word) if !c.is_ascii_uppercase() => word.push(c),
            _ => words.push(c.to_string()),
        }
    }
    words
}

fn is_empty_name(name: &str) -> bool {
    let kept = NAMES_KEPT.iter().any(|(known, _)| *known == name);
    !kept && words(name).iter().any(|w| EMPTY_WORDS.iter().any(|e| w == e || *w == format!("{e}s")))
}

#[test]
fn no_type_is_named_after_nothing() {
    let mut seen = 0;
    for path in files(".", "rs").into_iter().chain(files("proto", "proto")) {
        for name in type_names(&read(&path)) {
            seen += 1;
            assert!(!is_empty_name(&name), "{path}: {name}");
        }
    }
    assert!(seen > 300, "only {seen} types found");
    for bad in ["TaskManager", "DataHelper", "RobotInfo", "Utils", "CommonThings"] {
        assert_eq!(type_names(&format!("pub struct {bad} {{")), [bad]);
        assert!(is_empty_name(bad), "{bad}");
    }
    assert!(!is_empty_name("Database") && !is_empty_name("Informed"));
}

#[test]
fn a_target_that_is_not_compiled_for_tests_has_none() {
    let manifests = files("", "toml").into_iter().filter(|path| path.ends_with("/Cargo.toml"));
    let mut targets = 0;
    for manifest in manifests {
        let room = manifest.trim_end_matches("/Cargo.toml");
        let described: toml::Table = read(&manifest).parse().expect("a manifest");
        let untested = |target: &toml::Value| target.get("test").and_then(toml::Value::as_bool) == Some(false);
        let lib = described.get("lib").filter(|target| untested(target)).map(|_| files(&format!("{room}/src"), "rs"));
        let bins = described.get("bin").and_then(toml::Value::as_array).into_iter().flatten();
        let bins = bins.filter(|target| untested(target)).filter_map(|target| target.get("path")?.as_str());
        for path in lib.into_iter().flatten().chain(bins.map(|path| format!("{room}/{path}"))) {
            targets += 1;
            assert!(!read(&path).contains("#[cfg(test)]") && !read(&path).contains("#[test]"), "{path}");
        }
    }
    assert!(targets > 0, "no manifest was read");
}
