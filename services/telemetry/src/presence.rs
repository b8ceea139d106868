//! Writes whom heartbeats make ONLINE, SUSPECT or OFFLINE, as [`midshift_core::presence`] decides it.
//!
//! Invariant: nobody's clock but ours takes part; a store that fails costs one period. Of several gateways the one that had the robot's
//! newest session writes at once, the others a little later if it has not.

use crate::inner::Inner;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::RobotId;
use midshift_core::item::{Expect, Item};
use midshift_core::limits;
use midshift_core::presence::Presence;
use midshift_core::presence::PresenceRow;
use midshift_core::rows::{Record, Revision, Writer};
use midshift_core::time::{LinkDuration, LinkTime, Utc};
use midshift_store::{Query, Store};
use std::collections::BTreeMap;
use std::time::Duration;

/// How often presence is looked at.
const PERIOD: Duration = Duration::from_millis(500);
/// Rows of one item.
const ROWS_PER_ITEM: usize = 200;

/// What another gateway should have written is left to it for this long.
const LEFT_TO_OTHERS: LinkDuration = LinkDuration::from_secs(2);

/// What is not ours to write yet, and since when.
type Stood = BTreeMap<RobotId, (Presence, LinkTime)>;
/// Rows as they are; one that cannot be read is of a newer version, and that one's to write.
type Known = BTreeMap<RobotId, (Option<PresenceRow>, Revision)>;

async fn read(store: &dyn Store) -> Option<Known> {
    let mut known = Known::new();
    let mut query = Query::all(PresenceRow::TABLE);
    loop {
        let rows = store.list(query.clone()).await.ok()?;
        let Some(last) = rows.last() else { return Some(known) };
        query.after = Some(midshift_store::Cursor::of_row(last));
        for row in &rows {
            if let Ok(robot_id) = RobotId::parse(&row.key.id) {
                known.insert(robot_id, (row.decode::<PresenceRow>().ok(), row.revision));
            }
        }
    }
}

/// Keeps presence until it is dropped.
pub async fn write_presence(inner: &Inner) {
    let (mut known, mut stood): (Option<Known>, Stood) = (None, Stood::new());
    let started = inner.parts.clock.now().link;
    let mut tick = tokio::time::interval(PERIOD);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        if known.is_none() {
            known = read(inner.parts.store.as_ref()).await;
        }
        let Some(rows) = &mut known else { continue };
        if !write(inner, rows, &mut stood, started).await {
            known = None;
        }
    }
}

/// Writes what changed; false: the rows must be read again.
async fn write(inner: &Inner, known: &mut Known, stood: &mut Stood, started: LinkTime) -> bool {
    let now = inner.parts.clock.now();
    // After a start nobody is called offline before the time that it takes to come back.
    let young = now.link.since(started) <= limits::OFFLINE_AFTER;
    let mut changed: Vec<(PresenceRow, Revision)> = Vec::new();
    let mut look =
        |robot_id: &RobotId, live: Option<&NewestHeartbeat>, old: Option<&(Option<PresenceRow>, Revision)>| {
            let presence = Presence::since(live.map(|live| live.processed_at), now.link);
            let is_ours = || inner.shared.is_none() || inner.registry.is_home(robot_id);
            let is_news = |row: &PresenceRow| live.is_some_and(|live| is_news(row, live)) && is_ours();
            let is_told = |row: &PresenceRow| row.presence == presence && !is_news(row);
            let same = old.is_some_and(|(row, _)| row.as_ref().is_none_or(is_told));
            let too_early = young && live.is_none();
            if same || too_early || is_others(inner, robot_id, (presence, now.link), stood) {
                return;
            }
            let fresh = || PresenceRow::new(robot_id.clone(), Presence::Offline, now.wall.0);
            let row = old.and_then(|(row, _)| row.clone()).unwrap_or_else(fresh).next(presence, live, now.wall);
            changed.push((row, old.map_or(Revision(0), |(_, revision)| *revision)));
        };
    // Both are by id, and nearly always the same robots.
    let heard = inner.parts.board.all();
    let mut rest = known.iter().peekable();
    for (robot_id, live) in &heard {
        while let Some((unheard, old)) = rest.next_if(|(known, _)| *known < robot_id) {
            look(unheard, None, Some(old));
        }
        look(robot_id, Some(live), rest.next_if(|(known, _)| *known == robot_id).map(|(_, old)| old));
    }
    rest.for_each(|(unheard, old)| look(unheard, None, Some(old)));
    let mut items = Vec::new();
    for rows in changed.chunks(ROWS_PER_ITEM) {
        let mut item = Item::new(Writer::Telemetry, "telemetry");
        for (row, revision) in rows {
            let expect = if *revision == Revision(0) { Expect::Absent } else { Expect::At(*revision) };
            item.put_row(row, expect, "presence.changed");
        }
        items.push(item);
    }
    if items.is_empty() {
        return true;
    }
    let applied = inner.parts.store.commit(items).await.iter().all(Result::is_ok);
    for (row, revision) in changed {
        known.insert(row.robot_id.clone(), (Some(row), revision.next()));
    }
    applied
}

/// Whether a heartbeat says what the row does not: something else keeps the robot from work, or what was kept of it is old.
fn is_news(row: &PresenceRow, live: &NewestHeartbeat) -> bool {
    let is_old = row.last_heard.as_ref().is_none_or(|last| {
        Utc(live.received_unix_ms).ms_since(Utc(last.at_unix_ms)) >= limits::LAST_HEARD_EVERY.as_ms()
    });
    is_old || row.conditions_of(live) != row.conditions
}

/// Whether another gateway writes it, or has.
fn is_others(inner: &Inner, robot_id: &RobotId, (presence, now): (Presence, LinkTime), stood: &mut Stood) -> bool {
    if inner.shared.is_none() || inner.registry.is_home(robot_id) {
        return false;
    }
    if inner.projection.rows().presence.get(robot_id).is_some_and(|row| row.presence == presence) {
        stood.remove(robot_id);
        return true;
    }
    let since = stood.entry(robot_id.clone()).or_insert((presence, now));
    if since.0 != presence {
        *since = (presence, now);
    }
    now.since(since.1) < LEFT_TO_OTHERS
}
