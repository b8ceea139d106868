//! Robots and their events for people and programs: decode, look at the projection and the board, encode.

use crate::TelemetryService;
use crate::inner::Inner;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::presence::Presence;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::robot::Lane;
use midshift_core::robot_events::{InboxEntry, InboxItem, RobotEvent, SampleBody};
use midshift_core::rows::{Log, Seq};
use midshift_core::session::Session;
use midshift_core::time::Utc;
use midshift_proto::access::caller;
use midshift_proto::convert::WireEnum;
use midshift_proto::convert::telemetry::{RobotView, encode_event, encode_robot, shown_presence};
use midshift_proto::pages;
use midshift_proto::telemetry::v1::{self, telemetry_service_server::TelemetryService as Face};
use midshift_proto::watches::{self, Gone, Reader, Teller};
use midshift_store::{Dirty, Error, Subjects};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;
use std::time::Duration;
use tonic::{Request, Response, Status};

/// Robots of one message of a watch.
const ROBOTS_PER_MESSAGE: usize = 24;
/// Milliseconds between two messages of a watch, by default and allowed.
const PERIOD_DEFAULT_MS: u32 = 1_000;
const PERIOD_MS: std::ops::RangeInclusive<u32> = 50..=60_000;

/// Which robots somebody asks for, and who: nobody is shown what it may not see.
struct Filter {
    by: Caller,
    robot_ids: BTreeSet<String>,
    robot_id_prefix: String,
    presences: BTreeSet<Presence>,
    labels: BTreeMap<String, String>,
}

impl Filter {
    /// Ids of robots that may match, in order, behind the token of a page: those that are named, or those that begin so. Each is then held against
    /// the rest of the filter ([`admits`]) in memory, so a list costs by the number of robots that there are, and by nothing that is over.
    fn candidates(&self, sessions: &BTreeMap<RobotId, Session>, after: &str) -> Vec<RobotId> {
        let is_behind = |id: &&RobotId| id.as_str() > after;
        let begins = |id: &&RobotId| id.as_str().starts_with(&self.robot_id_prefix);
        if !self.robot_ids.is_empty() {
            let named = self.robot_ids.iter().filter_map(|id| RobotId::parse(id).ok());
            return named.filter(|id| is_behind(&id) && sessions.contains_key(id)).collect();
        }
        if self.robot_id_prefix.is_empty() {
            return sessions.keys().filter(is_behind).cloned().collect();
        }
        // What is no beginning of an id begins none.
        let Ok(first) = RobotId::parse(&self.robot_id_prefix) else { return Vec::new() };
        sessions.range(first..).map(|(id, _)| id).take_while(begins).filter(is_behind).cloned().collect()
    }
}

fn filter(wire: Option<v1::RobotFilter>, by: Caller, bad: &mut Violations) -> Filter {
    let wire = wire.unwrap_or_default();
    let mut presences = BTreeSet::new();
    for (i, number) in wire.presences.iter().enumerate() {
        match Presence::from_wire(*number) {
            Some(presence) => drop(presences.insert(presence)),
            None => bad.add(format!("filter.presences[{i}]"), "UNSPECIFIED is not a value"),
        }
    }
    if wire.robot_ids.len() > limits::PAGE_MAX {
        bad.add("filter.robot_ids", "must be at most 1000");
    }
    let (robot_ids, labels) = (wire.robot_ids.into_iter().collect(), wire.labels.into_iter().collect());
    Filter { by, robot_ids, robot_id_prefix: wire.robot_id_prefix, presences, labels }
}

