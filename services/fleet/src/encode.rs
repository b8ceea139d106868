//! Rows and explanations as their messages. Nothing is decided here.

use midshift_core::energy::RobotEnergy;
use midshift_core::fleet::explain::{RobotExplanation, TaskExplanation};
use midshift_core::fleet::projection::FleetProjection;
use midshift_core::fleet::projection::chosen::{PairCost, PlanChoice};
use midshift_core::fleet::rows::{
    Cordon, HoldToken, HolderState, Incident, Place, RobotControl, RobotCounter, RobotHolder,
};
use midshift_core::fleet::{Board, load, starts};
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::robot::Duty;
use midshift_core::rows::Revision;
use midshift_core::site::{PlaceKind, PlaceRule};
use midshift_core::task::state::Errand;
use midshift_core::time::{Now, Utc};
use midshift_proto::convert::WireEnum;
use midshift_proto::convert::task::etag;
use midshift_proto::convert::{shown, timestamp};
use midshift_proto::fleet::v1;

/// What people and the breaker decided about a robot, and what it is taken by.
pub fn control(view: &FleetProjection, board: &Board, robot_id: &RobotId) -> v1::RobotControl {
    let revised = view.control.get(robot_id.as_str());
    let row = revised.map_or_else(|| RobotControl::new(robot_id.clone()), |c| c.row.clone());
    let holder = match view.authority.get(robot_id.as_str()).map(|a| &a.row.holder) {
        Some(RobotHolder::Attempt(id)) => id.to_string(),
        Some(RobotHolder::Maintenance(id)) => format!("maintenance:{id}"),
        _ => String::new(),
    };
    let errand = view.held_by(robot_id).and_then(|id| view.attempt(id)).and_then(|a| a.errand);
    let live = board.get(robot_id).map(AsRef::as_ref);
    let load_settled = load::standing_word(view, robot_id, live);
    let hold = |h: &HoldToken| v1::Hold { token: h.token.clone(), since: Some(timestamp(h.since)) };
    v1::RobotControl {
        robot_id: robot_id.to_string(),
        duty: match row.duty() {
            Duty::InWork => v1::Duty::InWork,
            Duty::Cordoned => v1::Duty::Cordoned,
            Duty::BrokenOff => v1::Duty::BrokenOff,
            Duty::Retired => v1::Duty::Retired,
        } as i32,
        cordon: row.cordon.map(cordon),
        retired: row.retired.map(cordon),
        breaker_open_time: row.breaker.map(timestamp),
        failure_times: row.failures.iter().copied().map(timestamp).collect(),
        holder,
        errand: match errand {
            None => v1::Errand::Unspecified,
            Some(Errand::Charge) => v1::Errand::Charge,
            Some(Errand::Park) => v1::Errand::Park,
        } as i32,
        hold_tokens: view.robot_holds(robot_id).map(|h| h.token.clone()).collect(),
        holds: view.robot_holds(robot_id).map(hold).collect(),
        load_settled: load_settled.map(|word| v1::LoadSettled {
            reason: word.reason.clone(),
            since: Some(timestamp(word.since)),
            actor: word.actor.clone(),
            is_forget_pending: word.is_forget_pending,
        }),
        labels: row.labels,
        etag: etag(revised.map_or(Revision(0), |c| c.revision)),
        drain: drain(view, robot_id),
        work_generation: view.desired_work.get(robot_id.as_str()).map_or(0, |d| d.row.generation),
    }
}

fn cordon(cordon: Cordon) -> v1::Cordon {
    v1::Cordon { reason: cordon.reason, since: Some(timestamp(cordon.since)), actor: cordon.actor }
}

