//! Drives: how far a robot goes, and on whose word.

use crate::rig::{Rig, goto, point};
use crate::test_body::TestBody;
use midshift_agent::body::BodyNews;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_agent::memory::MemoryStore;
use midshift_core::desired_state::{AreaRules, Assignment, DesiredPolicy, DesiredWork, GrantedPlace, RoutePoint};
use midshift_core::ids::{AreaId, RobotId};
use midshift_core::policy::AreaPolicy;
use midshift_core::robot::WorkState;
use midshift_core::robot::{HardwareStop, Mode};
use midshift_core::robot_events::PlaceNews::{Entered, Left, NotEntered};
use midshift_proto::session::Downlink;

/// A, then B; a door on the way to C and on to D, where one stands; E is the goal.
fn route() -> Vec<RoutePoint> {
    vec![
        point("A", None, false, &[]),
        point("B", None, false, &[]),
        point("C", None, false, &["door"]),
        point("D", None, true, &["door"]),
        point("E", Some(0), true, &[]),
    ]
}

fn offer(rig: &Rig, released: u32) -> Assignment {
    Assignment { released_index: Some(released), ..rig.offer("T1", 1, vec![goto("E")], route()) }
}

fn grants(rig: &Rig) -> Vec<GrantedPlace> {
    vec![rig.grant("door", 11), rig.grant("D", 12), rig.grant("E", 13)]
}

/// On its way to E with everything granted and released.
fn under_way(rig: Rig) -> Rig {
    let mut rig = rig;
    rig.connect();
    rig.work(DesiredWork { grants: grants(&rig), ..rig.desired(Some(offer(&rig, 4))) });
    rig.reports();
    rig
}

/// The same work again, with these grants.
fn again(rig: &mut Rig, grants: impl FnOnce(&Rig) -> Vec<GrantedPlace>) {
    let work = DesiredWork { grants: grants(rig), ..rig.desired(Some(offer(rig, 4))) };
    rig.work(work);
}

#[test]
fn a_robot_drives_as_far_as_it_is_released_and_granted() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(offer(&rig, 4))));
    assert_eq!(rig.body.goes_to(), ["B"]);
    again(&mut rig, |rig| vec![rig.grant("door", 11)]);
    assert_eq!(rig.body.goes_to(), ["B", "C"]);
    again(&mut rig, grants);
    assert_eq!(rig.body.goes_to(), ["B", "C", "D", "E"]);
    let rig = {
        let mut rig = Rig::at("A");
        rig.connect();
        rig.work(DesiredWork { grants: grants(&rig), ..rig.desired(Some(offer(&rig, 3))) });
        rig
    };
    assert_eq!(rig.body.goes_to(), ["B", "C", "D"]);
}

#[test]
fn a_robot_asked_to_hand_back_stops_at_the_next_standing_place_and_says_so() {
    let mut rig = under_way(Rig::at("A"));
    let suspend = Assignment { suspend: true, ..offer(&rig, 4) };
    rig.work(DesiredWork { grants: grants(&rig), ..rig.desired(Some(suspend)) });
    assert_eq!(rig.body.goes_to(), ["B", "C", "D"]);
    assert!(rig.states().is_empty());
    (0..3).for_each(|_| {
        rig.body.reach();
        rig.pass(500);
    });
    assert_eq!(rig.states().last(), Some(&(WorkState::Suspended, 0)));
}