fn encode(inner: &Inner, robot_id: &RobotId, live: Option<&NewestHeartbeat>) -> Option<v1::Robot> {
    let rows = inner.projection.rows();
    let session = rows.sessions.get(robot_id);
    if session.is_none() && live.is_none() {
        return None;
    }
    let mut durable = BTreeMap::new();
    if let Some(session) = session {
        if let Some(mark) = rows.marks.get(&format!("{robot_id}/{}", session.ring)) {
            durable.insert(Lane::Critical, mark.critical);
            durable.insert(Lane::Event, mark.event);
        }
        let status = rows.durable_status(robot_id, &Arc::from(session.ring.as_str()));
        if status > 0 {
            durable.insert(Lane::Status, status);
        }
    }
    let presence = rows.presence.get(robot_id);
    let last_heard = presence.and_then(|row| row.last_heard.as_ref());
    let area_id = rows.area_of(live).or_else(|| rows.area_at(last_heard?.waypoint.as_ref()).filter(|_| live.is_none()));
    let observed_since = inner.registry.observed_since(robot_id);
    let view = RobotView { robot_id, presence, session, live, area_id, durable: &durable, observed_since };
    let now = inner.parts.clock.now();
    let beacon = inner.beacons.hint(robot_id, live.map(|live| live.processed_at), &now);
    Some(v1::Robot { beacon, ..encode_robot(view, now) })
}

/// Whether a caller may see a robot: where it is now, by its newest heartbeat.
fn sees(inner: &Inner, by: &Caller, robot_id: &RobotId) -> bool {
    by.is_permitted_everywhere(Permission::Read) || {
        let live = inner.parts.board.get(robot_id);
        by.is_permitted_in(Permission::Read, inner.projection.rows().area_of(live.as_deref()))
    }
}

fn admits(inner: &Inner, filter: &Filter, robot_id: &RobotId) -> bool {
    if !robot_id.as_str().starts_with(&filter.robot_id_prefix) || !sees(inner, &filter.by, robot_id) {
        return false;
    }
    let rows = inner.projection.rows();
    let presence = shown_presence(rows.presence.get(robot_id), inner.parts.board.get(robot_id).as_deref());
    (filter.robot_ids.is_empty() || filter.robot_ids.contains(robot_id.as_str()))
        && (filter.presences.is_empty() || filter.presences.contains(&presence))
        && filter.labels.iter().all(|(key, value)| rows.label(robot_id, key) == Some(value.as_str()))
}

impl TelemetryService {
    fn list(&self, r: v1::ListRobotsRequest, by: Caller) -> Result<v1::ListRobotsResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        let filter = filter(r.filter, by, &mut bad);
        bad.finish()?;
        let inner = &self.inner;
        let ids = filter.candidates(&inner.projection.rows().sessions, &r.page_token);
        let shown = |id: &RobotId| encode(inner, id, inner.parts.board.get(id).as_deref());
        let found = ids.iter().filter(|id| admits(inner, &filter, id));
        let found = found.filter_map(|id| Some((id.to_string(), shown(id)?)));
        let (robots, next_page_token) = pages::page(found, "", size);
        Ok(v1::ListRobotsResponse { robots, next_page_token })
    }

    fn get(&self, r: &v1::GetRobotRequest, by: &Caller) -> Result<v1::GetRobotResponse, Refusal> {
        let robot_id = RobotId::parse(&r.robot_id).map_err(|e| Refusal::field("robot_id", e.to_string()))?;
        let robot = || encode(&self.inner, &robot_id, self.inner.parts.board.get(&robot_id).as_deref());
        match sees(&self.inner, by, &robot_id).then(robot).flatten() {
            Some(robot) => Ok(v1::GetRobotResponse { robot: Some(robot) }),
            None => Err(Refusal::new(Kind::NotFound, Reason::from(Code::RobotNotFound).with("robot_id", &r.robot_id))),
        }
    }

    async fn events(&self, r: v1::ListEventsRequest, by: &Caller) -> Result<v1::ListEventsResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        if r.robot_ids.len() > limits::PAGE_MAX {
            bad.add("robot_ids", "must be at most 1000");
        }
        bad.finish()?;
        let store = &self.inner.parts.store;
        let after = self.position(&r.cursor)?;
        let subjects: Vec<Arc<str>> = r.robot_ids.iter().map(|id| Arc::from(id.as_str())).collect();
        let page = if subjects.is_empty() {
            store.feed(after, &[Log::RobotInbox], size).await
        } else {
            store.feed_of(Subjects::Robots(&subjects), after, size).await
        };
        let page = match page {
            Err(Error::CursorExpired { oldest, .. }) if r.cursor.is_empty() => {
                return Box::pin(self.events(v1::ListEventsRequest { cursor: self.cursor(oldest), ..r }, by)).await;
            }
            Err(Error::CursorExpired { .. }) => return Err(Refusal::new(Kind::Precondition, Code::CursorExpired)),
            Err(error) => {
                return Err(Refusal::new(Kind::Unavailable, Reason::new(Code::StoreUnavailable, error.to_string())));
            }
            Ok(page) => page,
        };
        let mut seen: BTreeMap<RobotId, bool> = BTreeMap::new();
        let events = page
            .entries
            .iter()
            .filter_map(|entry| {
                let said = InboxEntry::parse(entry.body.as_ref()?).ok()?;
                let about = r.subject.is_empty() || subject(&said).is_some_and(|s| s == r.subject);
                let is_seen = |robot_id: &RobotId| sees(&self.inner, by, robot_id);
                let is_seen = *seen.entry(said.robot_id.clone()).or_insert_with_key(is_seen);
                (about && is_seen).then(|| encode_event(&said, Utc(entry.at_unix_ms), self.cursor(entry.seq)))
            })
            .collect();
        Ok(v1::ListEventsResponse { events, cursor: self.cursor(page.next), caught_up: page.next >= page.head })
    }

    fn cursor(&self, seq: Seq) -> String {
        format!("{}:{}", self.inner.parts.store.id(), seq.0)
    }

    fn position(&self, cursor: &str) -> Result<Seq, Refusal> {
        if cursor.is_empty() {
            return Ok(Seq(0));
        }
        let (store, seq) = cursor.rsplit_once(':').ok_or_else(|| Refusal::field("cursor", "is not a cursor"))?;
        let seq = seq.parse().map_err(|_| Refusal::field("cursor", "is not a cursor"))?;
        if store != self.inner.parts.store.id().to_string() {
            return Err(Refusal::new(Kind::Precondition, Code::CursorOfOtherStore));
        }
        Ok(Seq(seq))
    }
}

