//! The agent without IO: `step(now, input)` decides, drives the body, and says what to keep and what to send.
//!
//! Invariant: no clock, no randomness, no waiting. Nothing that depends on a write leaves before [`Input::Persisted`] said that the
//! write is durable: no message of it, no movement on it. Called by the shell ([`crate::session`]) and by simulations.

use crate::body::{Body, BodyLimits};
use crate::bugs::Bugs;
use crate::lanes::{STATUS_SAMPLE_BYTES, Sender};
use crate::ledger::SessionMemory;
use crate::load::ListedLoad;
use crate::places::Places;
use crate::replay::{Pace, Replayed};
use crate::stop::{CheckIn, StopNews, Stops};
use crate::store::{Kept, Op};
use crate::throttle::Throttle;
use crate::update::{Done, Job, UpdateConfig, Updater};
use crate::work::{Doing, Work};
use midshift_core::authority::SentHeartbeats;
use midshift_core::ids::{AttemptId, PlaceId, RobotId, WaypointId};
use midshift_core::limits;
use midshift_core::robot::{Fault, FaultClass, HardwareStop, Inventory, Lane, Mode, ReportedState, StopLevel, Vitals};
use midshift_core::time::{LinkDuration, LinkTime, Now, SiteDuration, SiteTime, Utc};
use midshift_core::work::{DesiredPolicy, DesiredWork, RobotEvent, SampleBody};
use midshift_proto::session::{ClockSample, Downlink, Heartbeat, LaneAck, LaneBatch, StatusReplay, Uplink, Welcome};
use std::collections::{BTreeSet, VecDeque};

/// What does not change while the agent runs.
#[derive(Clone, Debug)]
pub struct CoreConfig {
    /// The robot that the agent is of.
    pub robot_id: RobotId,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
    /// What it believes of software; none: its software is not changed.
    pub update: Option<UpdateConfig>,
    /// Its server proves itself on each connection: what time it tells is believed within bounds.
    pub server_is_proven: bool,
}

/// What happened outside.
#[derive(Clone, Debug)]
pub enum Input {
    /// The process began. Once, first.
    Start,
    /// Time went on; see [`AgentCore::next_wake`].
    Tick,
    /// A session began.
    Connected(Welcome),
    /// The server says something.
    Down(Box<Downlink>),
    /// The session ended.
    Disconnected,
    /// The server said that a newer session of this robot proved its succession.
    Fenced,
    /// This batch and all before it are durable.
    Persisted(u64),
    /// What came of the job under way.
    Done(Box<Done>),
    /// The line to the stop service, or the file of stops, says something.
    Stop(Box<StopNews>),
    /// What came of the old STATUS under way, in the session of this epoch.
    Replayed(u64, Replayed),
}

/// Why the agent ends by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitReason {
    /// Asked to.
    Shutdown,
    /// Fenced for the second time: another machine has this robot's id and proof.
    FencedTwice,
    /// The switch record names another set: whoever started the program starts it again.
    Switched,
}

/// What to do, in this order.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// Make these operations durable and say [`Input::Persisted`] with this number. At most one is under way.
    Persist(u64, Vec<Op>),
    /// Send this in the session at hand; drop it if there is none.
    Send(Box<Uplink>),
    /// Send this over bulk and say [`Input::Replayed`]; drop it with its session. At most one is under way.
    Replay(Box<StatusReplay>),
    /// Do this beside everything else and say [`Input::Done`]. At most one is under way.
    Job(Box<Job>),
    /// Say this to the stop service under this number; drop it if there is no line.
    CheckIn(u64, Box<CheckIn>),
    /// Make a new line to the stop service: this one does not work.
    RedialStop(&'static str),
    /// Keep these stops and say [`StopNews::Kept`] with this number. At most one is under way.
    KeepStops(u64, Box<midshift_core::stop::robot::Kept>),
    /// Leave the job under way: what it has so far is kept.
    DropJob,
    /// End the process.
    Exit(ExitReason),
}

/// When to call again if nothing happens before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wake {
    /// On the link clock.
    pub link: LinkTime,
    /// On the site clock.
    pub site: Option<SiteTime>,
}

