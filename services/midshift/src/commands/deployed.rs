//! What operators type by deploy/ and the runbooks, and what one program of ours types for another, our programs read.

use super::{AgentVerb, Args, Command, logs};
use clap::{Args as _, FromArgMatches, Parser};
use midshift_agent::program::ENROLL;
use midshift_cli::enrol::Machine;

const UNITS: [(&str, &str); 3] = [
    ("midshift.service", include_str!("../../../../deploy/midshift.service")),
    ("midshift-stop.service", include_str!("../../../../deploy/midshift-stop.service")),
    ("midshift-robot.service", include_str!("../../../../deploy/midshift-robot.service")),
];

const PAGES: [(&str, &str); 11] = [
    ("README.md", include_str!("../../../../README.md")),
    ("docs/audit.md", include_str!("../../../../docs/audit.md")),
    ("docs/numbers.md", include_str!("../../../../docs/numbers.md")),
    ("docs/run-a-floor.md", include_str!("../../../../docs/run-a-floor.md")),
    ("docs/send-orders.md", include_str!("../../../../docs/send-orders.md")),
    ("docs/sites.md", include_str!("../../../../docs/sites.md")),
    ("docs/runbooks/backup.md", include_str!("../../../../docs/runbooks/backup.md")),
    ("docs/runbooks/keys.md", include_str!("../../../../docs/runbooks/keys.md")),
    ("docs/runbooks/split.md", include_str!("../../../../docs/runbooks/split.md")),
    ("deploy/README.md", include_str!("../../../../deploy/README.md")),
    ("ota_bundles/README.md", include_str!("../../../../ota_bundles/README.md")),
];

/// Words of a line as a shell reads them, up to a comment or to what the shell does with what was printed.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut quote) = (Vec::new(), None);
    let mut word: Option<String> = None;
    for c in line.chars().chain([' ']) {
        match quote {
            Some(q) if q == c => quote = None,
            Some(_) => word.get_or_insert_default().push(c),
            None if c == '\'' || c == '"' => {
                quote = Some(c);
                word.get_or_insert_default();
            }
            None if c == '#' && word.is_none() => break,
            None if c.is_whitespace() => match word.take() {
                Some(end) if ["|", "&&", ">", "2>"].contains(&end.as_str()) => break,
                Some(end) => words.push(end),
                None => {}
            },
            None => word.get_or_insert_default().push(c),
        }
    }
    words
}

/// Words of each line in a block of code that starts this program. In a block of what a console shows these are the lines behind `$`.
fn typed(page: &str) -> Vec<Vec<String>> {
    let mut block: Option<&str> = None;
    let mut typed = Vec::new();
    for line in page.lines() {
        if let Some(kind) = line.strip_prefix("```") {
            block = if block.is_some() { None } else { Some(kind) };
            continue;
        }
        if block.is_none() && !line.starts_with("    ") {
            continue;
        }
        let line = line.trim_start();
        let line = match block {
            Some("console") => line.strip_prefix("$ ").unwrap_or_default(),
            _ => line.strip_prefix("sudo ").unwrap_or(line),
        };
        // A digest that a page cuts short, and a program that is built first.
        let line = line.replace("9f3c…", &"9f3c".repeat(16)).replace("cargo run --release -- ", "midshift ");
        if line.starts_with("midshift ") || line.starts_with("midshift-stop ") {
            typed.push(words(&line));
        }
    }
    typed
}

/// Words of each ExecStart= of a unit, with what stands in the file that the unit reads.
fn started(unit: &str) -> Vec<Vec<String>> {
    let whole = unit.replace("\\\n", " ").replace("${ROBOT_ID}", "rbt-01").replace("${SERVER}", "fleet.local");
    let lines = whole.lines().filter_map(|line| line.strip_prefix("ExecStart="));
    lines.map(|line| line.split_whitespace().map(str::to_owned).collect()).collect()
}

fn read(words: &[String]) -> Args {
    Args::try_parse_from(words).unwrap_or_else(|error| panic!("{words:?}: {error}")).spread()
}

fn read_stop(words: &[String]) -> midshift_stop::program::Args {
    midshift_stop::program::Args::try_parse_from(words).unwrap_or_else(|error| panic!("{words:?}: {error}"))
}

