//! The simulated body: poses, battery, joints, faults and hands, advanced from event to event by whoever asks.
//!
//! Called by the agent through `trait Body`, and by the simulated person through [`crate::handle::SimHandle`].
//! Invariant: where a body is changes only by driving, also across faults, new paths, new speeds and a restart.

mod act;
mod acts;
mod config;
mod files;
mod legs;
mod orders;
mod restored;

use crate::behaviour::Behaviour;
use crate::energy::{Effort, Stores};
use crate::faults::{self, FaultRates, Injected, draw_next, draw_secs};
use crate::journal::{Effect, Work};
use crate::motion::Leg;
use crate::world::{SharedWorld, lock};
use act::Act;
pub use config::{BODY_LABEL, BodyConfig, Counts, MODEL, SPEED_FLOOR_MM_S, SPEED_MAX_MM_S};
use files::Keeper;
pub use files::{Error, JOURNAL_FILE};
use midshift_agent::body::{BodyNews, PathPoint};
use midshift_core::ids::{PlaceId, RobotId, TaskId, WaypointId};
use midshift_core::robot::{Fault, HardwareStop, Load, Mode, StopLevel};
use midshift_core::site::Site;
use midshift_core::time::{SiteDuration, SiteTime};
use nalgebra::Isometry2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use tokio::sync::watch;

/// A body stands on a waypoint while its middle is nearer than this, millimetres.
pub const CONTOUR_MM: f64 = 300.0;
/// Effects a body remembers, to say whether a step was done.
const RECENT_MAX: usize = 32;

#[derive(Clone, Debug)]
enum Order {
    Drive(VecDeque<PathPoint>),
    Act(Act),
}

#[derive(Clone, Debug)]
enum Phase {
    Still,
    Leg { leg: Leg, to: WaypointId, out_mm: Option<f64>, in_mm: Option<f64> },
    Blocked { until: SiteTime, gives_up: bool },
    Acting { until: SiteTime },
}

/// Something in the way on the lane at hand.
#[derive(Clone, Copy, Debug)]
struct Block {
    after_mm: f64,
    lasts: SiteDuration,
}

/// One simulated robot.
#[derive(Debug)]
pub struct SimBody {
    config: BodyConfig,
    site: Arc<Site>,
    world: SharedWorld,
    rng: ChaCha8Rng,
    /// Everything below is as it was at this moment.
    at: SiteTime,
    frame: Isometry2<f64>,
    /// Last waypoint reached.
    last: Option<WaypointId>,
    /// Waypoint under its contour.
    touching: Option<WaypointId>,
    /// Lane it is on, while it is between two waypoints.
    lane: Option<(WaypointId, WaypointId)>,
    inside: BTreeSet<PlaceId>,
    order: Option<Order>,
    phase: Phase,
    paused: bool,
    slow: bool,
    /// The level of operational stop that its agent obeys, and whether it has stood since that was one to stand by.
    obeyed: (StopLevel, bool),
    parked: bool,
    charging: bool,
    mode: Mode,
    hardware_stop: HardwareStop,
    broken: Option<Fault>,
    stores: Stores,
    odometer_mm: f64,
    loaded_mm: f64,
    load: Option<Load>,
    news: VecDeque<BodyNews>,
    work: Option<Work>,
    recent: VecDeque<(TaskId, String)>,
    block: Option<Block>,
    pending_block: Option<SiteDuration>,
    misses_next: u32,
    network: watch::Sender<bool>,
    /// As `network`, of its stop line alone: that needs both.
    stop_network: watch::Sender<bool>,
    stop_dropped_until: Option<SiteTime>,
    drop_at: Option<SiteTime>,
    dropped_until: Option<SiteTime>,
    stopped_until: Option<SiteTime>,
    manual_at: Option<SiteTime>,
    manual_until: Option<SiteTime>,
    idle_since: SiteTime,
    counts: Counts,
    faults_by_code: BTreeMap<u32, u64>,
    keeper: Option<Keeper>,
}