/// The session at hand.
#[derive(Debug)]
struct Session {
    epoch: u64,
    hb: u64,
    observed: bool,
    /// The map that its heartbeats have told; empty: none yet.
    told_map: String,
    /// The room for software that its heartbeats have told; none: none yet.
    told_room: Option<u64>,
}

impl Session {
    /// The room for software, if that is news: it was not told yet, or has changed by a tenth.
    fn room_to_tell(&mut self, free_bytes: Option<u64>) -> Option<u64> {
        let is_news = |now: &u64| self.told_room.is_none_or(|told| *now != told && now.abs_diff(told) >= told / 10);
        let news = free_bytes.filter(is_news);
        self.told_room = news.or(self.told_room);
        news
    }
}

/// Writes under way and waiting.
#[derive(Debug, Default)]
struct Writes {
    ops: Vec<Op>,
    urgent: bool,
    given: u64,
    durable: u64,
    batch: u64,
    /// Batch, number of its last operation, lane numbers at its end.
    in_flight: Option<(u64, u64, [u64; 3])>,
    barrier: u64,
}

/// What the robot runs.
pub struct AgentCore {
    pub(crate) config: CoreConfig,
    pub(crate) body: Box<dyn Body>,
    pub(crate) limits: BodyLimits,
    pub(crate) inventory: Inventory,
    pub(crate) kept: Kept,
    pub(crate) places: Places,
    pub(crate) work: Option<Work>,
    pub(crate) desired: Option<DesiredWork>,
    /// The newest section work cannot be read: it acts as if its authority had ended.
    pub(crate) work_unreadable: bool,
    pub(crate) sent: SentHeartbeats,
    pub(crate) mode: Mode,
    pub(crate) hardware_stop: HardwareStop,
    pub(crate) heading: Option<WaypointId>,
    pub(crate) echo_after: Option<LinkTime>,
    pub(crate) resume_needed: bool,
    pub(crate) refused: VecDeque<AttemptId>,
    pub(crate) answered: BTreeSet<AttemptId>,
    pub(crate) stale_told: BTreeSet<(u64, u64, u64)>,
    pub(crate) last_site: SiteTime,
    pub(crate) wake_link: Option<LinkTime>,
    pub(crate) wake_site: Option<SiteTime>,
    pub(crate) update: Updater,
    /// None: it has no line to a stop service, and obeys none.
    pub(crate) stop: Option<Box<Stops>>,
    pub(crate) authority: LinkDuration,
    pub(crate) listed_load: ListedLoad,
    session: Option<Session>,
    sender: Sender,
    pace: Pace,
    throttle: Throttle,
    writes: Writes,
    standing_fault: Option<Fault>,
    /// The body failed its maker's test when this process began.
    pub(crate) unfit: Option<Fault>,
    battery_critical: bool,
    odometer_mm: u64,
    progress: u64,
    period: LinkDuration,
    next_beat: LinkTime,
    /// No heartbeat before this, whatever happens: a quarter of the period after the last one.
    beat_floor: LinkTime,
    status_period: SiteDuration,
    next_status: SiteTime,
    clock: Option<ClockSample>,
    fences: u32,
}

const STATUS_PERIOD: SiteDuration = SiteDuration(2_000);
/// Above the critical threshold by this much the battery may become critical again, permille.
const BATTERY_HYSTERESIS: u16 = 20;

impl AgentCore {
    /// A robot that remembers `kept`. Call with [`Input::Start`] first.
    pub fn new(config: CoreConfig, body: Box<dyn Body>, kept: Kept, now: Now) -> Self {
        let bugs = config.bugs;
        let (places, restored) = Places::restored(kept.ledger.places.clone(), bugs.grant_from_receipt());
        let mut throttle = Throttle::new(now.link);
        restored.into_iter().for_each(|event| throttle.push(Lane::Event, event));
        Self {
            limits: body.limits(),
            inventory: body.capabilities(),
            mode: body.mode(),
            hardware_stop: body.hardware_stop(),
            work: kept.ledger.holder.clone().map(Work::restored),
            sender: Sender::new(&kept.ring),
            update: Updater { config: config.update.clone(), ..Updater::default() },
            config,
            body,
            kept,
            places,
            throttle,
            desired: None,
            work_unreadable: false,
            sent: SentHeartbeats::new(0, None),
            heading: None,
            echo_after: None,
            resume_needed: false,
            refused: VecDeque::new(),
            answered: BTreeSet::new(),
            stale_told: BTreeSet::new(),
            last_site: now.site,
            wake_link: None,
            wake_site: None,
            stop: None,
            authority: limits::AUTHORITY,
            listed_load: ListedLoad::default(),
            session: None,
            pace: Pace::default(),
            writes: Writes::default(),
            standing_fault: None,
            unfit: None,
            battery_critical: false,
            odometer_mm: 0,
            progress: 0,
            period: limits::HEARTBEAT,
            next_beat: now.link,
            beat_floor: now.link,
            status_period: STATUS_PERIOD,
            next_status: now.site,
            clock: None,
            fences: 0,
        }
    }

