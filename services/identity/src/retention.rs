//! Takes away what is past its time: tokens that have been good for nothing for a month, certificates of servers that are gone, and identities of
//! robots that were retired long ago.
//!
//! Invariants:
//! 1. Nothing goes that lets somebody in, or keeps somebody out: a revoked token stays until its time is over by itself, the time to stop
//!    included, and a robot until no certificate of it can be genuine.
//! 2. The newest token stays, whatever became of it: it says that the site has had its first.
//!
//! Called by the server now and then.

use midshift_core::Boxed;
use midshift_core::fleet::rows::RobotControl;
use midshift_core::identity::{RobotIdentity, ServerCertificate, TokenName, TokenRecord};
use midshift_core::item::{Expect, Item};
use midshift_core::limits;
use midshift_core::rows::{Key, Record, Row, Table, Writer};
use midshift_core::time::{Clock, Now, Utc};
use midshift_store::{Cursor, Error, GET_KEYS_MAX, Query, Store, expired_rows, load};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Takes away what is past its time. Gives back how many rows went.
///
/// # Errors
/// If the store does not answer.
pub fn prune<'a>(store: &'a dyn Store, clock: &dyn Clock) -> Boxed<'a, Result<u64, Error>> {
    let now = clock.now();
    Box::pin(async move {
        let wall = now.steady_wall();
        Ok(prune_tokens(store, wall).await? + prune_servers(store, wall).await? + prune_robots(store, &now).await?)
    })
}

fn item() -> Item {
    Item::new(Writer::Identity, "identity")
}

async fn prune_tokens(store: &dyn Store, wall: Utc) -> Result<u64, Error> {
    let newest = store.list(Query { newest_first: true, limit: 1, ..Query::all(Table::Token) }).await?;
    let (mut query, mut items) = (Query::all(Table::Token), Vec::new());
    loop {
        let page = store.list(query.clone()).await?;
        let is_last = page.len() < query.limit;
        query.after = page.last().map(Cursor::of_row);
        for row in page {
            let is_newest = newest.iter().any(|newest| newest.key == row.key);
            match row.decode::<TokenRecord>() {
                Ok(token) if token.is_past(wall) && !is_newest => items.push(forget_token(store, &token, row).await?),
                _ => {}
            }
        }
        if is_last {
            return expired_rows::commit_all(store, items).await;
        }
    }
}

/// With the row of its name, where no newer token has that.
async fn forget_token(store: &dyn Store, token: &TokenRecord, row: Row) -> Result<Item, Error> {
    let mut item = item();
    item.delete(row.key, row.revision, "token.forgotten");
    let name = load::<TokenName>(store, &token.name).await?;
    if let Some((name, at)) = name.filter(|(name, _)| name.token_id == token.token_id) {
        item.delete(name.key(), at, "token_name.free");
    }
    Ok(item)
}

/// A process that lives renews its certificate long before this. One that was never answered is asked for by a process that is there.
async fn prune_servers(store: &dyn Store, wall: Utc) -> Result<u64, Error> {
    let mut items = Vec::new();
    for row in store.snapshot(&[Table::ServerCertificate]).await?.rows {
        let is_past = |server: ServerCertificate| {
            let past_ms = wall.ms_since(Utc(server.expires_unix_ms));
            server.chain_pem.is_some() && past_ms > limits::GONE_KEPT.as_ms()
        };
        if row.decode().is_ok_and(is_past) {
            let mut item = item();
            item.delete(row.key, row.revision, "server.forgotten");
            items.push(item);
        }
    }
    expired_rows::commit_all(store, items).await
}

async fn prune_robots(store: &dyn Store, now: &Now) -> Result<u64, Error> {
    let mut retired: BTreeMap<Arc<str>, Row> = BTreeMap::new();
    for row in store.snapshot(&[Table::RobotControl]).await?.rows {
        if row.decode::<RobotControl>().is_ok_and(|control| expired_rows::is_gone(&control, now.steady_utc())) {
            retired.insert(row.key.id.clone(), row);
        }
    }
    let keys: Vec<Key> = retired.keys().map(|id| Key { table: Table::RobotIdentity, id: id.clone() }).collect();
    let mut items = Vec::new();
    for some in keys.chunks(GET_KEYS_MAX) {
        for row in store.get(some.to_vec()).await? {
            let is_spent = row.decode::<RobotIdentity>().is_ok_and(|robot| robot.is_spent(now.steady_wall()));
            if let (true, Some(control)) = (is_spent, retired.get(&row.key.id)) {
                let mut item = item();
                // Still retired when it is written.
                item.keep_row(control.key.clone(), Expect::At(control.revision));
                item.delete(row.key, row.revision, "robot.forgotten");
                items.push(item);
            }
        }
    }
    expired_rows::commit_all(store, items).await
}
