//! Desired state: what goes down to a robot.

use super::stop::{names, stop_ids};
use super::{
    At, Parse, WireEnum, common, from_one, from_struct, id, list, maybe, maybe_id, need, permille, to_struct, word,
};
use crate::link::v1;
use midshift_core::desired_state::{
    AreaRules, Assignment, DesiredPolicy, DesiredWork, GrantedPlace, LoadWord, RoutePoint,
};
use midshift_core::ids::{AreaId, DrainId, PlaceId, RobotId, WaypointId};
use midshift_core::reason::Violations;
use midshift_core::step::{StepKind, WorkStep};

impl From<&WorkStep> for v1::WorkStep {
    fn from(step: &WorkStep) -> Self {
        use v1::work_step::Kind as W;
        let kind = match &step.kind {
            StepKind::Goto { waypoint } => W::GotoWaypoint(waypoint.to_string()),
            StepKind::Action { name, params } => {
                let params = (!params.is_empty()).then(|| to_struct(params));
                W::Action(v1::WorkAction { name: name.clone(), params })
            }
            StepKind::Wait { duration_ms } => W::WaitMs(*duration_ms),
        };
        Self {
            kind: Some(kind),
            effect: step.effect.to_wire(),
            pause_allowed: step.pause_allowed,
            cancel_allowed: step.cancel_allowed,
            timeout_ms: step.timeout_ms,
            continue_on_fail: step.continue_on_fail,
        }
    }
}

impl Parse<WorkStep> for v1::WorkStep {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<WorkStep> {
        use v1::work_step::Kind as W;
        let effect = word(self.effect, at.field("effect"), bad);
        let kind = match self.kind {
            Some(W::GotoWaypoint(name)) => {
                id(&name, WaypointId::parse, at.field("goto_waypoint"), bad).map(|waypoint| StepKind::Goto { waypoint })
            }
            Some(W::Action(action)) => {
                let at = at.field("action");
                let name = super::text(action.name, 64, at.field("name"), bad);
                let params = from_struct(action.params, at.field("params"), bad);
                name.zip(params).map(|(name, params)| StepKind::Action { name, params })
            }
            Some(W::WaitMs(duration_ms)) => Some(StepKind::Wait { duration_ms }),
            None => {
                bad.add(at.to_string(), "must be one of goto_waypoint, action, wait_ms");
                None
            }
        };
        Some(WorkStep {
            kind: kind?,
            effect: effect?,
            pause_allowed: self.pause_allowed,
            cancel_allowed: self.cancel_allowed,
            timeout_ms: self.timeout_ms,
            continue_on_fail: self.continue_on_fail,
        })
    }
}

impl From<&RoutePoint> for v1::RoutePoint {
    fn from(point: &RoutePoint) -> Self {
        Self {
            waypoint: point.waypoint.to_string(),
            x_mm: point.x_mm,
            y_mm: point.y_mm,
            ends_step: point.ends_step,
            standing: point.standing.as_ref().map(ToString::to_string).unwrap_or_default(),
            passages: point.passages.iter().map(ToString::to_string).collect(),
            speed_limit_mm_s: point.speed_limit_mm_s,
            area_id: point.area_id.to_string(),
        }
    }
}

impl Parse<RoutePoint> for v1::RoutePoint {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<RoutePoint> {
        let waypoint = id(&self.waypoint, WaypointId::parse, at.field("waypoint"), bad);
        let standing = maybe_id(&self.standing, PlaceId::parse, at.field("standing"), bad);
        let area_id = id(&self.area_id, AreaId::parse, at.field("area_id"), bad);
        let passages: Vec<PlaceId> = self
            .passages
            .iter()
            .enumerate()
            .filter_map(|(i, text)| id(text, PlaceId::parse, at.field("passages").index(i), bad))
            .collect();
        if passages.len() != self.passages.len() {
            return None;
        }
        Some(RoutePoint {
            waypoint: waypoint?,
            x_mm: self.x_mm,
            y_mm: self.y_mm,
            ends_step: self.ends_step,
            standing: standing?,
            passages,
            speed_limit_mm_s: self.speed_limit_mm_s,
            area_id: area_id?,
        })
    }
}

impl From<&Assignment> for v1::Assignment {
    fn from(assignment: &Assignment) -> Self {
        Self {
            attempt: Some((&assignment.attempt).into()),
            offer: Some((&assignment.offer).into()),
            timeout_ms: assignment.timeout_ms,
            steps: assignment.steps.iter().map(Into::into).collect(),
            from_step: assignment.from_step,
            resume_step: assignment.resume_step,
            route_number: assignment.route_number,
            route: assignment.route.iter().map(Into::into).collect(),
            released_index: assignment.released_index,
            stop: assignment.stop,
            suspend: assignment.suspend,
            speed_limit_mm_s: assignment.speed_limit_mm_s,
        }
    }
}