    /// Takes one input at one moment and says what to do about it.
    pub fn step(&mut self, now: Now, input: Input) -> Vec<Output> {
        let mut out = Vec::new();
        (self.wake_link, self.wake_site) = (None, None);
        if let Input::Persisted(batch) = input {
            self.persisted(batch);
        }
        self.elapse(&now);
        self.take_news(&now);
        let yields = self.config.bugs.stop_yields_to_disk() && self.writes.in_flight.is_some();
        match &input {
            Input::Stop(news) if !yields => self.hear_stop(&now, StopNews::clone(news)),
            Input::Down(down) => self.hear_stop_beside(&now, down),
            _ => {}
        }
        self.obey(&now);
        match input {
            Input::Start => self.start(&now),
            Input::Tick | Input::Persisted(_) | Input::Stop(_) => {}
            Input::Connected(welcome) => self.connected(&now, welcome),
            Input::Down(down) => {
                // What the body has just ended is over before the server's word about it is heard.
                self.advance(&now);
                self.down(&now, *down);
            }
            Input::Disconnected => self.session = None,
            Input::Done(done) => self.job_done(&now, *done),
            Input::Replayed(session_epoch, replayed) => self.replayed(&now, session_epoch, replayed),
            Input::Fenced => {
                self.fences += 1;
                self.session = None;
                if self.fences >= 2 {
                    out.push(Output::Exit(ExitReason::FencedTwice));
                }
            }
        }
        self.obey(&now);
        self.advance(&now);
        self.say_stop(&now, &mut out);
        out.extend(self.pursue_update(&now).map(Output::Exit));
        let beat = self.beat(&now);
        self.write_events(&now);
        self.persist(&now, beat, &mut out);
        self.start_job(&mut out);
        self.send(&now, beat, &mut out);
        out
    }

    /// When to call again.
    pub fn next_wake(&self, now: &Now) -> Wake {
        let replay = self.pace.next_at(now.link).filter(|_| self.session.is_some() && self.sender.replays_apart());
        let (stop_link, stop_site) = self.stop_wakes();
        let link = [Some(self.next_beat), self.wake_link, self.throttle.next_at(), replay, stop_link];
        let body = self.body.next_change(now.site);
        let site = [Some(self.next_status), body, self.times_out_at(now), self.wake_site, stop_site];
        Wake {
            link: link.into_iter().flatten().min().unwrap_or(self.next_beat),
            site: site.into_iter().flatten().min(),
        }
    }

    /// What the robot believes of itself now, as Hello and heartbeat say it.
    pub fn reported(&self, now: &Now) -> ReportedState {
        let session = self.session.as_ref();
        ReportedState {
            hb: session.map_or(0, |s| s.hb),
            session_epoch: session.map_or(0, |s| s.epoch),
            applied_work: self.kept.ledger.applied.work,
            applied_policy: self.kept.ledger.applied.policy,
            applied_update: self.kept.ledger.applied.update,
            produced: Lane::ALL.into_iter().map(|lane| (lane, self.kept.ring.lane(lane).produced)).collect(),
            mode: self.mode,
            vitals: self.vitals(now),
            load: self.body.load(),
            attempts: self.reported_attempts(now),
            places: self.places.held(),
            stop_level: self.stop_level(),
            stops: self.stops_inside(),
            awaiting_resume: self.stops_awaiting(),
            map_version: self.body.map_version(),
            free_bytes: self.holdings().map(|holdings| holdings.free_bytes),
            hardware_stop: self.hardware_stop,
            field_violation: self.body.state(now.site).field_violation,
            fault: self.unfit.as_ref().or(self.standing_fault.as_ref()).cloned(),
            update: self.update_report().filter(|u| session.is_none() || !u.state.is_over()),
        }
    }

