//! One session after its Welcome: heartbeats to the board and back as echoes, lanes to the store and back as acknowledgements,
//! desired state down as it changes.
//!
//! Invariant: the stream is always drained; what is on its way to the store never holds up an echo.

use crate::enrolment::Waits;
use crate::event_rate::{self, lock};
use crate::events::{Batch, Events, Outcome, commit};
use crate::facts::count_misread;
use crate::inner::Inner;
use crate::offset::Offset;
use crate::projection::Sections;
use crate::registry::{InCharge, Replay};
use crate::shared_heartbeats::{News, Shared};
use crate::status::StatusLane;
use crate::stops::StopNews;
use crate::waits::{Keeping, await_kept, finish, is_cut_off, next_replay, sleep_until, until_over};
use crate::welcome::Begun;
use midshift_core::fleet::REPORT_TOO_LONG;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::RobotId;
use midshift_core::item::{Fact, Item};
use midshift_core::limits;
use midshift_core::reason::{Code, Reason, Refusal};
use midshift_core::robot::Lane;
use midshift_core::robot_events::{InboxEntry, InboxItem};
use midshift_core::rows::{Log, Writer};
use midshift_core::time::{LinkDuration, SiteTime};
use midshift_proto::GoAwayNotice;
use midshift_proto::link::v1;
use midshift_proto::session::{
    ClockSample, Close, CloseCode, Downlink, Echo, FromRobot, Heartbeat, Hello, LaneAck, LaneBatch, ToRobot, Uplink,
};
use midshift_proto::status::unreadable;
use std::collections::VecDeque;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;
use tonic::{Status, Streaming};
use tracing::field::Empty;

/// A robot that does not read what is sent is let go after this.
const UNREAD_MAX: Duration = Duration::from_secs(10);
/// Time to open the next session: what is left of the connection once it is old.
const MOVE_OVER_WITHIN: Duration = Duration::from_secs(30);
/// A robot whose gateway cannot reach the database looks for another after this: much of its authority is over by then.
const CUT_OFF_RETRY: LinkDuration = LinkDuration(500);
/// After a failed commit the robot is asked again not sooner than this.
const COMMIT_RETRY: Duration = Duration::from_millis(200);

/// Heartbeats of one session that wait to be kept; of more the oldest is not answered any more.
const UNECHOED_MAX: usize = 16;

type Boxed<T> = Pin<Box<dyn Future<Output = T> + Send>>;

/// A message down, or why there is none. Elsewhere: a queue has room for many from its first on.
pub type Word = Box<Result<v1::SessionResponse, Status>>;
/// To one robot.
pub type Down = mpsc::Sender<Word>;

/// A message as it goes down.
pub fn word(message: &ToRobot) -> Word {
    Box::new(Ok(message.into()))
}

/// A session under way.
pub(crate) struct Session {
    pub(crate) inner: Arc<Inner>,
    pub(crate) robot_id: RobotId,
    ring: Arc<str>,
    epoch: u64,
    pub(crate) in_charge: Option<InCharge>,
    /// What ends it; none: nothing does.
    waits: Option<Waits>,
    events: Events,
    rate: event_rate::SharedRate,
    committing: Option<Boxed<Outcome>>,
    /// A person is being told of a heartbeat that was too long.
    telling: Option<Boxed<bool>>,
    /// When a person was told of such a heartbeat; none: of none since one that could be read.
    too_long: Option<Instant>,
    pub(crate) status: StatusLane,
    /// STATUS that is being kept.
    pub(crate) keeping: Option<Keeping>,
    /// How far the ring's STATUS is durable, whichever session brought it.
    pub(crate) status_mark: Arc<AtomicU64>,
    /// Old STATUS from bulk; none: observed only.
    replays: Option<mpsc::Receiver<Replay>>,
    /// The last number of the batch from there that is being kept, and who waits for it.
    pub(crate) replaying: Option<(u64, oneshot::Sender<Result<LaneAck, Refusal>>)>,
    offset: Offset,
    progress: (u64, SiteTime),
    /// The map that the robot said last.
    map_version: String,
    /// The room for software that it said last.
    free_bytes: Option<u64>,
    /// Heartbeats that are not where other processes read them yet, with the answer they get then.
    unechoed: VecDeque<Echo>,
    /// What becomes of them.
    kept: (mpsc::Sender<News>, mpsc::Receiver<News>),
    stops: StopNews,
    out: Downlink,
    out_since: Option<Instant>,
}

