//! Software of robots on the server: keeps files of signed releases, says which release is the newest, hands out metadata and bytes.
//!
//! Called by the binary: [`OtaService::open`], its two gRPC faces, its pages over HTTP/1.1 and [`OtaService::run`]; and [`OtaReader`] where only
//! bytes are handed out. Several processes may share one folder. Invariant: nothing is signed here that says what software is good; only files
//! that the newest signed release lists are handed out; none of those is ever taken away.

mod collect;
pub mod content;
#[cfg(test)]
#[path = "../../../tests/src/counted.rs"]
mod counted;
mod disk;
#[cfg(test)]
mod fixture;
pub mod folder;
mod grpc;
mod hatch;
mod http1;
mod integrity;
#[cfg(test)]
#[expect(dead_code, reason = "shared with tests that need tasks too")]
#[path = "../../../tests/src/old_site.rs"]
mod old_site;
mod pages;
mod refusal;
pub mod repository;
mod retention;
pub mod rollouts;
#[cfg(test)]
#[path = "together/tests.rs"]
mod together;
#[cfg(test)]
mod wrong_clock;

pub use retention::prune;

use collect::{Collector, Named};
use content::{Content, DiskContent, Room, Sharing};
use folder::{Gate, Owner, Presence};
use hatch::Hatch;
use midshift_core::Boxed;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::time::{Clock, Utc};
use midshift_proto::ota::v1::bundle_service_server::{BundleService, BundleServiceServer};
use midshift_proto::ota::v1::chunk_service_server::ChunkServiceServer;
use midshift_store::{Store, StoreId};
use repository::{Documents, Error, OnlineKeys, Repository};
use std::panic::resume_unwind;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::runtime::RuntimeFlavor;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// How often the age of what was signed is looked at. By the wall, which may jump: so not once in half a day.
const LOOK_EVERY: Duration = Duration::from_secs(60);
/// People hear this long before that a document of theirs ends.
const WARN_BEFORE_MS: u64 = 60 * 24 * 3_600_000;
/// Longest message of the service: all documents of a publication.
const MESSAGE_BYTES: usize = 2 * midshift_bundle::trust::METADATA_BYTES_MAX as usize;

/// What the service is built from.
pub struct Parts {
    /// Where files and documents are kept; made if it is not there.
    pub folder: PathBuf,
    /// Keys of snapshot and timestamp, as `bundle keygen` makes them.
    pub keys: PathBuf,
    /// How much room files have, and how long.
    pub room: Room,
    /// Clocks. Documents are dated by the wall.
    pub clock: Arc<dyn Clock>,
    /// Whose the folder is, and who else works in it.
    pub owner: Owner,
}

struct Opened {
    content: Arc<dyn Content>,
    repository: Repository,
    collector: Collector,
    /// What the planner said last of what is needed. None: it said nothing since the start.
    named: watch::Sender<Option<Named>>,
    /// Whether this process keeps what was signed fresh: where several processes serve one folder, the one that plans does.
    leads: watch::Sender<bool>,
    clock: Arc<dyn Clock>,
    hatch: Hatch,
    /// Ends with the service.
    presence: Option<Presence>,
}

/// The service. Cheap to clone.
#[derive(Clone)]
pub struct OtaService {
    /// None: the server was given no keys, and every call says so.
    opened: Option<Arc<Opened>>,
    /// Rows that say who is enrolled. None: nobody is held against them.
    rows: Option<Arc<dyn Store>>,
}

