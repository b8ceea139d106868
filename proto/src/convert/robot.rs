//! What a robot says of itself: inventory, heartbeat, vitals, attempts, places.

use super::stop::{names, stop_ids};
use super::{At, Parse, WireEnum, counted, from_one, id, list, maybe, maybe_id, need, permille, text, word};
use crate::link::v1;
use midshift_core::ids::{AttemptId, PlaceId, Subject, TaskId, WaypointId};
use midshift_core::limits;
use midshift_core::reason::Violations;
use midshift_core::robot::{HeldPlace, Inventory, Lane, Load, ReportedAttempt, ReportedState, Vitals};
use std::collections::BTreeMap;

/// Capabilities of one robot.
const CAPABILITIES_MAX: usize = 64;

impl From<&AttemptId> for v1::AttemptId {
    fn from(attempt: &AttemptId) -> Self {
        Self { subject: attempt.subject.to_string(), epoch: attempt.epoch }
    }
}

impl Parse<AttemptId> for v1::AttemptId {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<AttemptId> {
        let subject = id(&self.subject, Subject::parse, at.field("subject"), bad);
        let epoch = from_one(self.epoch, at.field("epoch"), bad);
        Some(AttemptId { subject: subject?, epoch: epoch? })
    }
}

impl From<&Inventory> for v1::Inventory {
    fn from(inventory: &Inventory) -> Self {
        Self {
            capabilities: inventory.capabilities.clone(),
            labels: inventory.labels.clone(),
            payload_g: inventory.payload_g,
            software: inventory.software.clone(),
            agent_version: inventory.agent_version.clone(),
            model: inventory.model.clone(),
            load_by_memory: inventory.load_by_memory,
        }
    }
}

impl Parse<Inventory> for v1::Inventory {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Inventory> {
        let before = bad.0.len();
        let word_ok = |w: &String| {
            (1..=64).contains(&w.len())
                && w.bytes().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, b'-' | b'_'))
        };
        if self.capabilities.len() > CAPABILITIES_MAX || !self.capabilities.iter().all(word_ok) {
            bad.add(at.field("capabilities").to_string(), "must be at most 64, each 1-64 of [a-z0-9-_]");
        }
        let label_ok = |(k, v): (&String, &String)| (1..=63).contains(&k.len()) && (1..=63).contains(&v.len());
        if self.labels.len() > limits::LABELS_MAX || !self.labels.iter().all(label_ok) {
            bad.add(at.field("labels").to_string(), "must be at most 32 entries, key and value must be 1-63 bytes");
        }
        for (name, text) in
            [("software", &self.software), ("agent_version", &self.agent_version), ("model", &self.model)]
        {
            if text.len() > 128 {
                bad.add(at.field(name).to_string(), "must be at most 128 bytes");
            }
        }
        (bad.0.len() == before).then_some(Inventory {
            capabilities: self.capabilities,
            labels: self.labels,
            payload_g: self.payload_g,
            software: self.software,
            agent_version: self.agent_version,
            model: self.model,
            load_by_memory: self.load_by_memory,
        })
    }
}

impl From<&Vitals> for v1::Vitals {
    fn from(vitals: &Vitals) -> Self {
        Self {
            pose: vitals.pose.as_ref().map(Into::into),
            waypoint: vitals.waypoint.as_ref().map(ToString::to_string).unwrap_or_default(),
            speed_mm_s: vitals.speed_mm_s,
            battery_permille: u32::from(vitals.battery_permille),
            charging: vitals.charging,
            hottest_joint_decidegrees: vitals.hottest_joint_decidegrees,
            odometer_mm: vitals.odometer_mm,
            loaded_odometer_mm: vitals.loaded_odometer_mm,
            energy_mwh: vitals.energy_mwh,
        }
    }
}

impl Parse<Vitals> for v1::Vitals {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Vitals> {
        let pose = maybe(self.pose, at.field("pose"), bad);
        let waypoint = maybe_id(&self.waypoint, WaypointId::parse, at.field("waypoint"), bad);
        let battery = permille(self.battery_permille, at.field("battery_permille"), bad);
        Some(Vitals {
            pose: pose?,
            waypoint: waypoint?,
            speed_mm_s: self.speed_mm_s,
            battery_permille: battery?,
            charging: self.charging,
            hottest_joint_decidegrees: self.hottest_joint_decidegrees,
            odometer_mm: self.odometer_mm,
            loaded_odometer_mm: self.loaded_odometer_mm,
            energy_mwh: self.energy_mwh,
        })
    }
}

impl From<&Load> for v1::Load {
    fn from(load: &Load) -> Self {
        Self { task_id: load.task_id.as_ref().map(ToString::to_string).unwrap_or_default(), item: load.item.clone() }
    }
}

impl Parse<Load> for v1::Load {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Load> {
        let task_id = maybe_id(&self.task_id, TaskId::parse, at.field("task_id"), bad);
        Some(Load { task_id: task_id?, item: self.item })
    }
}

impl From<&ReportedAttempt> for v1::ReportedAttempt {
    fn from(reported: &ReportedAttempt) -> Self {
        Self {
            attempt: Some((&reported.attempt).into()),
            state: reported.state.to_wire(),
            step_index: reported.step_index,
            progress: reported.progress,
            route_index: reported.route_index,
            opened: reported.opened,
        }
    }
}

impl Parse<ReportedAttempt> for v1::ReportedAttempt {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<ReportedAttempt> {
        let attempt = need(self.attempt, at.field("attempt"), bad);
        let state = word(self.state, at.field("state"), bad);
        Some(ReportedAttempt {
            attempt: attempt?,
            state: state?,
            step_index: self.step_index,
            progress: self.progress,
            route_index: self.route_index,
            opened: self.opened,
        })
    }
}

