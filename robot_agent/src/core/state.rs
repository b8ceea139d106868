//! What the core knows, and the verbs that all of its rooms use: write, emit, wake.
//!
//! Invariant: nothing that depends on a write leaves before the write is durable. Nothing is decided here.

use super::interface::CoreConfig;
use super::lanes::Sender;
use super::load::ListedLoad;
use super::places::Places;
use super::throttle::Throttle;
use super::work::{Doing, Work};
use crate::body::{Body, BodyLimits};
use crate::stop::StopState;
use crate::storage::{Op, RobotMemory};
use crate::transport::replay::Pace;
use crate::update::Updater;
use midshift_core::authority::SentHeartbeats;
use midshift_core::desired_state::DesiredWork;
use midshift_core::ids::{AttemptId, RobotId, WaypointId};
use midshift_core::limits;
use midshift_core::robot::{Fault, HardwareStop, Inventory, Lane, Mode};
use midshift_core::robot_events::RobotEvent;
use midshift_core::time::{LinkDuration, LinkTime, Now, SiteDuration, SiteTime};
use midshift_proto::session::ClockSample;
use std::collections::{BTreeSet, VecDeque};

const STATUS_PERIOD: SiteDuration = SiteDuration(2_000);

/// The session at hand.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) epoch: u64,
    pub(super) hb: u64,
    pub(super) observed: bool,
    /// The map that its heartbeats have told; empty: none yet.
    pub(super) told_map: String,
    /// The room for software that its heartbeats have told; none: none yet.
    pub(super) told_room: Option<u64>,
}

impl Session {
    /// The room for software, if that is news: it was not told yet, or has changed by a tenth.
    pub(super) fn room_to_tell(&mut self, free_bytes: Option<u64>) -> Option<u64> {
        let is_news = |now: &u64| self.told_room.is_none_or(|told| *now != told && now.abs_diff(told) >= told / 10);
        let news = free_bytes.filter(is_news);
        self.told_room = news.or(self.told_room);
        news
    }
}

/// Writes under way and waiting.
#[derive(Debug, Default)]
pub(super) struct Writes {
    pub(super) ops: Vec<Op>,
    pub(super) urgent: bool,
    pub(super) given: u64,
    pub(super) durable: u64,
    pub(super) batch: u64,
    /// Batch, number of its last operation, lane numbers at its end.
    pub(super) in_flight: Option<(u64, u64, [u64; 3])>,
    pub(super) barrier: u64,
}

/// What the robot runs.
pub struct AgentCore {
    pub(crate) config: CoreConfig,
    pub(crate) body: Box<dyn Body>,
    pub(crate) limits: BodyLimits,
    pub(crate) inventory: Inventory,
    pub(crate) memory: RobotMemory,
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
    pub(crate) stop: Option<Box<StopState>>,
    pub(crate) authority: LinkDuration,
    pub(crate) listed_load: ListedLoad,
    pub(super) session: Option<Session>,
    pub(super) sender: Sender,
    pub(super) pace: Pace,
    pub(super) throttle: Throttle,
    pub(super) writes: Writes,
    pub(super) standing_fault: Option<Fault>,
    /// The body failed its maker's test when this process began.
    pub(crate) unfit: Option<Fault>,
    pub(super) battery_critical: bool,
    pub(super) odometer_mm: u64,
    pub(super) progress: u64,
    pub(super) period: LinkDuration,
    pub(super) next_beat: LinkTime,
    /// No heartbeat before this, whatever happens: a quarter of the period after the last one.
    pub(super) beat_floor: LinkTime,
    pub(super) status_period: SiteDuration,
    pub(super) next_status: SiteTime,
    pub(super) clock: Option<ClockSample>,
    pub(super) fences: u32,
}

impl AgentCore {
    /// A robot that begins with `memory`. Call with [`super::Input::Start`] first.
    pub fn new(config: CoreConfig, body: Box<dyn Body>, memory: RobotMemory, now: Now) -> Self {
        let bugs = config.bugs;
        let (places, restored) = Places::restored(memory.ledger.places.clone(), bugs.grant_from_receipt());
        let mut throttle = Throttle::new(now.link);
        restored.into_iter().for_each(|event| throttle.push(Lane::Event, event));
        Self {
            limits: body.limits(),
            inventory: body.capabilities(),
            mode: body.mode(),
            hardware_stop: body.hardware_stop(),
            work: memory.ledger.holder.clone().map(Work::restored),
            sender: Sender::new(&memory.ring),
            update: Updater { config: config.update.clone(), ..Updater::default() },
            config,
            body,
            memory,
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

    /// The robot's memory, as it is applied and perhaps not yet durable.
    pub fn memory(&self) -> &RobotMemory {
        &self.memory
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

    pub(crate) fn is_observed(&self) -> bool {
        self.session.as_ref().is_some_and(|s| s.observed)
    }

    /// The session at hand.
    pub(crate) fn session_epoch(&self) -> Option<u64> {
        self.session.as_ref().map(|s| s.epoch)
    }

    /// Applies an operation and queues it for the store. Not urgent: it may wait for the next second's group.
    pub(crate) fn write(&mut self, op: Op, urgent: bool) {
        self.memory.apply(&op);
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
        if self.places.row != self.memory.ledger.places {
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

    pub(crate) fn wake_at(&mut self, link: LinkTime) {
        self.wake_link = Some(self.wake_link.map_or(link, |w| w.min(link)));
    }

    /// The next heartbeat goes with this step, or as soon as one may go.
    pub(crate) fn beat_at_once(&mut self, now: &Now) {
        self.next_beat = self.next_beat.min(now.link.max(self.beat_floor));
    }

    /// Whether the body is under way for this work.
    pub(crate) fn is_driving(&self) -> bool {
        self.work.as_ref().is_some_and(|w| w.doing == Doing::Driving)
    }
}
