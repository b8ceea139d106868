use super::*;
use midshift_core::audit::{AuditRow, Head, Held, Mark, Note};
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::reason::Code as ReasonCode;
use midshift_core::rows::Writer;
use midshift_core::time::{Now, Utc};
use midshift_proto::convert::timestamp;
use midshift_proto::identity::v1;
use midshift_store::{MemoryStore, StoreId};
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicI64, Ordering};
use tokio::sync::mpsc;

const DAY_MS: i64 = 86_400_000;
const BEGIN: i64 = 1_780_000_000_000;

/// A wall that stands still until it is moved.
struct Wall(AtomicI64);

impl Clock for Wall {
    fn now(&self) -> Now {
        let wall = Utc(self.0.load(Ordering::Relaxed));
        Now { wall, utc: wall, ..Now::default() }
    }
    fn rate_permille(&self) -> u32 {
        1_000
    }
}

struct World {
    wall: Arc<Wall>,
    service: AuditService,
}

impl World {
    fn new() -> Self {
        let wall = Arc::new(Wall(AtomicI64::new(BEGIN)));
        let site = SiteId::parse("north").unwrap_or_else(|e| panic!("{e}"));
        let store = MemoryStore::new(site, StoreId(Arc::from("memory")), wall.clone());
        let service = AuditService::new(Arc::new(store), wall.clone(), CancellationToken::new());
        Self { wall, service }
    }
    fn pass(&self, ms: i64) {
        self.wall.0.fetch_add(ms, Ordering::Relaxed);
    }
    async fn note(&self, writer: Writer, actor: &str, note: Note) {
        let mut item = Item::new(writer, actor);
        item.audit(note);
        assert!(self.service.store.commit(vec![item]).await.iter().all(Result::is_ok));
    }
    async fn maintain(&self, writer: Writer) {
        upkeep::maintain_chain(&*self.service.store, &*self.wall, writer).await.unwrap_or_else(|e| panic!("{e}"));
    }
    /// All rows that fit, page by page, as `service:n`, and how many pages it took.
    async fn list(&self, mut request: v1::ListAuditRequest) -> (Vec<String>, usize) {
        let (mut all, mut pages) = (Vec::new(), 0);
        loop {
            let page = self.service.list(request.clone()).await.unwrap_or_else(|e| panic!("{e}"));
            pages += 1;
            all.extend(page.rows.iter().map(|row| format!("{}:{}", row.service, row.n)));
            if page.next_page_token.is_empty() {
                return (all, pages);
            }
            request.page_token = page.next_page_token;
        }
    }
    async fn export(&self) -> Vec<String> {
        let (sender, mut messages) = mpsc::channel(1_000);
        self.service.export(&"anna".into(), &sender).await.unwrap_or_else(|e| panic!("{e}"));
        drop(sender);
        let mut lines = Vec::new();
        while let Some(message) = messages.recv().await {
            lines.extend(message.unwrap_or_else(|e| panic!("{e}")).lines);
        }
        lines
    }
    async fn verify(&self, noted: Vec<Mark>) -> Vec<v1::AuditVerdict> {
        let (sender, mut messages) = mpsc::channel(1_000);
        self.service.verify(noted, &sender).await.unwrap_or_else(|e| panic!("{e}"));
        drop(sender);
        let mut verdicts = Vec::new();
        while let Some(message) = messages.recv().await {
            verdicts = message.unwrap_or_else(|e| panic!("{e}")).verdicts;
        }
        verdicts
    }
    async fn rows(&self, writer: Writer) -> Vec<AuditRow> {
        let table = Table::audit_of(writer).unwrap_or_else(|| panic!("an audit"));
        let rows = self.service.store.list(Query::all(table)).await.unwrap_or_else(|e| panic!("{e}"));
        rows.iter().map(|row| serde_json::from_str(&row.body).unwrap_or_else(|e| panic!("{e}"))).collect()
    }
}

fn cordon(robot: &str) -> Note {
    Note::new("robot.cordon").about("robot", robot)
}