impl Parse<Assignment> for v1::Assignment {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Assignment> {
        let attempt = need(self.attempt, at.field("attempt"), bad);
        let offer = common::authority(self.offer, at.field("offer"), bad);
        let timeout_ms = from_one(self.timeout_ms, at.field("timeout_ms"), bad);
        if self.steps.is_empty() {
            bad.add(at.field("steps").to_string(), "is required");
        }
        let end = (self.route.len() as u64, self.steps.len() as u64);
        let steps = list(self.steps, at.field("steps"), bad).filter(|s: &Vec<_>| !s.is_empty());
        let route = list(self.route, at.field("route"), bad);
        let steps_lie = self.from_step <= self.resume_step && u64::from(self.resume_step) <= end.1;
        if !steps_lie || self.released_index.is_some_and(|i| u64::from(i) >= end.0) {
            bad.add(
                at.to_string(),
                "from_step, resume_step and released_index must lie within steps and route, in order",
            );
            return None;
        }
        Some(Assignment {
            attempt: attempt?,
            offer: offer?,
            timeout_ms: timeout_ms?,
            steps: steps?,
            from_step: self.from_step,
            resume_step: self.resume_step,
            route_number: self.route_number,
            route: route?,
            released_index: self.released_index,
            stop: self.stop,
            suspend: self.suspend,
            speed_limit_mm_s: self.speed_limit_mm_s,
        })
    }
}

impl From<&GrantedPlace> for v1::GrantedPlace {
    fn from(grant: &GrantedPlace) -> Self {
        Self {
            place_id: grant.place_id.to_string(),
            grant_id: grant.grant_id,
            entry: grant.entry.as_ref().map(Into::into),
        }
    }
}

impl Parse<GrantedPlace> for v1::GrantedPlace {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<GrantedPlace> {
        let place_id = id(&self.place_id, PlaceId::parse, at.field("place_id"), bad);
        let entry = maybe(self.entry, at.field("entry"), bad);
        Some(GrantedPlace { place_id: place_id?, grant_id: self.grant_id, entry: entry? })
    }
}

impl From<&DesiredWork> for v1::DesiredWork {
    fn from(work: &DesiredWork) -> Self {
        Self {
            robot_id: work.robot_id.to_string(),
            generation: work.generation,
            assignment: work.assignment.as_ref().map(Into::into),
            grants: work.grants.iter().map(Into::into).collect(),
            held: work.held,
            resume: work.resume.as_ref().map(Into::into),
            closed: work.closed.iter().map(Into::into).collect(),
            maintenance: work.maintenance.as_ref().map(ToString::to_string).unwrap_or_default(),
            resumed: names(&work.resumed),
            load_word: work.load_word.map(|LoadWord { session_epoch, hb }| v1::LoadWord { session_epoch, hb }),
        }
    }
}

impl Parse<DesiredWork> for v1::DesiredWork {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<DesiredWork> {
        let robot_id = id(&self.robot_id, RobotId::parse, at.field("robot_id"), bad);
        let generation = from_one(self.generation, at.field("generation"), bad);
        let assignment = maybe(self.assignment, at.field("assignment"), bad);
        let grants = list(self.grants, at.field("grants"), bad);
        let resume = maybe(self.resume, at.field("resume"), bad);
        let closed = list(self.closed, at.field("closed"), bad);
        let maintenance = maybe_id(&self.maintenance, DrainId::parse, at.field("maintenance"), bad);
        let resumed = stop_ids(&self.resumed, at.field("resumed"), bad);
        let load_word = maybe(self.load_word, at.field("load_word"), bad);
        Some(DesiredWork {
            robot_id: robot_id?,
            generation: generation?,
            assignment: assignment?,
            grants: grants?,
            held: self.held,
            resume: resume?,
            closed: closed?,
            maintenance: maintenance?,
            resumed: resumed?,
            load_word: load_word?,
        })
    }
}

impl Parse<LoadWord> for v1::LoadWord {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<LoadWord> {
        let session_epoch = from_one(self.session_epoch, at.field("session_epoch"), bad);
        let hb = from_one(self.hb, at.field("hb"), bad);
        Some(LoadWord { session_epoch: session_epoch?, hb: hb? })
    }
}

impl From<&AreaRules> for v1::AreaRules {
    fn from(rules: &AreaRules) -> Self {
        Self {
            area_id: rules.area_id.to_string(),
            speed_limit_mm_s: rules.speed_limit_mm_s,
            avoidance_distance_mm: rules.avoidance_distance_mm,
            charge_stop_permille: u32::from(rules.charge_stop_permille),
            without_people: rules.without_people,
        }
    }
}

impl Parse<AreaRules> for v1::AreaRules {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<AreaRules> {
        let area_id = id(&self.area_id, AreaId::parse, at.field("area_id"), bad);
        let stop = permille(self.charge_stop_permille, at.field("charge_stop_permille"), bad);
        Some(AreaRules {
            area_id: area_id?,
            speed_limit_mm_s: self.speed_limit_mm_s,
            avoidance_distance_mm: self.avoidance_distance_mm,
            charge_stop_permille: stop?,
            without_people: self.without_people,
        })
    }
}

impl From<&DesiredPolicy> for v1::DesiredPolicy {
    fn from(policy: &DesiredPolicy) -> Self {
        Self {
            robot_id: policy.robot_id.to_string(),
            generation: policy.generation,
            areas: policy.areas.iter().map(Into::into).collect(),
        }
    }
}

impl Parse<DesiredPolicy> for v1::DesiredPolicy {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<DesiredPolicy> {
        let robot_id = id(&self.robot_id, RobotId::parse, at.field("robot_id"), bad);
        let generation = from_one(self.generation, at.field("generation"), bad);
        let areas = list(self.areas, at.field("areas"), bad);
        Some(DesiredPolicy { robot_id: robot_id?, generation: generation?, areas: areas? })
    }
}