/// Why the loop ends.
pub(crate) enum End {
    Gone,
    Close(Close),
}

/// Ends a session with a reason.
pub(crate) fn close(code: CloseCode, reason: Code, retry_after: LinkDuration) -> End {
    End::Close(Close { code, reason: Reason::from(reason), retry_after_ms: retry_after.as_ms() as u32 })
}

/// Runs a session to its end. The Welcome has been sent.
pub async fn run(
    inner: Arc<Inner>,
    hello: &Hello,
    begun: Begun,
    go_away: GoAwayNotice,
    mut up: Streaming<v1::SessionRequest>,
    down: Down,
) {
    let robot_id = hello.robot_id.clone();
    let epoch = begun.welcome.session_epoch;
    let mut desired = inner.projection.watch(&robot_id);
    desired.mark_changed();
    let now = inner.parts.clock.now();
    let (in_charge, replays) = begun.part.unzip();
    let is_observed = in_charge.is_none();
    let ring: Arc<str> = Arc::from(hello.ring.as_str());
    let mut session = Session {
        ring: ring.clone(),
        epoch,
        in_charge,
        waits: begun.waits,
        events: Events::new(begun.mark.0, begun.mark.1),
        rate: inner.event_rates.rate_of(&robot_id, Instant::now()),
        committing: None,
        telling: None,
        too_long: None,
        status: StatusLane::new(robot_id.clone(), ring.clone(), begun.status),
        keeping: None,
        // Of one that is only observed nothing is kept.
        status_mark: if is_observed {
            Arc::default()
        } else {
            inner.projection.status_mark(&robot_id, &ring, begun.status)
        },
        replays,
        replaying: None,
        offset: Offset::default(),
        progress: (0, now.site),
        map_version: hello.reported.map_version.clone(),
        free_bytes: hello.reported.free_bytes,
        unechoed: VecDeque::new(),
        kept: mpsc::channel(UNECHOED_MAX),
        stops: StopNews::new(inner.projection.watch_stops()),
        out: Downlink::default(),
        out_since: None,
        robot_id: robot_id.clone(),
        inner: inner.clone(),
    };
    let end = session.run(&go_away, &mut up, &down, &mut desired).await;
    if let End::Close(close) = end {
        // Of a session that is only observed nobody knows whether it is the robot.
        if close.code == CloseCode::Protocol && session.in_charge.is_some() {
            count_misread(&inner, &robot_id, close.reason.text());
        }
        let _ = down.try_send(word(&ToRobot::Close(close)));
    }
}

