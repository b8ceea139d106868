use super::*;
use crate::audit::note::NOTHING;
use crate::audit::verify::{Broken, Chain, Ends, Export, Held, Mark, Verified};
use crate::item::Item;
use crate::reason::{Kind as RefusalKind, Reason, Refusal};
use crate::time::Utc;
use proptest::prelude::*;

fn by(actor: &str, at_unix_ms: i64) -> Attribution {
    Attribution { actor: actor.into(), token: None, request_id: Some("req-1".into()), at_unix_ms }
}

/// Rows of a chain of fleet, behind whatever is in `heads`.
fn grow(heads: &mut BTreeMap<Writer, Head>, notes: &[Note]) -> Vec<Row> {
    let rows = notes.iter().enumerate().map(|(i, note)| append(heads, Writer::Fleet, note, &by("anna", i as i64)));
    rows.map(|row| row.expect("fleet has a chain")).collect()
}

fn decisions(n: usize) -> Vec<Note> {
    let decision = |i| Note::new("robot.cordon").about("robot", format!("r{i}")).because(format!("because \"{i}\""));
    (0..n).map(decision).collect()
}

fn noted(head: &Head) -> Mark {
    Mark { service: "fleet".to_owned(), head: head.clone(), by: "your note".to_owned(), at_unix_ms: None }
}

/// When everything here is verified.
const NOW: Utc = Utc(1_000 * DAY_MS);
const DAY_MS: i64 = 24 * 3_600_000;

fn verify(rows: &[Row], known: &[Mark]) -> Result<Verified, Broken> {
    let mut chain = Chain::new("fleet", known.iter().cloned(), NOW);
    for row in rows {
        chain.take_row(row)?;
    }
    chain.finish()
}

#[test]
fn a_chain_that_nobody_touched_holds_and_says_where_it_ends() {
    let mut heads = BTreeMap::new();
    let rows = grow(&mut heads, &decisions(5));
    let held = verify(&rows, &[noted(&heads[&Writer::Fleet])]).expect("it holds");
    assert_eq!((held.first, held.rows, &held.head), (1, 5, &heads[&Writer::Fleet]));
    assert_eq!(verify(&[], &[]).expect("an empty chain holds"), Verified::default());
}

#[test]
fn a_row_says_who_did_what_and_its_hash_is_that_of_its_own_text_behind_the_hash_before() {
    let mut heads = BTreeMap::new();
    let note = Note::new("task.cancel")
        .about("task", "T-1")
        .about("robot", "r7")
        .with("force", true)
        .because("wrong \"bay\"\0");
    let row = append(&mut heads, Writer::Task, &note, &by("anna", 7)).expect("task has a chain");
    let read: AuditRow = serde_json::from_str(&row.body).expect("JSON");
    assert_eq!((read.service.as_str(), read.n, read.actor.as_str(), read.at_unix_ms), ("task", 1, "anna", 7));
    assert_eq!(
        (read.outcome.as_str(), read.request_id.as_str(), read.reason.as_str()),
        (DONE, "req-1", "wrong \"bay\"\0")
    );
    assert!(read.is_about("r7") && read.is_about("robot:r7") && !read.is_about("r") && !read.is_about("task:r7"));
    assert_eq!(serde_json::to_string(&read).expect("JSON"), *row.body, "nothing is lost in reading");
    // As somebody does who has only this page and sha256sum.
    let (said, ends) = row.body.split_once(",\"prev\"").expect("its hashes are last");
    assert_eq!(ends, format!(":\"{NOTHING}\",\"hash\":\"{}\"}}", read.hash));
    assert_eq!(link(NOTHING, &format!("{said}}}")), read.hash);
    assert!(!row.body.contains('\0'), "an engine could not hold it");
}

#[test]
fn a_service_that_decides_nothing_for_anybody_has_no_chain() {
    assert_eq!(append(&mut BTreeMap::new(), Writer::Telemetry, &Note::new("x"), &by("anna", 0)), None);
}

