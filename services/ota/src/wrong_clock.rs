//! A server whose wall clock is far wrong for a minute, and what robots make of what it shows then and later.

use crate::content::Room;
use crate::fixture::{SEEDS, START, files, release, robot, targets, write_keys};
use crate::folder::Owner;
use crate::open_folder::OpenFolder;
use crate::repository::{Act, CannotSign, Error, FRESHEN_AFTER_MS};
use crate::{OtaService, Parts};
use midshift_bundle::trust::{self, Reading, Source, Trusted};
use midshift_core::time::{Clock, Utc};
use midshift_core::wall_clock::WallClock;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering::Relaxed};
use tempfile::TempDir;

const MINUTE_MS: u64 = 60_000;
const MONTH_MS: i64 = 30 * 24 * 3_600_000;

/// A server, and both clocks of its machine.
struct Site {
    us: Arc<AtomicU64>,
    ahead_ms: Arc<AtomicI64>,
    service: OtaService,
    _dir: TempDir,
}

impl Site {
    async fn new() -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let keys = dir.path().join("keys");
        write_keys(&keys);
        let (us, ahead_ms) = (Arc::<AtomicU64>::default(), Arc::new(AtomicI64::new(START.0)));
        let (mono, beside, ahead) = (us.clone(), us.clone(), ahead_ms.clone());
        let wall = move || Utc(ahead.load(Relaxed)).plus_ms(beside.load(Relaxed) / 1000);
        let clock: Arc<dyn Clock> = Arc::new(WallClock::new(move || mono.load(Relaxed), wall, |_| {}));
        let folder = dir.path().join("ota");
        let parts = Parts { folder, keys, room: Room::with_quota(1 << 30), clock, owner: Owner::Nobody };
        let service = OtaService::open(parts).await.expect("a service");
        Self { us, ahead_ms, service, _dir: dir }
    }
    fn opened(&self) -> &OpenFolder {
        self.service.opened().expect("keys")
    }
    /// Time passes, and the server looks.
    async fn pass(&self, ms: u64) {
        self.us.fetch_add(ms * 1000, Relaxed);
        self.opened().freshen_documents().await;
    }
    /// Somebody sets the wall.
    async fn set(&self, ms: i64) {
        self.ahead_ms.fetch_add(ms, Relaxed);
        self.opened().freshen_documents().await;
    }
    fn version(&self) -> u64 {
        self.opened().repository.newest().expect("published").stamp.version
    }
    /// What a robot believes once it was told the time by an echo, as far as the server stands by it, and asked; its clock is set, or not.
    async fn shown_to(&self, robot: &Trusted, clock: Reading) -> Result<Trusted, trust::Error> {
        let own = &self.opened().clock;
        let told = if own.doubt().is_some() { None } else { robot.raise_time_floor(own.now().wall) };
        let source = Arc::new(Shown(self.service.clone()));
        told.as_ref().unwrap_or(robot).refresh(source, clock).await.map(|refreshed| refreshed.trusted)
    }
    /// A release beside the first.
    async fn publish(&self, first: &[u8], version: &str, expected: u64) -> Result<Vec<u8>, Error> {
        let document = self.bring(first, version).await?;
        let act = Act::of_release(self.opened().now());
        self.opened().repository.publish(Vec::new(), document.clone(), expected, act).await.map(|_| document)
    }
    /// Brings the files of a release beside the first, and gives the document that lists them.
    async fn bring(&self, first: &[u8], version: &str) -> Result<Vec<u8>, Error> {
        let (opened, more) = (self.opened(), files("walk", version));
        for (_, content) in &more {
            let digest = midshift_bundle::digest::Digest::of_content(content);
            let file = crate::content::FileRef { digest, length: content.len() as u64 };
            if opened.content.length(digest).await?.is_none() {
                opened.content.append(file, 0, bytes::Bytes::copy_from_slice(content)).await?;
                opened.content.settle(file).await?;
            }
        }
        Ok(targets(Some(first), &more, SEEDS.targets))
    }
}

struct Shown(OtaService);

impl std::fmt::Debug for Shown {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Shown")
    }
}