impl Session {
    async fn run(
        &mut self,
        go_away: &GoAwayNotice,
        up: &mut Streaming<v1::SessionRequest>,
        down: &Down,
        desired: &mut tokio::sync::watch::Receiver<Sections>,
    ) -> End {
        let fenced = self.in_charge.as_ref().map(|c| c.fenced.clone()).unwrap_or_default();
        let (ends, shutdown) = (self.inner.moving.clone(), self.inner.shutdown.clone());
        // Made once: a session is woken for each heartbeat.
        let (shut_down, is_fenced) = (shutdown.cancelled(), fenced.cancelled());
        tokio::pin!(shut_down, is_fenced);
        // The server goes, or the connection is old.
        let moves = async {
            tokio::select! {
                () = ends.cancelled() => {}
                () = go_away.begun() => {}
            }
        };
        tokio::pin!(moves);
        let mut cut_off = self.inner.shared.as_ref().map(Shared::cut_off);
        let over = until_over(self.inner.clone(), self.waits.take());
        tokio::pin!(over);
        let mut moves_until = None;
        loop {
            self.start_writes();
            let waits = self.out != Downlink::default();
            let unread_at = self.out_since.map(|since| since + UNREAD_MAX);
            let (ack_at, rate_at) = (self.status.ack_at(), self.rate_at());
            tokio::select! {
                biased;
                () = &mut shut_down => return close(CloseCode::Shutdown, Code::ShuttingDown, LinkDuration(500)),
                () = &mut is_fenced => {
                    let moved = self.in_charge.as_ref().is_some_and(|c| c.moving.load(Relaxed));
                    let (code, why) = if moved { (CloseCode::MoveOver, Code::MoveOver) } else { (CloseCode::Fenced, Code::Fenced) };
                    return close(code, why, limits::FENCED_RETRY);
                }
                permit = down.reserve(), if waits => match permit {
                    Ok(permit) => {
                        permit.send(word(&ToRobot::Downlink(Box::new(self.stamp()))));
                        self.out_since = None;
                    }
                    Err(_) => return End::Gone,
                },
                facts = self.stops.next(&self.robot_id), if self.out.stops.is_none() => {
                    self.change_out(|out| out.stops = Some(facts));
                }
                told = finish(&mut self.telling), if self.telling.is_some() => if !told {
                    self.too_long = None;
                },
                outcome = finish(&mut self.committing), if self.committing.is_some() => self.committed(outcome),
                is_kept = await_kept(&mut self.keeping), if self.awaits_kept() => self.status_written(is_kept),
                message = up.message() => match message {
                    Ok(Some(message)) => {
                        if let Some(end) = self.take_message(message) {
                            return end;
                        }
                    }
                    Ok(None) => return End::Gone,
                    Err(status) => return self.broken(&status),
                },
                replay = next_replay(&mut self.replays), if self.replaying.is_none() => self.replay(replay),
                changed = desired.changed(), if self.in_charge.is_some() => {
                    if changed.is_err() {
                        return End::Gone;
                    }
                    let sections = desired.borrow_and_update().clone();
                    self.change_out(|out| {
                        out.work = sections.work.as_deref().cloned();
                        out.policy = sections.policy.as_deref().cloned();
                        out.update = sections.update.as_deref().cloned();
                    });
                }
                Some(news) = self.kept.1.recv() => if let Some(end) = self.heard(news) {
                    return end;
                },
                () = is_cut_off(&mut cut_off) => {
                    return close(CloseCode::MoveOver, Code::StoreUnavailable, CUT_OFF_RETRY);
                }
                () = sleep_until(unread_at) => return close(CloseCode::TooSlow, Code::Overloaded, LinkDuration(1_000)),
                () = sleep_until(ack_at) => self.look_for_ack(),
                () = sleep_until(rate_at) => {}
                () = sleep_until(moves_until) => return close(CloseCode::MoveOver, Code::MoveOver, LinkDuration(0)),
                () = &mut moves, if moves_until.is_none() => {
                    moves_until = Some(Instant::now() + MOVE_OVER_WITHIN);
                    self.move_over(down);
                }
                () = &mut over => {
                    return close(CloseCode::MoveOver, Code::MoveOver, LinkDuration(0));
                }
            }
        }
    }

    /// What the robot sent cannot be read: it hears why, if there still is a stream.
    fn broken(&self, status: &Status) -> End {
        let Some(refusal) = unreadable(status) else { return End::Gone };
        let (code, why) = (refusal.reason.code.as_str(), refusal.reason.text());
        tracing::warn!(peer = Empty, robot_id = %self.robot_id, code, why, "session ended by a message that cannot be read");
        End::Close(Close { code: CloseCode::Protocol, reason: refusal.reason, retry_after_ms: 1_000 })
    }

    /// Asks the robot for its next session.
    fn move_over(&self, down: &Down) {
        if let Some(in_charge) = &self.in_charge {
            in_charge.moving.store(true, Relaxed);
        }
        let _ = down.try_send(word(&ToRobot::MoveOver { within_ms: MOVE_OVER_WITHIN.as_millis() as u32 }));
    }

    pub(crate) fn change_out(&mut self, change: impl FnOnce(&mut Downlink)) {
        change(&mut self.out);
        // What says nothing is not sent, and nobody is too slow for it.
        if self.out != Downlink::default() {
            self.out_since.get_or_insert_with(Instant::now);
        }
    }

    /// What is to be sent, with the moment of sending in its clock sample.
    fn stamp(&mut self) -> Downlink {
        let mut out = std::mem::take(&mut self.out);
        if let Some(echo) = &mut out.echo {
            echo.clock.t3_us = self.inner.parts.clock.now().wall.0 * 1000;
            if self.status.goes_with_echo() {
                out.acks.push(self.status.ack());
            }
        }
        out
    }