#[test]
fn each_way_to_tamper_is_told_from_the_others() {
    let mut heads = BTreeMap::new();
    let rows = grow(&mut heads, &decisions(6));
    let known = [noted(&heads[&Writer::Fleet])];
    let broken = |change: &dyn Fn(&mut Vec<Row>)| {
        let mut rows = rows.clone();
        change(&mut rows);
        verify(&rows, &known).expect_err("it was tampered with")
    };
    let body = |row: &Row, from: &str, to: &str| row.body.replace(from, to).into();
    assert_eq!(broken(&|r| r[2].body = body(&r[2], "anna", "bert")), Broken::Altered { n: 3 });
    assert_eq!(broken(&|r| r[2].body = body(&r[2], "\"n\":3,", "\"n\":3, ")), Broken::Altered { n: 3 });
    assert_eq!(broken(&|r| r[2].body = "{}".into()), Broken::Altered { n: 3 });
    assert_eq!(broken(&|r| r[2].revision = Revision(2)), Broken::Altered { n: 3 });
    assert_eq!(broken(&|r| r[2].index.state = Some(1)), Broken::Altered { n: 3 });
    assert_eq!(broken(&|r| r[2].key.id = id_of(9).into()), Broken::Altered { n: 3 });
    assert_eq!(broken(&|r| r[2].key.table = Table::TaskAudit), Broken::Altered { n: 3 });
    assert_eq!(broken(&|r| drop(r.remove(2))), Broken::Order { expected: 3, found: 4 });
    assert_eq!(broken(&|r| r.swap(2, 3)), Broken::Order { expected: 3, found: 4 });
    assert_eq!(broken(&|r| r.insert(2, r[1].clone())), Broken::Order { expected: 3, found: 2 });
    assert_eq!(broken(&|r| drop(r.remove(0))), Broken::Beheaded { first: 2 });
    assert!(matches!(broken(&|r| drop(r.pop())), Broken::Truncated { last: 5, known: 6, .. }));
    assert!(matches!(broken(&|r| r.clear()), Broken::Truncated { last: 0, known: 6, .. }));
    // Written anew from row 4 on, with hashes that hold: only who kept a head can tell.
    let anew = |heads: &mut BTreeMap<Writer, Head>| {
        let mut rows = rows[..3].to_vec();
        let third: AuditRow = serde_json::from_str(&rows[2].body).expect("JSON");
        heads.insert(Writer::Fleet, third.head());
        rows.extend(grow(heads, &decisions(3)));
        rows
    };
    let mut theirs = BTreeMap::new();
    let anew = anew(&mut theirs);
    assert!(verify(&anew, &[]).is_ok(), "what a chain cannot show by itself");
    assert!(matches!(verify(&anew, &known), Err(Broken::Rewritten { n: 6, .. })));
    // One row with a hash that fits it again.
    let mut one = rows.clone();
    let opened = open(&one[2].body).expect("a row");
    let (text, hash) = seal(opened.prev, &opened.said.replace("anna", "bert"));
    assert_ne!(hash, opened.hash);
    one[2].body = text.into();
    assert_eq!(verify(&one, &known), Err(Broken::Unlinked { n: 4 }));
}

#[test]
fn a_chain_begins_behind_old_rows_only_where_a_row_of_it_says_so() {
    let mut heads = BTreeMap::new();
    let mut rows = grow(&mut heads, &decisions(4));
    let third: AuditRow = serde_json::from_str(&rows[2].body).expect("JSON");
    rows.extend(grow(&mut heads, &[Note::cut(third.head()), Note::new("robot.uncordon")]));
    let known = [noted(&heads[&Writer::Fleet])];
    let held = verify(&rows[3..], &known).expect("it was cut there");
    assert_eq!((held.first, held.rows), (4, 3));
    assert_eq!(verify(&rows[2..], &known), Err(Broken::Beheaded { first: 3 }), "not there");
    assert_eq!(verify(&rows[4..], &known), Err(Broken::Beheaded { first: 5 }));
}