/// The task or errand that an event is about.
fn subject(entry: &InboxEntry) -> Option<String> {
    match &entry.what {
        InboxItem::Sample(sample) => match &sample.body {
            SampleBody::Event(RobotEvent::Attempt(report)) => Some(report.attempt.subject.to_string()),
            _ => None,
        },
        _ => None,
    }
}

fn answer<T>(result: Result<T, Refusal>) -> Result<Response<T>, Status> {
    result.map(Response::new).map_err(|refusal| midshift_proto::status(&refusal, None))
}

#[tonic::async_trait]
impl Face for TelemetryService {
    type WatchRobotsStream = Reader<v1::WatchRobotsResponse>;

    async fn list_robots(&self, r: Request<v1::ListRobotsRequest>) -> Result<Response<v1::ListRobotsResponse>, Status> {
        let by = caller(&r);
        answer(self.list(r.into_inner(), by))
    }
    async fn get_robot(&self, r: Request<v1::GetRobotRequest>) -> Result<Response<v1::GetRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.get(&r.into_inner(), &by))
    }
    async fn list_events(&self, r: Request<v1::ListEventsRequest>) -> Result<Response<v1::ListEventsResponse>, Status> {
        let by = caller(&r);
        answer(self.events(r.into_inner(), &by).await)
    }
    async fn watch_robots(
        &self,
        r: Request<v1::WatchRobotsRequest>,
    ) -> Result<Response<Self::WatchRobotsStream>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let mut bad = Violations::default();
        let filter = filter(r.filter, by, &mut bad);
        let period_ms = if r.period_ms == 0 { PERIOD_DEFAULT_MS } else { r.period_ms };
        if !PERIOD_MS.contains(&period_ms) {
            bad.add("period_ms", "must be 50..60000; 0: 1000");
        }
        if let Err(refusal) = bad.finish() {
            return Err(midshift_proto::status(&refusal, None));
        }
        let (teller, reader) = watches::watch();
        let inner = self.inner.clone();
        tokio::spawn(async move {
            let shutdown = inner.shutdown.clone();
            tokio::select! {
                () = shutdown.cancelled() => {}
                _ = watch(&inner, filter, Duration::from_millis(u64::from(period_ms)), &teller) => {}
            }
        });
        Ok(Response::new(reader))
    }
}

