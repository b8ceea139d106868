//! One page of roll-outs, newest first; of those whose ids begin alike, by id. The projection has none that ended long
//! ago, so rows are read from the store.
//!
//! Invariant: a page costs its own roll-outs and their robots, whatever else has ended.

use super::encode::{self, Counts};
use super::service::RolloutService;
use midshift_core::identity::Caller;
use midshift_core::ids::RolloutId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal, Violations};
use midshift_core::rollout::objects;
use midshift_core::rollout::rows::{Rollout, RolloutRobot};
use midshift_core::rows::{Row, Table};
use midshift_proto::ota::v1;
use midshift_proto::pages;
use midshift_store::{Cursor, Query, SkippedRows};
use std::sync::Arc;

fn token(cursor: &Cursor) -> String {
    format!("{}/{}", cursor.order, cursor.id)
}

fn cursor_of(text: &str) -> Option<Cursor> {
    let (order, id) = text.split_once('/')?;
    Some(Cursor { order: order.parse().ok()?, id: Arc::from(id) })
}

fn unread(error: impl std::error::Error) -> Refusal {
    tracing::warn!(%error, "roll-outs cannot be listed");
    Refusal::new(Kind::Unavailable, Code::StoreUnavailable)
}

impl RolloutService {
    pub(super) async fn list(
        &self,
        r: v1::ListRolloutsRequest,
        by: &Caller,
    ) -> Result<v1::ListRolloutsResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        let after = cursor_of(&r.page_token);
        if after.is_none() && !r.page_token.is_empty() {
            bad.add("page_token", "is not a page token of this list");
        }
        bad.finish()?;
        let query = match r.rollout_id_prefix.is_empty() {
            true => Query { newest_first: true, after, ..Query::all(Table::Rollout) },
            false => Query { after, ..Query::all(Table::Rollout).of_prefix(&r.rollout_id_prefix) },
        };
        let (rollouts, next_page_token) = self.page(query, size, by).await?;
        let mut counted = Vec::new();
        for rollout in rollouts {
            // What is under way is counted in the projection.
            let counts = if rollout.phase.is_over() { Some(self.counts(&rollout.rollout_id).await?) } else { None };
            counted.push((rollout, counts));
        }
        let about = counted.iter().filter(|(_, counts)| counts.is_none()).map(|(r, _)| r.rollout_id.clone()).collect();
        self.ask_about(about, move |view, _, now| {
            let shown = |(row, counts): (Rollout, Option<Counts>)| match view.rollout(&row.rollout_id) {
                Some(row) => encode::rollout(view, now, row),
                None => encode::counted(view, now, &row, counts.unwrap_or_default()),
            };
            v1::ListRolloutsResponse { rollouts: counted.into_iter().map(shown).collect(), next_page_token }
        })
        .await
    }

    /// Roll-outs that the caller may see, at most `size`, and the token of the next page; empty after the last.
    async fn page(&self, mut query: Query, size: usize, by: &Caller) -> Result<(Vec<Rollout>, String), Refusal> {
        let (mut found, mut skipped) = (Vec::new(), SkippedRows::default());
        // One more shows whether there is another page.
        query.limit = size + 1;
        let mut last = None;
        loop {
            let rows = self.store.list(query.clone()).await.map_err(unread)?;
            let is_last = rows.len() < query.limit.min(limits::PAGE_MAX);
            query.after = rows.last().map(Cursor::of_row);
            for row in rows {
                let Some(rollout) = skipped.read::<Rollout>(&row).map_err(unread)? else { continue };
                if !objects::sees(by, &rollout) {
                    continue;
                }
                if found.len() == size {
                    return Ok((found, last.as_ref().map(token).unwrap_or_default()));
                }
                last = Some(Cursor::of_row(&row));
                found.push(rollout);
            }
            if is_last {
                return Ok((found, String::new()));
            }
        }
    }

    /// Robots of a roll-out that has ended.
    async fn counts(&self, id: &RolloutId) -> Result<Counts, Refusal> {
        let (mut counts, mut skipped) = (Counts::default(), SkippedRows::default());
        let mut query = Query::all(Table::RolloutRobot).of_parent(id.as_str());
        loop {
            let rows: Vec<Row> = self.store.list(query.clone()).await.map_err(unread)?;
            for row in &rows {
                if let Some(robot) = skipped.read::<RolloutRobot>(row).map_err(unread)? {
                    counts.add(&robot);
                }
            }
            match rows.last() {
                Some(last) if rows.len() == query.limit => query.after = Some(Cursor::of_row(last)),
                _ => return Ok(counts),
            }
        }
    }
}
