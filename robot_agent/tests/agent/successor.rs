//! A robot that goes back opens what the newer version wrote, on trial and committed: each kind of file by its name.
//!
//! The newer version is this one, with a hand that adds to its files what a release may add (record 0095): a field in
//! each object, a column in each table, a table, a fact, a lane, a kind of subject, a line in each record. The beacon
//! of a newer launcher is read in the room that hears it (services/telemetry/src/beacons.rs).

use crate::lanes::{holder, succeeded};
use crate::release::Releases;
use crate::rig::{attempt, place_id};
use crate::sets::{put_content, set};
use crate::stops::stop;
use midshift_agent::boot::{BOOT, Boot, Image};
use midshift_agent::device::DeviceKey;
use midshift_agent::enrolment::Enrolled;
use midshift_agent::launcher::SWITCH;
use midshift_agent::ledger::{Applied, Holder, Intent, PlacesRow, SessionMemory};
use midshift_agent::ring::Item;
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::stop::storage::{FileStops, STOP_FILE, StopStorage, unreadable};
use midshift_agent::storage::Proven;
use midshift_agent::store::{Op, RobotMemory, Store};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_agent::update::{DueMigration, HeldKeys, SoftwareRow, Update};
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::release::Release;
use midshift_bundle::set::SetManifest;
use midshift_bundle::trust::Trusted;
use midshift_core::ids::{AreaId, DrainId, RobotId, SiteId};
use midshift_core::policy::AreaPolicy;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::WorkState;
use midshift_core::robot::{Lane, Mode, StopLevel, Vitals};
use midshift_core::robot_events::{AttemptReport, Gap, RobotEvent, SampleBody};
use midshift_core::step::StepKind;
use midshift_core::stop::robot::SavedStops;
use midshift_core::time::Utc;
use midshift_core::update::UpdateState;
use midshift_durable::record;
use midshift_latch::LatchFile;
use serde_json::{Value, json};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions, Connection, Row};
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::sync::Arc;

/// What the newer version adds to a ledger and a ring.
const ADDED: &str = r#"
CREATE TABLE mood (robot TEXT PRIMARY KEY, level INTEGER NOT NULL) STRICT;
INSERT INTO mood VALUES ('rbt-01', 7);
ALTER TABLE fact ADD COLUMN mood TEXT;
ALTER TABLE subject ADD COLUMN mood TEXT;
ALTER TABLE unclosed ADD COLUMN mood TEXT;
ALTER TABLE lane ADD COLUMN mood TEXT;
ALTER TABLE sample ADD COLUMN mood TEXT NOT NULL DEFAULT 'plain';
ALTER TABLE gap ADD COLUMN mood TEXT NOT NULL DEFAULT 'plain';
UPDATE fact SET value = json_set(value, '$.next_version', 7)
    WHERE key IN ('session', 'applied', 'holder', 'places', 'software', 'trusted', 'proven');
UPDATE fact SET value = json_set(value, '$[0].next_version', 7, '$[0].software.next_version', 7) WHERE key = 'policy';
UPDATE fact SET value = json_set(value, '$.attempt.next_version', 7, '$.intent.next_version', 7) WHERE key = 'holder';
UPDATE fact SET value = json_set(value, '$.keys.next_version', 7, '$.due[0].next_version', 7,
    '$.update.next_version', 7, '$.update.reason.next_version', 7, '$.update.set.next_version', 7,
    '$.update.set.components.gait.next_version', 7) WHERE key = 'software';