impl OtaService {
    /// Opens what is kept.
    ///
    /// # Errors
    /// If the folder is another store's, or another process works in it that wants to be alone; if keys, files or documents cannot be read,
    /// or documents do not hang together.
    pub fn open(parts: Parts) -> Boxed<'static, Result<Self, Error>> {
        Box::pin(Self::opening(parts))
    }
    async fn opening(Parts { folder, keys, room, clock, owner }: Parts) -> Result<Self, Error> {
        let keys = blocking(move || OnlineKeys::read(&keys)).await?;
        let presence = Presence::come(&folder, &owner).await?;
        let sharing = presence.as_ref().filter(|_| matches!(owner, Owner::Shared { .. }));
        let sharing = sharing.map(|presence| (presence.number, presence.is_first));
        let of = folder.clone();
        let (content, collector) = blocking(move || {
            if sharing.is_none_or(|(_, is_first)| is_first) {
                folder::remove_encoded(&of);
            }
            let files = of.join("content");
            let collector = Collector::open(&of, room)?;
            let Some((number, is_first)) = sharing else {
                let content: Arc<dyn Content> = Arc::new(DiskContent::open(&files, room)?);
                return Ok((content, collector));
            };
            let gate = Gate::new(Some(of.join(folder::CONTENT)));
            let sharing = Sharing { gate, number, is_first };
            let content: Arc<dyn Content> = Arc::new(DiskContent::join(&files, room, sharing)?);
            Ok::<_, Error>((content, collector))
        })
        .await?;
        if let Some(presence) = &presence {
            presence.let_in().await?;
        }
        let metadata = folder.join("metadata");
        let repository = if sharing.is_some() {
            Repository::join(&metadata, keys, content.clone(), folder.join(folder::METADATA)).await?
        } else {
            Repository::open(&metadata, keys, content.clone()).await?
        };
        let repository = repository.with_clock(clock.clone());
        let hatch = Hatch::new(content.clone(), repository.documents().clone());
        let (named, leads) = (watch::Sender::new(None), watch::Sender::new(true));
        let opened = Opened { content, repository, collector, named, leads, clock, hatch, presence };
        Ok(Self { opened: Some(Arc::new(opened)), rows: None })
    }
    /// A service of a server without keys: it touches no disk and answers every call with what to do.
    pub fn without_keys() -> Self {
        Self { opened: None, rows: None }
    }
    /// The same, which gives bytes to machines alone that these rows know as robots.
    #[must_use]
    pub fn with_rows(self, rows: Arc<dyn Store>) -> Self {
        Self { rows: Some(rows), ..self }
    }
    /// With releases, for people and programs.
    pub fn add_bundles_to(&self, routes: Routes) -> Routes {
        add_bundles(self.clone(), routes)
    }
    /// With bytes, for robots.
    pub fn add_chunks_to(&self, routes: Routes) -> Routes {
        add_chunks(self.hatch(), routes)
    }
    /// `/metadata/…` and `/targets/…` over plain HTTP, for clients of TUF that are not ours.
    pub fn pages(&self) -> axum::Router {
        http1::router(self.hatch())
    }
    fn hatch(&self) -> Hatch {
        let hatch = self.opened.as_ref().map(|opened| opened.hatch.clone()).unwrap_or_default();
        hatch.with_rows(self.rows.clone())
    }
    /// Keeps what was signed fresh, and takes away what nobody needs, until shutdown.
    pub fn run(self, shutdown: CancellationToken) -> Boxed<'static, ()> {
        Box::pin(async move {
            let collecting = async {
                if let Some(opened) = &self.opened {
                    opened.keep_room(&shutdown).await;
                }
            };
            let following = async {
                if let Some(opened) = &self.opened {
                    opened.follow(&shutdown).await;
                }
            };
            tokio::join!(self.keep_fresh(&shutdown), collecting, following);
        })
    }
    async fn keep_fresh(&self, shutdown: &CancellationToken) {
        let Some(opened) = &self.opened else { return shutdown.cancelled().await };
        let mut leads = opened.leads.subscribe();
        loop {
            opened.look().await;
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(LOOK_EVERY) => {}
                // What was due while nobody led is done at once.
                Ok(()) = leads.changed() => {}
            }
        }
    }
    /// This process signs and takes away, or does not any more: another one on the same store does.
    fn lead(&self, leads: bool) {
        if let Some(opened) = &self.opened {
            opened.leads.send_if_modified(|known| std::mem::replace(known, leads) != leads);
        }
    }
    fn opened(&self) -> Result<&Opened, Refusal> {
        self.opened.as_deref().ok_or_else(|| Refusal::new(Kind::Precondition, Code::NoOnlineKeys))
    }
}

