//! Pages for people: how long they may be, where their links lead, and that what they show as printed is printed.

use crate::{files, read, root};
use std::path::Path;

/// Longest line, in characters.
const LINE_MAX: usize = 120;
/// Pages that programs write.
const GENERATED: [&str; 1] = ["docs/cli.md"];
/// Rows of tables and lines of code that are still longer, by page. It only shrinks.
const KNOWN_LONG: &[(&str, usize)] = &[
    ("SECURITY.md", 8),
    ("docs/audit.md", 5),
    ("docs/clients.md", 6),
    ("docs/glossary.md", 19),
    ("docs/numbers.md", 16),
    ("docs/privacy.md", 22),
    ("docs/robot-protocol.md", 8),
    ("docs/rows.md", 13),
    ("docs/runbooks/backup.md", 2),
    ("docs/runbooks/keys.md", 11),
    ("docs/runbooks/split.md", 8),
    ("docs/security.md", 3),
];
/// Most words of a page that everybody reads.
const WORDS: [(&str, usize); 2] = [("README.md", 1_500), ("ARCHITECTURE.md", 2_500)];
/// What entries of the changelog stand under, in this order.
const GROUPS: [&str; 4] = ["### Added", "### Changed", "### Fixed", "### Upgrading"];
const ENTRY_LINES_MAX: usize = 2;

/// Names of README's floor, which has more than two places, and what the transcript of the command line calls the same.
const NAMES: [(&str, &str); 4] = [("A01", "A"), ("B03", "B"), ("TASK-1", "TASK-5"), ("rbt-04", "rbt-01")];

/// Pages of ours, without those that tools bring.
fn all_pages() -> Vec<String> {
    files("", "md").into_iter().filter(|path| !path.contains("node_modules")).collect()
}

/// Pages that say how things are now: a decision record says how they were.
fn pages() -> Vec<String> {
    all_pages().into_iter().filter(|path| !path.starts_with("docs/decisions/0")).collect()
}

/// Lines that are longer than people read, by number.
fn long_lines(page: &str) -> Vec<usize> {
    let long = page.lines().enumerate().filter(|(_, line)| line.chars().count() > LINE_MAX);
    long.map(|(n, _)| n + 1).collect()
}

#[test]
fn pages_are_no_longer_than_people_read() {
    let all = all_pages();
    assert!(all.len() > 100, "{all:?}");
    let mut wrong = Vec::new();
    for path in all.into_iter().filter(|path| !GENERATED.contains(&path.as_str())) {
        let long = long_lines(&read(&path));
        let known = KNOWN_LONG.iter().find(|(known, _)| *known == path).map_or(0, |(_, count)| *count);
        if long.len() != known {
            wrong.push((path, known, long));
        }
    }
    assert!(wrong.is_empty(), "shorten what came, or lower the number: (page, known, lines) {wrong:?}");
    for (path, most) in WORDS {
        let words = read(path).split_whitespace().count();
        assert!(words <= most, "{path} has {words} words; {most} are read");
    }
    let long = "a".repeat(LINE_MAX + 1);
    assert_eq!(long_lines(&format!("# A\n{long}\n| {long} |\n```\n{long}\n```\nb\n")), [2, 3, 5]);
}

/// What is wrong with a changelog.
fn misplaced(page: &str) -> Vec<String> {
    let mut wrong = Vec::new();
    let (mut group, mut lines) = (None, 0);
    for line in page.lines() {
        if line.starts_with("## ") {
            (group, lines) = (None, 0);
        } else if line.starts_with("### ") {
            let at = GROUPS.iter().position(|known| *known == line);
            if at.is_none() || at <= group {
                wrong.push(line.to_owned());
            }
            group = at;
        } else if line.starts_with("- ") {
            lines = 1;
            if group.is_none() {
                wrong.push(line.to_owned());
            }
        } else if line.starts_with("  ") {
            lines += 1;
            if lines > ENTRY_LINES_MAX {
                wrong.push(line.to_owned());
            }
        }
    }
    wrong
}

