//! docs/cli.md is written from the command line itself: each command with its purpose, its arguments and its exit codes.
//!
//! Invariant: nothing on the page is typed by hand but the meaning of exit codes, which stands in [`EXIT_CODES`].

use super::Args;
use clap::{Arg, ArgGroup, Command, CommandFactory};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

const LINE_MAX: usize = 120;
/// An option of so many commands is described once, at the head of the page.
const SHARED_FROM: usize = 10;

const HEAD: &str = "\
# The command line

Every command of `midshift`, and `midshift-stop`, with arguments and exit codes. This page is written from the programs
themselves by `cargo xtask golden`; do not edit it.

Results go to stdout and everything else to stderr. `-o json` is the stable contract.
";

/// An exit code, its meaning, and the commands that end with it; none: any command may.
const EXIT_CODES: [(u8, &str, &[&str]); 15] = [
    (0, "done", &[]),
    (1, "failed: a fault, or a run whose checks did not hold", &[]),
    (2, "the command line is wrong, or the request breaks a rule", &[]),
    (4, "no such task, robot, place, roll-out, bundle", &[]),
    (5, "no server there, or one that does not know the call; start `midshift dev`, or look at the port", &[]),
    (6, "not signed in, or not permitted", &[]),
    (9, "conflict: it changed since you looked, or its state does not allow this now", &[]),
    (10, "too late: a wait or a deadline ran out", &[]),
    (11, "a person must judge the roll-out", &["rollout wait"]),
    (12, "the roll-out was aborted, went back or was superseded", &["rollout wait", "rollout watch"]),
    (13, "not every robot has confirmed the stop", &["stop"]),
    (14, "the roll-out completed, and too few robots have the bundle", &["rollout wait", "rollout watch"]),
    (74, "its environment failed it (lock, disk, device); no try of its software is counted", &["agent run"]),
    (75, "another set of software is to be started, which the launcher does", &["agent run"]),
    (141, "nobody reads the output of a watch any more", &[]),
];

/// An option as people type it: the short form, the long form, its value.
fn typed(arg: &Arg) -> String {
    let value = || {
        let names = arg.get_value_names().map(|names| names.iter().map(|name| name.to_string()).collect::<Vec<_>>());
        let names = names.unwrap_or_else(|| vec![arg.get_id().to_string()]);
        let more = if arg.get_num_args().is_some_and(|n| n.max_values() > names.len()) { "..." } else { "" };
        names.iter().map(|name| format!("<{name}>")).collect::<Vec<_>>().join(" ") + more
    };
    let takes = arg.get_num_args().is_some_and(|n| n.takes_values());
    let is_optional = arg.get_num_args().is_some_and(|n| n.min_values() == 0);
    let mut words = Vec::new();
    words.extend(arg.get_short().map(|short| format!("-{short}")));
    words.extend(arg.get_long().map(|long| format!("--{long}")));
    let flag = words.join(", ");
    match (flag.is_empty(), takes) {
        (true, _) => value(),
        (false, true) if is_optional => format!("{flag}[={}]", value()),
        (false, true) => format!("{flag} {}", value()),
        (false, false) => flag,
    }
}

/// Text of a doc comment in Markdown: what would be markup outside of code is not, and the full stop that clap takes away is there again.
fn plain(text: &str) -> String {
    let mut is_code = false;
    let mut plain = String::new();
    for c in text.split_whitespace().collect::<Vec<_>>().join(" ").chars() {
        is_code ^= c == '`';
        if !is_code && "<*_".contains(c) {
            plain.push('\\');
        }
        plain.push(c);
    }
    if plain.ends_with(|c: char| c.is_alphanumeric() || ")`\"".contains(c)) {
        plain.push('.');
    }
    plain
}

/// An argument by its name in a sentence.
fn named(arg: &Arg) -> String {
    arg.get_long().map_or_else(|| format!("`{}`", typed(arg)), |long| format!("`--{long}`"))
}

/// Arguments of a command that `arg` does not go with, by a word of either.
fn conflicts(command: &Command, arg: &Arg) -> Vec<String> {
    let excludes = |one: &Arg, other: &Arg| command.get_arg_conflicts_with(one).contains(&other);
    let others = arguments(command).into_iter().filter(|other| other.get_id() != arg.get_id());
    others.filter(|other| excludes(arg, other) || excludes(other, arg)).map(named).collect()
}

