//! Housekeeping of every process: prunes old rows, entries and frames of its roles, tends the chains of the audit,
//! folds samples of histograms.
//!
//! Which of it goes when is in [`midshift_core::privacy::RETENTION_RULES`]. Called by [`crate::server`]. Invariant: nothing goes
//! that a service has not consumed, unless it has not been there for a month.

mod oldest;

use crate::components::Components;
use metrics_exporter_prometheus::PrometheusHandle;
use midshift_cli::roles::Role;
use midshift_core::fleet::rows::FleetMark;
use midshift_core::limits;
use midshift_core::privacy::Retention;
use midshift_core::rollout::rows::OtaMark;
use midshift_core::rows::{Log, Seq, Writer};
use midshift_core::time::{Clock, Utc};
use midshift_identity::audit::upkeep as audit;
use midshift_process::recorder;
use midshift_store::{Error, FrameLog, Retention as EntriesKept, Store};
use midshift_task::TaskService;
use midshift_telemetry::precision;
use std::time::Duration;

/// How often old log entries are taken away.
const PRUNE_EVERY: Duration = Duration::from_secs(60);
/// How often samples of histograms are folded: without a scrape they would gather for ever.
const FOLD_EVERY: Duration = Duration::from_secs(5);

/// Until it is dropped.
pub async fn run(parts: &Components, task: Option<TaskService>) {
    tokio::join!(prune(parts, task), fold(recorder::handle()), keep_audit(parts));
}

/// Folds samples of histograms, whether or not anybody scrapes.
async fn fold(metrics: Option<PrometheusHandle>) {
    loop {
        tokio::time::sleep(FOLD_EVERY).await;
        if let Some(metrics) = &metrics {
            metrics.run_upkeep();
        }
    }
}

/// Takes old rows, entries and frames away, entries never past what fleet and roll-outs have not consumed, and tells
/// how old the rest is.
async fn prune(parts: &Components, task: Option<TaskService>) {
    let (store, frames, clock) = (parts.store.as_ref(), parts.frames.as_ref(), parts.clock.as_ref());
    loop {
        tokio::time::sleep(PRUNE_EVERY).await;
        let turn = Turn { store, frames, clock, task: task.as_ref(), log_entries_max: parts.keep.log_entries };
        turn.prune_all(|role| parts.roles.has(role)).await;
        if let Err(error) = oldest::publish_ages(store, frames, clock).await {
            tracing::warn!(%error, "how old the oldest rows are cannot be read");
        }
    }
}

/// One turn over everything that goes by age.
pub struct Turn<'t> {
    /// Rows and entries.
    pub store: &'t dyn Store,
    /// The log of STATUS samples.
    pub frames: &'t dyn FrameLog,
    /// The clock that ages are held against.
    pub clock: &'t dyn Clock,
    /// Intake of tasks, in a process that has it.
    pub task: Option<&'t TaskService>,
    /// Entries of each log that are kept at most.
    pub log_entries_max: u64,
}

impl Turn<'_> {
    /// Takes away what the services of this process keep too long. What fails is told, and done another time.
    pub async fn prune_all(&self, has: impl Fn(Role) -> bool) {
        let (store, frames, clock) = (self.store, self.frames, self.clock);
        if let Some(task) = self.task
            && let Err(error) = task.prune().await
        {
            tracing::warn!(%error, "old requests could not be taken away");
        }
        if has(Role::Fleet) {
            if let Err(error) = midshift_fleet::prune(store, clock).await {
                tracing::warn!(%error, "tasks that ended long ago could not be taken away");
            }
            if let Err(error) = prune_entries(store, clock, self.log_entries_max).await {
                tracing::warn!(%error, "old log entries could not be taken away");
            }
        }
        if has(Role::Ota)
            && let Err(error) = midshift_ota::prune(store, clock).await
        {
            tracing::warn!(%error, "what is past its time about software could not be taken away");
        }
        if has(Role::Identity)
            && let Err(error) = midshift_identity::prune(store, clock).await
        {
            tracing::warn!(%error, "what is past its time about tokens and identities could not be taken away");
        }
        if has(Role::Telemetry) {
            if let Err(error) = midshift_telemetry::prune(store, frames, clock).await {
                tracing::warn!(%error, "rows of rings and robots that are gone could not be taken away");
            }
            match frames.prune().await {
                Ok(bytes) => metrics::counter!("midshift_telemetry_pruned_bytes_total").increment(bytes),
                Err(error) => tracing::warn!(%error, "old status could not be taken away"),
            }
            match frames.coarsen(precision::coarsen).await {
                Ok(rows) => metrics::counter!("midshift_telemetry_coarsened_total").increment(rows),
                Err(error) => tracing::warn!(%error, "old positions could not be made coarser"),
            }
        }
    }
}

