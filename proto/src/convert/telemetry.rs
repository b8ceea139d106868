//! Robots and their events as callers see them.

use super::robot::lane_marks;
use super::{WireEnum, timestamp};
use crate::telemetry::v1;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::{AreaId, RobotId};
use midshift_core::presence::Presence;
use midshift_core::presence::{Condition, LastHeard, PresenceRow};
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::Lane;
use midshift_core::robot_events::{InboxEntry, InboxItem};
use midshift_core::session::Session;
use midshift_core::time::{Now, Utc};
use midshift_core::update::{Installed, InstalledSet};
use std::collections::BTreeMap;

/// What is known of one robot.
#[derive(Clone, Copy, Debug)]
pub struct RobotView<'a> {
    /// The robot's id.
    pub robot_id: &'a RobotId,
    /// Whether it is heard; none: never.
    pub presence: Option<&'a PresenceRow>,
    /// Its newest session.
    pub session: Option<&'a Session>,
    /// Its newest heartbeat.
    pub live: Option<&'a NewestHeartbeat>,
    /// The area in which it is, or was when it was heard last; none: not known.
    pub area_id: Option<&'a AreaId>,
    /// Highest durable number of each lane of its ring.
    pub durable: &'a BTreeMap<Lane, u64>,
    /// Since when another machine is attached under its name and only observed; none: there is none.
    pub observed_since: Option<Utc>,
}

/// Whether a robot is heard: what a row says of one that this server has not heard is of another time.
pub fn shown_presence(row: Option<&PresenceRow>, live: Option<&NewestHeartbeat>) -> Presence {
    live.and(row).map_or(Presence::Offline, |row| row.presence)
}

/// A robot as callers see it at `now`.
pub fn encode_robot(view: RobotView<'_>, now: Now) -> v1::Robot {
    let RobotView { robot_id, presence, session, live, area_id, durable, observed_since } = view;
    let since_unix_ms = presence.map(|row| live.map_or(row.unheard_since_unix_ms(), |_| row.since_unix_ms));
    let conditions = match (presence, live) {
        (Some(row), Some(live)) => row.conditions_of(live),
        (Some(row), None) => row.conditions.clone(),
        (None, _) => Vec::new(),
    };
    let last_heard = presence.filter(|_| live.is_none()).and_then(|row| row.last_heard.as_ref());
    // The live board measures; the row keeps what was known at Hello.
    let measured = live.and_then(|l| l.clock);
    let offset = measured.map(|clock| clock.clock_offset_ms).or_else(|| session.and_then(|s| s.clock_offset_ms));
    v1::Robot {
        robot_id: robot_id.to_string(),
        presence: shown_presence(presence, live).to_wire(),
        presence_since: since_unix_ms.map(|since| timestamp(Utc(since))),
        inventory: session.map(|s| (&s.inventory).into()),
        reported: live.map(|l| (&l.report).into()),
        receive_time: live.map(|l| timestamp(Utc(l.received_unix_ms))),
        age: live.map(|l| super::duration(now.link.since(l.processed_at).as_ms())),
        session_epoch: session.map(|s| s.session_epoch).unwrap_or_default(),
        clock_offset_ms: offset,
        clock_error_ms: measured.map(|clock| clock.clock_error_ms),
        observed: observed_since.is_some(),
        ring: session.map(|s| s.ring.clone()).unwrap_or_default(),
        durable: lane_marks(durable),
        observed_since: observed_since.map(timestamp),
        // No part of what is known of it: whoever listens for beacons adds it.
        beacon: None,
        installed: session.and_then(|s| s.installed.as_ref()).map(|installed| v1::InstalledSoftware {
            free_bytes: live.and_then(|l| l.report.free_bytes).unwrap_or(installed.free_bytes),
            ..installed.into()
        }),
        device_key: session.and_then(|s| s.device_key.clone()).unwrap_or_default(),
        device_key_changed: session.is_some_and(|s| s.device_key_changed),
        other_device_key: session.and_then(|s| s.other_device_key.clone()).unwrap_or_default(),
        area_id: area_id.map(ToString::to_string).unwrap_or_default(),
        conditions: conditions.iter().map(Into::into).collect(),
        last_heard: last_heard.map(|last| encode_last_heard(last, now.wall)),
    }
}

impl From<&Condition> for v1::Condition {
    fn from(condition: &Condition) -> Self {
        Self { what: condition.what.clone(), since: Some(timestamp(Utc(condition.since_unix_ms))) }
    }
}

fn encode_last_heard(last: &LastHeard, wall: Utc) -> v1::LastHeard {
    let at = Utc(last.at_unix_ms);
    v1::LastHeard {
        receive_time: Some(timestamp(at)),
        age: Some(super::duration(wall.ms_since(at))),
        battery_permille: u32::from(last.battery_permille),
        waypoint: last.waypoint.as_ref().map(ToString::to_string).unwrap_or_default(),
    }
}

impl From<&Installed> for v1::InstalledSoftware {
    fn from(installed: &Installed) -> Self {
        Self {
            running: installed.running.to_string(),
            current: installed.current.to_string(),
            previous: installed.previous.as_ref().map(ToString::to_string).unwrap_or_default(),
            sets: installed.sets.iter().map(Into::into).collect(),
            free_bytes: installed.free_bytes,
            model: installed.model.clone(),
        }
    }
}

impl From<&InstalledSet> for v1::InstalledSet {
    fn from(set: &InstalledSet) -> Self {
        Self {
            set: set.set.to_string(),
            bundle: set.bundle.as_ref().map(ToString::to_string).unwrap_or_default(),
            version: set.version.clone(),
            components: set.components.clone().into_iter().collect(),
            components_left_out: set.components_left_out,
        }
    }
}

/// A durable fact as callers see it. `cursor`: position after it; `received`: UTC of the wall, its commit.
pub fn encode_event(entry: &InboxEntry, received: Utc, cursor: String) -> v1::Event {
    use v1::event::Item;
    let item = match &entry.what {
        InboxItem::Sample(sample) => Item::Sample(sample.into()),
        InboxItem::Gap(gap) => Item::Gap(gap.into()),
        InboxItem::Poison { seq, detail } => {
            let reason = Reason::new(Code::Poison, detail.clone());
            Item::Poison(v1::Poison { seq: *seq, reason: Some(super::shown(&reason)) })
        }
    };
    v1::Event {
        robot_id: entry.robot_id.to_string(),
        session_epoch: entry.session_epoch,
        ring: entry.ring.clone(),
        lane: entry.lane.to_wire(),
        item: Some(item),
        receive_time: Some(timestamp(received)),
        stamp_in_future: entry.stamp_in_future,
        cursor,
    }
}