UPDATE fact SET value = json_set(value, '$.versions.next_version', 7) WHERE key = 'trusted';
UPDATE subject SET report = json_set(report, '$.next_version', 7, '$.stats.next_version', 7) WHERE report IS NOT NULL;
UPDATE unclosed SET value = json_set(value, '$.next_version', 7, '$.attempt.next_version', 7);
UPDATE sample SET value = json_set(value, '$.next_version', 7);
UPDATE sample SET value = json_set(value, '$.body.status.next_version', 7) WHERE lane = 2;
UPDATE gap SET value = json_set(value, '$.next_version', 7, '$.reason.next_version', 7);
INSERT INTO fact (key, value) VALUES ('mood', '{"level":7}');
INSERT INTO subject (subject, epoch, at_unix_ms) VALUES ('wish/7', 1, 1);
INSERT INTO lane (lane, produced, acked) VALUES (9, 3, 1);
INSERT INTO sample (lane, seq, value) VALUES (9, 2, '{}');
INSERT INTO gap (lane, from_seq, to_seq, value) VALUES (9, 3, 3, '{}');
UPDATE fact SET mood = 'curious';
UPDATE subject SET mood = 'curious';
UPDATE unclosed SET mood = 'curious';
UPDATE lane SET mood = 'curious';
"#;
/// Fields that were added to facts.
const FIELDS: &str = "SELECT sum(length(value) - length(replace(value, 'next_version', ''))) / 12 FROM fact";
/// Its own rows.
const THEIRS: &str = "SELECT (SELECT value FROM fact WHERE key = 'mood') || ' ' || (SELECT level FROM mood) || ' ' ||
    (SELECT epoch FROM subject WHERE subject = 'wish/7') || ' ' || (SELECT produced FROM lane WHERE lane = 9) || ' ' ||
    (SELECT count(*) FROM sample WHERE lane = 9) || ' ' || (SELECT count(*) FROM gap WHERE lane = 9)";
/// Rows that lost what stands in its columns.
const LOST: &str =
    "SELECT (SELECT count(*) FROM fact WHERE mood IS NULL) + (SELECT count(*) FROM subject WHERE mood IS NULL) +
    (SELECT count(*) FROM unclosed WHERE mood IS NULL) + (SELECT count(*) FROM lane WHERE mood IS NULL)";

/// The newer version's hand on a database.
struct Successor(SqliteConnection);

impl Successor {
    async fn open(path: &Path) -> Self {
        Self(SqliteConnectOptions::new().filename(path).connect().await.expect("opens"))
    }
    async fn writes(mut self, sql: &'static str) {
        sqlx::raw_sql(sql).execute(&mut self.0).await.expect("writes");
        self.0.close().await.expect("closes");
    }
    async fn number(&mut self, sql: &'static str) -> i64 {
        sqlx::query(sql).fetch_one(&mut self.0).await.expect("reads").try_get(0).expect("a number")
    }
    async fn text(&mut self, sql: &'static str) -> String {
        sqlx::query(sql).fetch_one(&mut self.0).await.expect("reads").try_get(0).expect("a text")
    }
}

fn update(state: UpdateState) -> Update {
    Update {
        state,
        bundle: Digest::of_content(b"bundle"),
        manifest_length: 7,
        rollback_floor: 1,
        set: Some(set("v2", b"program", b"settings")),
        raises_floor: true,
        is_irreversible: false,
        drain_id: Some(DrainId::parse("drain-1").expect("a name")),
        tries: 1,
        probation_ms: 10_000,
        // A code that this version does not know is kept by its name.
        reason: Some(Reason::named("GRAVITY_LOST")),
    }
}

/// What may run, with the documents of a release.
fn proven() -> Proven {
    let releases = Releases::new();
    let bundle = releases.release("2.0.0");
    let documents = releases.documents();
    let text = |name: &str| String::from_utf8_lossy(&documents[name]).into_owned();
    let release = Release::verified(&text("1.root.json"), &text("2.targets.json"), &bundle.manifest.to_bytes());
    let set = set("v2", b"program", b"settings");
    let mut proven = Proven { directive_generation: 3, ..Proven::default() };
    proven.committed.previous = Some("v1".to_owned());
    proven.intended = Some(proven.committed.clone());
    proven.believed = set.components.values().cloned().collect();
    proven.sets.insert(set.id(), set);
    proven.releases.insert(bundle.digest, Arc::new(release.expect("a release")));
    proven
}

