//! Two processes of the rollout service over one store and one folder: one plans and signs, the other carries out what
//! people ask.

mod damage;
mod ended;
mod moves;
mod reach;

use crate::content::Room;
use crate::fixture::{START, files, give_back, hide, key, key_set, release, write_keys};
use crate::folder::Owner;
use crate::repository::FRESHEN_AFTER_MS;
use crate::rollouts::{Parts, RolloutService};
use crate::{OtaService, Parts as OtaParts};
use midshift_bundle::digest::Digest;
use midshift_core::fleet::rows::FleetMark;
use midshift_core::ids::RolloutId;
use midshift_core::item::Item;
use midshift_core::leadership::OtaLeader;
use midshift_core::rollout::bugs::Bugs;
use midshift_core::rollout::rows::{Bundle, OtaMark, Phase, Rollout};
use midshift_core::rows::{Log, Record, Revision, Table, Writer};
use midshift_core::site::{DEMO, Site, text};
use midshift_core::time::{Clock, Now, ScaledClock};
use midshift_proto::access::local;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::bundle_service_server::BundleService as Bundles;
use midshift_proto::ota::v1::rollout_service_server::RolloutService as Face;
use midshift_store::{Error, LiveBoard, MemoryStore, Retention, Store, StoreId};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tempfile::TempDir;
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// So long after [`World::half_a_day_passes`] what was published before it has to be signed anew.
const DUE_MS: u64 = 60_000;

/// A clock whose wall may be moved on.
struct MovedOn {
    clock: Arc<dyn Clock>,
    by_ms: Arc<AtomicU64>,
}

impl Clock for MovedOn {
    fn now(&self) -> Now {
        let now = self.clock.now();
        Now { wall: now.wall.plus_ms(self.by_ms.load(Relaxed)), ..now }
    }
    fn rate_permille(&self) -> u32 {
        self.clock.rate_permille()
    }
}

/// What the processes share.
struct World {
    dir: TempDir,
    store: Arc<MemoryStore>,
    clock: Arc<dyn Clock>,
    by_ms: Arc<AtomicU64>,
    site: Arc<Site>,
}

/// One of them.
struct Process {
    ota: OtaService,
    face: RolloutService,
    shutdown: CancellationToken,
    running: Vec<JoinHandle<()>>,
}

impl World {
    fn new() -> Self {
        let dir = TempDir::new().expect("a folder");
        write_keys(&dir.path().join("keys"));
        let begun = Instant::now();
        let (clock, by_ms) =
            (ScaledClock::new(move || begun.elapsed().as_micros() as u64, START, 1000), Arc::default());
        let clock: Arc<dyn Clock> = Arc::new(MovedOn { clock: Arc::new(clock), by_ms: Arc::clone(&by_ms) });
        let site = Arc::new(text::parse(DEMO).expect("the demo reads"));
        let store = MemoryStore::new(site.site_id().clone(), StoreId(Arc::from("store")), clock.clone()).shared();
        Self { dir, store: Arc::new(store), clock, by_ms, site }
    }
    /// What is published before this is due to be signed anew [`DUE_MS`] after it.
    fn half_a_day_passes(&self) {
        self.by_ms.store(FRESHEN_AFTER_MS - DUE_MS, Relaxed);
    }

    async fn process(&self) -> Process {
        self.process_over(self.store.clone()).await
    }

    async fn process_over(&self, store: Arc<dyn Store>) -> Process {
        let (folder, keys) = (self.dir.path().join("ota"), self.dir.path().join("keys"));
        let owner = Owner::Shared { store_id: self.store.id().clone(), known_bundles: 0 };
        let ota = OtaParts { folder, keys, room: Room::with_quota(1 << 20), clock: self.clock.clone(), owner };
        let ota = OtaService::open(ota).await.expect("a service");
        let shutdown = CancellationToken::new();
        let parts = Parts {
            store,
            board: LiveBoard::new(),
            site: self.site.clone(),
            clock: self.clock.clone(),
            ota: ota.clone(),
            bugs: Bugs::default(),
        };
        let (face, planner) = RolloutService::new(parts, shutdown.clone());
        let token = shutdown.clone();
        let planning = tokio::spawn(async move { planner.run(token).await.expect("without a fault") });
        let serving = tokio::spawn(ota.clone().run(shutdown.clone()));
        tokio::time::sleep(Duration::from_secs(1)).await;
        Process { ota, face, shutdown, running: vec![planning, serving] }
    }