/// One watcher: what it was told is what it is told the end of.
struct Watching<'a> {
    inner: &'a Inner,
    filter: Filter,
    beats: Dirty<NewestHeartbeat>,
    touched: Dirty<()>,
    shown: BTreeSet<RobotId>,
}

impl Watching<'_> {
    /// Robots to tell of `ids`: those that match, and once more those that did and no longer do.
    fn news(&mut self, ids: Vec<RobotId>) -> Vec<v1::Robot> {
        let mut robots = Vec::new();
        for id in ids {
            let matches = admits(self.inner, &self.filter, &id);
            let matched = self.shown.contains(&id);
            let live = self.inner.parts.board.get(&id);
            if let Some(robot) = encode(self.inner, &id, live.as_deref()).filter(|_| matches || matched) {
                robots.push(robot);
            }
            if matches {
                self.shown.insert(id);
            } else {
                self.shown.remove(&id);
            }
        }
        robots
    }
    /// Robots of the whole behind one, as many as a message takes: an unread watch holds none of the others.
    fn of_the_whole(&self, behind: Bound<RobotId>) -> Vec<RobotId> {
        let rows = self.inner.projection.rows();
        rows.sessions.range((behind, Bound::Unbounded)).map(|(id, _)| id).take(ROBOTS_PER_MESSAGE).cloned().collect()
    }
    async fn tell_whole(&mut self, teller: &Teller<v1::WatchRobotsResponse>) -> Result<(), Gone> {
        let (mut behind, mut snapshot_complete) = (Bound::Unbounded, false);
        while !snapshot_complete {
            teller.asked().await?;
            let ids = self.of_the_whole(behind.clone());
            snapshot_complete = ids.len() < ROBOTS_PER_MESSAGE;
            behind = ids.last().cloned().map_or(behind, Bound::Excluded);
            let robots = self.news(ids);
            // The end of the whole is told, also where nothing of it is shown.
            if !robots.is_empty() || snapshot_complete {
                teller.tell_message(v1::WatchRobotsResponse { robots, snapshot_complete });
            }
        }
        Ok(())
    }
    async fn tell_changes(&mut self, period: Duration, teller: &Teller<v1::WatchRobotsResponse>) -> Result<(), Gone> {
        let mut ids = Vec::new();
        loop {
            while ids.is_empty() {
                tokio::select! {
                    () = teller.gone() => return Err(Gone),
                    () = tokio::time::sleep(period) => ids = self.changed(),
                }
            }
            teller.asked().await?;
            let rest = ids.split_off(ids.len().min(ROBOTS_PER_MESSAGE));
            let robots = self.news(ids);
            ids = rest;
            if !robots.is_empty() {
                teller.tell_message(v1::WatchRobotsResponse { robots, snapshot_complete: true });
            }
        }
    }
    /// Those that changed since the last call.
    fn changed(&mut self) -> Vec<RobotId> {
        let beats = self.beats.take_changed().into_iter().map(|(id, _)| id);
        let ids: BTreeSet<RobotId> = beats.chain(self.touched.take_changed().into_iter().map(|(id, _)| id)).collect();
        ids.into_iter().collect()
    }
}

/// The whole, then what changed, newest only, at the watcher's pace; a slow watcher lowers only its own rate.
async fn watch(
    inner: &Inner,
    filter: Filter,
    period: Duration,
    teller: &Teller<v1::WatchRobotsResponse>,
) -> Result<(), Gone> {
    let (beats, touched) = (inner.parts.board.watch(), inner.projection.touched());
    let mut watching = Watching { inner, filter, beats, touched, shown: BTreeSet::new() };
    // What is there already is part of the whole.
    let _ = watching.changed();
    watching.tell_whole(teller).await?;
    watching.tell_changes(period, teller).await
}