    fn take_message(&mut self, mut message: v1::SessionRequest) -> Option<End> {
        if let Some(list) = midshift_proto::convert::session::drop_long_heartbeat(&mut message) {
            self.heartbeat_too_long(list);
        }
        let read = midshift_proto::parse::<FromRobot, _>(message);
        let Ok(FromRobot::Uplink(Uplink { heartbeat, batches })) = read else {
            let detail = read.err().map_or_else(|| "a second hello".to_owned(), |e| e.reason.message);
            tracing::warn!(peer = Empty, robot_id = %self.robot_id, code = Code::ProtocolError.as_str(), why = %detail, "session ended by a message that breaks its rules");
            let reason = Reason::new(Code::ProtocolError, detail);
            return Some(End::Close(Close { code: CloseCode::Protocol, reason, retry_after_ms: 1_000 }));
        };
        if let Some(heartbeat) = heartbeat {
            self.too_long = None;
            self.heartbeat(heartbeat);
        }
        for batch in batches {
            match batch.lane {
                Lane::Status => {
                    if let Some(end) = self.status(&batch) {
                        return Some(end);
                    }
                }
                Lane::Critical | Lane::Event => self.events(batch),
            }
        }
        None
    }

    /// It is neither processed nor echoed, so that the robot's authority ends by itself.
    fn heartbeat_too_long(&mut self, list: &'static str) {
        metrics::counter!("midshift_telemetry_heartbeats_too_long_total").increment(1);
        let (now, every) = (Instant::now(), Duration::from_millis(limits::REPORT_TOO_LONG_TOLD_EVERY.as_ms()));
        let is_told = self.too_long.is_some_and(|told| now < told + every);
        if self.in_charge.is_none() || is_told || self.telling.is_some() {
            return;
        }
        self.too_long = Some(now);
        tracing::warn!(peer = Empty, robot_id = %self.robot_id, list, "heartbeats with a list that is too long are not processed");
        let (inner, robot_id) = (self.inner.clone(), self.robot_id.clone());
        self.telling = Some(Box::pin(async move {
            let mut item = Item::new(Writer::Telemetry, robot_id.as_str());
            item.facts.push(Fact {
                log: Log::Telemetry,
                subject: Arc::from(robot_id.as_str()),
                kind: REPORT_TOO_LONG,
                body: Arc::from(serde_json::json!({ "list": list }).to_string()),
            });
            matches!(inner.parts.store.commit(vec![item]).await.pop(), Some(Ok(_)))
        }));
    }

    fn heartbeat(&mut self, heartbeat: Heartbeat) {
        let now = self.inner.parts.clock.now();
        let t2_us = now.wall.0 * 1000;
        if let Some(sample) = heartbeat.clock {
            self.offset.add(sample);
        }
        let mut report = heartbeat.reported;
        report.session_epoch = self.epoch;
        if report.map_version.is_empty() {
            report.map_version.clone_from(&self.map_version);
        } else {
            self.map_version.clone_from(&report.map_version);
        }
        report.free_bytes = report.free_bytes.or(self.free_bytes);
        self.free_bytes = report.free_bytes;
        let hb = report.hb;
        let progress = report.progress();
        if progress != self.progress.0 {
            self.progress = (progress, now.site);
        }
        metrics::counter!("midshift_telemetry_heartbeats_total").increment(1);
        let Some(in_charge) = &self.in_charge else { return };
        in_charge.note_heard(now.link);
        let live = NewestHeartbeat {
            robot_id: self.robot_id.clone(),
            report,
            processed_at: now.link,
            processed_site: now.site,
            received_unix_ms: now.wall.0,
            progress_at: self.progress.1,
            clock: self.offset.estimate(),
        };
        let live = Arc::new(live);
        let clock = ClockSample { t1_us: heartbeat.sent_unix_us, t2_us, t3_us: t2_us, t4_us: 0 };
        let is_clock_doubted = self.inner.parts.clock.doubt().is_some();
        let echo = Echo { hb, clock, is_clock_doubted };
        match &self.inner.shared {
            None => {
                self.inner.parts.board.publish(&self.robot_id, live);
                self.change_out(|out| out.echo = Some(echo));
            }
            Some(shared) => {
                shared.queue(live, &self.kept.0);
                self.unechoed.push_back(echo);
                if self.unechoed.len() > UNECHOED_MAX {
                    self.unechoed.pop_front();
                }
            }
        }
    }

