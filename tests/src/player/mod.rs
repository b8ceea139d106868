//! A robot that behaves badly: what one seed lets it say is legal by link.v1 and may be late, repeated, contradictory or impossible.
//!
//! Invariant: every message can be read by the rules of the wire; only what it says is wrong. Nothing here does IO or reads a clock, so the
//! same seed says the same in the simulation and over a socket. `habit` and `habits` are what is wrong with it, `work` is what it does of its work,
//! `line` carries its words.

mod habit;
mod habits;
mod job;
pub mod line;
mod work;

pub use habit::Habit;

use job::Job;
use midshift_core::desired_state::DesiredWork;
use midshift_core::ids::{AttemptId, PlaceId, RobotId, TaskId, WaypointId};
use midshift_core::limits;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{HeldPlace, Inventory, Lane, ReportedAttempt, ReportedState, StopLevel, Vitals, WorkState};
use midshift_core::robot_events::{Gap, InboxItem, PlaceNews, RobotEvent, Sample, SampleBody};
use midshift_core::site::Site;
use midshift_proto::link::v1;
use midshift_proto::session::{
    ClockSample, FromRobot, Heartbeat, Hello, LaneAck, LaneBatch, LanePosition, Previous, ToRobot, Uplink, Welcome,
};
use prost::Message;
use rand::rngs::StdRng;
use rand::seq::{IndexedRandom, IteratorRandom};
use rand::{RngExt, SeedableRng};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Samples that it keeps until they are acknowledged; what comes after is forgotten.
const KEPT_MAX: usize = 512;
/// Bytes of samples in one message: a control message takes 64 KiB.
const MESSAGE_BYTES: usize = 40 * 1024;
/// Starting places of a site that it may stand on: honest robots begin at the other end.
const SEATS: usize = 30;
/// Habits of one seed at most.
const HABITS_MAX: usize = 5;

/// What it can name: everything else it has heard of.
#[derive(Clone, Debug, Default)]
pub struct Around {
    /// Waypoints of the site; the first is where it says that it stands.
    pub waypoints: Vec<WaypointId>,
    /// Places of the site.
    pub places: Vec<PlaceId>,
    /// Other robots.
    pub robots: Vec<RobotId>,
    /// Tasks, its own and those of others.
    pub tasks: Vec<TaskId>,
}

impl Around {
    /// Everything of `site`, of one that stands on its last starting place but `number`.
    pub fn of_site(site: &Site, number: usize, robots: Vec<RobotId>, tasks: Vec<TaskId>) -> Self {
        let seats = site.starting_places(SEATS);
        let home = seats.iter().rev().cycle().nth(number).map(|at| site.name_of(*at).clone());
        Self {
            waypoints: home.into_iter().chain(site.waypoints().iter().map(|w| w.waypoint_id.clone())).collect(),
            places: site.places().iter().map(|place| place.place_id.clone()).collect(),
            robots,
            tasks,
        }
    }
}

/// How a session of it ended.
#[derive(Clone, Debug)]
pub enum End {
    /// By its own will, or with the network.
    Own,
    /// The server said why, in its last message.
    Closed(Reason),
    /// A status ended the stream, with the name of a reason; empty: with none.
    Status(String),
    /// What the server said cannot be read.
    Unread(String),
}

impl End {
    /// Whether the server gave a reason where it ended the session.
    pub fn is_told(&self) -> bool {
        match self {
            Self::Own | Self::Closed(_) => true,
            Self::Status(reason) => !reason.is_empty(),
            Self::Unread(_) => false,
        }
    }
}

/// One such robot.
pub struct Player {
    rng: StdRng,
    robot_id: RobotId,
    around: Around,
    habits: BTreeSet<Habit>,
    /// How often each habit really showed, by its name.
    deeds: BTreeMap<&'static str, u64>,
    boots: u64,
    ring: String,
    produced: BTreeMap<Lane, u64>,
    kept: VecDeque<(Lane, Sample)>,
    session: Option<(Previous, String)>,
    /// Of the session at hand; none: there is none, or it is only watched.
    in_charge: bool,
    hb: u64,
    echo: Option<ClockSample>,
    state: ReportedState,
    work: Option<DesiredWork>,
    /// Highest generation of its work that it has applied.
    applied: u64,
    job: Option<Job>,
    /// Attempts of tasks that it spoke of without having them, or as over, or that it did not list while it had them.
    disowned: BTreeSet<AttemptId>,
    /// What it answers next and when, milliseconds.
    answer_at: Option<u64>,
    beat_at: u64,
    quiet_until: u64,
    drops: bool,
    second: bool,
    /// Heartbeats of machines beside it.
    seconds: u64,
    /// Something was noted since it last said what it keeps.
    fresh: bool,
    /// Places in which it ever said that it is, or at which it said that it stands.
    said_in: BTreeSet<PlaceId>,
    /// It said of itself that something will never come, or writes in another ring.
    lost_words: bool,
}