impl From<&HeldPlace> for v1::HeldPlace {
    fn from(held: &HeldPlace) -> Self {
        Self { place_id: held.place_id.to_string(), grant_id: held.grant_id, inside: held.inside }
    }
}

impl Parse<HeldPlace> for v1::HeldPlace {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<HeldPlace> {
        let place_id = id(&self.place_id, PlaceId::parse, at.field("place_id"), bad);
        Some(HeldPlace { place_id: place_id?, grant_id: self.grant_id, inside: self.inside })
    }
}

/// Numbers of lanes for the wire; a lane at 0 is left out.
pub fn lane_marks(marks: &BTreeMap<Lane, u64>) -> Vec<v1::LaneMark> {
    marks
        .iter()
        .filter(|(_, seq)| **seq > 0)
        .map(|(lane, seq)| v1::LaneMark { lane: lane.to_wire(), seq: *seq })
        .collect()
}

fn parse_marks(wire: Vec<v1::LaneMark>, at: At<'_>, bad: &mut Violations) -> Option<BTreeMap<Lane, u64>> {
    let length = wire.len();
    let marks: BTreeMap<Lane, u64> = wire
        .into_iter()
        .enumerate()
        .filter_map(|(i, m)| {
            let seq = counted(m.seq, at.index(i).field("seq"), bad);
            Some((word(m.lane, at.index(i).field("lane"), bad)?, seq?))
        })
        .collect();
    if marks.len() != length {
        bad.add(at.to_string(), "must name each lane at most once");
        return None;
    }
    Some(marks)
}

impl From<&ReportedState> for v1::ReportedState {
    fn from(state: &ReportedState) -> Self {
        Self {
            hb: state.hb,
            session_epoch: state.session_epoch,
            applied_work: state.applied_work,
            applied_policy: state.applied_policy,
            produced: lane_marks(&state.produced),
            mode: state.mode.to_wire(),
            vitals: Some((&state.vitals).into()),
            load: state.load.as_ref().map(Into::into),
            attempts: state.attempts.iter().map(Into::into).collect(),
            places: state.places.iter().map(Into::into).collect(),
            stop_level: state.stop_level.to_wire(),
            hardware_stop: state.hardware_stop.to_wire(),
            field_violation: state.field_violation,
            fault: state.fault.as_ref().map(Into::into),
            applied_update: state.applied_update,
            update: state.update.as_ref().map(Into::into),
            stops: names(&state.stops),
            awaiting_resume: names(&state.awaiting_resume),
            map_version: state.map_version.clone(),
            free_bytes: state.free_bytes,
        }
    }
}

/// Name of the first list that is longer than a report may have.
pub(crate) fn long_list(state: &v1::ReportedState) -> Option<&'static str> {
    let lists = [
        ("attempts", state.attempts.len()),
        ("places", state.places.len()),
        ("stops", state.stops.len()),
        ("awaiting_resume", state.awaiting_resume.len()),
        ("produced", state.produced.len()),
    ];
    lists.into_iter().find(|(_, length)| *length > limits::REPORTED_LIST_MAX).map(|(name, _)| name)
}

impl Parse<ReportedState> for v1::ReportedState {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<ReportedState> {
        if let Some(name) = long_list(&self) {
            bad.add(at.field(name).to_string(), format!("must be at most {}", limits::REPORTED_LIST_MAX));
            return None;
        }
        let produced = parse_marks(self.produced, at.field("produced"), bad);
        let mode = word(self.mode, at.field("mode"), bad);
        let vitals = need(self.vitals, at.field("vitals"), bad);
        let load = maybe(self.load, at.field("load"), bad);
        let attempts = list(self.attempts, at.field("attempts"), bad);
        let places = list(self.places, at.field("places"), bad);
        let stop_level = word(self.stop_level, at.field("stop_level"), bad);
        let hardware_stop = word(self.hardware_stop, at.field("hardware_stop"), bad);
        let fault = maybe(self.fault, at.field("fault"), bad);
        let update = maybe(self.update, at.field("update"), bad);
        let stops = stop_ids(&self.stops, at.field("stops"), bad);
        let awaiting_resume = stop_ids(&self.awaiting_resume, at.field("awaiting_resume"), bad);
        let map_version = match self.map_version.is_empty() {
            true => Some(String::new()),
            false => text(self.map_version, limits::MAP_VERSION_BYTES, at.field("map_version"), bad),
        };
        let applied_update = counted(self.applied_update, at.field("applied_update"), bad);
        let hb = counted(self.hb, at.field("hb"), bad);
        let session_epoch = counted(self.session_epoch, at.field("session_epoch"), bad);
        let applied_work = counted(self.applied_work, at.field("applied_work"), bad);
        let applied_policy = counted(self.applied_policy, at.field("applied_policy"), bad);
        Some(ReportedState {
            hb: hb?,
            session_epoch: session_epoch?,
            applied_work: applied_work?,
            applied_policy: applied_policy?,
            applied_update: applied_update?,
            produced: produced?,
            mode: mode?,
            vitals: vitals?,
            load: load?,
            attempts: attempts?,
            places: places?,
            stop_level: stop_level?,
            stops: stops?,
            awaiting_resume: awaiting_resume?,
            map_version: map_version?,
            free_bytes: self.free_bytes,
            hardware_stop: hardware_stop?,
            field_violation: self.field_violation,
            fault: fault?,
            update: update?,
        })
    }
}