impl SimBody {
    /// A new body that stands at its start. Its start must be a waypoint of the site.
    pub fn new(config: BodyConfig, site: Arc<Site>, world: SharedWorld, now: SiteTime) -> Result<Self, Error> {
        let mut body = Self::at_rest(config, site, world, now)?;
        body.occupy(now);
        body.note_software(now);
        Ok(body)
    }
    /// As [`SimBody::new`], but it has not told the journal yet where it stands.
    fn at_rest(config: BodyConfig, site: Arc<Site>, world: SharedWorld, now: SiteTime) -> Result<Self, Error> {
        let start = site.find(&config.start).ok_or_else(|| Error::UnknownStart(config.start.clone()))?;
        let point = site.waypoint(start);
        let mut rng = config.rng(0);
        let charge = config.battery_permille.unwrap_or_else(|| rng.random_range(600..=1000));
        let frame = Isometry2::translation(point.x_mm as f64 / 1000.0, point.y_mm as f64 / 1000.0);
        Ok(Self {
            at: now,
            frame,
            last: Some(config.start.clone()),
            touching: Some(config.start.clone()),
            lane: None,
            inside: BTreeSet::new(),
            order: None,
            phase: Phase::Still,
            paused: false,
            slow: false,
            obeyed: (StopLevel::None, false),
            parked: false,
            charging: false,
            mode: Mode::Automatic,
            hardware_stop: HardwareStop::None,
            broken: None,
            stores: Stores::new(charge, config.drains),
            odometer_mm: 0.0,
            loaded_mm: 0.0,
            load: None,
            news: VecDeque::new(),
            work: None,
            recent: VecDeque::new(),
            block: None,
            pending_block: None,
            misses_next: 0,
            network: watch::Sender::new(true),
            stop_network: watch::Sender::new(true),
            stop_dropped_until: None,
            drop_at: draw_next(&mut rng, now, config.faults.silence_per_hour),
            dropped_until: None,
            stopped_until: None,
            manual_at: draw_next(&mut rng, now, config.faults.manual_per_hour),
            manual_until: None,
            idle_since: now,
            counts: Counts::default(),
            faults_by_code: BTreeMap::new(),
            keeper: None,
            config,
            site,
            world,
            rng,
        })
    }
    /// Its name.
    pub fn robot_id(&self) -> &RobotId {
        &self.config.robot_id
    }
    /// Whether its network is up, now and whenever it changes.
    pub fn network(&self) -> watch::Receiver<bool> {
        self.network.subscribe()
    }
    /// Whether its way to the stop service is up: it falls with its network, and also alone.
    pub fn stop_network(&self) -> watch::Receiver<bool> {
        self.stop_network.subscribe()
    }
    fn note_network(&self) {
        self.stop_network.send_replace(*self.network.borrow() && self.stop_dropped_until.is_none());
    }
    /// Faults so far by the maker's code.
    pub fn faults_by_code(&self) -> &BTreeMap<u32, u64> {
        &self.faults_by_code
    }
    /// What it did so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }
    /// Millimetres driven, and of these with a load.
    pub fn odometers_mm(&self) -> (u64, u64) {
        (self.odometer_mm as u64, self.loaded_mm as u64)
    }
    /// Milliwatt-hours spent since it was made.
    pub fn energy_mwh(&self) -> u64 {
        self.stores.spent_mwh as u64
    }
    /// The fault that keeps it standing.
    pub fn broken(&self) -> Option<&Fault> {
        self.broken.as_ref()
    }
    /// Since when it has no order; none while it has one.
    pub fn idle_since(&self) -> Option<SiteTime> {
        self.order.is_none().then_some(self.idle_since)
    }
    /// Places its contour reaches into.
    pub fn inside(&self) -> &BTreeSet<PlaceId> {
        &self.inside
    }
    /// The last waypoint it reached.
    pub fn last_waypoint(&self) -> Option<&WaypointId> {
        self.last.as_ref()
    }
    /// Waits from now on for what was injected, or suffers it at once.
    pub fn inject(&mut self, now: SiteTime, what: Injected) {
        self.advance(now);
        match what {
            Injected::Obstacle(lasts) if matches!(&self.phase, Phase::Leg { leg, .. } if !leg.is_braking()) => {
                self.meet_obstacle(now, lasts);
            }
            Injected::Obstacle(lasts) => self.pending_block = Some(lasts),
            Injected::GripperMissed(times) => self.misses_next = times.max(1),
            Injected::Jam => self.jam(now),
            Injected::DropNetwork(lasts) => self.lose_network(now, lasts),
            Injected::DropStopLine(lasts) => {
                self.stop_dropped_until = Some(now + lasts);
                self.note_network();
            }
            Injected::Manual(lasts) => self.take_over(now, lasts),
            Injected::HardwareStop(lasts) => self.stop_hard(now, lasts),
            Injected::LowBattery(permille) => {
                let Stores { spent_mwh, joint_c, climbed_c, .. } = self.stores;
                self.stores = Stores { spent_mwh, joint_c, climbed_c, ..Stores::new(permille, self.config.drains) };
            }
        }
    }
    /// What its software makes of it, and the version that it says.
    pub fn software(&self) -> (&Behaviour, &str) {
        (&self.config.behaviour, &self.config.software)
    }
    /// Other software drives it from now on, or dies at its start if it behaves so.
    pub fn run_software(&mut self, now: SiteTime, behaviour: Behaviour, version: String) {
        self.advance(now);
        self.config.behaviour = behaviour;
        self.config.software = version;
        self.note_software(now);
    }
    /// Its journal says which software begins to run.
    fn note_software(&self, now: SiteTime) {
        lock(&self.world).run(now, &self.config.robot_id, self.config.software.clone());
    }
    /// A person mends what is broken; an empty battery is changed for a half-full one.
    pub fn clear(&mut self, now: SiteTime) {
        self.advance(now);
        if let Some(fault) = self.broken.take() {
            if fault.code == faults::FAULT_BATTERY_EMPTY {
                let Stores { spent_mwh, joint_c, climbed_c, .. } = self.stores;
                self.stores = Stores { spent_mwh, joint_c, climbed_c, ..Stores::new(500, self.config.drains) };
            }
            self.news.push_back(BodyNews::Fault(fault, false));
            self.go(now);
        }
    }
    /// A person takes its load and carries it back to where it was picked.
    pub fn take_load(&mut self, now: SiteTime) -> bool {
        self.advance(now);
        let taken = lock(&self.world).put_back(now, &self.config.robot_id).is_some();
        if taken {
            self.load = None;
            self.news.push_back(BodyNews::Load(None));
        }
        taken
    }
    /// A person who drives hands it back.
    pub fn hand_back(&mut self, now: SiteTime) {
        self.advance(now);
        self.end_manual(now);
    }
    fn end_manual(&mut self, now: SiteTime) {
        self.manual_until = None;
        if std::mem::take(&mut self.mode) != Mode::Automatic {
            self.news.push_back(BodyNews::Mode(Mode::Automatic));
            self.go(now);
        }
    }
    /// Lets all happen that happens until `now`.
    pub fn advance(&mut self, now: SiteTime) {
        while let Some(at) = self.next_event().filter(|at| *at <= now) {
            self.settle(at.max(self.at));
            self.happen(at.max(self.at));
            self.note_motion(at.max(self.at));
        }
        self.settle(now);
        self.note_motion(now);
    }