/// What a process has of the folder that others keep: it hands out bytes and documents, signs nothing and writes nothing. Cheap to clone.
#[derive(Clone)]
pub struct OtaReader {
    hatch: Hatch,
    documents: Documents,
}

impl OtaReader {
    /// Opens the folder of a store that its processes with role ota keep.
    ///
    /// # Errors
    /// If it is not there, does not say that it is this store's, or documents do not hang together.
    pub fn open(folder: PathBuf, store_id: StoreId) -> Boxed<'static, Result<Self, Error>> {
        Box::pin(async move {
            let of = folder.clone();
            blocking(move || folder::must_be_of(&of, &store_id)).await?;
            let content: Arc<dyn Content> = Arc::new(DiskContent::reading(&folder.join("content")));
            let documents = Documents::reading(&folder.join("metadata"), content.clone()).await?;
            Ok(Self { hatch: Hatch::new(content, documents.clone()), documents })
        })
    }
    /// The same, which gives bytes to machines alone that these rows know as robots.
    #[must_use]
    pub fn with_rows(self, rows: Arc<dyn Store>) -> Self {
        Self { hatch: self.hatch.with_rows(Some(rows)), ..self }
    }
    /// With bytes and documents, for robots: nothing else of releases is answered here.
    pub fn add_to(&self, routes: Routes) -> Routes {
        add_bundles(self.hatch.clone(), add_chunks(self.hatch.clone(), routes))
    }
    /// `/metadata/…` and `/targets/…` over plain HTTP, for clients of TUF that are not ours.
    pub fn pages(&self) -> axum::Router {
        http1::router(self.hatch.clone())
    }
    /// Learns what others publish until shutdown.
    pub fn run(self, shutdown: CancellationToken) -> Boxed<'static, ()> {
        Box::pin(async move { every_second(&shutdown, || self.documents.follow_if_possible()).await })
    }
}

fn add_bundles(face: impl BundleService, routes: Routes) -> Routes {
    let face = BundleServiceServer::new(face).accept_compressed(CompressionEncoding::Gzip);
    routes.add_service(face.max_decoding_message_size(MESSAGE_BYTES))
}

