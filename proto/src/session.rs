//! What the two ends of a link say to each other, in core types: read from and written to `link.v1`.
//!
//! Called by the agent (says [`FromRobot`], hears [`ToRobot`]) and by telemetry (the other way round).

use midshift_core::desired_state::{DesiredPolicy, DesiredWork};
use midshift_core::identity::SessionSecret;
use midshift_core::ids::RobotId;
use midshift_core::reason::Reason;
use midshift_core::robot::{Inventory, Lane, ReportedState};
use midshift_core::robot_events::InboxItem;
use midshift_core::stop::{Reset, Stop};
use midshift_core::update::DesiredUpdate;
use std::collections::BTreeMap;

/// The wire version that this build speaks.
pub const PROTOCOL_VERSION: u32 = 1;

/// One message from the robot.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "nearly every message is an uplink, and none is kept in a collection")]
pub enum FromRobot {
    /// Exactly once, first.
    Hello(Box<Hello>),
    /// Everything after it.
    Uplink(Uplink),
}

/// One message to the robot.
#[derive(Clone, Debug, PartialEq)]
pub enum ToRobot {
    /// Exactly once, first.
    Welcome(Welcome),
    /// Everything after it.
    Downlink(Box<Downlink>),
    /// The session is over. The last message.
    Close(Close),
    /// Open the next session; this one closes after so many milliseconds of link time.
    MoveOver {
        /// Milliseconds of link time.
        within_ms: u32,
    },
}

/// Everything the robot believes, before anything else is said.
#[derive(Clone, Debug, PartialEq)]
pub struct Hello {
    /// The robot that says it.
    pub robot_id: RobotId,
    /// New for each start of the agent; orders nothing.
    pub boot_id: String,
    /// Proof of succession. None: first session ever, or the ledger was lost.
    pub previous: Option<Previous>,
    /// What it says of itself.
    pub inventory: Inventory,
    /// What it believes now; `hb` and `session_epoch` are 0.
    pub reported: ReportedState,
    /// Random, made when the ring was formatted.
    pub ring: String,
    /// Where the numbers of each lane stand. An absent lane was never written.
    pub lanes: BTreeMap<Lane, LanePosition>,
    /// Store of the applied generations; empty: none was applied yet.
    pub store_id: String,
    /// Robot's wall clock at sending, unix ms UTC.
    pub sent_unix_ms: i64,
    /// How fast its site clock runs, thousandths.
    pub clock_rate_permille: u32,
    /// Wire versions spoken.
    pub protocol_versions: Vec<u32>,
    /// Signed envelope of what it has installed, unchecked; empty: its software is not changed from here.
    pub installed: String,
}

impl Hello {
    /// Of a robot that had no session before, has nothing to tell, and whose clock goes as fast as ours.
    pub fn new(robot_id: RobotId, boot_id: impl Into<String>, ring: impl Into<String>) -> Self {
        Self {
            robot_id,
            boot_id: boot_id.into(),
            previous: None,
            inventory: Inventory::default(),
            reported: ReportedState::default(),
            ring: ring.into(),
            lanes: BTreeMap::new(),
            store_id: String::new(),
            sent_unix_ms: 0,
            clock_rate_permille: 1_000,
            protocol_versions: vec![PROTOCOL_VERSION],
            installed: String::new(),
        }
    }
}

/// The session before this one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Previous {
    /// Its epoch.
    pub session_epoch: u64,
    /// The secret of its Welcome.
    pub secret: SessionSecret,
}

/// Where the numbers of one lane stand on the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LanePosition {
    /// Oldest number kept; equal to `next_seq` if nothing is kept.
    pub first_seq: u64,
    /// Number that the next sample will get.
    pub next_seq: u64,
}

/// The server's answer to Hello.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Welcome {
    /// Sessions with less are fenced.
    pub session_epoch: u64,
    /// Proves succession in the next Hello.
    pub session_secret: SessionSecret,
    /// Which store serves.
    pub store_id: String,
    /// What is durable of this ring.
    pub acks: Vec<LaneAck>,
    /// Milliseconds of link time between heartbeats.
    pub heartbeat_period_ms: u32,
    /// Milliseconds of site time between STATUS samples.
    pub status_period_ms: u32,
    /// Milliseconds of link time that an echoed heartbeat lets the robot go on, from its sending.
    pub authority_ms: u32,
    /// Bytes of STATUS that may be under way beyond the last ack.
    pub status_credit_bytes: u32,
    /// Wire version of this session.
    pub protocol_version: u32,
    /// Rate of the server's site clock, thousandths.
    pub clock_rate_permille: u32,
    /// Succession was not proven while another session is alive: attached, no work.
    pub observed: bool,
}