#[tokio::test]
async fn rows_of_all_chains_are_listed_newest_first_and_each_once_whatever_the_page() {
    let world = World::new();
    for n in 0..7 {
        world.note(Writer::Fleet, "anna", cordon(&format!("r{n}"))).await;
        world.pass(1_000);
        world.note(Writer::Task, "bert", Note::new("task.cancel").about("task", format!("T-{n}"))).await;
        world.pass(1_000);
    }
    let newest_first: Vec<String> = (1..=7).rev().flat_map(|n| [format!("task:{n}"), format!("fleet:{n}")]).collect();
    for page_size in [1, 3, 14, 100] {
        let request = v1::ListAuditRequest { page_size, ..v1::ListAuditRequest::default() };
        assert_eq!(world.list(request).await.0, newest_first, "pages of {page_size}");
    }
    let (of_fleet, _) = world.list(v1::ListAuditRequest { service: "fleet".to_owned(), ..Default::default() }).await;
    assert_eq!(of_fleet.len(), 7);
}

#[tokio::test]
async fn what_is_asked_for_is_found_by_who_what_and_when() {
    let world = World::new();
    world.note(Writer::Fleet, "anna", cordon("r1")).await;
    world.pass(DAY_MS);
    world
        .note(Writer::Ota, "anna", Note::new("robot.pin").about("robot", "r1").refused(ReasonCode::NotAllowedNow))
        .await;
    world.note(Writer::Task, "bert", Note::new("task.cancel").about("task", "r1")).await;
    let found = async |request: v1::ListAuditRequest| world.list(request).await.0;
    let all = v1::ListAuditRequest::default;
    assert_eq!(found(v1::ListAuditRequest { robot_id: "r1".to_owned(), ..all() }).await, ["ota:1", "fleet:1"]);
    assert_eq!(found(v1::ListAuditRequest { subject: "r1".to_owned(), ..all() }).await.len(), 3);
    assert_eq!(found(v1::ListAuditRequest { subject: "task:r1".to_owned(), ..all() }).await, ["task:1"]);
    assert_eq!(
        found(v1::ListAuditRequest { actor: "anna".to_owned(), action_prefix: "robot.c".to_owned(), ..all() }).await,
        ["fleet:1"]
    );
    let noon = Some(timestamp(Utc(BEGIN + DAY_MS / 2)));
    assert_eq!(found(v1::ListAuditRequest { since: noon, ..all() }).await.len(), 2);
    assert_eq!(found(v1::ListAuditRequest { until: noon, ..all() }).await, ["fleet:1"]);
    let until = Some(prost_types::Timestamp { seconds: 0, nanos: -1 });
    let wrong = v1::ListAuditRequest { service: "nobody".to_owned(), page_token: "x".to_owned(), until, ..all() };
    let refused = world.service.list(wrong).await.map_or_else(|refusal| refusal, |_| panic!("it is wrong"));
    let fields: BTreeSet<&str> = refused.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, BTreeSet::from(["page_token", "service", "until"]));
}

#[tokio::test]
async fn each_chain_quotes_the_others_once_an_hour() {
    let world = World::new();
    world.note(Writer::Fleet, "anna", cordon("r1")).await;
    for _ in 0..3 {
        world.maintain(Writer::Task).await;
    }
    let anchors = world.rows(Writer::Task).await;
    assert_eq!(anchors.len(), 1, "once");
    assert_eq!(anchors[0].heads["fleet"], world.rows(Writer::Fleet).await[0].head());
    world.pass(limits::AUDIT_ANCHOR_EVERY_MS as i64 - 1);
    world.maintain(Writer::Task).await;
    assert_eq!(world.rows(Writer::Task).await.len(), 1);
    world.pass(1);
    world.maintain(Writer::Task).await;
    assert_eq!(world.rows(Writer::Task).await.len(), 2);
    world.maintain(Writer::Telemetry).await;
}

#[tokio::test]
async fn rows_go_after_four_hundred_days_and_what_is_left_holds() {
    let world = World::new();
    for n in 0..5 {
        world.note(Writer::Fleet, "anna", cordon(&format!("r{n}"))).await;
    }
    world.maintain(Writer::Task).await;
    world.pass(limits::AUDIT_DAYS as i64 * DAY_MS);
    world.note(Writer::Fleet, "anna", cordon("r9")).await;
    world.maintain(Writer::Fleet).await;
    assert_eq!(world.rows(Writer::Fleet).await.len(), 7, "a day that is not over is kept");
    world.pass(1);
    world.maintain(Writer::Fleet).await;
    let left: Vec<u64> = world.rows(Writer::Fleet).await.iter().map(|row| row.n).collect();
    assert_eq!(
        left,
        [5, 6, 7, 8],
        "the last one until the next is old, that one, the anchor and the row that says what went"
    );
    let verdicts = world.verify(Vec::new()).await;
    assert!(verdicts.iter().all(|v| v.broken.is_none()), "also a row that another chain quotes: {verdicts:?}");
    assert_eq!(verdicts.iter().find(|v| v.service == "fleet").map(|v| (v.first, v.rows)), Some((5, 4)));
    // Somebody who noted a row down is told that it went: nobody here knows when that was.
    let noted = Mark::parse(&format!("fleet:2:{}", "0".repeat(64))).unwrap_or_else(|| panic!("a head"));
    let broken =
        world.verify(vec![noted]).await.into_iter().find_map(|v| v.broken).unwrap_or_else(|| panic!("it holds"));
    assert_eq!((broken.what.as_str(), broken.n), ("BEHEADED", 2));
    assert!(broken.text.starts_with("it begins with row 5, and your note has row 2: "), "{}", broken.text);
}

