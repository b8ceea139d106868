//! Charge for a task and for the way to a charger after it.

use super::*;
use crate::fleet::assignment::demand::Demand;
use crate::fleet::assignment::filters;
use crate::reason::Code;
use crate::task::Phase;

/// The corridor without its way back from B to the other waypoints.
fn dead_end() -> String {
    let lane = "{ path = [\"b-in\", \"B\", \"b-far\"] }";
    assert!(CORRIDOR.contains(lane));
    CORRIDOR.replace(lane, "{ path = [\"b-in\", \"B\"] }")
}

fn why_not(rig: &Rig) -> Option<Reason> {
    let task_id = TaskId::parse("T1").expect("an id");
    let (task, intake) = rig.view.task(&task_id).zip(rig.view.intake(&task_id)).expect("a task");
    filters::pair(
        &rig.view,
        &rig.board,
        &RobotId::parse("r1").expect("an id"),
        &Demand::new(&rig.view, task, intake),
        &rig.now,
    )
    .err()
}

fn rig_on(text: &str) -> Rig {
    let mut rig = Rig::on(text);
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig
}

#[test]
fn a_last_goal_from_which_no_charger_can_be_reached_is_refused() {
    assert_eq!(why_not(&rig_on(CORRIDOR)), None);
    let mut rig = rig_on(&dead_end());
    let why = why_not(&rig).expect("it would stand there without charge");
    assert_eq!((why.code, why.metadata.get("goal").map(String::as_str)), (Code::NoRoute, Some("B")));
    rig.cycle(Pace::Sweep);
    assert_eq!(rig.task("T1").phase, Phase::Queued);
}

#[test]
fn a_site_without_chargers_has_no_way_home() {
    let without = dead_end().replace("kind = \"charger\"", "kind = \"park\"");
    let rig = rig_on(&without);
    assert!(rig.view.site.chargers().next().is_none());
    assert_eq!(why_not(&rig), None);
}