#[test]
fn places_are_said_as_they_are_entered_and_left_and_a_grant_is_used_once() {
    let mut rig = under_way(Rig::at("A"));
    rig.body.reach();
    rig.pass(500);
    assert_eq!(rig.places(), [("door".into(), 11, Entered)]);
    rig.body.reach();
    rig.pass(500);
    assert_eq!(rig.places(), [("D".into(), 12, Entered)]);
    rig.body.reach();
    rig.pass(500);
    assert_eq!(rig.places(), [("door".into(), 11, Left), ("E".into(), 13, Entered)]);
    rig.body.reach();
    rig.pass(1_000);
    assert_eq!(rig.places(), [("D".into(), 12, Left)]);
    assert_eq!(rig.states().last(), Some(&(WorkState::Succeeded, 1)));
    let held = rig.reported.clone().expect("a heartbeat").places;
    assert_eq!(held.iter().map(|h| (h.place_id.as_str(), h.grant_id, h.inside)).collect::<Vec<_>>(), [("E", 13, true)]);
    // Back again, and the old grants still stand in what the server says.
    let back = vec![point("E", None, true, &[]), point("D", None, true, &[]), point("C", Some(0), false, &["door"])];
    let work = rig.offer("T2", 1, vec![goto("C")], back);
    rig.work(DesiredWork { grants: grants(&rig), ..rig.desired(Some(work)) });
    assert_eq!(rig.body.goes_to(), Vec::<String>::new());
}

#[test]
fn the_grants_of_a_path_are_on_the_ledger_before_the_body_drives() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(offer(&rig, 4))));
    rig.slow_disk = true;
    again(&mut rig, grants);
    assert_eq!(rig.body.goes_to(), ["B"]);
    rig.flush();
    assert_eq!(rig.body.goes_to(), ["B", "C", "D", "E"]);
    // Killed here, it may be in any of them: it says so.
    let mut rig = rig.restart();
    rig.connect();
    assert_eq!(rig.places(), [("D".into(), 12, Entered), ("E".into(), 13, Entered), ("door".into(), 11, Entered)]);
}

#[test]
fn a_grant_that_goes_stale_on_the_way_stops_the_robot_before_the_place_and_a_fresh_one_lets_it_on() {
    let mut rig = under_way(Rig::at("A"));
    let old = grants(&rig);
    rig.pass(10_500);
    assert_eq!(rig.body.goes_to(), ["B"]);
    rig.body.reach();
    rig.pass(500);
    assert_eq!((rig.places(), rig.stale()), (vec![], 1));
    again(&mut rig, |_| old);
    assert_eq!(rig.body.goes_to(), Vec::<String>::new());
    again(&mut rig, grants);
    assert_eq!(rig.body.goes_to(), ["C", "D", "E"]);
    assert_eq!(rig.places(), [("door".into(), 11, Entered)]);
}

#[test]
fn a_robot_inside_stays_whatever_its_grant_says() {
    let mut rig = under_way(Rig::at("A"));
    rig.body.reach();
    rig.pass(10_500);
    assert_eq!(rig.body.goes_to(), ["C"]);
    rig.body.reach();
    rig.pass(1_000);
    assert_eq!(rig.places(), [("door".into(), 11, Entered)]);
}

fn reconnected_with_standing_grants(rig: Rig) -> Rig {
    let mut rig = rig;
    rig.connect();
    let old = grants(&rig);
    rig.work(rig.desired(Some(offer(&rig, 4))));
    rig.connect();
    again(&mut rig, |_| old);
    rig.body.reach();
    rig.pass(500);
    rig
}

#[test]
fn a_grant_that_stood_while_the_robot_reconnected_moves_nobody() {
    let mut rig = reconnected_with_standing_grants(Rig::at("A"));
    assert_eq!((rig.body.goes_to(), rig.places()), (vec![], vec![]));
    let naive = Bugs::seeded(&[SeededBug::GrantFromReceipt]);
    let mut rig = reconnected_with_standing_grants(Rig::with(TestBody::at("A"), MemoryStore::new(), naive));
    assert_eq!(rig.places(), [("door".into(), 11, Entered)]);
}