    /// A heartbeat is where every process can read it, or will never be.
    fn heard(&mut self, news: News) -> Option<End> {
        match news {
            News::Fenced => return Some(close(CloseCode::Fenced, Code::Fenced, limits::FENCED_RETRY)),
            News::Kept(hb) => {
                let upto = self.unechoed.iter().take_while(|echo| echo.hb <= hb).count();
                let newest = self.unechoed.drain(..upto).next_back();
                if newest.is_some() {
                    self.change_out(|out| out.echo = newest);
                }
            }
        }
        None
    }

    fn events(&mut self, batch: LaneBatch) {
        if self.in_charge.is_none() {
            return;
        }
        let (robot_id, ring, lane, epoch) = (&self.robot_id, &self.ring, batch.lane, self.epoch);
        let clock = self.offset.estimate();
        let ahead_ms = clock.map_or(limits::SKEW_ALERT_MS, |clock| clock.clock_offset_ms + clock.clock_error_ms as i64);
        let wall = self.inner.parts.clock.now().wall.0;
        let bugs = self.inner.parts.bugs;
        let arrived = self.events.arrive(batch, bugs, |what| InboxEntry {
            robot_id: robot_id.clone(),
            session_epoch: epoch,
            ring: ring.to_string(),
            lane,
            stamp_in_future: matches!(&what, InboxItem::Sample(s) if s.robot_unix_ms > wall + ahead_ms),
            what,
        });
        let naive = bugs.ack_before_commit().then(|| self.events.taken());
        let known = arrived.known.then(|| self.events.acks());
        let acks: Vec<LaneAck> =
            arrived.expect.into_iter().chain(naive.into_iter().flatten()).chain(known.into_iter().flatten()).collect();
        if !acks.is_empty() {
            self.change_out(|out| out.acks.extend(acks));
        }
    }

    /// Begins the writes that wait, at most one of each kind at a time.
    fn start_writes(&mut self) {
        if self.committing.is_none()
            && let Some(batch) = self.next_events()
        {
            self.committing = Some(self.commit(batch));
        }
        let asked = self.events.ask_again();
        if !asked.is_empty() {
            self.change_out(|out| out.acks.extend(asked));
        }
        self.keep_status();
    }

    /// The next events to keep, as many as the robot's rate allows.
    fn next_events(&mut self) -> Option<Batch> {
        let waiting = self.events.waiting();
        if waiting == 0 {
            return None;
        }
        let now = Instant::now();
        let mut rate = lock(&self.rate);
        let allowed = rate.allowed(waiting, now);
        if rate.is_told(now) {
            tracing::warn!(peer = Empty, robot_id = %self.robot_id, waiting, "more events than the robot may send are kept and acknowledged later");
        }
        drop(rate);
        let batch = self.events.next_batch(&self.robot_id, self.inner.parts.clock.now().wall, allowed)?;
        if allowed < waiting {
            metrics::counter!("midshift_telemetry_commits_slowed_total").increment(1);
        }
        Some(batch)
    }

    /// When some of the events that wait are allowed; none: none waits, or some are being kept.
    fn rate_at(&self) -> Option<Instant> {
        let waiting = self.events.waiting();
        (waiting > 0 && self.committing.is_none()).then(|| lock(&self.rate).next_at(waiting))
    }

    fn commit(&self, batch: Batch) -> Boxed<Outcome> {
        let inner = self.inner.clone();
        Box::pin(async move {
            let begun = Instant::now();
            let outcome = commit(inner, batch).await;
            if !matches!(outcome, Outcome::Done(..)) {
                tokio::time::sleep(COMMIT_RETRY).await;
            }
            metrics::histogram!("midshift_telemetry_event_commit_seconds").record(begun.elapsed().as_secs_f64());
            outcome
        })
    }

    fn committed(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Done(mark, facts) => {
                lock(&self.rate).spend(facts);
                self.events.done(mark);
                let acks = self.events.acks();
                self.change_out(|out| out.acks.extend(acks));
            }
            Outcome::Again(mark, revision) => {
                let acks = self.events.reset(mark, revision);
                self.change_out(|out| out.acks.extend(acks));
            }
            // Nothing is acknowledged; what arrives next finds the store again or not.
            Outcome::Lost => {
                let acks = self.events.acks();
                let again = acks.map(|ack| LaneAck { expect: Some(ack.seq + 1), ..ack });
                self.events.forget_taken();
                self.change_out(|out| out.acks.extend(again));
            }
        }
    }
}