#[test]
fn an_entry_of_the_changelog_is_short_and_stands_in_its_group() {
    assert_eq!(misplaced(&read("CHANGELOG.md")), Vec::<String>::new());
    let bad = "## 1\n- a\n### Fixed\n- b\n  b\n  b\n### Added\n- c\n### Gone\n";
    assert_eq!(misplaced(bad), ["- a", "  b", "### Added", "### Gone"]);
}

/// Where links of a page lead, files only.
fn links(page: &str) -> Vec<&str> {
    let targets = page.split("](").skip(1).filter_map(|rest| rest.split_once(')').map(|(target, _)| target));
    let files = targets.map(|target| target.split('#').next().unwrap_or_default());
    files.filter(|target| !target.is_empty() && !target.contains("://") && !target.contains(' ')).collect()
}

#[test]
fn every_link_of_a_page_leads_to_a_file_or_folder() {
    let mut seen = 0;
    for path in all_pages() {
        let folder = root().join(&path).parent().map(Path::to_owned).unwrap_or_default();
        let page = read(&path);
        for target in links(&page) {
            seen += 1;
            assert!(folder.join(target).exists(), "{path} leads to {target}");
        }
    }
    assert!(seen > 100, "only {seen} links found");
    assert_eq!(links("[a](docs/a.md#b) [b](#c) [c](https://x.y) `f[0](1 2)`"), ["docs/a.md"]);
}

/// Methods that a page names as grpcurl takes them: package, service, method.
fn methods(page: &str) -> Vec<[&str; 3]> {
    let words = page.split(|c: char| c.is_whitespace() || "`()[],;'\"".contains(c));
    let named = words.filter_map(|word| word.strip_prefix("midshift.")?.split_once('/'));
    named
        .filter_map(|(service, method)| service.rsplit_once('.').map(|(package, name)| [package, name, method]))
        .collect()
}

#[test]
fn every_method_that_a_page_calls_is_one_of_the_proto_files() {
    let protos: Vec<String> = files("proto", "proto").iter().map(read).collect();
    let mut seen = 0;
    for path in pages() {
        for [package, service, method] in methods(&read(&path)) {
            seen += 1;
            let parts =
                [format!("package midshift.{package};"), format!("service {service} {{"), format!("rpc {method}(")];
            let is_there = protos.iter().any(|proto| parts.iter().all(|part| proto.contains(part)));
            assert!(is_there, "{path}: {package}.{service}/{method}");
        }
    }
    assert!(seen >= 5, "only {seen} methods found");
    assert_eq!(
        methods("`midshift.task.v1.TaskService/SubmitTask` /midshift.a/b"),
        [["task.v1", "TaskService", "SubmitTask"]]
    );
}

/// Words of a line with one space between them.
fn spaced(line: &str) -> String {
    line.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Parts of the lines that a page shows as printed: what stands in a block of a console, not behind `$`, between the signs that something is left out.
fn printed(page: &str) -> Vec<String> {
    let mut is_console = false;
    let mut found = Vec::new();
    for line in page.lines() {
        if line.starts_with("```") {
            is_console = line == "```console";
        } else if is_console && !line.starts_with("$ ") {
            let line = line.trim_start_matches("next: ").trim_start_matches("error: ");
            found.extend(line.split('…').map(spaced).filter(|part| !part.is_empty()));
        }
    }
    found
}

#[test]
fn what_the_readme_shows_as_printed_stands_in_the_transcript_or_in_a_test() {
    let mut known = read("tests/golden/cli.txt");
    let sources = files("", "rs").into_iter().filter(|path| !path.ends_with("architecture/pages.rs"));
    sources.for_each(|path| known += &read(path).replace("\\\"", "\""));
    let known = spaced(&known);
    let parts = printed(&read("README.md"));
    assert!(parts.len() > 15, "{parts:?}");
    for part in parts {
        let alike = NAMES.iter().fold(part.clone(), |text, (here, there)| text.replace(here, there));
        assert!(known.contains(&part) || known.contains(&alike), "no test prints: {part}");
    }
    assert_eq!(printed("a\n```console\n$ b\nnext: c  d … e\n```\nf"), ["c d", "e"]);
}
