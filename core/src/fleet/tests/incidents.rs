//! Several incidents at one moment, and as many as one robot's words open.

use super::Rig;
use crate::fleet::rows::{HolderState, Place, PlaceHolder};
use crate::fleet::tasks::claims;
use crate::fleet::{Plan, incidents};
use crate::ids::{PlaceId, RobotId};
use crate::limits::{CROWD_NAMED_MAX, INCIDENTS_OF_ROBOT_MAX};
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

#[test]
fn robots_that_crowd_one_place_are_one_incident_that_names_a_few_and_counts_all() {
    let (mut rig, mut plan) = (Rig::new(), Plan::default());
    let place_id = PlaceId::parse("park-a").expect("an id");
    let ix = rig.view.site.find_place(&place_id).expect("a place");
    let mut place = Place::unheld(rig.view.site.place(ix));
    let second = rig.now.utc.plus_ms(1_000);
    for n in 1..=31 {
        let robot_id = RobotId::parse(&format!("r{n}")).expect("an id");
        let (state, since) = (HolderState::Inside, rig.now.utc);
        place.holders.push(PlaceHolder { robot_id: robot_id.clone(), grant_id: 0, state, since, claimed: true });
        plan.decide(&mut rig.view, rig.now, "fleet", |tx| {
            tx.put_row(place.clone(), "place.adopted");
            claims::entered(tx, &robot_id, &place_id);
        });
        rig.pass(1_000);
        let said = plan.items.len();
        plan.decide(&mut rig.view, rig.now, "fleet", |tx| claims::entered(tx, &robot_id, &place_id));
        assert_eq!(plan.items.len(), said, "what is known is not told again");
        assert_eq!(open(&rig).len(), usize::from(n > 1));
    }
    let incident = &rig.view.incidents.values().next().expect("an incident").row;
    assert_eq!(incident.opened_unix_ms, second, "it is as old as the breach");
    let facts = &incident.reason.metadata;
    assert_eq!((facts["place_id"].as_str(), facts["inside"].as_str()), ("park-a", "31"));
    let first: Vec<String> = (1..=CROWD_NAMED_MAX).map(|n| format!("r{n}")).collect();
    assert_eq!(facts["robots"], first.join(" "));
}
