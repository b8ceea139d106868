//! Pages of the audit, the newest first, over all chains or one.
//!
//! Invariant: within a chain rows keep their order whatever their clocks say; a call reads at most [`limits::AUDIT_LOOK_ROWS`] rows, and its token
//! says how far each chain was read.

use super::{AuditService, unavailable};
use midshift_core::audit::{AuditRow, Head};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::{Refusal, Violations};
use midshift_core::rows::{Table, Writer};
use midshift_proto::convert::{At, parse_time, timestamp};
use midshift_proto::identity::v1;
use midshift_proto::pages;
use midshift_store::{Cursor, Query, Store};
use std::collections::{BTreeMap, VecDeque};

/// Rows of a chain read at a time.
const SLICE: usize = 500;
/// Bytes of a page, about: a row is small, and one that names many robots is not.
const PAGE_BYTES: usize = 1 << 20;
/// A wall clock that was set back shows rows of a chain in another order of time than of number, by less than this.
const CLOCK_SLACK_MS: i64 = 24 * 3_600_000;

/// Filters rows of the audit.
#[derive(Debug, Default)]
struct AuditFilter {
    actor: String,
    robot: Option<String>,
    subject: String,
    action: String,
    since_unix_ms: Option<i64>,
    until_unix_ms: Option<i64>,
}

impl AuditFilter {
    fn fits(&self, row: &AuditRow) -> bool {
        (self.actor.is_empty() || row.actor == self.actor)
            && self.robot.as_ref().is_none_or(|robot| row.about.contains(robot))
            && (self.subject.is_empty() || row.is_about(&self.subject))
            && row.action.starts_with(&self.action)
            && self.since_unix_ms.is_none_or(|since| row.at_unix_ms >= since)
            && self.until_unix_ms.is_none_or(|until| row.at_unix_ms < until)
    }
    /// No row before one of this moment can fit.
    fn is_past(&self, at_unix_ms: i64) -> bool {
        self.since_unix_ms.is_some_and(|since| at_unix_ms < since.saturating_sub(CLOCK_SLACK_MS))
    }
}

/// A chain that is read from its newest row backwards.
struct Behind {
    table: Table,
    /// The row that was given last; 0: none is left.
    at: u64,
    ahead: VecDeque<AuditRow>,
}

impl Behind {
    /// Makes sure that the next row is known, if there is one. Says how many rows were read for it.
    async fn peek(&mut self, store: &dyn Store) -> Result<usize, Refusal> {
        if !self.ahead.is_empty() || self.at <= 1 {
            return Ok(0);
        }
        let from = Cursor { order: self.at.min(i64::MAX as u64).cast_signed(), id: "".into() };
        let query = Query { after: Some(from), newest_first: true, limit: SLICE, ..Query::all(self.table) };
        let rows = store.list(query).await.map_err(unavailable)?;
        if rows.is_empty() {
            self.at = 0;
        }
        // What cannot be read is no row to show; `verify` names it.
        self.ahead.extend(rows.iter().filter_map(|row| AuditRow::read(&row.body)));
        if self.ahead.is_empty() {
            self.at = rows.last().and_then(|row| row.index.order).unwrap_or(0).max(0).cast_unsigned();
        }
        Ok(rows.len())
    }
}

/// The chains named, each with where to go on: `task.17-fleet.4`; empty: from the newest row on.
fn chains(service: &str, token: &str, bad: &mut Violations) -> Vec<(Writer, Behind)> {
    let known = Table::audits().iter();
    let named = known.filter(|(writer, _)| service.is_empty() || writer.as_str() == service);
    let mut chains: Vec<_> = named
        .map(|(writer, table)| (*writer, Behind { table: *table, at: u64::MAX, ahead: VecDeque::new() }))
        .collect();
    if chains.is_empty() {
        let names: Vec<&str> = Table::audits().iter().map(|(writer, _)| writer.as_str()).collect();
        bad.add("service", format!("must be one of {}, or empty", names.join(", ")));
    }
    if !token.is_empty() {
        let read: Option<BTreeMap<&str, u64>> = token
            .split('-')
            .map(|part| part.split_once('.').and_then(|(name, n)| Some((name, n.parse().ok()?))))
            .collect();
        match read {
            Some(read) => {
                chains
                    .iter_mut()
                    .for_each(|(writer, chain)| chain.at = read.get(writer.as_str()).copied().unwrap_or(0));
            }
            None => bad.add("page_token", "is not one of an answer"),
        }
    }
    chains
}