#[test]
fn a_grant_that_is_taken_back_before_it_was_used_is_given_back_and_never_entered_on() {
    let mut rig = under_way(Rig::at("A"));
    let old = grants(&rig);
    again(&mut rig, |_| vec![]);
    assert_eq!(
        rig.places(),
        [("door".into(), 11, NotEntered), ("D".into(), 12, NotEntered), ("E".into(), 13, NotEntered)]
    );
    assert_eq!(rig.body.goes_to(), ["B"]);
    rig.work(rig.desired(None));
    drop(old);
}

#[test]
fn without_an_echo_for_thirty_seconds_the_robot_goes_to_the_next_standing_place_it_holds_and_waits() {
    let mut rig = under_way(Rig::at("A"));
    // Inside the door and on the way to D, all entered or held.
    rig.body.reach();
    rig.body.reach();
    rig.silence(30_500);
    rig.body.reach();
    rig.silence(500);
    assert_eq!((rig.body.goes_to().len(), rig.body.log().waypoint.clone()), (0, Some(crate::rig::waypoint("D"))));
    rig.silence(1_000);
    assert_eq!(rig.states().last(), Some(&(WorkState::Paused, 0)));
    rig.echo();
    again(&mut rig, |rig| vec![rig.grant("E", 13)]);
    assert_eq!(rig.body.goes_to(), ["E"]);
}

#[test]
fn a_robot_that_cannot_read_its_newer_work_goes_to_the_next_standing_place_it_holds_and_keeps_its_session() {
    let mut rig = under_way(Rig::at("A"));
    rig.body.reach();
    let unreadable = || Downlink { unreadable_work: Some("step 7 of kind 12".to_owned()), ..Downlink::default() };
    rig.down(unreadable());
    rig.pass(500);
    assert_eq!(rig.body.goes_to(), ["C", "D"], "no further than as if its authority had ended");
    rig.body.reach();
    rig.body.reach();
    rig.down(unreadable());
    rig.pass(60_000);
    assert_eq!((rig.body.goes_to().len(), rig.body.log().waypoint), (0, Some(crate::rig::waypoint("D"))));
    assert_eq!((rig.states().last(), rig.stale()), (Some(&(WorkState::Paused, 0)), 1));
    assert!(rig.exit.is_none(), "its session goes on");
    again(&mut rig, |rig| vec![rig.grant("E", 13)]);
    assert_eq!(rig.body.goes_to(), ["E"], "work that it can read again");
}

#[test]
fn a_hold_ends_only_with_a_fresh_word() {
    let mut rig = under_way(Rig::at("A"));
    let held =
        |rig: &Rig, held, resume| DesiredWork { grants: grants(rig), held, resume, ..rig.desired(Some(offer(rig, 4))) };
    let work = held(&rig, true, None);
    rig.work(work);
    let path = rig.body.goes_to();
    assert_eq!(path.last().map(String::as_str), Some("D"));
    path.iter().for_each(|_| drop(rig.body.reach()));
    rig.pass(1_000);
    assert_eq!(rig.states().last(), Some(&(WorkState::Paused, 0)));
    let buffered = rig.authority(10_000);
    rig.pass(12_000);
    let work = held(&rig, false, Some(buffered));
    rig.work(work);
    assert_eq!((rig.body.goes_to().len(), rig.stale()), (0, 1));
    let work = held(&rig, false, Some(rig.authority(10_000)));
    rig.work(work);
    assert_eq!(rig.body.goes_to(), ["E"]);
}

#[test]
fn a_stop_is_obeyed_at_the_next_point_that_is_not_inside_a_passage() {
    let mut rig = under_way(Rig::at("A"));
    let stop = |rig: &Rig| DesiredWork {
        grants: grants(rig),
        ..rig.desired(Some(Assignment { stop: true, ..offer(rig, 4) }))
    };
    let work = stop(&rig);
    rig.work(work);
    assert_eq!(rig.body.goes_to(), ["B"]);
    rig.body.reach();
    rig.pass(500);
    assert_eq!(rig.states(), [(WorkState::Stopping, 0), (WorkState::Aborted, 0)]);

    let mut rig = under_way(Rig::at("A"));
    rig.body.reach();
    rig.pass(500);
    let work = stop(&rig);
    rig.work(work);
    assert_eq!(rig.body.goes_to(), ["C", "D"]);
}