    /// The next moment at which something happens by itself.
    fn next_event(&self) -> Option<SiteTime> {
        let phase = match &self.phase {
            Phase::Still => None,
            Phase::Leg { leg, out_mm, in_mm, .. } => {
                let block_mm = self.block.map(|b| b.after_mm).filter(|mm| *mm <= leg.length_mm());
                let marks = [*out_mm, *in_mm, block_mm].into_iter().flatten().filter_map(|mm| leg.when_driven(mm));
                Some(marks.fold(leg.end(), SiteTime::min))
            }
            Phase::Blocked { until, .. } | Phase::Acting { until } => Some(*until),
        };
        let empties = self.stores.lasts(&self.effort(f64::from(self.speed_mm_s(self.at)))).map(|lasts| self.at + lasts);
        let dead = (self.is_empty() && self.broken.is_none()).then_some(self.at);
        let drops = [self.drop_at, self.dropped_until, self.stop_dropped_until];
        let stands = [self.stopped_until, self.manual_at, self.manual_until];
        [phase, empties, dead].into_iter().chain(drops).chain(stands).flatten().min()
    }
    /// What happens at `now`, to which everything is settled.
    fn happen(&mut self, now: SiteTime) {
        let due = |at: Option<SiteTime>| at.is_some_and(|at| at <= now);
        if due(self.dropped_until) {
            self.dropped_until = None;
            self.network.send_replace(true);
            self.note_network();
        } else if due(self.stop_dropped_until) {
            self.stop_dropped_until = None;
            self.note_network();
        } else if due(self.drop_at) {
            self.drop_at = draw_next(&mut self.rng, now, self.config.faults.silence_per_hour);
            let lasts = draw_secs(&mut self.rng, 2..=20);
            self.lose_network(now, lasts);
        } else if due(self.stopped_until) {
            self.stopped_until = None;
            self.hardware_stop = HardwareStop::None;
            self.news.push_back(BodyNews::HardwareStop(HardwareStop::None));
            self.go(now);
        } else if due(self.manual_until) {
            self.end_manual(now);
        } else if due(self.manual_at) {
            self.manual_at = draw_next(&mut self.rng, now, self.config.faults.manual_per_hour);
            let lasts = draw_secs(&mut self.rng, 30..=120);
            self.take_over(now, lasts);
        } else if self.is_empty() && self.broken.is_none() {
            self.break_down(now, faults::battery_empty());
        } else {
            self.happen_in_phase(now);
        }
    }
    fn happen_in_phase(&mut self, now: SiteTime) {
        match &mut self.phase {
            Phase::Still => {}
            Phase::Leg { leg, to, out_mm, in_mm } => {
                let due = |mm: Option<f64>| mm.and_then(|mm| leg.when_driven(mm)).is_some_and(|at| at <= now);
                if due(*out_mm) {
                    *out_mm = None;
                    self.touching = None;
                    self.occupy(now);
                } else if due(*in_mm) {
                    *in_mm = None;
                    self.touching = Some(to.clone());
                    self.occupy(now);
                } else if let Some(block) = self.block.filter(|b| !leg.is_braking() && due(Some(b.after_mm))) {
                    self.meet_obstacle(now, block.lasts);
                } else if leg.end() <= now || self.block.is_some_and(|b| due(Some(b.after_mm))) {
                    if leg.is_braking() { self.interrupt(now) } else { self.arrive(now) }
                }
            }
            Phase::Blocked { until, gives_up } if *until <= now => {
                let gives_up = *gives_up;
                self.phase = Phase::Still;
                if gives_up {
                    self.fail(now, faults::obstacle());
                } else {
                    self.go(now);
                }
            }
            Phase::Acting { until } if *until <= now => self.finish_act(now),
            Phase::Blocked { .. } | Phase::Acting { .. } => {}
        }
    }
    /// Brings frame, odometers, battery and heat to `now`; nothing happens on the way.
    fn settle(&mut self, now: SiteTime) {
        let time = now.since(self.at);
        if time.as_ms() == 0 {
            return;
        }
        let (frame, driven_mm, stores) = self.glance(now);
        self.frame = frame;
        self.odometer_mm += driven_mm;
        self.loaded_mm += if self.load.is_some() { driven_mm } else { 0.0 };
        self.stores = stores;
        let counts = &mut self.counts;
        *match (&self.phase, &self.order) {
            (Phase::Leg { .. }, _) => &mut counts.driving_ms,
            (Phase::Acting { .. }, _) => &mut counts.acting_ms,
            (Phase::Blocked { .. }, _) => &mut counts.blocked_ms,
            (Phase::Still, Some(_)) => &mut counts.halted_ms,
            (Phase::Still, None) => &mut counts.idle_ms,
        } += time.as_ms();
        self.at = now;
    }
    /// Frame, millimetres driven since it was settled, battery and heat at `now`, if nothing happens until then.
    fn glance(&self, now: SiteTime) -> (Isometry2<f64>, f64, Stores) {
        let ends = match &self.phase {
            Phase::Still => now,
            Phase::Leg { leg, .. } => leg.end(),
            Phase::Blocked { until, .. } | Phase::Acting { until } => *until,
        };
        let ends = ends.clamp(self.at, now.max(self.at));
        let busy = ends.since(self.at);
        let (frame, driven_mm) = match &self.phase {
            Phase::Leg { leg, .. } => (leg.frame(now), leg.driven_mm(now) - leg.driven_mm(self.at)),
            _ => (self.frame, 0.0),
        };
        let speed_mm_s = if busy.as_ms() == 0 { 0.0 } else { driven_mm / busy.as_secs_f64() };
        let effort = self.effort(speed_mm_s);
        let rest = Effort { speed_m_s: 0.0, acting: false, ..effort };
        (frame, driven_mm, self.stores.after(busy, &effort).after(now.since(ends), &rest))
    }
    fn effort(&self, speed_mm_s: f64) -> Effort {
        Effort {
            speed_m_s: speed_mm_s / 1000.0,
            loaded: self.load.is_some(),
            acting: matches!((&self.phase, &self.order), (Phase::Acting { .. }, Some(Order::Act(act))) if act.works()),
            parked: self.parked,
            charging: self.charging,
            draw_permille: self.config.behaviour.energy_permille.saturating_mul(self.config.energy.draw_permille)
                / 1_000,
            charge_permille: self.config.energy.charge_permille,
            climb_c_s: f64::from(self.config.behaviour.joint_temperature_climb_millidegrees_per_s) / 1000.0,
        }
    }
    fn speed_mm_s(&self, now: SiteTime) -> u32 {
        match &self.phase {
            Phase::Leg { leg, .. } => leg.speed_mm_s(now),
            _ => 0,
        }
    }
    fn is_empty(&self) -> bool {
        self.config.drains && !self.charging && self.stores.charge_mwh <= 0.0
    }
    /// How often things go wrong now.
    fn rates(&self) -> FaultRates {
        self.config.behaviour.rates(&self.config.faults, self.load.as_ref())
    }
    fn target(&self) -> Option<&PathPoint> {
        match &self.order {
            Some(Order::Drive(path)) => path.front(),
            _ => None,
        }
    }
    fn lose_network(&mut self, now: SiteTime, lasts: SiteDuration) {
        self.counts.silences += 1;
        self.dropped_until = Some(now + lasts);
        self.network.send_replace(false);
        self.note_network();
    }
    fn stop_hard(&mut self, now: SiteTime, lasts: SiteDuration) {
        self.stopped_until = Some(now + lasts);
        if self.hardware_stop == HardwareStop::None {
            self.halt(now);
            self.hardware_stop = HardwareStop::AutoAck;
            self.news.push_back(BodyNews::HardwareStop(HardwareStop::AutoAck));
        }
    }
    /// Its journal says whether it stands or moves under a stop that it has to stand by.
    fn note_motion(&mut self, now: SiteTime) {
        let (level, stood) = self.obeyed;
        let stands = !matches!(self.phase, Phase::Leg { .. });
        if level < StopLevel::Halt || stands == stood {
            return;
        }
        self.obeyed.1 = stands;
        let odometer_mm = self.odometer_mm as u64;
        let effect = if stands { Effect::Stood { odometer_mm } } else { Effect::Moved { odometer_mm } };
        lock(&self.world).stop(now, &self.config.robot_id, effect);
    }
    /// Whether something other than the world keeps it standing.
    fn is_kept(&self) -> bool {
        let stopped = self.hardware_stop != HardwareStop::None;
        self.paused || stopped || self.mode != Mode::Automatic || self.broken.is_some()
    }
    fn count_fault(&mut self, code: u32) {
        *self.faults_by_code.entry(code).or_insert(0) += 1;
    }
    /// A person drives: the order stays and goes on when the robot is handed back, unless the agent drops it.
    fn take_over(&mut self, now: SiteTime, lasts: SiteDuration) {
        self.counts.manuals += 1;
        self.manual_until = Some(now + lasts);
        if self.mode == Mode::Automatic {
            self.halt(now);
            self.mode = Mode::Manual;
            self.news.push_back(BodyNews::Mode(Mode::Manual));
        }
    }
    fn jam(&mut self, now: SiteTime) {
        self.counts.jams += 1;
        self.break_down(now, faults::jam());
    }
    /// A fault that stands until a person clears it.
    fn break_down(&mut self, now: SiteTime, fault: Fault) {
        if self.broken.is_none() {
            self.count_fault(fault.code);
            self.halt(now);
            if self.order.is_some() {
                self.drop_order(now);
                self.news.push_back(BodyNews::Failed(fault.clone()));
            }
            self.broken = Some(fault.clone());
            self.news.push_back(BodyNews::Fault(fault, true));
        }
    }
    fn fail(&mut self, now: SiteTime, fault: Fault) {
        self.count_fault(fault.code);
        self.drop_order(now);
        self.news.push_back(BodyNews::Failed(fault));
    }
    fn drop_order(&mut self, now: SiteTime) {
        self.order = None;
        self.paused = false;
        self.idle_since = now;
    }
}
