//! What a robot that drains has in its hands, and who waits for it to be laid down.
//!
//! Called by `drain` and `screen`. Invariant: a robot that drains is given no work but the rest of the task whose item it carries.

use super::rows::{Drain, DrainState};
use super::view::View;
use crate::task::Phase;
use crate::work::Live;

/// The robot carries something that it is not taken with: software changes only on an empty robot, unless it goes back to what it kept.
/// With a person's drain somebody comes to it, who waits only for a task that goes on.
pub fn must_deliver(view: &View, drain: &Drain, live: Option<&Live>) -> bool {
    let loaded = live.is_some_and(|live| live.report.load.is_some());
    loaded && !drain.returns && (!drain.is_of_person() || goes_on(view, live))
}

/// The task whose item the robot carries is tried again by itself, on this robot.
pub fn goes_on(view: &View, live: Option<&Live>) -> bool {
    let Some(live) = live else { return false };
    let task_id = live.report.load.as_ref().and_then(|load| load.task_id.as_ref());
    task_id.and_then(|id| view.task(id)).is_some_and(|task| {
        let waits = matches!(task.phase, Phase::Queued | Phase::RetryWait);
        waits && task.opened.as_ref() == Some(&live.robot_id)
    })
}

/// Whether a robot that drains may be given work all the same: of the task whose item it carries, and of no other.
pub fn may_end_its_task(view: &View, drain: &Drain, live: &Live) -> bool {
    drain.state == DrainState::Draining && must_deliver(view, drain, Some(live)) && goes_on(view, Some(live))
}
