//! What passes between the core and the shell: inputs, outputs and when to call again.
//!
//! Invariant: plain values. A simulation plays them as a shell does.

use crate::bugs::Bugs;
use crate::stop::{CheckIn, StopNews};
use crate::storage::Op;
use crate::transport::replay::Replayed;
use crate::update::{Done, Job, UpdateConfig};
use midshift_core::ids::RobotId;
use midshift_core::stop::robot::SavedStops;
use midshift_core::time::{LinkTime, SiteTime};
use midshift_proto::session::{Downlink, StatusReplay, Uplink, Welcome};

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
    /// Time went on; see [`super::AgentCore::next_wake`].
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
    /// Save these stops and report [`StopNews::Saved`] with this number. At most one is under way.
    SaveStops(u64, Box<SavedStops>),
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