    /// The process ends: nobody drives the body any more, so it stands.
    pub fn halt(&mut self, now: Now) {
        if self.work.is_some() || !self.body.standstill(now.site) {
            self.body.stop(now.site, StopLevel::Halt);
        }
    }

    /// What it remembers.
    pub fn kept(&self) -> &Kept {
        &self.kept
    }

    /// The robot that the agent is of.
    pub fn robot_id(&self) -> &RobotId {
        &self.config.robot_id
    }

    /// What it says of itself in Hello.
    pub fn inventory(&self) -> &Inventory {
        &self.inventory
    }

    /// The body, for a simulation that looks at it.
    pub fn body(&self) -> &dyn Body {
        self.body.as_ref()
    }

    /// Gives the body back, for a simulation that crashes the agent around it.
    pub fn into_body(self) -> Box<dyn Body> {
        self.body
    }

    fn vitals(&self, now: &Now) -> Vitals {
        let state = self.body.state(now.site);
        Vitals {
            pose: Some(state.pose),
            waypoint: state.waypoint,
            speed_mm_s: state.speed_mm_s,
            battery_permille: state.battery_permille,
            charging: state.charging,
            hottest_joint_decidegrees: state.hottest_joint_decidegrees,
            odometer_mm: state.odometer_mm,
            loaded_odometer_mm: state.loaded_odometer_mm,
            energy_mwh: state.energy_mwh,
        }
    }

    fn start(&mut self, now: &Now) {
        if !self.body.standstill(now.site) {
            self.body.stop(now.site, StopLevel::Halt);
        }
        if let Err(fault) = self.body.self_test(now.site) {
            self.failed_test(fault);
        }
        self.note_where_it_stands();
        self.write_places();
        self.judge_intent();
    }

    /// Standing places are called like their waypoints.
    pub(crate) fn note_where_it_stands(&mut self) {
        for waypoint in self.body.stands_on() {
            if let Ok(place_id) = PlaceId::parse(waypoint.as_str()) {
                let event = self.places.stands_on(place_id);
                event.into_iter().for_each(|e| self.emit(Lane::Event, e));
            }
        }
    }

    fn connected(&mut self, now: &Now, welcome: Welcome) {
        self.sent = SentHeartbeats::new(welcome.session_epoch, self.sent.lease_from());
        self.session = Some(Session {
            epoch: welcome.session_epoch,
            hb: 0,
            observed: welcome.observed,
            told_map: String::new(),
            told_room: None,
        });
        self.listed_load.clear();
        let old = &self.kept.ledger.session;
        if old.store_id != welcome.store_id {
            self.answered.clear();
            if !old.store_id.is_empty() {
                self.write(Op::Applied(crate::ledger::Applied::default()), true);
            }
        }
        let memory = SessionMemory {
            session_epoch: welcome.session_epoch,
            secret: welcome.session_secret,
            store_id: welcome.store_id,
        };
        self.write(Op::Session(memory), true);
        for ack in &welcome.acks {
            for op in self.kept.ring.jump(ack.lane, ack.seq) {
                tracing::error!(lane = ack.lane.as_str(), watermark = ack.seq, "ring behind server, numbers moved on");
                self.write(op, true);
            }
        }
        welcome.acks.iter().for_each(|ack| self.acked(ack));
        self.sender.connected(&self.kept.ring, welcome.status_credit_bytes as usize);
        self.pace = Pace::default();
        if welcome.observed {
            // Nothing of it is stored, whichever way it goes.
            self.sender.replay_on_link();
        }
        welcome.acks.iter().for_each(|ack| self.expected(ack));
        self.period = LinkDuration(u64::from(welcome.heartbeat_period_ms).clamp(100, limits::AUTHORITY.as_ms() / 3));
        // The server may give less; more than both ends were built for it cannot give.
        self.authority = LinkDuration(u64::from(welcome.authority_ms).min(limits::AUTHORITY.as_ms()));
        self.status_period = SiteDuration(u64::from(welcome.status_period_ms).max(100));
        self.next_beat = now.link;
        self.clock = None;
    }