/// The drain a robot is in, or the last that waits or was refused.
fn drain(view: &FleetProjection, robot_id: &RobotId) -> Option<v1::Drain> {
    let drain = view.drain_of(robot_id).or_else(|| view.all_drains_of(robot_id).last())?;
    let within_ms = i64::try_from(drain.within_ms).unwrap_or(i64::MAX);
    Some(v1::Drain {
        drain_id: drain.drain_id.to_string(),
        state: drain.state.to_wire(),
        reason: drain.reason.clone(),
        actor: drain.actor.clone(),
        since: Some(timestamp(drain.since)),
        deadline: Some(timestamp(Utc(drain.since.0.saturating_add(within_ms)))),
        why: drain.why.as_ref().map(shown),
        rollout_id: drain.rollout_id.as_ref().map(ToString::to_string).unwrap_or_default(),
    })
}

/// An incident.
pub fn incident(row: &Incident, revision: Revision) -> v1::Incident {
    let text = |id: Option<String>| id.unwrap_or_default();
    v1::Incident {
        incident_id: row.id.clone(),
        reason: Some(shown(&row.reason)),
        robot_id: text(row.robot_id.as_ref().map(ToString::to_string)),
        task_id: text(row.task_id.as_ref().map(ToString::to_string)),
        area_id: text(row.area_id.as_ref().map(ToString::to_string)),
        open_time: Some(timestamp(row.opened_unix_ms)),
        closed: row.closed.as_ref().map(|closed| v1::IncidentClosed {
            actor: closed.actor.clone(),
            reason: closed.reason.clone(),
            close_time: Some(timestamp(closed.at)),
        }),
        etag: etag(revision),
    }
}

/// A place with its holders and who waits for it.
pub fn place(view: &FleetProjection, row: &Place, revision: Revision) -> v1::Place {
    let site = view.site.find_place(&row.place_id).map(|ix| view.site.place(ix));
    let kind = site.map_or(v1::PlaceKind::Unspecified, |p| match p.kind() {
        PlaceKind::Passage => v1::PlaceKind::Passage,
        PlaceKind::Standing => v1::PlaceKind::Standing,
    });
    let rule = site.map_or(v1::PlaceRule::Unspecified, |p| match p.rule {
        PlaceRule::Exclusive => v1::PlaceRule::Exclusive,
        PlaceRule::Capacity => v1::PlaceRule::Capacity,
    });
    let mut waiting: Vec<_> = view
        .waits
        .iter()
        .filter(|(_, w)| w.places.contains(&row.place_id))
        .map(|(r, w)| (w.since, r.to_string()))
        .collect();
    waiting.sort();
    let ix = view.site.find_place(&row.place_id);
    let awaited = ix.into_iter().flat_map(|ix| starts::awaited(view, ix)).map(ToString::to_string).collect();
    let area = site.and_then(|p| p.waypoint()).map(|w| view.site.area_of(w).area_id.to_string());
    v1::Place {
        place_id: row.place_id.to_string(),
        kind: kind as i32,
        rule: rule as i32,
        capacity: row.capacity,
        holders: row
            .holders
            .iter()
            .map(|h| v1::PlaceHolder {
                robot_id: h.robot_id.to_string(),
                state: match h.state {
                    HolderState::Granted => v1::PlaceHolderState::Granted,
                    HolderState::Inside => v1::PlaceHolderState::Inside,
                    HolderState::Revoking => v1::PlaceHolderState::Revoking,
                } as i32,
                since: Some(timestamp(h.since)),
                grant_id: h.grant_id,
            })
            .collect(),
        waiting_robot_ids: waiting.into_iter().map(|(_, r)| r).collect(),
        quarantine: row.quarantine.as_ref().map(shown),
        etag: etag(revision),
        area_id: area.unwrap_or_default(),
        awaited_robot_ids: awaited,
        block: view.place_blocks.get(row.place_id.as_str()).map(|block| v1::PlaceBlock {
            reason: block.row.reason.clone(),
            since: Some(timestamp(block.row.since)),
            until: block.row.until.map(timestamp),
            actor: block.row.actor.clone(),
        }),
    }
}

