//! Takes away what is past its time: roll-outs beyond their number with their robots, bundles that nothing names any more with what robots went
//! back from, used request_ids, and rows of robots that were retired long ago.
//!
//! Invariants:
//! 1. A roll-out goes only once it has ended and nothing names it, and after its robots.
//! 2. A bundle that a person took back stays: published again it is still taken back.
//!
//! Called by the server now and then.

use midshift_core::Boxed;
use midshift_core::ids::BundleId;
use midshift_core::item::{Expect, Item};
use midshift_core::limits;
use midshift_core::privacy;
use midshift_core::rollout::ended;
use midshift_core::rollout::rows::{Bundle, Quarantine, RobotSoftware, Rollout};
use midshift_core::rows::{Key, Row, Table, Writer};
use midshift_core::time::{Clock, Now, Utc};
use midshift_store::{Cursor, Error, Query, Store, expired_rows};
use std::collections::BTreeSet;

/// Robots of one item, which has the roll-out's row beside them.
const ROBOTS_AT_ONCE: usize = limits::ITEM_ROWS_MAX - 1;

/// Takes away what is past its time. Gives back how many rows went.
///
/// # Errors
/// If the store does not answer.
pub fn prune<'a>(store: &'a dyn Store, clock: &dyn Clock) -> Boxed<'a, Result<u64, Error>> {
    let now = clock.now();
    Box::pin(async move {
        let keys = match privacy::retention_of(Table::OtaCommandKey).before(now.steady_wall()) {
            Some(before) => expired_rows::take_away(store, Table::OtaCommandKey, before.0, "command.forgotten").await?,
            None => 0,
        };
        let rollouts = prune_rollouts(store).await?;
        let bundles = prune_bundles(store, &now).await?;
        Ok(keys + rollouts + bundles + expired_rows::forget_robots(store, Writer::Ota, now.steady_utc()).await?)
    })
}

/// Of roll-outs that have ended the newest stay.
async fn prune_rollouts(store: &dyn Store) -> Result<u64, Error> {
    let ended = Query::all(Table::Rollout).in_states(ended::ended_phases());
    let mut query = Query { newest_first: true, ..ended };
    let (mut seen, mut gone) = (0, 0);
    loop {
        let page = store.list(query.clone()).await?;
        let is_last = page.len() < query.limit;
        query.after = page.last().map(Cursor::of_row);
        let stay = limits::ROLLOUTS_MAX.saturating_sub(seen);
        seen += page.len();
        let beyond: Vec<Row> = page.into_iter().skip(stay).collect();
        if !beyond.is_empty() {
            let named = store.read(&ended::naming(), ended::named).await?;
            let named: BTreeSet<Key> = named.rows.into_iter().map(|row| row.key).collect();
            for row in beyond.into_iter().filter(|row| !named.contains(&row.key)) {
                gone += forget_rollout(store, row).await?;
            }
        }
        if is_last {
            return Ok(gone);
        }
    }
}

async fn forget_rollout(store: &dyn Store, rollout: Row) -> Result<u64, Error> {
    let mut gone = 0;
    loop {
        let of_rollout = Query::all(Table::RolloutRobot).of_parent(&rollout.key.id);
        let robots = store.list(Query { limit: ROBOTS_AT_ONCE, ..of_rollout }).await?;
        let is_last = robots.len() < ROBOTS_AT_ONCE;
        let mut item = Item::new(Writer::Ota, "ota");
        for robot in robots {
            item.delete(robot.key, robot.revision, "robot.forgotten");
        }
        if is_last {
            item.delete(rollout.key.clone(), rollout.revision, "rollout.forgotten");
        } else {
            item.keep_row(rollout.key.clone(), Expect::At(rollout.revision));
        }
        let rows = expired_rows::commit(store, item).await?;
        gone += rows;
        // Somebody has changed it: another time.
        if is_last || rows == 0 {
            return Ok(gone);
        }
    }
}

/// Bundles that no release lists, no roll-out is of and no robot has, and that nobody took back.
async fn prune_bundles(store: &dyn Store, now: &Now) -> Result<u64, Error> {
    let mut old = old_bundles(store, now).await?;
    if old.is_empty() {
        return Ok(0);
    }
    let named = named_bundles(store).await?;
    old.retain(|(bundle, _)| !named.contains(&bundle.bundle));
    if old.is_empty() {
        return Ok(0);
    }
    let ids: BTreeSet<&BundleId> = old.iter().map(|(bundle, _)| &bundle.bundle).collect();
    let quarantines = store.snapshot(&[Table::Quarantine]).await?.rows.into_iter();
    let left = quarantines.filter(|row| row.decode::<Quarantine>().is_ok_and(|q| ids.contains(&q.bundle)));
    // A bundle goes after what robots went back from, or a bundle that is published anew would find none of it.
    let mut gone = take_away(store, left.collect(), "quarantine.forgotten").await?;
    gone += take_away(store, old.iter().map(|(_, row)| row.clone()).collect(), "bundle.forgotten").await?;
    Ok(gone)
}

async fn old_bundles(store: &dyn Store, now: &Now) -> Result<Vec<(Bundle, Row)>, Error> {
    let (mut query, mut old) = (Query::all(Table::Bundle), Vec::new());
    loop {
        let page = store.list(query.clone()).await?;
        let is_last = page.len() < query.limit;
        query.after = page.last().map(Cursor::of_row);
        let bundles = page.into_iter().filter_map(|row| Some((row.decode::<Bundle>().ok()?, row)));
        old.extend(bundles.filter(|(bundle, _)| is_past(bundle, now)));
        if is_last {
            return Ok(old);
        }
    }
}

fn is_past(bundle: &Bundle, now: &Now) -> bool {
    let is_old = |at: Utc, now: Utc| now.ms_since(at) > limits::GONE_KEPT.as_ms();
    !bundle.listed
        && bundle.revoked.is_none()
        && is_old(bundle.published, now.steady_wall())
        && bundle.ended.is_none_or(|ended| is_old(ended, now.steady_utc()))
}

/// Bundles of roll-outs, ended or not, and of robots. A row that cannot be read may name any.
async fn named_bundles(store: &dyn Store) -> Result<BTreeSet<BundleId>, Error> {
    let mut named = BTreeSet::new();
    for row in store.snapshot(&[Table::Rollout, Table::RobotSoftware]).await?.rows {
        named.extend(match row.key.table {
            Table::Rollout => vec![row.decode::<Rollout>()?.spec.bundle.clone()],
            _ => bundles_of(row.decode()?),
        });
    }
    Ok(named)
}

fn bundles_of(robot: RobotSoftware) -> Vec<BundleId> {
    let said = robot.report.map(|report| report.bundle);
    [robot.committed, robot.previous, robot.on_trial, said].into_iter().flatten().collect()
}

async fn take_away(store: &dyn Store, rows: Vec<Row>, kind: &'static str) -> Result<u64, Error> {
    let item = |rows: &[Row]| {
        let mut item = Item::new(Writer::Ota, "ota");
        for row in rows {
            item.delete(row.key.clone(), row.revision, kind);
        }
        item
    };
    expired_rows::commit_all(store, rows.chunks(limits::ITEM_ROWS_MAX).map(item).collect()).await
}

#[cfg(test)]
mod tests;
