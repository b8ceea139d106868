//! The service: opens the folder of a server, answers from it, and keeps it fresh until shutdown.

use crate::collect::Collector;
use crate::content::{Content, DiskContent, Room, Sharing};
use crate::downloads::{Downloads, add_bundles, add_chunks};
use crate::folder::{self, FolderLock, Gate, Owner};
use crate::http1;
use crate::open_folder::OpenFolder;
use crate::repository::{Error, OnlineKeys, Repository};
use crate::threads::blocking;
use midshift_core::Boxed;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::time::Clock;
use midshift_store::Store;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;

/// How often the age of what was signed is looked at. By the wall, which may jump: so not once in half a day.
const LOOK_EVERY: Duration = Duration::from_secs(60);

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

/// The service. Cheap to clone.
#[derive(Clone)]
pub struct OtaService {
    /// None: the server was given no keys, and every call says so.
    opened: Option<Arc<OpenFolder>>,
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
        let lock = FolderLock::acquire(&folder, &owner).await?;
        let sharing = lock.as_ref().filter(|_| matches!(owner, Owner::Shared { .. }));
        let sharing = sharing.map(|lock| (lock.number, lock.is_first));
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
        if let Some(lock) = &lock {
            lock.let_in().await?;
        }
        let metadata = folder.join("metadata");
        let repository = if sharing.is_some() {
            Repository::join(&metadata, keys, content.clone(), folder.join(folder::METADATA)).await?
        } else {
            Repository::open(&metadata, keys, content.clone()).await?
        };
        let repository = repository.with_clock(clock.clone());
        let downloads = Downloads::new(content.clone(), repository.documents().clone());
        let (named, leads) = (watch::Sender::new(None), watch::Sender::new(true));
        let opened = OpenFolder { content, repository, collector, named, leads, clock, downloads, lock };
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
        add_chunks(self.downloads(), routes)
    }
    /// `/metadata/…` and `/targets/…` over plain HTTP, for clients of TUF that are not ours.
    pub fn pages(&self) -> axum::Router {
        http1::router(self.downloads())
    }
    pub(crate) fn downloads(&self) -> Downloads {
        let downloads = self.opened.as_ref().map(|opened| opened.downloads.clone()).unwrap_or_default();
        downloads.with_rows(self.rows.clone())
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
            opened.freshen_documents().await;
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(LOOK_EVERY) => {}
                // What was due while nobody led is done at once.
                Ok(()) = leads.changed() => {}
            }
        }
    }
    /// This process signs and takes away, or does not any more: another one on the same store does.
    pub(crate) fn lead(&self, leads: bool) {
        if let Some(opened) = &self.opened {
            opened.leads.send_if_modified(|known| std::mem::replace(known, leads) != leads);
        }
    }
    pub(crate) fn opened(&self) -> Result<&OpenFolder, Refusal> {
        self.opened.as_deref().ok_or_else(|| Refusal::new(Kind::Precondition, Code::NoOnlineKeys))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::content::FileRef;
    use crate::fixture::{START, files, release, service, write_keys};
    use crate::repository::FRESHEN_AFTER_MS;
    use crate::rollouts;
    use midshift_core::limits;
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
            room: Room::with_quota(1 << 20),
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
        let room = Room { unnamed_ms, ..Room::with_quota(1 << 20) };
        let parts = Parts { folder: dir.path().join("ota"), keys, room, clock: clock.clone(), owner: Owner::Nobody };
        let service = OtaService::open(parts).await.expect("a service");
        let walk = files("walk", "1.0.0");
        release(&service, &walk).await;
        let opened = service.opened().expect("keys");
        let stray = midshift_bundle::digest::Digest::of_content(b"stray");
        opened.content.append(FileRef { digest: stray, length: 5 }, 0, "stray".into()).await.expect("room");
        opened.content.settle(FileRef { digest: stray, length: 5 }).await.expect("whole");
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
            let digest = midshift_bundle::digest::Digest::of_content(content);
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
        let file = FileRef { digest: midshift_bundle::digest::Digest::of_content(stray), length: stray.len() as u64 };
        opened.content.append(file, 0, bytes::Bytes::from_static(stray)).await.expect("room");
        opened.content.settle(file).await.expect("whole");
        let refusal = opened.downloads.listed(file.digest).await.expect_err("nobody signed it");
        assert_eq!(refusal.reason.code, Code::SoftwareNotFound);
    }
}