fn add_chunks(hatch: Hatch, routes: Routes) -> Routes {
    let face = ChunkServiceServer::new(hatch).accept_compressed(CompressionEncoding::Gzip);
    routes.add_service(face.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
}

/// Follows what other processes publish.
async fn every_second<F: Future<Output = ()>>(shutdown: &CancellationToken, follow: impl Fn() -> F) {
    loop {
        follow().await;
        tokio::select! {
            () = shutdown.cancelled() => return,
            () = tokio::time::sleep(Duration::from_millis(limits::SOFTWARE_FOLLOW_EVERY_MS)) => {}
        }
    }
}

impl Opened {
    fn is_shared(&self) -> bool {
        self.presence.as_ref().is_some_and(Presence::is_shared)
    }

    /// Tries files and keys again that could not be read, and learns what other processes publish.
    async fn follow(&self, shutdown: &CancellationToken) {
        every_second(shutdown, || async {
            self.repository.documents().follow_if_possible().await;
            // Said before this process has to sign.
            let _known = self.repository.find_directive_key().await;
        })
        .await;
    }

    fn now(&self) -> Utc {
        self.clock.now().wall
    }

    /// One pass each time the planner says what is named.
    async fn keep_room(&self, shutdown: &CancellationToken) {
        let mut said = self.named.subscribe();
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return,
                changed = said.changed() => if changed.is_err() { return },
            }
            let named = said.borrow_and_update().clone();
            if let Some(named) = named {
                self.collect(&named).await;
            }
        }
    }

    async fn collect(&self, named: &Named) {
        if !*self.leads.borrow() {
            return;
        }
        let at = self.now();
        match self.collector.collect(self.content.as_ref(), &self.repository, named, at).await {
            Ok(collected) => collected.tell(at),
            Err(error) => tracing::error!(%error, "nobody knows which software is needed, so all of it is kept"),
        }
    }

    async fn look(&self) {
        let now = self.now();
        if self.is_shared()
            && let Err(error) = self.content.list().await
        {
            tracing::error!(%error, "nobody knows how full the folder of releases is");
        }
        let fill = self.content.fill();
        metrics::gauge!("midshift_ota_used_bytes").set(fill.used_bytes as f64);
        metrics::gauge!("midshift_ota_quota_bytes").set(fill.quota_bytes as f64);
        let before = self.repository.newest().map(|newest| newest.stamp);
        if *self.leads.borrow()
            && let Err(error) = self.repository.freshen(now).await
        {
            tracing::error!(%error, "freshness could not be signed: robots take no new software once it has expired");
        }
        let Some(newest) = self.repository.newest() else { return };
        let ends = [
            ("root", newest.root.edition.expires),
            ("targets", newest.targets.edition.expires),
            ("timestamp", newest.stamp.expires),
        ];
        for (role, expires) in ends {
            let left_ms = expires.ms_since(now);
            metrics::gauge!("midshift_ota_expires_in_seconds", "role" => role).set((left_ms / 1_000) as f64);
            // Once for each signature, so twice a day.
            if role != "timestamp" && left_ms < WARN_BEFORE_MS && before != Some(newest.stamp) {
                tracing::warn!(
                    role,
                    expires = expires.rfc3339(),
                    "a signed document ends soon: sign it anew and push it"
                );
            }
        }
    }
}

/// Does what blocks away from the threads that serve. A runtime of one thread is a simulation's or a test's: there it is done in place,
/// so that the order of everything follows from what was asked and not from how fast a disk was.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    if is_of_one_thread() {
        return work();
    }
    match tokio::task::spawn_blocking(work).await.map_err(tokio::task::JoinError::try_into_panic) {
        Ok(done) => done,
        Err(Ok(panic)) => resume_unwind(panic),
        // The process ends: whoever waits ends with it.
        Err(Err(_)) => std::future::pending().await,
    }
}