/// Groups of arguments of which only one may be there.
fn choices(command: &Command) -> Vec<String> {
    let choice = |group: &ArgGroup| {
        let of_group = arguments(command).into_iter().filter(|arg| group.get_args().any(|id| id == arg.get_id()));
        let names: Vec<String> = of_group.map(named).collect();
        let how = if group.is_required_set() { "Exactly one" } else { "At most one" };
        (names.len() > 1).then(|| format!("{how} of {}.", names.join(", ")))
    };
    command.get_groups().filter(|group| !(*group).clone().is_multiple()).filter_map(choice).collect()
}

/// What an option is for, what it may be, what it is when nobody says it, and what it does not go with.
fn described(command: &Command, arg: &Arg) -> String {
    let help = arg.get_long_help().or_else(|| arg.get_help()).map(|help| plain(&help.to_string()));
    let mut text = help.unwrap_or_default();
    let takes = arg.get_num_args().is_some_and(|n| n.takes_values());
    let values: Vec<String> = arg.get_possible_values().iter().map(|v| format!("`{}`", v.get_name())).collect();
    if takes && !values.is_empty() {
        let _infallible = write!(text, " One of {}.", values.join(", "));
    }
    let defaults: Vec<String> = arg.get_default_values().iter().map(|v| v.to_string_lossy().into_owned()).collect();
    if takes && defaults.iter().any(|value| !value.is_empty()) {
        let _infallible = write!(text, " Default: `{}`.", defaults.join(","));
    }
    if let Some(variable) = arg.get_env() {
        let _infallible = write!(text, " Environment: `{}`.", variable.to_string_lossy());
    }
    if arg.is_required_set() {
        text += " Required.";
    }
    let conflicts = conflicts(command, arg);
    if !conflicts.is_empty() {
        let _infallible = write!(text, " Not with {}.", conflicts.join(", "));
    }
    text.trim_start().to_owned()
}

fn item(command: &Command, arg: &Arg) -> String {
    wrapped(format!("- `{}`: {}", typed(arg), described(command, arg)).trim_end_matches([':', ' ']), "  ")
}

/// Lines of at most [`LINE_MAX`] characters, all but the first behind `indent`; a word that is longer stands alone.
pub(super) fn wrapped(text: &str, indent: &str) -> String {
    let (mut lines, mut line) = (String::new(), String::new());
    for word in text.split(' ') {
        if !line.trim().is_empty() && line.chars().count() + 1 + word.chars().count() > LINE_MAX {
            lines += &line;
            lines.push('\n');
            line = format!("{indent}{word}");
        } else {
            if !line.is_empty() {
                line.push(' ');
            }
            line += word;
        }
    }
    lines + &line + "\n"
}

/// Arguments that people see, without the help that every command has.
fn arguments(command: &Command) -> Vec<&Arg> {
    command
        .get_arguments()
        .filter(|arg| !arg.is_hide_set() && !["help", "version"].contains(&arg.get_id().as_str()))
        .collect()
}

fn verbs(command: &Command) -> Vec<&Command> {
    command.get_subcommands().filter(|verb| !verb.is_hide_set() && verb.get_name() != "help").collect()
}

/// Counts, over all commands below, the options that are typed and described alike.
fn count(command: &Command, counted: &mut BTreeMap<String, usize>) {
    for arg in arguments(command).into_iter().filter(|arg| !arg.is_positional()) {
        *counted.entry(item(command, arg)).or_default() += 1;
    }
    verbs(command).into_iter().for_each(|verb| count(verb, counted));
}

