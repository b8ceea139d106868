//! What is in the way of a changed map.

use super::*;
use crate::fleet::maps::{MapChange, Obstacle, in_the_way, outdated};
use crate::fleet::rows::SiteRow;
use crate::reason::Code;

fn moved_text(waypoint: &str, from: &str, to: &str) -> String {
    let place = |at: &str| format!("id = \"{waypoint}\", at = [{at}]");
    assert!(CORRIDOR.contains(&place(from)));
    CORRIDOR.replace(&place(from), &place(to))
}

fn moved(waypoint: &str, from: &str, to: &str) -> crate::site::Site {
    text::parse(&moved_text(waypoint, from, to)).expect("a site")
}

#[test]
fn a_map_that_was_chosen_long_ago_is_outdated_by_another_stored_one_and_by_what_is_in_its_way_now() {
    let own = moved_text("B", "18000, 3000", "18000, 4000");
    let third = moved_text("charge", "20000, -1000", "20000, -1500");
    let task = Obstacle::Task(TaskId::parse("T1").expect("an id"));
    let why = |stored: Option<&str>, at_start: Option<&str>, has_task: bool, change: &MapChange| {
        let mut rig = Rig::on(&own);
        if let Some(stored) = stored {
            let site = text::parse(stored).expect("a site");
            let map_version = site.map_version().to_owned();
            rig.absorb(&SiteRow { site_id: site.site_id().clone(), map_version, text: stored.to_owned() });
        }
        if has_task {
            rig.submit("T1", |_| {});
        }
        outdated(&rig.view, &own, at_start, change).map(|why| why.metadata.get("tasks").cloned())
    };
    let taken = MapChange::Taken;
    assert_eq!(why(None, None, true, &taken), None, "nothing is stored");
    assert_eq!(why(Some(&own), Some(CORRIDOR), true, &taken), None, "it is the stored one");
    assert_eq!(why(Some(CORRIDOR), Some(CORRIDOR), false, &taken), None, "nothing is in its way");
    assert_eq!(why(Some(CORRIDOR), Some(CORRIDOR), true, &taken), Some(Some("T1".to_owned())));
    assert_eq!(why(Some(CORRIDOR), Some(CORRIDOR), true, &MapChange::Forced { obstacles: vec![task] }), None);
    assert!(why(Some(CORRIDOR), Some(CORRIDOR), true, &MapChange::Forced { obstacles: vec![] }).is_some());
    for at_start in [None, Some(&*own), Some(CORRIDOR)] {
        assert_eq!(why(Some(&third), at_start, false, &taken), Some(None), "somebody stored another one meanwhile");
    }
}

#[test]
fn goals_that_move_are_in_the_way_and_so_are_robots_whose_route_leads_there() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Sweep);
    rig.cycle(Pace::Sweep);
    assert!(rig.view.desired_work.values().any(|desired| desired.row.assignment.is_some()), "it has work");
    assert_eq!(in_the_way(&rig.view, &rig.view.site, &text::parse(CORRIDOR).expect("a site")), []);
    assert_eq!(
        in_the_way(&rig.view, &rig.view.site, &moved("charge", "20000, -1000", "20000, -1500")),
        [],
        "nobody goes there"
    );
    let task = Obstacle::Task(TaskId::parse("T1").expect("an id"));
    let robot = Obstacle::Robot(RobotId::parse("r1").expect("an id"));
    assert_eq!(in_the_way(&rig.view, &rig.view.site, &moved("B", "18000, 3000", "18000, 4000")), [task, robot.clone()]);
    assert_eq!(in_the_way(&rig.view, &rig.view.site, &moved("c-1", "7000, 1000", "7000, 1500")), [robot], "on its way");
}

#[test]
fn a_robot_that_drives_by_another_map_gets_no_work_until_it_has_ours_and_a_person_is_told_once() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    let robot_id = RobotId::parse("r1").expect("an id");
    let drives_by = |rig: &mut Rig, map: &str| {
        let live = Arc::make_mut(rig.board.get_mut(&robot_id).expect("heard"));
        live.report.map_version = map.to_owned();
        live.report.applied_work = rig.view.desired_work.get("r1").map_or(0, |desired| desired.row.generation);
        rig.pass(1_000);
        rig.cycle(Pace::Sweep);
        rig.cycle(Pace::Sweep);
    };
    let told = |rig: &Rig| {
        let of_map = rig.view.incidents.values().map(|i| &i.row).filter(|i| i.reason.code == Code::MapDiffers);
        of_map.map(|i| i.closed.is_none()).collect::<Vec<_>>()
    };
    rig.submit("T1", |_| {});
    drives_by(&mut rig, "0");
    assert_eq!(rig.view.held_by(&robot_id), None, "it gets no work");
    assert_eq!(told(&rig), [true]);
    drives_by(&mut rig, "1");
    assert!(rig.view.held_by(&robot_id).is_some(), "it works");
    drives_by(&mut rig, "1");
    assert_eq!(told(&rig), [false]);
}

#[test]
fn a_robot_that_goes_by_points_alone_works_and_nobody_is_told() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Sweep);
    assert!(rig.view.held_by(&RobotId::parse("r1").expect("an id")).is_some());
    assert!(rig.view.incidents.is_empty());
}