    fn down(&mut self, now: &Now, down: Downlink) {
        let observed = self.is_observed();
        if let Some(echo) = down.echo {
            if !observed {
                self.sent.echoed(echo.hb);
                self.update.server_reached = Some(now.link);
            }
            self.clock = Some(ClockSample { t4_us: now.wall.0 * 1000, ..echo.clock });
            if !echo.is_clock_doubted {
                self.told_the_time(Utc(echo.clock.t3_us / 1000));
            }
        }
        for ack in &down.acks {
            self.acked(ack);
            self.expected(ack);
        }
        if let Some(bytes) = down.status_credit_bytes {
            self.sender.credit(bytes as usize);
        }
        if let Some(policy) = down.policy {
            self.on_policy(policy);
        }
        if let Some(update) = down.update {
            self.on_update(update);
        }
        if let Some(why) = down.unreadable_work {
            self.cannot_read_work(&why);
        }
        if let Some(work) = down.work {
            self.on_work(now, work);
        }
    }

    fn on_policy(&mut self, policy: DesiredPolicy) {
        let mut applied = self.kept.ledger.applied;
        if policy.generation < applied.policy {
            tracing::warn!(generation = policy.generation, applied = applied.policy, "older policy refused");
            return;
        }
        if policy.areas != self.kept.ledger.policy {
            self.write(Op::Policy(policy.areas), true);
        }
        applied.policy = policy.generation;
        self.write(Op::Applied(applied), false);
    }

    fn acked(&mut self, ack: &LaneAck) {
        if let Some(op) = self.kept.ring.ack(ack.lane, ack.seq) {
            self.write(op, false);
        }
    }

    fn expected(&mut self, ack: &LaneAck) {
        let Some(expect) = ack.expect else { return };
        if let Some(op) = self.kept.ring.expected(ack.lane, expect) {
            self.write(op, true);
        }
        self.sender.rewind(ack.lane, expect);
    }

    pub(crate) fn is_observed(&self) -> bool {
        self.session.as_ref().is_some_and(|s| s.observed)
    }

    /// The session at hand.
    pub(crate) fn session_epoch(&self) -> Option<u64> {
        self.session.as_ref().map(|s| s.epoch)
    }

    /// Applies an operation and queues it for the store. Not urgent: it may wait for the next second's group.
    pub(crate) fn write(&mut self, op: Op, urgent: bool) {
        self.kept.apply(&op);
        self.writes.ops.push(op);
        self.writes.given += 1;
        self.writes.urgent |= urgent;
    }

    /// Work goes on only after everything written so far is durable.
    pub(crate) fn wait_until_durable(&mut self) {
        self.writes.barrier = self.writes.given;
    }

    /// Count of everything written so far, for [`Self::durable_up_to`]; what of it still waits is made durable soon.
    pub(crate) fn written(&mut self) -> u64 {
        self.writes.urgent |= !self.writes.ops.is_empty();
        self.writes.given
    }

    /// Whether so many writes are durable.
    pub(crate) fn durable_up_to(&self, count: u64) -> bool {
        self.writes.durable >= count
    }

    pub(crate) fn is_durable(&self) -> bool {
        self.writes.durable >= self.writes.barrier
    }

    /// Writes places down if they changed.
    pub(crate) fn write_places(&mut self) {
        if self.places.row != self.kept.ledger.places {
            self.write(Op::Places(self.places.row.clone()), true);
        }
    }

    /// Says a fact in its lane.
    pub(crate) fn emit(&mut self, lane: Lane, event: RobotEvent) {
        self.throttle.push(lane, event);
    }

    pub(crate) fn progressed(&mut self) {
        self.progress += 1;
    }

    pub(crate) fn progress(&self) -> u64 {
        self.progress
    }