#[tokio::test]
async fn a_quote_of_a_row_that_went_before_it_was_old_shows_that_it_was_taken_away() {
    let world = World::new();
    for n in 0..3 {
        world.note(Writer::Fleet, "anna", cordon(&format!("r{n}"))).await;
    }
    world.maintain(Writer::Task).await;
    let head = world.rows(Writer::Fleet).await[2].head();
    world.note(Writer::Fleet, "fleet", Note::cut(head)).await;
    let verdicts = world.verify(Vec::new()).await;
    let broken = verdicts.iter().find_map(|v| v.broken.as_ref()).unwrap_or_else(|| panic!("{verdicts:?}"));
    assert_eq!((broken.what.as_str(), broken.n), ("BEHEADED", 3));
    assert!(broken.text.contains("row 1 of task has row 3"), "{}", broken.text);
}

#[tokio::test]
async fn an_export_holds_by_itself_and_has_the_heads_that_verify_says() {
    let world = World::new();
    for n in 0..300 {
        world.note(Writer::Fleet, "anna", cordon(&format!("r{n}")).because("x".repeat(200))).await;
    }
    for writer in [Writer::Task, Writer::Fleet] {
        world.maintain(writer).await;
    }
    let lines = world.export().await;
    assert_eq!(lines.len(), 1 + 301 + 1 + 1);
    let own = world.rows(Writer::Identity).await.pop().unwrap_or_else(|| panic!("its own row"));
    assert_eq!((own.action.as_str(), own.actor.as_str()), ("audit.export", "anna"));
    assert!(lines[1..].iter().any(|line| line.contains("audit.export")), "it is in the export");
    let export = midshift_core::audit::Export::parse(&lines[0]).unwrap_or_else(|| panic!("an export"));
    let quoted: Vec<Mark> = lines[1..].iter().flat_map(|line| Mark::in_line(line)).collect();
    let mut held = Held::new(&export, &quoted, Utc(BEGIN));
    lines[1..].iter().for_each(|line| held.add_line(line));
    let offline = held.finish();
    let head = |verdict: &v1::AuditVerdict| verdict.head.clone().map(|h| Head { n: h.n, hash: h.hash });
    for verdict in world.verify(Vec::new()).await.iter().filter(|verdict| verdict.rows > 0) {
        let known = offline[&verdict.service].as_ref().unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(head(verdict), Some(known.head.clone()));
        assert_eq!(export.heads[&verdict.service], known.head);
    }
}

#[tokio::test]
async fn a_noted_head_that_is_not_in_its_chain_is_told() {
    let world = World::new();
    world.note(Writer::Fleet, "anna", cordon("r1")).await;
    let noted = |n: u64, hash: &str| Mark::parse(&format!("fleet:{n}:{hash}")).unwrap_or_else(|| panic!("a head"));
    let hash = world.rows(Writer::Fleet).await[0].hash.clone();
    let what = async |mark| {
        let verdicts = world.verify(vec![mark]).await;
        verdicts.into_iter().find_map(|v| v.broken).map(|broken| broken.what)
    };
    assert_eq!(what(noted(1, &hash)).await, None);
    assert_eq!(what(noted(1, &"0".repeat(64))).await.as_deref(), Some("REWRITTEN"));
    assert_eq!(what(noted(2, &hash)).await.as_deref(), Some("TRUNCATED"));
    let wrong = v1::AuditHead { service: "telemetry".to_owned(), n: 1, hash };
    assert!(verify::noted(&v1::VerifyAuditRequest { heads: vec![wrong] }).is_err());
    assert!(verify::noted(&v1::VerifyAuditRequest { heads: vec![v1::AuditHead::default()] }).is_err());
}