#[test]
fn a_new_route_is_taken_from_where_the_robot_is_heading() {
    let mut rig = under_way(Rig::at("A"));
    rig.body.reach();
    rig.pass(500);
    let other = vec![
        point("B", None, false, &[]),
        point("C", None, false, &["door"]),
        point("F", None, false, &["door"]),
        point("E", Some(0), true, &[]),
    ];
    let order = Assignment { route: other, route_number: 2, released_index: Some(3), ..offer(&rig, 3) };
    rig.work(DesiredWork { grants: grants(&rig), ..rig.desired(Some(order)) });
    assert_eq!(rig.body.goes_to(), ["C", "F", "E"]);
}

#[test]
fn the_distance_an_area_asks_for_reaches_the_body_under_way() {
    let mut rig = under_way(Rig::at("A"));
    let asked = |rig: &Rig| rig.body.log().path.iter().map(|p| p.keep_off_mm).collect::<Vec<_>>();
    assert_eq!(asked(&rig), [None; 4]);
    let area_id = AreaId::parse("hall").expect("a name");
    let area = AreaRules { avoidance_distance_mm: Some(800), ..AreaPolicy::default_of(area_id).into() };
    let policy =
        DesiredPolicy { robot_id: RobotId::parse("rbt-01").expect("a name"), generation: 5, areas: vec![area] };
    rig.down(Downlink { policy: Some(policy), ..Downlink::default() });
    assert_eq!(asked(&rig), [Some(800); 4]);
}

#[test]
fn a_policy_slows_a_drive_under_way_and_an_older_one_never_speeds_it_up() {
    let mut rig = under_way(Rig::at("A"));
    let policy = |generation, limit| DesiredPolicy {
        robot_id: RobotId::parse("rbt-01").expect("a name"),
        generation,
        areas: vec![AreaRules {
            speed_limit_mm_s: Some(limit),
            ..AreaPolicy::default_of(AreaId::parse("hall").expect("a name")).into()
        }],
    };
    let speed = |rig: &Rig| rig.body.log().path[0].speed_mm_s;
    assert_eq!(speed(&rig), 1_500);
    rig.down(Downlink { policy: Some(policy(5, 300)), ..Downlink::default() });
    assert_eq!(speed(&rig), 300);
    rig.down(Downlink { policy: Some(policy(4, 900)), ..Downlink::default() });
    assert_eq!(speed(&rig), 300);
}

#[test]
fn a_person_at_the_robot_stops_the_work_and_giving_it_back_lets_it_on() {
    let mut rig = under_way(Rig::at("A"));
    rig.body.says(BodyNews::Mode(Mode::Manual));
    rig.pass(1_000);
    assert_eq!(rig.states().last(), Some(&(WorkState::Paused, 0)));
    assert_eq!((rig.body.log().stops, rig.body.goes_to().len()), (1, 0));
    rig.body.says(BodyNews::Mode(Mode::Automatic));
    rig.silence(500);
    assert_eq!(rig.body.goes_to().len(), 0);
    rig.pass(1_500);
    assert_eq!(rig.body.goes_to(), ["B", "C", "D", "E"]);
}

#[test]
fn the_makers_own_stop_pauses_the_body_at_once() {
    let mut rig = under_way(Rig::at("A"));
    rig.body.says(BodyNews::HardwareStop(HardwareStop::AutoAck));
    rig.pass(500);
    assert!(rig.body.log().paused);
    rig.body.says(BodyNews::HardwareStop(HardwareStop::None));
    rig.pass(2_000);
    assert!(!rig.body.log().paused);
    assert_eq!(rig.body.goes_to().len(), 4);
}