/// Why a task is where it is.
pub fn task_explanation(task_id: &TaskId, e: &TaskExplanation, now: Utc) -> v1::TaskExplanation {
    v1::TaskExplanation {
        task_id: task_id.to_string(),
        position: e.position.map(|p| p as u32),
        verdict: e.verdict.as_ref().map(shown),
        candidates: e
            .candidates
            .iter()
            .map(|c| v1::RobotCandidate {
                robot_id: c.robot_id.to_string(),
                reason: c.reason.as_ref().map(shown),
                distance_mm: c.distance_mm,
            })
            .collect(),
        filtered: e
            .filtered
            .iter()
            .map(|(code, n)| v1::FilterCount { code: code.as_str().to_owned(), robots: *n as u32 })
            .collect(),
        expected_start_time: e.expected.map(timestamp),
        expected_start_p10_time: e.start.map(|start| timestamp(start.p10)),
        expected_start_p90_time: e.start.map(|start| timestamp(start.p90)),
        explain_time: Some(timestamp(now)),
        choice: e.choice.as_ref().map(plan_choice),
    }
}

fn plan_choice(choice: &PlanChoice) -> v1::PlanChoice {
    let next = choice.next.iter().map(|next| v1::NextRobot {
        robot_id: next.robot_id.to_string(),
        cost: Some(pair_cost(&next.cost)),
        task_id: next.took.as_ref().map(ToString::to_string).unwrap_or_default(),
    });
    v1::PlanChoice {
        plan_time: Some(timestamp(choice.at)),
        robot_id: choice.robot_id.to_string(),
        given: choice.is_given,
        cost: Some(pair_cost(&choice.cost)),
        next: next.collect(),
        weighed: choice.weighed as u32,
    }
}

fn pair_cost(cost: &PairCost) -> v1::PairCost {
    v1::PairCost {
        total_ms: cost.sum() / PairCost::UNITS_PER_MS,
        ready_ms: cost.ready / PairCost::UNITS_PER_MS,
        way_ms: cost.way / PairCost::UNITS_PER_MS,
        failed_ms: cost.failed / PairCost::UNITS_PER_MS,
        charge_ms: cost.charge / PairCost::UNITS_PER_MS,
        lateness_ms: cost.lateness / PairCost::UNITS_PER_MS,
        age_ms: cost.age / PairCost::UNITS_PER_MS,
        kept_ms: cost.kept / PairCost::UNITS_PER_MS,
        energy_ms: cost.energy / PairCost::UNITS_PER_MS,
    }
}

/// Why a robot has no work, or what it does.
pub fn robot_explanation(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    robot_id: &RobotId,
    e: &RobotExplanation,
) -> v1::RobotExplanation {
    v1::RobotExplanation {
        robot_id: robot_id.to_string(),
        verdict: e.verdict.as_ref().map(shown),
        candidates: e
            .candidates
            .iter()
            .map(|c| v1::TaskCandidate {
                task_id: c.task_id.to_string(),
                reason: c.reason.as_ref().map(shown),
                distance_mm: c.distance_mm,
            })
            .collect(),
        explain_time: Some(timestamp(now.utc)),
        control: Some(control(view, board, robot_id)),
        energy: Some(robot_energy(&e.energy)),
    }
}

fn robot_energy(energy: &RobotEnergy) -> v1::RobotEnergy {
    v1::RobotEnergy {
        empty_mwh_per_km: energy.rates.empty_mwh_per_km,
        loaded_mwh_per_km: energy.rates.loaded_mwh_per_km,
        idle_mw: energy.rates.idle_mw,
        action_mwh: energy.rates.action_mwh,
        error_permille: energy.error_permille,
        attempts: energy.attempts,
    }
}

/// Work done by one robot on one version.
pub fn counter(row: &RobotCounter) -> v1::RobotCounter {
    v1::RobotCounter {
        robot_id: row.robot_id.to_string(),
        software: row.software.clone(),
        tasks_succeeded: row.succeeded,
        failures: row.failures.iter().map(|(k, v)| (*k, *v)).collect(),
        task_duration_ms: row.stats.duration_ms,
        path_mm: row.stats.path_mm,
        loaded_path_mm: row.stats.loaded_path_mm,
        attached_ms: row.attached_ms,
        hottest_joint_decidegrees: row.stats.hottest_joint_decidegrees,
        energy_mwh: row.stats.energy_mwh,
    }
}
