//! Several incidents at one moment, and as many as one robot's words open.

use super::Rig;
use crate::fleet::{Plan, incidents};
use crate::ids::RobotId;
use crate::limits::INCIDENTS_OF_ROBOT_MAX;
use crate::reason::{Code, Reason};

fn about(place: usize) -> Reason {
    Reason::from(Code::GrantUnknown).with("place_id", format!("p{place}"))
}

/// Metadata of the incidents that are open.
fn open(rig: &Rig) -> Vec<&Reason> {
    rig.view.incidents.values().filter(|i| i.row.closed.is_none()).map(|i| &i.row.reason).collect()
}

#[test]
fn incidents_of_one_code_at_one_moment_are_told_apart_and_the_same_one_is_told_once() {
    let (mut rig, mut plan) = (Rig::new(), Plan::default());
    for place in [1, 2, 1] {
        plan.decide(&mut rig.view, rig.now, "fleet", |tx| incidents::open(tx, about(place), None, None));
    }
    assert_eq!(open(&rig), [&about(1), &about(2)]);
}

#[test]
fn one_robot_opens_a_few_incidents_of_a_code_and_more_once_some_are_closed() {
    let (mut rig, mut plan) = (Rig::new(), Plan::default());
    let robot_id = RobotId::parse("r1").expect("an id");
    let mut say = |rig: &mut Rig, places: std::ops::Range<usize>| {
        for place in places {
            plan.decide(&mut rig.view, rig.now, "fleet", |tx| {
                incidents::open_about(tx, about(place), Some(&robot_id), "place_id");
            });
        }
    };
    say(&mut rig, 0..100);
    assert_eq!(open(&rig).len(), INCIDENTS_OF_ROBOT_MAX);
    assert_eq!(open(&rig).iter().filter(|reason| reason.metadata.contains_key("further")).count(), 1);
    let first = rig.view.incidents.keys().next().expect("an incident").clone();
    let mut closed = Plan::default();
    closed.decide(&mut rig.view, rig.now, "anna", |tx| incidents::close(tx, &first, "seen", "anna"));
    say(&mut rig, 100..101);
    assert_eq!(open(&rig).len(), INCIDENTS_OF_ROBOT_MAX);
    assert!(open(&rig).iter().any(|reason| reason.metadata["place_id"] == "p100"), "there is room again");
}