fn token(chains: &[(Writer, Behind)]) -> String {
    let left = chains.iter().filter(|(_, chain)| chain.at > 1 || !chain.ahead.is_empty());
    left.map(|(writer, chain)| format!("{}.{}", writer.as_str(), chain.at)).collect::<Vec<_>>().join("-")
}

impl AuditService {
    /// One page.
    pub(super) async fn list(&self, r: v1::ListAuditRequest) -> Result<v1::ListAuditResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        let robot = if r.robot_id.is_empty() { None } else { bad.accept("robot_id", RobotId::parse(&r.robot_id)) };
        let mut chains = chains(&r.service, &r.page_token, &mut bad);
        let since = parse_time(r.since.as_ref(), At::top("since"), &mut bad);
        let until = parse_time(r.until.as_ref(), At::top("until"), &mut bad);
        bad.finish()?;
        let wanted = AuditFilter {
            actor: r.actor,
            robot: robot.map(|id| format!("robot:{id}")),
            subject: r.subject,
            action: r.action_prefix,
            since_unix_ms: since.map(|utc| utc.0),
            until_unix_ms: until.map(|utc| utc.0),
        };
        let (mut rows, mut read, mut bytes) = (Vec::new(), 0, 0);
        while rows.len() < size && read < limits::AUDIT_LOOK_ROWS && bytes < PAGE_BYTES {
            for (_, chain) in &mut chains {
                read += chain.peek(&*self.store).await?;
            }
            let newest = chains.iter_mut().map(|(_, chain)| chain).filter(|chain| !chain.ahead.is_empty());
            let newest = newest.max_by_key(|chain| chain.ahead.front().map(|row| row.at_unix_ms));
            let Some(chain) = newest else {
                // A slice in which nothing could be read leaves a chain without a next row and not at its end.
                if token(&chains).is_empty() {
                    break;
                } else {
                    continue;
                };
            };
            let Some(row) = chain.ahead.pop_front() else { break };
            chain.at = row.n;
            if wanted.is_past(row.at_unix_ms) {
                (chain.at, chain.ahead) = (0, VecDeque::new());
            } else if wanted.fits(&row) {
                bytes += row.about.iter().map(String::len).sum::<usize>() + 500;
                rows.push(encode(row));
            }
        }
        for (_, chain) in &mut chains {
            chain.peek(&*self.store).await?;
        }
        Ok(v1::ListAuditResponse { rows, next_page_token: token(&chains) })
    }
}

pub(super) fn encode_head(service: &str, head: &Head) -> v1::AuditHead {
    v1::AuditHead { service: service.to_owned(), n: head.n, hash: head.hash.clone() }
}

fn encode(row: AuditRow) -> v1::AuditRow {
    v1::AuditRow {
        heads: row.heads.iter().map(|(service, head)| encode_head(service, head)).collect(),
        cut: row.cut.as_ref().map(|head| encode_head(&row.service, head)),
        service: row.service,
        n: row.n,
        time: Some(timestamp(midshift_core::time::Utc(row.at_unix_ms))),
        actor: row.actor,
        token_id: row.token_id,
        action: row.action,
        about: row.about,
        with: row.with,
        request_id: row.request_id,
        reason: row.reason,
        outcome: row.outcome,
        prev: row.prev,
        hash: row.hash,
    }
}