/// Every kind of fact, subject and attempt.
fn rows(state: UpdateState) -> Vec<Op> {
    let done = attempt("T1", 4);
    let (report, listed) = succeeded(&done);
    // A state that this version does not know is kept by its number.
    let report = AttemptReport { state: WorkState::Unknown(99), ..report };
    let intent = Some(Intent { step: 1, kind: StepKind::Wait { duration_ms: 5 } });
    let holder = Holder { intent, ..holder(attempt("T2", 1)) };
    let key = SecretKey::of_seed([5; 32]).public();
    let software = SoftwareRow {
        directive_generation: 3,
        envelope: Some(Digest::of_content(b"envelope")),
        keys: Some(HeldKeys { number: 2, from: vec![key.id()], keys: vec![key] }),
        grant_id: 8,
        floors: [("gait".to_owned(), 1)].into(),
        committed_at: Some(Utc(1)),
        due: vec![DueMigration { component: "gait".to_owned(), from: None, to: "1.0.0".to_owned() }],
        update: Some(update(state)),
    };
    let trusted = Trusted::new(&Releases::new().config().root).expect("a root");
    let places = PlacesRow { inside: [(place_id("door"), 3)].into(), ..PlacesRow::default() };
    vec![
        Op::Session(SessionMemory { session_epoch: 3, secret: "s".into(), store_id: "store".into() }),
        Op::Applied(Applied { work: 4, policy: 5, update: 6 }),
        Op::Policy(vec![AreaPolicy::default_of(AreaId::parse("hall").expect("a name")).into()]),
        Op::Holder(Some(Box::new(holder))),
        Op::Places(places),
        Op::Maintenance(Some(DrainId::parse("drain-1").expect("a name"))),
        Op::Software(Box::new(software)),
        Op::Trusted(Arc::new(trusted)),
        Op::Proven(Arc::new(proven())),
        Op::Device(DeviceKey::of_seed([9; 32])),
        Op::Epoch(attempt("T3", 1).subject, 8, 3_000),
        Op::Finish(Arc::new(report), listed, 2_000),
    ]
}

/// What is there after a start.
async fn started(path: &Path) -> (SqliteStore, RobotMemory) {
    let mut store = SqliteStore::open(path).await.expect("opens");
    let memory = store.load("ring-1").await.expect("loads");
    (store, memory)
}

/// Writes these rows, and as many samples into each lane.
async fn write(path: &Path, mut ops: Vec<Op>, samples: usize) -> RobotMemory {
    let (mut store, mut memory) = started(path).await;
    for lane in Lane::ALL.into_iter().flat_map(|lane| std::iter::repeat_n(lane, samples)) {
        let body = match lane {
            Lane::Status => SampleBody::Status(Vitals::default()),
            _ => SampleBody::Event(RobotEvent::Mode(Mode::Manual)),
        };
        let appended = memory.ring.append(lane, 7, body);
        appended.iter().for_each(|op| memory.apply(op));
        ops.extend(appended);
    }
    store.commit(&ops).await.expect("commits");
    drop(store);
    started(path).await.1
}

#[tokio::test]
async fn the_ledger_and_the_ring_of_a_newer_version_are_read_and_what_it_added_outlives_what_is_written_then() {
    for state in [UpdateState::Trial, UpdateState::Committed] {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("robot.db");
        let rows = rows(state);
        write(&path, rows.clone(), 3).await;
        let gap = Gap { lane: Lane::Status, from_seq: 1, to_seq: 1, reason: Code::Overflow.into() };
        let before = write(&path, vec![Op::Gap(gap)], 0).await;
        Successor::open(&path).await.writes(ADDED).await;
        assert_eq!(Successor::open(&path).await.number(FIELDS).await, 18, "each object has one");
        assert_eq!(started(&path).await.1, before, "{state:?}");
        // This version writes each kind of row anew.
        write(&path, rows, 1).await;
        let after = write(&path, vec![Op::Free(Lane::Event, 1), Op::Jump(Lane::Critical, 9)], 0).await;
        assert_eq!(after.ledger, before.ledger);
        let mut theirs = Successor::open(&path).await;
        assert_eq!(theirs.text(THEIRS).await, "{\"level\":7} 7 1 3 1 1");
        assert_eq!(theirs.number(LOST).await, 0, "columns stay where a row is written anew");
    }
}

