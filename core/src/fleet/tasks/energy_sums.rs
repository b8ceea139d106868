//! What an attempt that ended did, as far as its energy is explained by it.
//!
//! Invariant: only work that is known whole counts. One that failed or was broken off may have done half an action, and what a robot takes at a
//! charger is no work.

use crate::energy::fit::AttemptWork;
use crate::fleet::projection::state::FleetProjection;
use crate::step::StepKind;
use crate::task::state::Errand;
use crate::task::{Attempt, AttemptPhase};

/// What the attempt did. None: it is not known whole, or it charged.
pub fn work_of(view: &FleetProjection, a: &Attempt) -> Option<AttemptWork> {
    if a.phase != AttemptPhase::Succeeded {
        return None;
    }
    let actions = match a.errand {
        Some(Errand::Charge) => return None,
        Some(Errand::Park) => 0,
        None => {
            let steps = &view.intake(a.attempt.subject.task_id()?)?.spec.steps;
            let done = steps.iter().skip(a.visited.as_ref()?.resume_step as usize);
            done.filter(|step| matches!(step.kind, StepKind::Action { .. })).count() as u64
        }
    };
    let stats = &a.stats;
    Some(AttemptWork {
        empty_mm: stats.path_mm.checked_sub(stats.loaded_path_mm)?,
        loaded_mm: stats.loaded_path_mm,
        duration_ms: stats.duration_ms,
        actions,
        energy_mwh: stats.energy_mwh,
    })
}