/// Writes one command and those below it; `line` is what people type, from the name of the program on.
fn write_command(command: &Command, line: &str, depth: usize, shared: &BTreeMap<String, usize>, page: &mut String) {
    let _infallible = write!(page, "\n{} {line}\n", "#".repeat(depth));
    let about = command.get_long_about().or_else(|| command.get_about()).map(ToString::to_string).unwrap_or_default();
    for paragraph in about.split("\n\n") {
        *page += "\n";
        *page += &wrapped(&plain(paragraph), "");
    }
    let all = arguments(command);
    let (alike, own): (Vec<&Arg>, Vec<&Arg>) =
        all.into_iter().partition(|arg| shared.contains_key(&item(command, arg)));
    if !own.is_empty() {
        *page += "\n";
    }
    own.iter().for_each(|arg| *page += &item(command, arg));
    for choice in choices(command) {
        *page += "\n";
        *page += &wrapped(&choice, "");
    }
    if command.is_args_conflicts_with_subcommands_set() {
        *page += "\nIts own options do not go with the commands below it.\n";
    }
    let alike: Vec<String> = alike
        .into_iter()
        .filter(|arg| !arg.is_global_set())
        .filter_map(|arg| arg.get_long())
        .map(|long| format!("`--{long}`"))
        .collect();
    if !alike.is_empty() {
        *page += "\n";
        *page += &wrapped(
            &format!("Also {}: see [options of many commands](#options-of-many-commands).", alike.join(", ")),
            "",
        );
    }
    let ends: Vec<String> = EXIT_CODES
        .iter()
        .filter(|(.., commands)| line.strip_prefix("midshift ").is_some_and(|path| commands.contains(&path)))
        .map(|(code, meaning, _)| format!("{code} ({meaning})"))
        .collect();
    if !ends.is_empty() {
        *page += "\n";
        *page += &wrapped(&format!("Its own exit codes: {}.", ends.join("; ")), "");
    }
    for verb in verbs(command) {
        write_command(verb, &format!("{line} {}", verb.get_name()), depth + 1, shared, page);
    }
}

fn page() -> String {
    let mut whole = Args::command();
    whole.build();
    let mut shared = BTreeMap::new();
    verbs(&whole).into_iter().for_each(|command| count(command, &mut shared));
    shared.retain(|_, commands| *commands >= SHARED_FROM);
    let mut page = HEAD.to_owned();
    page += "\n## Exit codes\n\n| code | means | of |\n|---|---|---|\n";
    for (code, meaning, commands) in EXIT_CODES {
        let of: Vec<String> = commands.iter().map(|command| format!("`{command}`")).collect();
        let of = if of.is_empty() { "any command".to_owned() } else { of.join(", ") };
        let _infallible = writeln!(page, "| {code} | {meaning} | {of} |");
    }
    page += "\n## Options of many commands\n\n";
    shared.keys().for_each(|item| page += item);
    for command in verbs(&whole) {
        write_command(command, &format!("midshift {}", command.get_name()), 2, &shared, &mut page);
    }
    let mut stop = midshift_stop::program::Args::command();
    stop.build();
    write_command(&stop, "midshift-stop", 2, &shared, &mut page);
    page
}

/// The folder of the workspace, wherever this crate stands in it.
pub(super) fn root() -> PathBuf {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    here.ancestors().find(|folder| folder.join("Cargo.lock").is_file()).expect("a workspace").to_owned()
}

#[test]
fn golden_page_of_the_command_line() {
    let path = root().join("docs/cli.md");
    let page = page();
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, &page).expect("docs/cli.md");
    }
    let expected = std::fs::read_to_string(&path).unwrap_or_default();
    for (n, (was, is)) in expected.lines().zip(page.lines()).enumerate() {
        assert_eq!(is, was, "line {} of docs/cli.md; `cargo xtask golden` if the change is meant", n + 1);
    }
    assert_eq!(page.lines().count(), expected.lines().count(), "`cargo xtask golden` if the change is meant");
}

#[test]
fn each_exit_code_stands_once_and_belongs_to_commands_that_there_are() {
    let mut whole = Args::command();
    whole.build();
    for pair in EXIT_CODES.windows(2) {
        assert!(pair[0].0 < pair[1].0, "{}", pair[1].0);
    }
    for name in EXIT_CODES.iter().flat_map(|(.., commands)| *commands) {
        let found = name.split(' ').try_fold(&whole, |command, word| command.find_subcommand(word));
        assert!(found.is_some(), "{name}");
    }
}

#[test]
fn every_line_of_the_page_is_one_that_people_can_read() {
    let page = page();
    let long: Vec<&str> =
        page.lines().filter(|line| !line.starts_with('|') && line.chars().count() > LINE_MAX).collect();
    assert_eq!(long, Vec::<&str>::new());
    for choice in ["Exactly one of `--all`, `--robot`, `--zone`, `--area`.", "Not with `--pin`."] {
        assert!(page.contains(choice), "{choice}");
    }
    for command in
        ["## midshift dev", "### midshift task submit", "#### midshift bundle root rotate", "## midshift-stop"]
    {
        assert!(page.lines().any(|line| line == command), "{command}");
    }
}