#[tokio::test]
async fn samples_of_a_newer_version_are_told_as_missing_and_stay_until_that_is_acknowledged() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.db");
    write(&path, Vec::new(), 4).await;
    let dreams = r#"UPDATE sample SET value = json_set(value, '$.body', json('{"dream":{"of":"sheep"}}'))
        WHERE lane = 1 AND seq IN (2, 3)"#;
    Successor::open(&path).await.writes(dreams).await;
    let (mut store, memory) = started(&path).await;
    let lane = memory.ring.lane(Lane::Event);
    assert_eq!((lane.produced, lane.samples.iter().map(|s| s.seq).collect::<Vec<_>>()), (4, vec![1, 4]));
    let Some(Item::Gap(gap)) = memory.ring.after(Lane::Event, 1) else { panic!("{lane:?}") };
    assert_eq!((gap.from_seq, gap.to_seq, gap.reason.code), (2, 3, Code::RowUnknown));
    assert!(matches!(memory.ring.after(Lane::Event, 3), Some(Item::Sample(sample)) if sample.seq == 4));
    let dreamt = "SELECT count(*) FROM sample WHERE value LIKE '%sheep%'";
    assert_eq!(Successor::open(&path).await.number(dreamt).await, 2, "the newer version may come back and say them");
    store.commit(&[Op::Free(Lane::Event, 4)]).await.expect("commits");
    drop(store);
    assert_eq!(Successor::open(&path).await.number(dreamt).await, 0);
    assert_eq!(started(&path).await.1.ring.lane(Lane::Event).gaps.len(), 0);
}

#[tokio::test]
async fn a_word_that_a_newer_version_may_not_write_yet_is_named_and_nothing_is_lost_by_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.db");
    write(&path, rows(UpdateState::Trial), 1).await;
    let dreams = "UPDATE fact SET value = json_set(value, '$.update.state', 'dreaming') WHERE key = 'software'";
    Successor::open(&path).await.writes(dreams).await;
    let mut store = SqliteStore::open(&path).await.expect("opens");
    let refused = store.load("ring-1").await.expect_err("nobody knows what it does").to_string();
    assert!(refused.contains("software") && refused.contains("dreaming"), "{refused}");
    let still = "SELECT count(*) FROM fact WHERE value LIKE '%dreaming%'";
    assert_eq!(Successor::open(&path).await.number(still).await, 1);
}

/// Adds a field to a file that is one object.
fn adds_a_field(path: &Path) {
    let mut page: Value = serde_json::from_slice(&fs::read(path).expect("reads")).expect("is JSON");
    page["next_version"] = json!({"level": 7});
    fs::write(path, page.to_string()).expect("writes");
}

#[tokio::test]
async fn the_latch_of_a_newer_version_is_obeyed_and_one_with_words_that_nobody_knows_stands_the_robot() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(STOP_FILE);
    let unknown = unreadable(&RobotId::parse("rbt-01").expect("a name"), Utc(7));
    let mut known = SavedStops::default();
    known.latch.engage(stop(1, StopLevel::Halt));
    let mut stops = FileStops::new(&path);
    stops.load(unknown.clone()).await;
    stops.save(known.clone()).await.expect("keeps");
    drop(stops);
    let rewrites = |change: &dyn Fn(&mut Value)| {
        let (mut file, mut page) = LatchFile::open(&path, 1 << 19, Value::Null).expect("opens");
        change(&mut page);
        file.write(&page).expect("writes");
    };
    rewrites(&|page| {
        page["next_version"] = json!(7);
        page["latch"]["next_version"] = json!(7);
        page["latch"]["stops"].as_object_mut().expect("stops").values_mut().for_each(|s| s["next_version"] = json!(7));
    });
    let loaded = FileStops::new(&path).load(unknown.clone()).await;
    assert_eq!((&loaded.saved, loaded.is_durable), (&known, true));
    rewrites(&|page| {
        page["latch"]["stops"].as_object_mut().expect("stops").values_mut().for_each(|s| s["level"] = json!("dream"));
    });
    assert_eq!(FileStops::new(&path).load(unknown.clone()).await.saved, unknown, "it stands until a person resumes it");
    let (_, theirs) = midshift_latch::read::<Value>(&path.with_extension("latch.broken")).expect("stays beside");
    assert!(theirs.to_string().contains("dream"), "{theirs}");
}