#[async_trait::async_trait]
impl Source for Shown {
    async fn fetch(&self, name: &str) -> std::io::Result<Option<Vec<u8>>> {
        let opened = self.0.opened().map_err(std::io::Error::other)?;
        opened.repository.document(name).await.map_err(std::io::Error::other)
    }
}

#[tokio::test]
async fn a_wall_that_was_thirty_days_ahead_for_a_minute_stops_no_update_afterwards() {
    let site = Site::new().await;
    let first = files("walk", "1.0.0");
    release(&site.service, &first).await;
    let first = targets(None, &first, SEEDS.targets);
    let (set, unset) = (|at| Reading { utc: at, is_synced: true }, Reading { utc: Utc(0), is_synced: false });
    let new = robot();
    let mut robots =
        [site.shown_to(&new, set(START)).await.expect("believed"), site.shown_to(&new, unset).await.expect("believed")];

    site.set(MONTH_MS).await;
    assert_eq!(site.version(), 1, "it was due by that wall, and nothing was signed");
    let error = site.publish(&first, "1.1.0", 1).await.expect_err("nor is a release");
    assert!(matches!(error, Error::Clock(doubt) if doubt.step_ms == MONTH_MS), "{error}");
    assert_eq!(site.opened().repository.directive_key().err(), Some(CannotSign::Clock));
    let naive = robots[1].raise_time_floor(site.opened().now()).expect("one that goes by any echo");
    site.pass(MINUTE_MS).await;
    let later = START.plus_ms(MINUTE_MS);
    for (robot, clock) in robots.iter_mut().zip([set(later), unset]) {
        *robot = site.shown_to(robot, clock).await.expect("it takes software meanwhile");
    }

    site.set(-MONTH_MS).await;
    assert!(site.opened().repository.directive_key().is_ok(), "orders are signed at once");
    site.publish(&first, "1.1.0", 1).await.expect("and releases");
    for (robot, clock) in robots.iter_mut().zip([set(later), unset]) {
        *robot = site.shown_to(robot, clock).await.expect("it takes software");
        assert!(robot.time_floor() <= later, "{}", robot.time_floor().rfc3339());
    }
    let error = site.shown_to(&naive, unset).await.expect_err("it waits for two days");
    assert!(matches!(error, trust::Error::Expired { .. }), "{error}");
    site.pass(FRESHEN_AFTER_MS).await;
    assert_eq!(site.version(), 3);
    for robot in &robots {
        let clock = set(later.plus_ms(FRESHEN_AFTER_MS));
        site.shown_to(robot, clock).await.expect("it takes software half a day later");
    }
}

#[tokio::test]
async fn what_began_while_the_wall_was_wrong_is_signed_by_the_time_at_which_it_is_signed() {
    let site = Site::new().await;
    let first = files("walk", "1.0.0");
    release(&site.service, &first).await;
    let document = site.bring(&targets(None, &first, SEEDS.targets), "1.1.0").await.expect("room");
    let repository = &site.opened().repository;
    site.set(MONTH_MS).await;
    let asked = site.opened().now();
    assert_eq!(asked, Utc(START.0 + MONTH_MS));
    site.set(-MONTH_MS).await;
    let newest = repository.publish(Vec::new(), document, 1, Act::of_release(asked)).await.expect("signed");
    assert_eq!((newest.stamp.version, newest.stamp.issued), (2, START));
    assert!(newest.releases.iter().all(|release| release.seen == START), "{:?}", newest.releases);
    repository.freshen(asked).await.expect("signed");
    let newest = repository.newest().expect("published");
    assert_eq!((newest.stamp.version, newest.stamp.issued), (3, START), "it was due by that wall");
}

#[tokio::test]
async fn what_a_person_says_of_a_wall_in_doubt_is_signed_by() {
    let site = Site::new().await;
    release(&site.service, &files("walk", "1.0.0")).await;
    site.set(MONTH_MS).await;
    assert_eq!(site.version(), 1);
    site.opened().clock.accept_wall();
    site.pass(MINUTE_MS).await;
    assert_eq!(site.version(), 2);
    assert!(site.opened().repository.directive_key().is_ok());
}