/// What is durable of one lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneAck {
    /// The lane that it is about.
    pub lane: Lane,
    /// All up to and with this one are durable.
    pub seq: u64,
    /// The server saw a hole: send again from here, or say a gap.
    pub expect: Option<u64>,
}

/// From the robot, after Hello.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Uplink {
    /// Newest wins, never stored.
    pub heartbeat: Option<Heartbeat>,
    /// Samples and gaps by lane.
    pub batches: Vec<LaneBatch>,
}

/// The heartbeat with its clocks.
#[derive(Clone, Debug, PartialEq)]
pub struct Heartbeat {
    /// Everything the robot believes of itself.
    pub reported: ReportedState,
    /// Robot's wall clock at sending, unix microseconds UTC: `t1` of the sample it begins.
    pub sent_unix_us: i64,
    /// The newest complete clock sample.
    pub clock: Option<ClockSample>,
}

/// Samples and gaps of one lane, by rising number.
#[derive(Clone, Debug, PartialEq)]
pub struct LaneBatch {
    /// The lane that numbers them.
    pub lane: Lane,
    /// What; poison only when read by the server.
    pub items: Vec<InboxItem>,
}

/// A batch of old STATUS beside the session: on the bulk connection, with the proof of the session that it is for.
#[derive(Clone, Debug, PartialEq)]
pub struct StatusReplay {
    /// The robot that sends it.
    pub robot_id: RobotId,
    /// The session that this robot has now.
    pub session_epoch: u64,
    /// The secret of its Welcome.
    pub session_secret: SessionSecret,
    /// Lane STATUS.
    pub batch: LaneBatch,
}

/// Four timestamps, unix microseconds UTC, each on its own machine's clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClockSample {
    /// Robot: heartbeat sent.
    pub t1_us: i64,
    /// Server: heartbeat received.
    pub t2_us: i64,
    /// Server: echo sent.
    pub t3_us: i64,
    /// Robot: echo received; 0 in an echo.
    pub t4_us: i64,
}

impl ClockSample {
    /// Robot clock minus server clock, microseconds.
    pub const fn offset_us(&self) -> i64 {
        (self.t1_us.saturating_sub(self.t2_us)).saturating_add(self.t4_us.saturating_sub(self.t3_us)) / 2
    }
    /// Time both ways on the wire, microseconds; half of it bounds the error of the offset.
    pub const fn delay_us(&self) -> i64 {
        (self.t4_us.saturating_sub(self.t1_us)).saturating_sub(self.t3_us.saturating_sub(self.t2_us))
    }
}

/// To the robot, after Welcome.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Downlink {
    /// Answer to the newest heartbeat processed.
    pub echo: Option<Echo>,
    /// What became durable.
    pub acks: Vec<LaneAck>,
    /// None: unchanged.
    pub work: Option<DesiredWork>,
    /// A section work that cannot be read, and why; none: there is none. Never sent.
    pub unreadable_work: Option<String>,
    /// None: unchanged.
    pub policy: Option<DesiredPolicy>,
    /// None: unchanged.
    pub update: Option<DesiredUpdate>,
    /// None: unchanged.
    pub status_credit_bytes: Option<u32>,
    /// None: nothing new.
    pub stops: Option<StopFacts>,
    /// Facts of stops that cannot be read, and why; none: there are none. Never sent.
    pub unreadable_stops: Option<String>,
}

/// Stops and resets that add up, at most [`midshift_core::limits::STOPS_MAX`] of each.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StopFacts {
    /// Engaged and not reset.
    pub stops: Vec<Stop>,
    /// Resets, each of one stop by its id.
    pub resets: Vec<Reset>,
}

/// Answer to a heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Echo {
    /// Its number.
    pub hb: u64,
    /// `t1` of that heartbeat, `t2` and `t3` of the server.
    pub clock: ClockSample,
    /// The server doubts its own wall: the time that it tells is nothing to go by.
    pub is_clock_doubted: bool,
}

/// The end of a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Close {
    /// Why the session ends, as a code.
    pub code: CloseCode,
    /// Why, for a person.
    pub reason: Reason,
    /// Do not come back sooner, milliseconds of link time; 0: the agent's own back-off.
    pub retry_after_ms: u32,
}

/// Why a session ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CloseCode {
    /// A newer session proved its succession.
    Fenced,
    /// A message broke the session's rules.
    Protocol,
    /// The server is stopping.
    Shutdown,
    /// The robot does not read, or sends more than its credit.
    TooSlow,
    /// The time that `MoveOver` gave is over.
    MoveOver,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_timestamps_give_offset_and_delay() {
        // The robot runs 500 us ahead; 30 us each way, 10 us in the server.
        let sample = ClockSample { t1_us: 1_500, t2_us: 1_030, t3_us: 1_040, t4_us: 1_570 };
        assert_eq!((sample.offset_us(), sample.delay_us()), (500, 60));
    }
}
