//! What a server with keys has open, and what it does by itself: follows the folder, signs anew in time, takes away what nobody needs.

use crate::collect::{Collector, NamedBundles};
use crate::content::Content;
use crate::downloads::Downloads;
use crate::folder::FolderLock;
use crate::repository::{Repository, every_second};
use midshift_core::time::{Clock, Utc};
use std::sync::Arc;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// People hear this long before that a document of theirs ends.
const WARN_BEFORE_MS: u64 = 60 * 24 * 3_600_000;

/// The folder of releases as a server with keys has it open.
pub(crate) struct OpenFolder {
    pub(crate) content: Arc<dyn Content>,
    pub(crate) repository: Repository,
    pub(crate) collector: Collector,
    /// What the planner said last of what is needed. None: it said nothing since the start.
    pub(crate) named: watch::Sender<Option<NamedBundles>>,
    /// Whether this process keeps what was signed fresh: where several processes serve one folder, the one that plans does.
    pub(crate) leads: watch::Sender<bool>,
    pub(crate) clock: Arc<dyn Clock>,
    pub(crate) downloads: Downloads,
    /// Ends with the service.
    pub(crate) lock: Option<FolderLock>,
}

impl OpenFolder {
    fn is_shared(&self) -> bool {
        self.lock.as_ref().is_some_and(FolderLock::is_shared)
    }

    /// Tries files and keys again that could not be read, and learns what other processes publish.
    pub(crate) async fn follow(&self, shutdown: &CancellationToken) {
        every_second(shutdown, || async {
            self.repository.documents().follow_if_possible().await;
            // Said before this process has to sign.
            let _known = self.repository.find_directive_key().await;
        })
        .await;
    }

    /// Time of the wall, UTC.
    pub(crate) fn now(&self) -> Utc {
        self.clock.now().wall
    }

    /// One pass each time the planner says what is named.
    pub(crate) async fn keep_room(&self, shutdown: &CancellationToken) {
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

    async fn collect(&self, named: &NamedBundles) {
        if !*self.leads.borrow() {
            return;
        }
        let at = self.now();
        match self.collector.collect(self.content.as_ref(), &self.repository, named, at).await {
            Ok(collected) => collected.report_pass(at),
            Err(error) => tracing::error!(%error, "nobody knows which software is needed, so all of it is kept"),
        }
    }

    /// Signs what is due, and says how full it is and when documents end.
    pub(crate) async fn freshen_documents(&self) {
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