#[test]
fn a_cut_takes_no_row_that_a_person_noted_or_that_was_quoted_when_it_was_young() {
    const CUT: i64 = 500 * DAY_MS;
    const KEPT: i64 = 400 * DAY_MS;
    let mut heads = BTreeMap::new();
    grow(&mut heads, &decisions(6));
    let old = heads[&Writer::Fleet].clone();
    // All that is left says of itself that the rows before it were cut.
    let cut = |at: i64| {
        let row = append(&mut heads.clone(), Writer::Fleet, &Note::cut(old.clone()), &by("fleet", at));
        [row.expect("fleet has a chain")]
    };
    let quoted = |n: u64, at: i64| {
        let (hash, by) = (old.hash.clone(), "row 9 of task".to_owned());
        [Mark { service: "fleet".to_owned(), head: Head { n, hash }, by, at_unix_ms: Some(at) }]
    };
    let early = |n: u64, by: &str| Err(Broken::CutEarly { first: 7, known: n, by: by.to_owned() });
    assert_eq!(verify(&cut(CUT), &[noted(&old)]), early(6, "your note"));
    assert_eq!(verify(&cut(CUT), &[noted(&Head { n: 2, hash: NOTHING.to_owned() })]), early(2, "your note"));
    assert_eq!(verify(&cut(CUT), &quoted(6, CUT - 1)), early(6, "row 9 of task"));
    assert_eq!(verify(&cut(CUT), &quoted(3, CUT - KEPT + DAY_MS)), early(3, "row 9 of task"));
    assert!(verify(&cut(CUT), &quoted(6, CUT - KEPT - 1)).is_ok(), "old when it went");
    let late = cut(NOW.0 + 2 * KEPT);
    assert_eq!(verify(&late, &quoted(6, NOW.0 - DAY_MS)), early(6, "row 9 of task"), "nothing was cut in the future");
    // One row of the chain that is looked up where it should be.
    let ends = Ends { first: 7, last: 7, cut_unix_ms: Some(CUT), now_unix_ms: NOW.0 };
    let hold = |mark: &[Mark], ends| mark[0].hold(None, ends);
    assert_eq!(hold(&quoted(6, CUT - 1), ends), early(6, "row 9 of task").map(|_: Verified| ()));
    assert_eq!(hold(&quoted(6, CUT - KEPT - 1), ends), Ok(()));
    assert!(
        hold(&quoted(6, CUT - KEPT - 1), Ends { cut_unix_ms: None, ..ends }).is_err(),
        "nothing says that it was cut"
    );
}

#[test]
fn an_anchor_quotes_the_heads_of_the_others_and_a_row_that_is_not_the_quoted_one_shows() {
    let mut heads = BTreeMap::new();
    let rows = grow(&mut heads, &decisions(3));
    let anchor = append(&mut heads, Writer::Task, &Note::anchor(), &by("task", 9)).expect("a chain");
    let read: AuditRow = serde_json::from_str(&anchor.body).expect("JSON");
    assert_eq!(anchor.index.state, Some(Kind::Anchor.number()));
    let marks: Vec<Mark> = Mark::quoted(&read).collect();
    assert_eq!(marks, Mark::in_line(&anchor.body));
    let [mark] = marks.as_slice() else { panic!("fleet alone is there to be quoted: {marks:?}") };
    assert_eq!(
        (mark.service.as_str(), &mark.head, mark.by.as_str()),
        ("fleet", &heads[&Writer::Fleet], "row 1 of task")
    );
    let ends = |first, last| Ends { first, last, ..Ends::default() };
    assert_eq!(mark.hold(Some(&rows[2].body), ends(0, 0)), Ok(()));
    assert!(matches!(mark.hold(Some(&rows[1].body), ends(0, 0)), Err(Broken::Rewritten { n: 3, .. })));
    assert!(matches!(mark.hold(None, ends(1, 2)), Err(Broken::Truncated { last: 2, known: 3, .. })));
    assert!(matches!(mark.hold(None, ends(1, 5)), Err(Broken::Order { expected: 3, .. })));
}

#[test]
fn a_head_that_was_noted_down_is_read_again_as_it_was_printed() {
    let head = Head { n: 17, hash: "ab".repeat(32) };
    assert_eq!(Mark::parse(&format!("fleet:{head}")), Some(noted(&head)));
    for wrong in ["", "fleet", "fleet:17", "fleet:x:00", ":17:ab", &format!("fleet:17:{}", "AB".repeat(32))] {
        assert_eq!(Mark::parse(wrong), None, "{wrong}");
    }
}

#[test]
fn a_refusal_as_things_are_is_noted_and_a_mistake_of_form_is_not() {
    let refusal = |kind, code| crate::reason::Refusal::new(kind, Reason::from(code));
    let of = |why: &Refusal| Item::for_refusal(Writer::Fleet, "anna", Some("q"), Note::new("robot.drain"), why);
    let item = of(&refusal(RefusalKind::Precondition, Code::RobotDraining)).expect("a decision");
    assert_eq!(item.note.as_ref().and_then(|note| note.refused), Some(Code::RobotDraining));
    assert!(!item.is_empty() && item.rows.is_empty());
    assert!(of(&refusal(RefusalKind::NotFound, Code::RobotNotFound)).is_none());
    assert!(of(&refusal(RefusalKind::Invalid, Code::InvalidRequest)).is_none());
}

