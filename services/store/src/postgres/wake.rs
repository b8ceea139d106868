//! How a process hears of what others commit, and tells them of its own.
//!
//! Invariant: a wake is a hint, and nothing depends on one arriving: the head is looked at every 250 ms whatever happens here.
//! NOTIFY is never part of a transaction that commits rows, which would take a lock of the whole server: a connection of its own
//! sends the newest number, at most once every 10 ms.

use super::connect::{Database, WRITE_PATIENCE, patiently};
use super::read;
use crate::queue::unavailable;
use midshift_core::ids::SiteId;
use midshift_core::rows::Seq;
use sqlx::postgres::PgListener;
use sqlx::{PgConnection, PgPool};
use std::time::Duration;
use tokio::sync::watch;

/// Pause between looks at the head: what a dead listener or notifier costs at most.
const SWEEP_PERIOD: Duration = Duration::from_millis(250);
/// Least time between two notifications of one process.
const NOTIFY_PERIOD: Duration = Duration::from_millis(10);
/// Pause before a connection is tried again.
const RECONNECT_PAUSE: Duration = Duration::from_millis(500);

/// Announces `seq` within this process unless a newer one has been.
pub(super) fn raise(wake: &watch::Sender<Seq>, seq: Seq) {
    wake.send_if_modified(|newest| {
        let newer = seq > *newest;
        if newer {
            *newest = seq;
        }
        newer
    });
}

/// The channel of a site: its id may be longer than a channel's name (63 bytes), and a stranger's wake does no harm.
fn channel(site_id: &SiteId) -> String {
    let fnv = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    format!("midshift_{:016x}", site_id.as_str().bytes().fold(0xcbf2_9ce4_8422_2325, fnv))
}

/// Looks at the head again and again.
pub(super) async fn sweep(readers: PgPool, site_id: SiteId, wake: watch::Sender<Seq>) {
    loop {
        tokio::time::sleep(SWEEP_PERIOD).await;
        let head = patiently(async { read::head(&readers, &site_id).await.map_err(unavailable) });
        match head.await {
            Ok(head) => raise(&wake, head),
            Err(_) if readers.is_closed() => return,
            Err(error) => tracing::debug!(%error, "looking at the head failed"),
        }
    }
}

/// Hears of others' commits.
pub(super) async fn listen(database: Database, site_id: SiteId, wake: watch::Sender<Seq>) {
    let channel = channel(&site_id);
    loop {
        match database.listener(&channel).await {
            Ok(listener) => raise_heard(listener, &wake).await,
            Err(error) => tracing::warn!(%error, "listening for commits failed; looking for them instead"),
        }
        tokio::time::sleep(RECONNECT_PAUSE).await;
    }
}

/// Until the connection is lost.
async fn raise_heard(mut listener: PgListener, wake: &watch::Sender<Seq>) {
    while let Ok(Some(heard)) = listener.try_recv().await {
        if let Ok(seq) = heard.payload().parse() {
            raise(wake, Seq(seq));
        }
    }
}

/// Tells others of this process's commits, the newest only.
pub(super) async fn notify(database: Database, site_id: SiteId, mut committed: watch::Receiver<Seq>) {
    let channel = channel(&site_id);
    let mut connection = None;
    while committed.changed().await.is_ok() {
        let seq = *committed.borrow_and_update();
        if let Err(error) = notify_once(&database, &mut connection, &channel, seq).await {
            connection = None;
            tracing::debug!(%error, "telling of a commit failed; others look for it");
            tokio::time::sleep(RECONNECT_PAUSE).await;
        }
        tokio::time::sleep(NOTIFY_PERIOD).await;
    }
}

async fn notify_once(
    database: &Database,
    connection: &mut Option<PgConnection>,
    channel: &str,
    seq: Seq,
) -> Result<(), crate::Cause> {
    let connection = match connection {
        Some(connection) => connection,
        None => connection.insert(database.writer().await.map_err(|e| -> crate::Cause { std::sync::Arc::new(e) })?),
    };
    let telling = sqlx::query("SELECT pg_notify($1, $2)").bind(channel).bind(seq.0.to_string()).execute(connection);
    let told = tokio::time::timeout(WRITE_PATIENCE, telling).await.map_err(|_| super::connect::no_answer())?;
    told.map(drop).map_err(|e| -> crate::Cause { std::sync::Arc::new(e) })
}
