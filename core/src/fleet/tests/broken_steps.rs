//! Tasks that a broken step bars: who waits, who does not, and who is let through as a probe.

use super::*;
use crate::fleet::projection::rows::{Incident, IncidentClosure};
use crate::fleet::{WAITS_FOR, explain};
use crate::reason::Code;
use crate::task::raw::RawStepKind;

/// What robots fail at the end of a task.
fn broken(action: &str, waypoint: &str, again: Utc) -> Incident {
    let reason = Reason::from(Code::PlaceBroken).with("waypoint", waypoint).with("action", action);
    Incident {
        id: format!("PLACE_BROKEN:{waypoint}:{action}"),
        reason: reason.with("robots", "r1, r2, r3").with("again_time", again.rfc3339()),
        robot_id: None,
        task_id: None,
        area_id: None,
        opened_unix_ms: BEGIN,
        closed: None,
    }
}

fn to_park(raw: &mut RawTask) {
    raw.steps[2].kind = Some(RawStepKind::Goto("park-b".to_owned()));
}

/// Nine tasks that end where nothing can be put down, and one from the same shelf that does not.
fn nine_barred() -> Rig {
    let mut rig = Rig::new();
    for nth in 0..9 {
        rig.submit(&format!("barred-{nth}"), |_| {});
    }
    rig.submit("open", to_park);
    rig.cycle(Pace::Wake);
    rig.absorb(&broken("place", "B", BEGIN.plus_ms(600_000)));
    rig
}

#[test]
fn tasks_that_a_broken_step_bars_keep_no_other_from_the_same_shelf() {
    let mut rig = nine_barred();
    assert_eq!(rig.order(), ["open"]);
    rig.robot("r4", "park-a");
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["open"]);
    let task_id = TaskId::parse("barred-0").expect("an id");
    let why = rig.why(&task_id).expect("a reason");
    assert_eq!(why.code, Code::PlaceBroken);
    assert!(why.metadata[WAITS_FOR].starts_with("a probe at 20"), "{why:?}");
    let told = explain::task(&rig.view, &rig.board, &rig.now, &task_id).expect("known");
    assert_eq!((told.position, told.expected, told.start), (None, None, None));
}

#[test]
fn a_task_whose_robot_carries_the_item_and_one_that_has_done_the_step_go_on() {
    let mut rig = nine_barred();
    let mut opened = rig.task("barred-3").clone();
    opened.opened_robot_id = RobotId::parse("r4").ok();
    rig.change(&opened);
    let mut done = rig.task("barred-5").clone();
    done.next_step = 4;
    rig.change(&done);
    assert_eq!(rig.order(), ["barred-3", "barred-5", "open"]);
}

#[test]
fn one_is_let_through_when_it_is_time_and_the_next_where_that_finds_no_robot() {
    let mut rig = nine_barred();
    let ready = |rig: &mut Rig, ms: u64| {
        rig.pass(ms);
        rig.cycle(Pace::Wake);
        rig.order()
    };
    assert_eq!(ready(&mut rig, 599_999), ["open"]);
    assert_eq!(ready(&mut rig, 1), ["barred-0", "open"]);
    assert_eq!(ready(&mut rig, 59_000), ["barred-0", "open"]);
    let why = rig.why(&TaskId::parse("barred-7").expect("an id")).expect("a reason");
    assert!(why.metadata[WAITS_FOR].starts_with("task barred-0, which probes it, or "), "{why:?}");
    assert_eq!(ready(&mut rig, 1_000), ["barred-1", "open"]);
}

#[test]
fn all_are_back_where_they_stood_once_the_incident_is_closed() {
    let mut rig = nine_barred();
    let incident = broken("place", "B", BEGIN.plus_ms(600_000));
    let closed = IncidentClosure { actor: "ann".into(), reason: "emptied".into(), at: rig.now.utc };
    let closed = Incident { closed: Some(closed), ..incident };
    let row = Row { key: closed.key(), revision: Revision(2), index: closed.index(), body: closed.body() };
    rig.view.absorb(&row.key, row.revision, Some(&row)).expect("a row of ours");
    let order = rig.order();
    assert_eq!((order.len(), order[0].as_str(), order[9].as_str()), (10, "barred-0", "open"));
    // Another action there is another step, and what may fail without harm is none.
    rig.absorb(&broken("weld", "B", BEGIN));
    assert_eq!(rig.order(), order);
    rig.submit("harmless", |raw| raw.steps[1].continue_on_fail = Some(Some(true)));
    rig.cycle(Pace::Wake);
    rig.absorb(&broken("pick", "A", BEGIN.plus_ms(600_000)));
    assert_eq!(rig.order(), ["harmless"]);
}