impl Player {
    /// The player of this number in the game of `seed`.
    pub fn of_seed(seed: u64, number: usize, robot_id: RobotId, around: Around) -> Self {
        Self::new(seed.wrapping_mul(8).wrapping_add(number as u64), robot_id, around)
    }
    /// What `seed` makes of a robot of this name.
    pub fn new(seed: u64, robot_id: RobotId, around: Around) -> Self {
        let mut rng = StdRng::seed_from_u64(seed ^ 0x706c_6179);
        let many = rng.random_range(1..=HABITS_MAX);
        let habits = Habit::ALL.into_iter().sample(&mut rng, many).into_iter().collect();
        Self::with(seed, robot_id, around, habits)
    }
    /// One with these habits.
    pub fn with(seed: u64, robot_id: RobotId, around: Around, habits: BTreeSet<Habit>) -> Self {
        let rng = StdRng::seed_from_u64(seed ^ 0x6261_6462);
        let vitals = Vitals {
            waypoint: around.waypoints.first().cloned(),
            battery_permille: 900,
            odometer_mm: 1,
            ..Vitals::default()
        };
        Self {
            rng,
            ring: format!("ring-{seed}-0"),
            robot_id,
            around,
            habits,
            deeds: BTreeMap::new(),
            boots: 0,
            produced: BTreeMap::new(),
            kept: VecDeque::new(),
            session: None,
            in_charge: false,
            hb: 0,
            echo: None,
            state: ReportedState { vitals, ..ReportedState::default() },
            work: None,
            applied: 0,
            job: None,
            disowned: BTreeSet::new(),
            answer_at: None,
            beat_at: 0,
            quiet_until: 0,
            drops: false,
            second: false,
            seconds: 0,
            fresh: false,
            said_in: BTreeSet::new(),
            lost_words: false,
        }
    }
    /// Its name.
    pub fn robot_id(&self) -> &RobotId {
        &self.robot_id
    }
    /// What is wrong with it.
    pub fn habits(&self) -> &BTreeSet<Habit> {
        &self.habits
    }
    /// How often each habit really showed.
    pub fn deeds(&self) -> &BTreeMap<&'static str, u64> {
        &self.deeds
    }
    /// It has this habit too from now on.
    pub fn take_up(&mut self, habit: Habit) {
        self.habits.insert(habit);
    }
    /// Whether it has this attempt and never said anything else of it. Who says that it has applied what comes, and lists none of it, says so of
    /// all that comes.
    pub fn keeps(&self, attempt: &AttemptId) -> bool {
        let has = self.job.as_ref().is_some_and(|job| job.assignment.attempt == *attempt);
        has && !self.disowned.contains(attempt) && !self.deeds.contains_key(Habit::WrongGenerations.name())
    }
    /// Whether it never said that it was in this place, and has no excuse: nothing that it said is lost or too long to be read, one machine has
    /// its name, and it has applied no more than it was given.
    pub fn was_never_in(&self, place_id: &PlaceId) -> bool {
        let excuses = [Habit::StartsTwice, Habit::WrongGenerations, Habit::EndlessLists, Habit::EndlessTexts];
        let is_excused = self.lost_words || excuses.iter().any(|habit| self.deeds.contains_key(habit.name()));
        !is_excused && !self.said_in.contains(place_id)
    }
    /// The task whose load it last said that it has, in a heartbeat.
    pub fn said_load(&self) -> Option<&TaskId> {
        self.state.load.as_ref()?.task_id.as_ref()
    }

    // --- a session

    /// The first word of a session.
    pub fn hello(&mut self, unix_ms: i64) -> v1::SessionRequest {
        (self.hb, self.in_charge, self.drops, self.beat_at) = (0, false, false, 0);
        if self.session.is_none() || self.shows(Habit::Restarts, 0.5) {
            self.restart();
        }
        let mut reported = ReportedState { applied_work: self.applied, ..self.state.clone() };
        let lasting = |habit: &Habit| !matches!(habit, Habit::FallsSilent | Habit::StartsTwice | Habit::Restarts);
        for habit in self.habits.clone().into_iter().filter(lasting) {
            self.misbehave(habit, 0, &mut reported);
        }
        self.lists(&reported.attempts);
        self.says_where(&reported);
        let position = |(lane, last): (&Lane, &u64)| {
            let first = self.kept.iter().find(|(kept, _)| kept == lane).map_or(last + 1, |(_, sample)| sample.seq);
            (*lane, LanePosition { first_seq: first, next_seq: last + 1 })
        };
        let lanes = self.produced.iter().map(position).collect();
        let hello = Hello {
            previous: self.session.as_ref().map(|(previous, _)| previous.clone()),
            inventory: inventory(),
            reported,
            lanes,
            store_id: self.session.as_ref().map(|(_, store)| store.clone()).unwrap_or_default(),
            sent_unix_ms: self.stamp(unix_ms),
            ..Hello::new(self.robot_id.clone(), format!("boot-{}", self.boots), self.ring.clone())
        };
        (&FromRobot::Hello(Box::new(hello))).into()
    }
    /// The process ends and another begins: some of them remember nothing.
    fn restart(&mut self) {
        self.boots += 1;
        if self.boots > 1 && self.rng.random_bool(0.5) {
            // Also if it takes that work up again, of which it has nothing then.
            self.disowned.extend(self.job.take().map(|job| job.assignment.attempt));
            self.answer_at = None;
            self.state.attempts.clear();
        }
        if self.boots > 1 && self.rng.random_bool(0.3) {
            self.format();
            (self.session, self.work, self.applied) = (None, None, 0);
        }
    }
    /// The first word of a machine that has its name beside it.
    pub fn second_hello(&mut self, unix_ms: i64) -> v1::SessionRequest {
        let reported = ReportedState { hb: 0, session_epoch: 0, ..self.state.clone() };
        self.lists(&reported.attempts);
        let (boot_id, ring) = (format!("boot-beside-{}", self.boots), format!("ring-beside-{}", self.boots));
        let hello = Hello {
            previous: self.session.as_ref().map(|(previous, _)| previous.clone()),
            inventory: inventory(),
            reported,
            sent_unix_ms: unix_ms,
            ..Hello::new(self.robot_id.clone(), boot_id, ring)
        };
        (&FromRobot::Hello(Box::new(hello))).into()
    }
    /// A heartbeat of that machine, which has its own idea of what the robot does.
    pub fn second_says(&mut self, unix_ms: i64) -> v1::SessionRequest {
        self.seconds += 1;
        let mut reported = ReportedState { hb: self.seconds, session_epoch: 1, ..self.state.clone() };
        self.misbehave(Habit::ForeignAttempts, 0, &mut reported);
        self.lists(&reported.attempts);
        let heartbeat = Heartbeat { reported, sent_unix_us: unix_ms.saturating_mul(1_000), clock: None };
        (&FromRobot::Uplink(Uplink { heartbeat: Some(heartbeat), batches: Vec::new() })).into()
    }
    /// Hears one message at `now_ms` of its own clock. An error: the session is over.
    ///
    /// # Errors
    /// How the server ended it.
    pub fn receive(&mut self, message: v1::SessionResponse, now_ms: u64) -> Result<(), End> {
        let message = midshift_proto::parse::<ToRobot, _>(message).map_err(|bad| End::Unread(format!("{bad:?}")))?;
        match message {
            ToRobot::Welcome(welcome) => self.welcomed(welcome),
            ToRobot::Downlink(down) => {
                if let Some(echo) = down.echo {
                    self.echo = Some(ClockSample { t4_us: (now_ms * 1_000) as i64, ..echo.clock });
                }
                down.acks.iter().for_each(|ack| self.acknowledged(ack));
                if let Some(work) = down.work {
                    self.asked(work, now_ms);
                }
            }
            ToRobot::Close(close) => return Err(End::Closed(close.reason)),
            ToRobot::MoveOver { .. } => self.drops = true,
        }
        Ok(())
    }
    fn welcomed(&mut self, welcome: Welcome) {
        self.in_charge = !welcome.observed;
        if self.in_charge {
            let previous = Previous { session_epoch: welcome.session_epoch, secret: welcome.session_secret };
            self.session = Some((previous, welcome.store_id));
            self.work = None;
        }
        welcome.acks.iter().for_each(|ack| self.acknowledged(ack));
    }
    fn acknowledged(&mut self, ack: &LaneAck) {
        self.kept.retain(|(lane, sample)| *lane != ack.lane || sample.seq > ack.seq);
        let last = self.produced.entry(ack.lane).or_default();
        *last = (*last).max(ack.seq);
        // It has said itself that no number comes any more: it goes on in another ring.
        if *last >= limits::COUNTED_MAX - 1 {
            self.drops = true;
            self.format();
        }
    }
    /// Forgets what it has said, in a new ring.
    fn format(&mut self) {
        self.lost_words = true;
        self.ring = format!("{}-{}", self.robot_id, self.rng.random::<u32>());
        self.produced.clear();
        self.kept.clear();
    }
    /// Whether it breaks its connection off now.
    pub fn drops(&self) -> bool {
        self.drops
    }
    /// Whether a machine with its name appears now.
    pub fn has_second(&mut self) -> bool {
        std::mem::take(&mut self.second)
    }

    // --- what it says

    /// What it says at `now_ms` of its own clock.
    pub fn due_messages(&mut self, now_ms: u64, unix_ms: i64) -> Vec<v1::SessionRequest> {
        if now_ms < self.quiet_until {
            return Vec::new();
        }
        self.go_on(now_ms);
        let mut said = Vec::new();
        let beats = now_ms >= self.beat_at;
        if beats {
            self.beat_at = now_ms + 1_000;
            said.push(self.heartbeat(now_ms, unix_ms));
        }
        if std::mem::take(&mut self.fresh) || beats {
            let batches = self.batches(unix_ms);
            if !batches.is_empty() {
                said.push((&FromRobot::Uplink(Uplink { heartbeat: None, batches })).into());
            }
        }
        said
    }
    fn heartbeat(&mut self, now_ms: u64, unix_ms: i64) -> v1::SessionRequest {
        self.hb += 1;
        let mut report = ReportedState {
            hb: self.hb,
            session_epoch: self.session.as_ref().map_or(1, |(previous, _)| previous.session_epoch),
            applied_work: self.applied,
            produced: self.produced.clone(),
            stop_level: StopLevel::None,
            ..self.state.clone()
        };
        for habit in self.habits.clone() {
            self.misbehave(habit, now_ms, &mut report);
        }
        self.lists(&report.attempts);
        self.says_where(&report);
        let sent_unix_us = self.stamp(unix_ms).saturating_mul(1_000);
        let heartbeat = Heartbeat { reported: report, sent_unix_us, clock: self.echo.take() };
        (&FromRobot::Uplink(Uplink { heartbeat: Some(heartbeat), batches: Vec::new() })).into()
    }
    /// What is not acknowledged, from the oldest on, in messages of their size.
    fn batches(&mut self, unix_ms: i64) -> Vec<LaneBatch> {
        let mut batches: Vec<LaneBatch> = Vec::new();
        let mut room = MESSAGE_BYTES;
        let fits = |sample: &Sample| {
            let bytes = v1::Sample::from(sample).encoded_len();
            let fits = bytes <= room;
            room = room.saturating_sub(bytes);
            fits
        };
        let next = self.kept.iter().take(64).scan(fits, |fits, one| fits(&one.1).then(|| one.clone()));
        let samples: Vec<(Lane, Sample)> = next.collect();
        for (lane, sample) in samples {
            let robot_unix_ms = self.stamp(unix_ms);
            let item = InboxItem::Sample(Sample { robot_unix_ms, ..sample });
            match batches.iter_mut().find(|batch| batch.lane == lane) {
                Some(batch) => batch.items.push(item),
                None => batches.push(LaneBatch { lane, items: vec![item] }),
            }
        }
        if self.shows(Habit::LosesNumbers, 0.1) {
            self.lose_numbers(&mut batches);
        }
        batches
    }
    /// Says that some will never come, or leaves some out and says those behind them.
    fn lose_numbers(&mut self, batches: &mut [LaneBatch]) {
        for batch in batches.iter_mut().filter(|batch| batch.items.len() > 1) {
            let at = self.rng.random_range(0..batch.items.len() - 1);
            let lane = batch.lane;
            if let (InboxItem::Sample(sample), true) = (batch.items.remove(at), self.rng.random_bool(0.5)) {
                let (seq, reason) = (sample.seq, Code::Overflow.into());
                let to_seq = if self.rng.random_bool(0.05) { limits::COUNTED_MAX - 1 } else { seq };
                batch.items.insert(at, InboxItem::Gap(Gap { lane, from_seq: seq, to_seq, reason }));
                self.lost_words = true;
                self.kept.retain(|(kept, sample)| *kept != lane || !(seq..=to_seq).contains(&sample.seq));
            }
        }
    }
    /// Notes something to be said in this lane.
    fn produce(&mut self, lane: Lane, body: SampleBody) {
        let seq = self.produced.entry(lane).or_default();
        *seq += 1;
        let sample = Sample { seq: *seq, robot_unix_ms: 0, body };
        // What finds no room is never said: its number goes to the next.
        if self.kept.len() < KEPT_MAX {
            self.kept.push_back((lane, sample));
        } else {
            *seq -= 1;
        }
        self.fresh = true;
    }
    fn event(&mut self, event: RobotEvent) {
        if let RobotEvent::Attempt(report) = &event {
            self.says_of(&report.attempt, report.state);
        }
        if let RobotEvent::Place { place_id, news: PlaceNews::Entered, .. } = &event {
            self.said_in.insert(place_id.clone());
        }
        self.produce(Lane::Event, SampleBody::Event(event));
    }
    /// Notes what it says of an attempt.
    fn says_of(&mut self, attempt: &AttemptId, state: WorkState) {
        let has = self.job.as_ref().is_some_and(|job| job.assignment.attempt == *attempt);
        let lives = !state.is_over() && state != WorkState::StepUnknown;
        if attempt.subject.task_id().is_some() && !(has && lives) {
            self.disowned.insert(attempt.clone());
        }
    }
    /// Notes what it says of its attempts together.
    fn lists(&mut self, attempts: &[ReportedAttempt]) {
        attempts.iter().for_each(|listed| self.says_of(&listed.attempt, listed.state));
        let at_hand = self.job.as_ref().map(|job| job.assignment.attempt.clone());
        self.disowned.extend(at_hand.filter(|id| attempts.iter().all(|listed| listed.attempt != *id)));
    }
    /// Notes where it says that it is.
    fn says_where(&mut self, report: &ReportedState) {
        let inside = report.places.iter().filter(|held| held.inside).map(|held| held.place_id.clone());
        let stands = report.vitals.waypoint.iter().filter_map(|waypoint| PlaceId::parse(waypoint.as_str()).ok());
        self.said_in.extend(inside.chain(stands));
    }
    fn alarm(&mut self, event: RobotEvent) {
        self.produce(Lane::Critical, SampleBody::Event(event));
    }
    /// The time that it writes on something.
    fn stamp(&mut self, unix_ms: i64) -> i64 {
        if self.habits.contains(&Habit::WrongClocks) && self.rng.random_bool(0.5) {
            let far = [0, -1, 1, i64::MAX / 2_000, i64::MIN / 2_000, unix_ms + 86_400_000, unix_ms - 86_400_000];
            *self.deeds.entry(Habit::WrongClocks.name()).or_default() += 1;
            return far.choose(&mut self.rng).copied().unwrap_or(unix_ms);
        }
        unix_ms
    }
    /// Whether it has this habit and shows it now; counted.
    fn shows(&mut self, habit: Habit, chance: f64) -> bool {
        let shows = self.habits.contains(&habit) && self.rng.random_bool(chance);
        if shows {
            *self.deeds.entry(habit.name()).or_default() += 1;
        }
        shows
    }
    fn some_place(&mut self) -> Option<PlaceId> {
        self.around.places.choose(&mut self.rng).cloned()
    }
    fn holds(&mut self, place_id: &PlaceId, grant_id: u64, inside: bool) {
        self.state.places.retain(|held| held.place_id != *place_id);
        self.state.places.push(HeldPlace { place_id: place_id.clone(), grant_id, inside });
    }
}

/// It can do what the simulated bodies can, so that it is given the same work.
fn inventory() -> Inventory {
    let capabilities = ["charge", "drop", "inspect", "park", "pick", "place", "transport"].map(str::to_owned).into();
    Inventory { capabilities, payload_g: 60_000, software: "1.0.0".to_owned(), ..Inventory::default() }
}