/// Lines of an export of two chains, each with an anchor, and its first line.
fn export() -> (Export, Vec<String>) {
    let mut heads = BTreeMap::new();
    let mut lines: Vec<String> = grow(&mut heads, &decisions(4)).iter().map(|row| row.body.to_string()).collect();
    for note in decisions(2).iter().chain([&Note::anchor()]) {
        lines.push(append(&mut heads, Writer::Task, note, &by("task", 1)).expect("a chain").body.to_string());
    }
    let heads = heads.into_iter().map(|(writer, head)| (writer.as_str().to_owned(), head)).collect();
    let (format, site, store) = (Export::FORMAT.to_owned(), "north".to_owned(), "s".to_owned());
    (Export { format, site, store, at_unix_ms: 0, heads }, lines)
}

fn read(export: &Export, lines: &[String]) -> BTreeMap<String, Result<Verified, Broken>> {
    let quoted: Vec<Mark> = lines.iter().flat_map(|line| Mark::in_line(line)).collect();
    let mut held = Held::new(export, &quoted, NOW);
    lines.iter().for_each(|line| held.add_line(line));
    held.finish()
}

#[test]
fn an_export_is_held_chain_by_chain() {
    let (export, lines) = export();
    let verdicts = read(&export, &lines);
    assert!(verdicts.values().all(Result::is_ok) && verdicts.len() == 2, "{verdicts:?}");
    let first = serde_json::to_string(&export).expect("JSON");
    assert_eq!(Export::parse(&first), Some(export.clone()));
    assert_eq!(Export::parse(&lines[0]), None);
    let mut unreadable = lines.clone();
    unreadable[4] = "?".to_owned();
    let verdicts = read(&export, &unreadable);
    assert_eq!(verdicts["task"], Err(Broken::Altered { n: 1 }));
    assert!(verdicts["fleet"].is_ok(), "{verdicts:?}");
    // Whole chains of the file, and of its first line too: the other chain still quotes it.
    let mut beheaded = export.clone();
    beheaded.heads.remove("fleet");
    let verdicts = read(&beheaded, &lines[4..]);
    assert!(verdicts["task"].is_ok());
    assert!(matches!(verdicts["fleet"], Err(Broken::Truncated { last: 0, known: 4, .. })), "{verdicts:?}");
}

#[derive(Clone, Debug)]
enum Tamper {
    Byte { row: usize, at: usize, xor: u8 },
    Remove { from: usize, count: usize },
    Swap { one: usize, other: usize },
    Copy { from: usize, to: usize },
    Resealed { row: usize },
}

fn tampers() -> impl Strategy<Value = Tamper> {
    let n = 0..12_usize;
    prop_oneof![
        (n.clone(), any::<usize>(), 1..128_u8).prop_map(|(row, at, xor)| Tamper::Byte { row, at, xor }),
        (n.clone(), 1..12_usize).prop_map(|(from, count)| Tamper::Remove { from, count }),
        (n.clone(), n.clone()).prop_map(|(one, other)| Tamper::Swap { one, other }),
        (n.clone(), n.clone()).prop_map(|(from, to)| Tamper::Copy { from, to }),
        n.prop_map(|row| Tamper::Resealed { row }),
    ]
}

proptest! {
    #[test]
    fn whatever_is_done_to_a_chain_whose_head_is_known_is_found(tamper in tampers()) {
        let mut heads = BTreeMap::new();
        let rows = grow(&mut heads, &decisions(12));
        let known = [noted(&heads[&Writer::Fleet])];
        let mut other = rows.clone();
        match tamper {
            Tamper::Byte { row, at, xor } => {
                let mut bytes = other[row].body.as_bytes().to_vec();
                let at = at % bytes.len();
                bytes[at] ^= xor;
                other[row].body = String::from_utf8_lossy(&bytes).into_owned().into();
            }
            Tamper::Remove { from, count } => drop(other.drain(from..(from + count).min(12))),
            Tamper::Swap { one, other: two } => other.swap(one, two),
            Tamper::Copy { from, to } => other.insert(to, rows[from].clone()),
            Tamper::Resealed { row } => {
                let opened = open(&rows[row].body).expect("a row");
                other[row].body = seal(opened.prev, &opened.said.replace("anna", "bert")).0.into();
            }
        }
        prop_assert_eq!(verify(&other, &known).is_ok(), other == rows);
    }
}