#[test]
fn every_unit_starts_a_command_that_there_is_with_arguments_that_it_takes() {
    for (name, unit) in UNITS {
        let started = started(unit);
        assert_eq!(started.len(), 1, "{name}");
        for words in started {
            assert!(!words.iter().any(|word| word.contains('$')), "{name}: {words:?}");
            if words[0].ends_with("/midshift-stop") {
                read_stop(&words);
                continue;
            }
            if words[0].ends_with("/midshift") {
                read(&words);
                continue;
            }
            // The launcher, which gives what stands behind -- to the program there.
            assert_eq!(words[0], "/usr/local/bin/midshift-launcher", "{name}");
            let theirs = words.iter().position(|word| word == "--").expect("a program to start");
            assert!(matches!(read(&words[theirs + 1..]).command, Command::Agent(_)), "{name}");
            let own: Vec<String> =
                ["midshift", "launcher"].map(str::to_owned).into_iter().chain(words[1..].to_vec()).collect();
            read(&own);
        }
    }
}

#[test]
fn every_command_on_a_page_for_operators_is_one_that_there_is_with_arguments_that_it_takes() {
    for (name, page) in PAGES {
        let typed = typed(page);
        assert!(!typed.is_empty(), "{name}");
        for words in typed {
            if words[0] == "midshift-stop" {
                read_stop(&words);
            } else {
                read(&words);
            }
        }
    }
}

#[test]
fn a_command_is_read_as_a_shell_reads_it() {
    assert_eq!(
        words("midshift stop --all --reason 'it\"s down' && rm x"),
        ["midshift", "stop", "--all", "--reason", "it\"s down"]
    );
    assert_eq!(words("midshift task ls   # nobody's"), ["midshift", "task", "ls"]);
    assert_eq!(words("midshift task ls --cursor \"\" > file"), ["midshift", "task", "ls", "--cursor", ""]);
    let page =
        "```console\n$ cargo run --release -- dev\nmidshift dev  12\n```\nmidshift not\n```\nsudo midshift health\n```";
    assert_eq!(typed(page), [vec!["midshift", "dev"], vec!["midshift", "health"]]);
}

#[test]
fn the_stop_service_beside_a_server_takes_the_same_peers_and_logs_in_the_same_form() {
    let told = |arguments: &[&str]| {
        let words: Vec<String> = ["midshift"].iter().chain(arguments).map(|word| (*word).to_owned()).collect();
        let Command::Serve(serve) = read(&words).command else { panic!("{arguments:?}") };
        let own = [&["midshift-stop".to_owned()][..], &serve.for_stop()].concat();
        let args = read_stop(&own);
        (args.log, args.share)
    };
    let asked = ["--connections-per-address", "8000", "--requests-per-second", "77", "--watches-per-caller", "9"];
    let (log, share) = told(&[&["--log", "json", "serve"][..], &asked].concat());
    assert_eq!(log, logs::Format::Json);
    let requests = share.requests_per_second.map(std::num::NonZero::get);
    assert_eq!((share.connections_per_address, requests, share.watches_per_caller), (Some(8_000), Some(77), Some(9)));
    let (log, share) = told(&["serve"]);
    assert_eq!((log, share.connections_per_address), (logs::Format::Text, None));
}

#[test]
fn the_line_of_a_robot_is_taken_as_it_is_printed() {
    let typed = ["enroll", "r7", "--server", "hub:7420", "--link-server", "hub:7401", "--site", "/etc/hall.toml"];
    let machine = Machine::augment_args(clap::Command::new("enroll")).get_matches_from(typed);
    let machine = Machine::from_arg_matches(&machine).expect("its arguments");
    let printed = machine.line("hub:7402", Some("hub:18421"), "mse.ID.SECRET.DIGEST");
    let (secret, words) = printed.split_once(" midshift ").expect("an assignment and a command");
    assert_eq!(secret, format!("{ENROLL}=mse.ID.SECRET.DIGEST"));
    let words: Vec<String> = ["midshift"].into_iter().chain(words.split(' ')).map(str::to_owned).collect();
    let shown = Args::try_parse_from(words.iter().map(String::as_str).chain(["--enroll", "mse.ID.SECRET.DIGEST"]));
    assert!(shown.is_err(), "other users of a machine see what stands on a command line");
    let Command::Agent(AgentVerb::Run(taken)) = read(&words).command else { panic!("{words:?}") };
    assert_eq!((taken.config.robot_id.as_str(), taken.config.server.as_str()), ("r7", "hub:7401"));
    assert_eq!(taken.config.identity.identity_server.as_deref(), Some("hub:7402"));
    assert_eq!(taken.site, Some("/etc/hall.toml".into()));
    assert_eq!(taken.config.stop.stop_server.as_deref(), Some("hub:18421"));
}