#[test]
fn trust_and_certificate_that_a_newer_version_wrote_are_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trust.json");
    let config = Releases::new().config();
    let site = SiteId::parse("hall-1").expect("a name");
    let trust = TrustAnchors { root: config.root, directive_keys: config.directive_keys, site };
    trust.write(&path).expect("writes");
    let before = TrustAnchors::read(&path).expect("reads");
    adds_a_field(&path);
    assert_eq!(TrustAnchors::read(&path).expect("reads"), before);
    let home = folder.path().join("identity");
    let enrolled = Enrolled {
        robot_id: RobotId::parse("rbt-01").expect("a name"),
        certificate_pem: "certificate".to_owned(),
        authority_pem: "authority".to_owned(),
        expires_unix_ms: 7,
        trust_json: String::new(),
        line_id: "line".to_owned(),
    };
    enrolled.write(&home).expect("writes");
    let file = fs::read_dir(&home).expect("is there").next().expect("one").expect("an entry").path();
    adds_a_field(&file);
    assert_eq!(Enrolled::read(&home).expect("reads"), Some(enrolled));
}

/// Adds a line to a record.
fn adds_a_line(path: &Path) {
    let text = record::read(path).expect("reads").expect("was written");
    record::write(path, &format!("{text}mood curious\n")).expect("writes");
}

fn staged(sets: &mut DiskSets, version: &str) -> SetManifest {
    let [program, settings] = ["program", "settings"].map(|what| format!("{what} {version}").into_bytes());
    put_content(sets, &program);
    put_content(sets, &settings);
    let set = set(version, &program, &settings);
    sets.stage(&set).expect("stages");
    set
}

#[test]
fn the_switch_record_and_the_sets_of_a_newer_version_lead_back_to_the_kept_set() {
    for is_committed in [false, true] {
        let folder = tempfile::tempdir().expect("a folder");
        let mut sets = DiskSets::open(folder.path()).expect("opens");
        let [kept, next] = ["v1", "v2"].map(|version| staged(&mut sets, version));
        let mut switch = sets.holdings().expect("tells").switch;
        switch.try_out(&kept.id().to_string());
        switch.commit();
        switch.try_out(&next.id().to_string());
        if is_committed {
            switch.commit();
        }
        sets.write_switch(&mut switch).expect("writes");
        // The newer version would have staged it so.
        let page = folder.path().join(next.id().to_string()).join("set.json");
        adds_a_field(&page);
        adds_a_line(&folder.path().join(SWITCH));
        let mut sets = DiskSets::open(folder.path()).expect("opens");
        let holdings = sets.holdings().expect("tells");
        assert_eq!((&holdings.switch, holdings.sets.contains_key(&kept.id())), (&switch, true));
        sets.collect(&BTreeSet::new()).expect("collects");
        assert!(page.exists(), "the record names it");
        if is_committed {
            switch.undo_commit();
        } else {
            switch.go_back();
        }
        sets.write_switch(&mut switch).expect("writes");
        assert_eq!(sets.holdings().expect("tells").switch, switch);
        sets.verify(&kept.id()).expect("is whole");
        sets.collect(&BTreeSet::new()).expect("collects");
        assert!(!page.exists() && folder.path().join(kept.id().to_string()).is_dir());
    }
}

#[test]
fn the_boot_record_of_a_newer_version_is_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(BOOT);
    for is_committed in [false, true] {
        let before = Boot::read(&path).expect("reads");
        let mut boot = Boot::default();
        boot.put_spare(Some(Image { name: "v2".to_owned(), length: 7 }));
        boot.try_out("v2");
        if is_committed {
            boot.settle("v2");
        }
        boot.number = before.number;
        boot.write_over(&before, &path).expect("writes");
        adds_a_line(&path);
        assert_eq!(Boot::read(&path).expect("reads"), boot);
        let before = boot.clone();
        boot.start(|_, _| true);
        boot.write_over(&before, &path).expect("writes");
        assert_eq!(Boot::read(&path).expect("reads"), boot);
    }
}
