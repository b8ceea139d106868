//! Robots and their events as callers see them.

use super::robot::lane_marks;
use super::{WireEnum, timestamp};
use crate::telemetry::v1;
use midshift_core::ids::RobotId;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{Lane, Presence};
use midshift_core::time::{LinkTime, Utc};
use midshift_core::update::{Installed, InstalledSet};
use midshift_core::work::{InboxEntry, InboxItem, Live, PresenceRow, Session};
use std::collections::BTreeMap;

/// What is known of one robot.
#[derive(Clone, Copy, Debug)]
pub struct RobotView<'a> {
    /// Who.
    pub robot_id: &'a RobotId,
    /// Whether it is heard; none: never.
    pub presence: Option<&'a PresenceRow>,
    /// Its newest session.
    pub session: Option<&'a Session>,
    /// Its newest heartbeat.
    pub live: Option<&'a Live>,
    /// Highest durable number of each lane of its ring.
    pub durable: &'a BTreeMap<Lane, u64>,
    /// Since when another machine is attached under its name and only observed; none: there is none.
    pub observed_since: Option<Utc>,
}

/// A robot as callers see it at `now`.
pub fn encode_robot(view: RobotView<'_>, now: LinkTime) -> v1::Robot {
    let RobotView { robot_id, presence, session, live, durable, observed_since } = view;
    // The live board measures; the row keeps what was known at Hello.
    let measured = live.and_then(|l| l.clock_offset_ms);
    let offset = measured.map(|(offset, _)| offset).or_else(|| session.and_then(|s| s.clock_offset_ms));
    v1::Robot {
        robot_id: robot_id.to_string(),
        presence: presence.map_or(Presence::Offline, |p| p.presence).to_wire(),
        presence_since: presence.map(|p| timestamp(Utc(p.since_unix_ms))),
        inventory: session.map(|s| (&s.inventory).into()),
        reported: live.map(|l| (&l.report).into()),
        receive_time: live.map(|l| timestamp(Utc(l.received_unix_ms))),
        age: live.map(|l| super::duration(now.since(l.processed_at).as_ms())),
        session_epoch: session.map(|s| s.session_epoch).unwrap_or_default(),
        clock_offset_ms: offset,
        clock_error_ms: measured.map(|(_, error)| error),
        observed: observed_since.is_some(),
        ring: session.map(|s| s.ring.clone()).unwrap_or_default(),
        durable: lane_marks(durable),
        observed_since: observed_since.map(timestamp),
        // No part of what is known of it: whoever listens for beacons adds it.
        beacon: None,
        installed: session.and_then(|s| s.installed.as_ref()).map(Into::into),
        device_key: session.and_then(|s| s.device_key.clone()).unwrap_or_default(),
        device_key_changed: session.is_some_and(|s| s.device_key_changed),
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