    pub(crate) fn fault_changed(&mut self, fault: Fault, stands: bool) {
        let is_this = |f: &Fault| f.code == fault.code;
        let same = self.standing_fault.as_ref().is_some_and(is_this);
        if !stands && self.unfit.as_ref().is_some_and(is_this) {
            self.unfit = None;
        }
        self.emit(Lane::Critical, RobotEvent::Fault { fault: fault.clone(), cleared: !stands });
        if stands {
            self.standing_fault = Some(fault);
        } else if same {
            self.standing_fault = None;
        }
    }

    /// No work is accepted until the body says that this fault is over, or a later process begins with a test that passes. It is told as
    /// one that a person must look at: nobody may wait for it to pass by itself.
    fn failed_test(&mut self, fault: Fault) {
        tracing::error!(robot_id = %self.config.robot_id, code = fault.code, "the body failed its test");
        let class = if fault.class == FaultClass::Recoverable { FaultClass::Mechanical } else { fault.class };
        let fault = Fault { class, ..fault };
        self.unfit = Some(fault.clone());
        self.fault_changed(fault, true);
    }

    /// The next heartbeat goes with this step, or as soon as one may go.
    pub(crate) fn beat_at_once(&mut self, now: &Now) {
        self.next_beat = self.next_beat.min(now.link.max(self.beat_floor));
    }

    /// What falls due by time alone. True: a heartbeat is due.
    fn beat(&mut self, now: &Now) -> bool {
        let beat = now.link >= self.next_beat;
        let early = if beat { SiteDuration(self.status_period.as_ms() / 4) } else { SiteDuration(0) };
        if now.site + early >= self.next_status {
            self.next_status = now.site + self.status_period;
            let vitals = self.vitals(now);
            self.check_battery(vitals.battery_permille);
            for op in self.kept.ring.append(Lane::Status, now.wall.0, SampleBody::Status(vitals)) {
                self.write(op, false);
            }
        }
        if beat {
            self.beat_floor = now.link + LinkDuration(self.period.as_ms() / 4);
            self.next_beat = (self.next_beat + self.period).max(now.link + LinkDuration(self.period.as_ms() / 2));
            self.note_progress(now);
        }
        beat
    }

    fn note_progress(&mut self, now: &Now) {
        let odometer_mm = self.body.state(now.site).odometer_mm;
        if odometer_mm != self.odometer_mm || self.work.as_ref().is_some_and(Work::goes_on_by_itself) {
            self.progress += 1;
        }
        self.odometer_mm = odometer_mm;
    }

    fn check_battery(&mut self, battery_permille: u16) {
        let critical = self.limits.battery_critical_permille;
        if battery_permille < critical && !self.battery_critical {
            self.battery_critical = true;
            self.emit(Lane::Critical, RobotEvent::BatteryCritical { battery_permille });
        } else if battery_permille >= critical + BATTERY_HYSTERESIS {
            self.battery_critical = false;
        }
    }

    fn write_events(&mut self, now: &Now) {
        self.write_places();
        while let Some((lane, event)) = self.throttle.ready(now.link) {
            for op in self.kept.ring.append(lane, now.wall.0, SampleBody::Event(event)) {
                self.write(op, true);
            }
        }
    }

    fn persist(&mut self, now: &Now, beat: bool, out: &mut Vec<Output>) {
        let due = self.writes.urgent || beat || self.writes.ops.len() >= limits::SAMPLES_PER_MESSAGE;
        if self.writes.in_flight.is_some() || self.writes.ops.is_empty() || !due {
            return;
        }
        let forget = self.kept.ledger.forgettable(now.wall.0);
        forget.into_iter().for_each(|op| self.write(op, false));
        self.writes.batch += 1;
        self.writes.urgent = false;
        let lanes = Lane::ALL.map(|lane| self.kept.ring.lane(lane).produced);
        self.writes.in_flight = Some((self.writes.batch, self.writes.given, lanes));
        out.push(Output::Persist(self.writes.batch, std::mem::take(&mut self.writes.ops)));
    }

    fn persisted(&mut self, batch: u64) {
        if let Some((number, given, lanes)) = self.writes.in_flight
            && number == batch
        {
            self.writes.in_flight = None;
            self.writes.durable = given;
            self.sender.durable(lanes);
        }
    }