/// Lets the chains of this process' services quote the others each hour, and end where they are old.
async fn keep_audit(parts: &Components) {
    let of_roles = [
        (Role::Task, Writer::Task),
        (Role::Fleet, Writer::Fleet),
        (Role::Ota, Writer::Ota),
        (Role::Identity, Writer::Identity),
    ];
    let of_roles = of_roles.into_iter().filter(|(role, _)| parts.roles.has(*role)).map(|(_, writer)| writer);
    let writers: Vec<Writer> = of_roles.chain(parts.stops.is_some().then_some(Writer::Stop)).collect();
    loop {
        for writer in &writers {
            if let Err(error) = audit::maintain_chain(parts.store.as_ref(), parts.clock.as_ref(), *writer).await {
                tracing::warn!(%error, chain = writer.as_str(), "a chain of the audit was not looked after");
            }
        }
        tokio::time::sleep(PRUNE_EVERY).await;
    }
}

async fn prune_entries(store: &dyn Store, clock: &dyn Clock, entries_max: u64) -> Result<(), Error> {
    // Until fleet has consumed something nothing may go.
    let Some((fleet, _)) = midshift_store::load::<FleetMark>(store, "fleet").await? else { return Ok(()) };
    let wall = clock.now().steady_wall();
    let Some(before) = Retention::Week.before(wall) else { return Ok(()) };
    let floor = match midshift_store::load::<OtaMark>(store, "ota").await? {
        Some((ota, _)) if !is_abandoned(store, ota.seq, wall).await? => fleet.seq.min(ota.seq),
        _ => fleet.seq,
    };
    let keep = EntriesKept { before_unix_ms: before.0, entries_max, floor };
    store.prune(keep).await.map(drop)
}

/// Whether whoever moved this mark is gone, or will not read on from it: the first entry behind it is older than
/// anything about what is gone is kept, or gone itself. A process of roll-outs that comes back reads the rows, and the
/// log from its oldest entry on.
async fn is_abandoned(store: &dyn Store, mark: Seq, wall: Utc) -> Result<bool, Error> {
    let page = match store.feed(mark, &Log::ALL, 1).await {
        Err(Error::CursorExpired { asked, oldest }) => return Ok(asked < oldest),
        page => page?,
    };
    let is_old = |at_unix_ms: i64| wall.ms_since(Utc(at_unix_ms)) > limits::GONE_KEPT.as_ms();
    Ok(page.entries.first().is_some_and(|entry| is_old(entry.at_unix_ms)))
}

#[cfg(test)]
mod tests {
    mod aging;

    use super::*;
    use metrics_exporter_prometheus::PrometheusBuilder;

    /// Whether the samples of a histogram were folded; only the text of the recorder tells without folding them itself.
    fn folded(metrics: &PrometheusHandle, name: &str) -> bool {
        format!("{metrics:?}").split_once("distributions:").is_some_and(|(_, folded)| folded.contains(name))
    }

    #[tokio::test(start_paused = true)]
    async fn histograms_do_not_grow_while_nobody_scrapes() {
        let recorder = PrometheusBuilder::new().build_recorder();
        let metrics = recorder.handle();
        metrics::with_local_recorder(&recorder, || metrics::histogram!("midshift_test_seconds").record(1.0));
        assert!(!folded(&metrics, "midshift_test_seconds"));
        let _ = tokio::time::timeout(FOLD_EVERY * 2, fold(Some(metrics.clone()))).await;
        assert!(folded(&metrics, "midshift_test_seconds"));
    }
}