    async fn row<R: Record>(&self, id: &str) -> Option<(R, Revision)> {
        midshift_store::load(&*self.store, id).await.expect("a store")
    }

    async fn holder(&self) -> String {
        self.row::<OtaLeader>("ota").await.map(|(row, _)| row.holder).unwrap_or_default()
    }

    /// Bundles that have a row.
    async fn bundles(&self) -> Vec<Bundle> {
        let rows = self.store.snapshot(&[Table::Bundle]).await.expect("a store").rows;
        rows.iter().map(|row| row.decode().expect("a bundle")).collect()
    }
}

impl Process {
    /// As if it were killed.
    fn kill(self) {
        self.running.iter().for_each(JoinHandle::abort);
    }
    async fn end(self) {
        self.shutdown.cancel();
        for running in self.running {
            running.await.expect("it ends");
        }
    }
    fn signed(&self) -> u64 {
        self.ota.opened().expect("keys").repository.newest().expect("published").stamp.version
    }
    async fn create(&self, id: &str, bundle: &str) -> Result<v1::Rollout, tonic::Status> {
        let wave = v1::RolloutWave { size: Some(v1::rollout_wave::Size::Rest(true)) };
        let spec = v1::RolloutSpec {
            bundle: bundle.to_owned(),
            waves: vec![wave],
            allow_full_push: true,
            ..Default::default()
        };
        let request = v1::CreateRolloutRequest { rollout_id: id.to_owned(), spec: Some(spec) };
        let created = Face::create_rollout(&self.face, local(request)).await?;
        Ok(created.into_inner().rollout.expect("a roll-out"))
    }
    async fn phase(&self, id: &str) -> Option<Phase> {
        let id = RolloutId::parse(id).expect("an id");
        self.face.ask_projection(move |view, _, _| view.rollout(&id).map(|r| r.phase)).await.expect("it runs")
    }
}

async fn secs(secs: u64) {
    tokio::time::sleep(Duration::from_secs(secs)).await;
}

