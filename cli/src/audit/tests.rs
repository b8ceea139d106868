use super::*;
use clap::Parser;
use midshift_core::audit::{Attribution, Note, append};
use midshift_core::rows::Writer;
use std::collections::BTreeMap;

#[derive(Parser)]
struct Line {
    #[command(subcommand)]
    verb: Verb,
}

fn parse(words: &str) -> Result<Verb, clap::Error> {
    Line::try_parse_from(["audit"].into_iter().chain(words.split_whitespace())).map(|line| line.verb)
}

#[test]
fn a_moment_is_a_time_or_how_long_ago() {
    assert_eq!(moment("2026-11-22T06:00:00Z"), Ok(Utc(1_795_327_200_000)));
    assert_eq!(moment("2026-11-22T08:00:00+02:00"), Ok(Utc(1_795_327_200_000)));
    let ago = moment("8h").unwrap_or_default();
    assert!(ago.0 > 0 && ago < midshift_agent::clock::wall());
    for wrong in ["", "yesterday", "2026-11-22", "12"] {
        assert!(moment(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn heads_are_given_as_they_were_printed_and_as_often_as_they_were() {
    let head = format!("fleet:17:{}", "ab".repeat(32));
    let verb = parse(&format!("verify --head {head} --head {head}"));
    assert!(matches!(verb, Ok(Verb::Verify { head, file: None, .. }) if head.len() == 2));
    assert!(parse("verify --head fleet:17").is_err());
    assert!(parse("ls --robot r1 --since 8h --actor anna --service fleet --subject task:T-1").is_ok());
}

/// An export of one chain of three rows.
fn lines() -> Vec<String> {
    let mut heads = BTreeMap::new();
    let by = Attribution { actor: "anna".into(), token: None, request_id: None, at_unix_ms: 1 };
    let rows = ["r1", "r2", "r3"]
        .map(|robot| append(&mut heads, Writer::Fleet, &Note::new("robot.cordon").about("robot", robot), &by));
    let heads = heads.into_iter().map(|(writer, head)| (writer.as_str().to_owned(), head)).collect();
    let (format, site, store) = (Export::FORMAT.to_owned(), "north".to_owned(), "s".to_owned());
    let export = Export { format, site, store, at_unix_ms: 0, heads };
    let first = serde_json::to_string(&export).unwrap_or_else(|e| panic!("{e}"));
    std::iter::once(first).chain(rows.into_iter().flatten().map(|row| row.body.to_string())).collect()
}

/// What `audit verify --file` ends with for these lines.
fn verified(lines: &[String], noted: &[Mark]) -> Result<(), Exit> {
    let dir = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
    let path = dir.path().join("audit.jsonl");
    std::fs::write(&path, lines.iter().map(|line| format!("{line}\n")).collect::<String>())
        .unwrap_or_else(|e| panic!("{e}"));
    print_verification(&read(&path, noted)?, &Out::new(Format::Name))
}

fn broken(lines: &[String], noted: &[Mark]) -> String {
    let exit = verified(lines, noted).map_or_else(|exit| exit, |()| panic!("it holds"));
    assert_eq!(exit.code(), 1);
    exit.to_string()
}

#[test]
fn an_export_that_was_changed_is_told_with_the_row_that_shows_it() {
    let good = lines();
    assert!(verified(&good, &[]).is_ok());
    let changed = |change: &dyn Fn(&mut Vec<String>)| {
        let mut lines = good.clone();
        change(&mut lines);
        broken(&lines, &[])
    };
    assert!(changed(&|l| l[2] = l[2].replace("r2", "r9")).contains("fleet: row 2 was altered"));
    assert!(changed(&|l| drop(l.remove(2))).contains("fleet: row 2 is not there, row 3 is in its place"));
    assert!(changed(&|l| l.swap(2, 3)).contains("fleet: row 2 is not there, row 3 is in its place"));
    assert!(changed(&|l| drop(l.pop())).contains("it ends with row 2, and the first line of the export has row 3"));
    assert!(changed(&|l| drop(l.remove(0))).contains("does not begin like an export"));
}

#[test]
fn a_head_that_somebody_noted_down_is_held_against_an_export() {
    let good = lines();
    let head = |n: u64, hash: &str| Mark::parse(&format!("fleet:{n}:{hash}")).unwrap_or_else(|| panic!("a head"));
    let second = midshift_core::audit::open(&good[2]).unwrap_or_else(|| panic!("a row")).hash;
    assert!(verified(&good, &[head(2, second)]).is_ok());
    assert!(broken(&good, &[head(2, &"0".repeat(64))]).contains("row 2 is not the one that your note has"));
    assert!(broken(&good, &[head(9, second)]).contains("it ends with row 3, and your note has row 9"));
}