    /// Critical, event, the live heartbeat, then STATUS, which travels with heartbeats, or what is old of it beside them.
    fn send(&mut self, now: &Now, beat: bool, out: &mut Vec<Output>) {
        if self.session.is_none() {
            return;
        }
        let mut message = Uplink::default();
        self.send_lane(Lane::Critical, &mut message, out);
        self.send_lane(Lane::Event, &mut message, out);
        if beat {
            message.heartbeat = self.heartbeat(now);
        }
        let waiting = self.kept.ring.lane(Lane::Status).samples.len();
        if beat || waiting > limits::SAMPLES_PER_MESSAGE / 8 {
            self.send_lane(Lane::Status, &mut message, out);
        }
        if message != Uplink::default() {
            out.push(Output::Send(Box::new(message)));
        }
        self.send_replay(now, out);
    }

    fn send_lane(&mut self, lane: Lane, message: &mut Uplink, out: &mut Vec<Output>) {
        let size = |b: &LaneBatch| b.items.len();
        while let Some(batch) = self.sender.next_batch(&self.kept.ring, lane) {
            let have: usize = message.batches.iter().map(size).sum();
            if have + size(&batch) > limits::SAMPLES_PER_MESSAGE {
                out.push(Output::Send(Box::new(std::mem::take(message))));
            }
            message.batches.push(batch);
        }
    }

    /// Old STATUS goes beside the session, at its own pace.
    fn send_replay(&mut self, now: &Now, out: &mut Vec<Output>) {
        if self.session.is_none() || !self.pace.is_due(now.link) {
            return;
        }
        let Some(batch) = self.sender.next_replay(&self.kept.ring) else { return };
        let cap_bytes_s = self.update.desired.as_ref().map_or(0, |d| d.rate_bytes_s);
        self.pace.sent(now.link, batch.items.len() * STATUS_SAMPLE_BYTES, cap_bytes_s);
        let memory = &self.kept.ledger.session;
        out.push(Output::Replay(Box::new(StatusReplay {
            robot_id: self.config.robot_id.clone(),
            session_epoch: memory.session_epoch,
            session_secret: memory.secret.clone(),
            batch,
        })));
    }

    /// The server's word on a batch counts as on the session; what brought nothing is tried again, and then left to the session.
    fn replayed(&mut self, now: &Now, session_epoch: u64, replayed: Replayed) {
        if self.session.as_ref().is_none_or(|s| s.epoch != session_epoch) {
            return;
        }
        let before = self.kept.ring.lane(Lane::Status).acked;
        if let Replayed::Stored(ack) = &replayed {
            self.acked(ack);
        }
        self.sender.replayed(&self.kept.ring);
        if let Replayed::Stored(ack) = &replayed {
            self.expected(ack);
        }
        let goes_on = match &replayed {
            Replayed::Stored(_) if self.kept.ring.lane(Lane::Status).acked > before => {
                self.pace.went_well();
                true
            }
            Replayed::NotServed => false,
            Replayed::Stored(_) | Replayed::Failed(_) => self.pace.came_to_nothing(now.link),
        };
        if !goes_on {
            tracing::info!(robot_id = %self.config.robot_id, ?replayed, "old status goes on the session");
            self.sender.replay_on_link();
        }
    }

    fn heartbeat(&mut self, now: &Now) -> Option<Heartbeat> {
        let session = self.session.as_mut()?;
        session.hb += 1;
        self.sent.sent(session.hb, now.link);
        let mut reported = self.reported(now);
        self.listed_load.note(reported.hb, reported.load.as_ref());
        if self.desired.is_none() {
            // Grants are not on the ledger: until the server has said them again, what is not listed here proves nothing.
            reported.applied_work = 0;
        }
        match self.session.as_mut().filter(|session| session.told_map != reported.map_version) {
            Some(session) => session.told_map.clone_from(&reported.map_version),
            None => reported.map_version.clear(),
        }
        reported.free_bytes = self.session.as_mut().and_then(|session| session.room_to_tell(reported.free_bytes));
        Some(Heartbeat { reported, sent_unix_us: now.wall.0 * 1000, clock: self.clock.take() })
    }

    /// Whether the body is under way for this work.
    pub(crate) fn is_driving(&self) -> bool {
        self.work.as_ref().is_some_and(|w| w.doing == Doing::Driving)
    }
}