#[tokio::test(start_paused = true)]
async fn the_leader_takes_a_release_and_a_roll_out_created_at_the_standby_is_written_once() {
    let world = World::new();
    let leader = world.process().await;
    let first = world.holder().await;
    release(&leader.ota, &files("walk", "1.0.0")).await;
    secs(2).await;
    let bundles = world.bundles().await;
    assert_eq!(bundles.len(), 1, "the leader has taken it");
    let taken = world.row::<Bundle>(bundles[0].bundle.as_str()).await.expect("a row").1;
    let standby = world.process().await;
    secs(2).await;
    let row = world.row::<Bundle>(bundles[0].bundle.as_str()).await.expect("a row").1;
    assert_eq!((row, world.holder().await == first), (taken, true), "the other one takes nothing");
    let bundle = bundles[0].bundle.as_str();
    standby.create("r-1", bundle).await.expect("created");
    let written = world.row::<Rollout>("r-1").await.expect("a row").1;
    // The answer was lost, and the proxy asks the other one.
    leader.create("r-1", bundle).await.expect("done already");
    standby.create("r-1", bundle).await.expect("done already");
    assert_eq!(world.row::<Rollout>("r-1").await.expect("a row").1, written, "written once");
    assert_eq!((leader.phase("r-1").await, standby.phase("r-1").await), (Some(Phase::Draft), Some(Phase::Draft)));
    assert_eq!(world.holder().await, first);
    leader.end().await;
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_roll_out_of_what_was_pushed_a_moment_ago_is_taken_by_the_process_that_has_no_row_of_it_yet() {
    let world = World::new();
    let leader = world.process().await;
    let standby = world.process().await;
    release(&leader.ota, &files("walk", "1.0.0")).await;
    assert!(world.bundles().await.is_empty(), "the leader has not come to it");
    let created = standby.create("r-1", "walk-1.0.0").await.expect("it waits for the row");
    assert_eq!(created.rollout_id, "r-1");
    let asked = Instant::now();
    let unknown = standby.create("r-2", "walk-9.0.0").await.expect_err("nobody published it");
    assert_eq!((unknown.code(), asked.elapsed()), (tonic::Code::NotFound, Duration::ZERO), "nothing to wait for");
    leader.end().await;
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn what_was_signed_is_signed_anew_by_the_leader_alone() {
    let world = World::new();
    let leader = world.process().await;
    release(&leader.ota, &files("walk", "1.0.0")).await;
    world.half_a_day_passes();
    let standby = world.process().await;
    secs(5 * 60).await;
    // Had the standby signed as well, there would be a third.
    assert_eq!((leader.signed(), standby.signed()), (2, 2));
    leader.end().await;
    standby.end().await;
    assert_eq!(world.holder().await, "", "the last one left the row empty");
}

#[tokio::test(start_paused = true)]
async fn what_was_signed_by_a_leader_that_was_killed_is_signed_anew_by_whoever_follows_it() {
    let world = World::new();
    let leader = world.process().await;
    release(&leader.ota, &files("walk", "1.0.0")).await;
    world.half_a_day_passes();
    let standby = world.process().await;
    let first = world.holder().await;
    leader.kill();
    secs(2).await;
    assert_eq!(world.holder().await, first, "nobody knows yet that it is dead");
    secs(5 * 60).await;
    let second = world.holder().await;
    assert!(second != first && !second.is_empty(), "{second}");
    assert_eq!(standby.signed(), 2);
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_leader_of_roll_outs_that_ends_as_asked_hands_over_at_once() {
    let world = World::new();
    let (leader, standby) = (world.process().await, world.process().await);
    let first = world.holder().await;
    leader.end().await;
    tokio::time::sleep(Duration::from_millis(500)).await;
    let second = world.holder().await;
    assert!(second != first && !second.is_empty(), "{second}");
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_bundle_that_the_disk_does_not_give_is_not_unlisted_and_is_there_again_without_a_start() {
    let world = World::new();
    let walk = files("walk", "1.0.0");
    let manifest = world.dir.path().join("ota/content").join(Digest::of_content(&walk[0].1).to_string());
    let process = world.process().await;
    release(&process.ota, &walk).await;
    secs(2).await;
    process.end().await;
    hide(&manifest);
    let process = world.process().await;
    secs(3).await;
    let known =
        |process: &Process| process.ota.opened().expect("keys").repository.newest().expect("shown").releases.len();
    assert_eq!(known(&process), 0, "nobody can read what it is");
    assert!(world.bundles().await[0].listed, "roll-outs of it would stand still as if it had been taken back");
    give_back(&manifest);
    secs(2).await;
    assert_eq!(known(&process), 1);
    process.end().await;
    // The twin: a file that is gone is gone.
    std::fs::remove_file(&manifest).expect("removed");
    let process = world.process().await;
    secs(3).await;
    assert!(!world.bundles().await[0].listed);
    process.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_process_that_takes_over_without_a_current_directive_key_says_so_and_goes_on_when_it_has_one() {
    let world = World::new();
    let set = key_set(1, &[15], 5);
    let all: Vec<_> = files("walk", "1.0.0").into_iter().chain([set]).collect();
    let leader = world.process().await;
    release(&leader.ota, &all).await;
    secs(2).await;
    let file = world.dir.path().join("keys/directive-2.pem");
    std::fs::remove_file(&file).expect("the next process was not given it");
    let next = world.process().await;
    let keyless = async |process: &Process| {
        process.face.ask_projection(|view, _, _| view.keyless.is_some()).await.expect("it runs")
    };
    assert!(!keyless(&leader).await);
    leader.end().await;
    secs(6).await;
    assert!(keyless(&next).await, "it leads and can sign nothing");
    let request = local(v1::ListBundlesRequest::default());
    let listed = Bundles::list_bundles(&next.ota, request).await.expect("listed").into_inner();
    assert_eq!(listed.keyless.map(|why| why.code), Some("NO_DIRECTIVE_KEY".to_owned()));
    key(15).write(&file).expect("a key");
    secs(2).await;
    assert!(!keyless(&next).await);
    next.end().await;
}

#[tokio::test(start_paused = true)]
async fn whoever_comes_back_after_its_place_in_the_log_went_reads_the_rows_and_goes_on() {
    let world = World::new();
    let process = world.process().await;
    release(&process.ota, &files("walk", "1.0.0")).await;
    secs(2).await;
    process.end().await;
    let mark = world.row::<OtaMark>("ota").await.expect("it has read something").0.seq;
    let mut fleet = Item::new(Writer::Fleet, "tests");
    fleet.create(&FleetMark { seq: mark }, "fleet.consumed");
    world.store.commit(vec![fleet]).await.remove(0).expect("applied");
    let floor = *world.store.wake().borrow();
    let keep = Retention { before_unix_ms: i64::MAX, entries_max: 0, floor };
    assert!(world.store.prune(keep).await.expect("pruned") > 0);
    let expired = world.store.feed(mark, &Log::ALL, 1).await;
    assert!(matches!(expired, Err(Error::CursorExpired { .. })), "{expired:?}");
    let process = world.process().await;
    let bundle = world.bundles().await[0].bundle.to_string();
    process.create("r-1", &bundle).await.expect("created");
    process.end().await;
}

/// A process that leads, one that follows it, and the bundle of a release that both know.
async fn with_a_release(world: &World) -> (Process, Process, String) {
    let leader = world.process().await;
    release(&leader.ota, &files("walk", "1.0.0")).await;
    secs(2).await;
    let standby = world.process().await;
    secs(2).await;
    let bundle = world.bundles().await[0].bundle.to_string();
    (leader, standby, bundle)
}

#[tokio::test(start_paused = true)]
async fn a_roll_out_that_is_created_at_both_processes_at_once_is_written_once_and_both_say_so() {
    let world = World::new();
    let (leader, standby, bundle) = with_a_release(&world).await;
    for n in 0..8 {
        let id = format!("r-{n}");
        let (first, second) = tokio::join!(leader.create(&id, &bundle), standby.create(&id, &bundle));
        let [first, second] = [first, second].map(|made| made.expect("created"));
        assert_eq!(first.etag, second.etag, "written once");
    }
    leader.end().await;
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_bundle_is_taken_back_once_for_a_request_id_whichever_process_is_asked_and_a_check_takes_nothing_back() {
    let world = World::new();
    let (leader, standby, bundle) = with_a_release(&world).await;
    let revoke = async |process: &Process, reason: &str, validate_only: bool| {
        let (bundle, reason, request_id) = (bundle.clone(), reason.to_owned(), "r-1".to_owned());
        let request = v1::RevokeBundleRequest { bundle, reason, request_id, validate_only };
        Face::revoke_bundle(&process.face, local(request)).await
    };
    for process in [&leader, &standby] {
        revoke(process, "it limps", true).await.expect("nothing is against it");
    }
    let (row, unread) = world.row::<Bundle>(&bundle).await.expect("a row");
    assert_eq!(row.revoked, None, "it was only asked whether it may be");
    revoke(&standby, "it limps", false).await.expect("taken back");
    let written = world.row::<Bundle>(&bundle).await.expect("a row").1;
    assert!(written > unread);
    for process in [&leader, &standby] {
        revoke(process, "it limps", false).await.expect("done already");
        let other = revoke(process, "it leaks", false).await.expect_err("the id is taken");
        assert_eq!(other.code(), tonic::Code::AlreadyExists);
    }
    assert_eq!(world.row::<Bundle>(&bundle).await.expect("a row").1, written, "written once");
    leader.end().await;
    standby.end().await;
}