fn is_of_one_thread() -> bool {
    tokio::runtime::Handle::current().runtime_flavor() == RuntimeFlavor::CurrentThread
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::content::Wanted;
    use crate::fixture::{START, files, release, service, write_keys};
    use crate::repository::FRESHEN_AFTER_MS;
    use midshift_core::time::ScaledClock;
    use tokio::time::Instant;

    #[tokio::test(start_paused = true)]
    async fn what_was_signed_is_signed_anew_before_it_ends_and_the_service_ends_when_asked() {
        let dir = tempfile::tempdir().expect("a folder");
        let keys = dir.path().join("keys");
        write_keys(&keys);
        let begun = Instant::now();
        let clock = ScaledClock::new(move || begun.elapsed().as_micros() as u64, START, 1000);
        let parts = Parts {
            folder: dir.path().join("ota"),
            keys,
            room: Room::of(1 << 20),
            clock: Arc::new(clock),
            owner: Owner::Nobody,
        };
        let service = OtaService::open(parts).await.expect("a service");
        release(&service, &files("walk", "1.0.0")).await;
        let shutdown = CancellationToken::new();
        let running = tokio::spawn(service.clone().run(shutdown.clone()));
        let newest = || service.opened().expect("keys").repository.newest().expect("published").stamp;
        tokio::time::sleep(Duration::from_millis(FRESHEN_AFTER_MS - 1_000)).await;
        assert_eq!(newest().version, 1);
        while newest().version == 1 {
            tokio::time::sleep(LOOK_EVERY).await;
        }
        let late_ms = newest().issued.ms_since(START) - FRESHEN_AFTER_MS;
        assert!(late_ms <= 2 * LOOK_EVERY.as_millis() as u64, "{late_ms} ms");
        shutdown.cancel();
        running.await.expect("it ends");
    }

    #[tokio::test(start_paused = true)]
    async fn what_nobody_published_goes_while_the_server_serves_and_its_release_stays() {
        let dir = tempfile::tempdir().expect("a folder");
        let keys = dir.path().join("keys");
        write_keys(&keys);
        let begun = Instant::now();
        let clock = ScaledClock::new(move || begun.elapsed().as_micros() as u64, START, 1000);
        let clock: Arc<dyn Clock> = Arc::new(clock);
        let unnamed_ms = 2 * limits::COLLECT_EVERY_MS;
        let room = Room { unnamed_ms, ..Room::of(1 << 20) };
        let parts = Parts { folder: dir.path().join("ota"), keys, room, clock: clock.clone(), owner: Owner::Nobody };
        let service = OtaService::open(parts).await.expect("a service");
        let walk = files("walk", "1.0.0");
        release(&service, &walk).await;
        let opened = service.opened().expect("keys");
        let stray = midshift_bundle::digest::Digest::of(b"stray");
        opened.content.append(Wanted { digest: stray, length: 5 }, 0, "stray".into()).await.expect("room");
        opened.content.settle(Wanted { digest: stray, length: 5 }).await.expect("whole");
        let site = Arc::new(midshift_core::site::text::parse(midshift_core::site::DEMO).expect("the demo reads"));
        let store_id = midshift_store::StoreId(Arc::from("store"));
        let store = midshift_store::MemoryStore::new(site.site_id().clone(), store_id, clock.clone());
        let shutdown = CancellationToken::new();
        let parts = rollouts::Parts {
            store: Arc::new(store),
            board: midshift_store::LiveBoard::new(),
            site,
            clock,
            ota: service.clone(),
            bugs: midshift_core::rollout::bugs::Bugs::default(),
        };
        let (_face, planner) = rollouts::RolloutService::new(parts, shutdown.clone());
        let running = tokio::spawn(service.clone().run(shutdown.clone()));
        let planning = tokio::spawn(planner.run(shutdown.clone()));
        while opened.content.length(stray).await.expect("asked").is_some() {
            tokio::time::sleep(LOOK_EVERY).await;
        }
        let took_ms = begun.elapsed().as_millis() as u64;
        // Seen unnamed at the first pass, or the second that saw it touched, and gone at a pass after its time.
        let passes = limits::COLLECT_EVERY_MS + unnamed_ms;
        assert!((passes..passes + 2 * limits::COLLECT_EVERY_MS).contains(&took_ms), "{took_ms} ms");
        for (name, content) in &walk {
            let digest = midshift_bundle::digest::Digest::of(content);
            assert!(opened.content.length(digest).await.expect("asked").is_some(), "{name}");
        }
        shutdown.cancel();
        running.await.expect("it ends");
        planning.await.expect("it ends").expect("without a fault");
    }

    #[tokio::test]
    async fn a_file_that_nobody_signed_is_not_handed_out() {
        let dir = tempfile::tempdir().expect("a folder");
        let service = service(&dir).await;
        let stray = b"brought and never signed";
        let opened = service.opened().expect("keys");
        let file = Wanted { digest: midshift_bundle::digest::Digest::of(stray), length: stray.len() as u64 };
        opened.content.append(file, 0, bytes::Bytes::from_static(stray)).await.expect("room");
        opened.content.settle(file).await.expect("whole");
        let refusal = opened.hatch.listed(file.digest).await.expect_err("nobody signed it");
        assert_eq!(refusal.reason.code, Code::SoftwareNotFound);
    }
}
