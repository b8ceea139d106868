//! A robot that says that its task is done: it is believed if it was where that is done, or if nobody can tell.

use super::Rig;
use crate::fleet::assignment::filters;
use crate::fleet::commands::{self, Command};
use crate::fleet::facts::inbox;
use crate::fleet::maps::MapChange;
use crate::fleet::rows::{HolderState, PlaceHolder};
use crate::fleet::tasks::claims;
use crate::fleet::{Board, Pace, Plan, Tally, ensure_site_rows};
use crate::ids::{AttemptId, PlaceId, RobotId, WaypointId};
use crate::reason::{Code, Reason};
use crate::robot::{FAULT_DISBELIEVED, Lane, WorkState};
use crate::robot_events::{
    AttemptReport, Gap, InboxEntry, InboxItem, PlaceNews, RobotEvent, Sample, SampleBody, WorkStats,
};
use crate::site::CORRIDOR;
use crate::step::Effect;
use crate::task::raw::RawStepKind;
use crate::task::{AttemptPhase, Phase, RawTask};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Steps of a transport.
const STEPS: u32 = 4;

fn robot_id() -> RobotId {
    RobotId::parse("r1").expect("an id")
}

/// A robot that stands at `waypoint` has taken a transport from A to B.
fn given_at(waypoint: &str, change: impl FnOnce(&mut RawTask)) -> Rig {
    let mut rig = Rig::new();
    rig.robot("r1", waypoint);
    start(&mut rig);
    rig.submit("T1", change);
    rig.cycle(Pace::Sweep);
    reports(&mut rig, WorkState::Accepted, 0);
    assert_eq!(rig.task("T1").phase, Phase::Running);
    rig
}

/// What every start of the server makes sure of.
fn start(rig: &mut Rig) {
    ensure_site_rows(&mut rig.view, rig.now, CORRIDOR, &MapChange::Taken, &mut Plan::default());
}

fn given() -> Rig {
    given_at("park-a", |_| {})
}

fn attempt(rig: &Rig) -> AttemptId {
    rig.task("T1").attempt_id().expect("an attempt")
}

/// Fleet takes this from the robot's inbox.
fn arrive(rig: &mut Rig, what: InboxItem) {
    let ring = String::new();
    let lane = Lane::Event;
    let entry = InboxEntry { robot_id: robot_id(), session_epoch: 1, ring, lane, what, stamp_in_future: false };
    let (now, board) = (rig.now, rig.board.clone());
    Plan::default().decide(&mut rig.view, now, "r1", |tx| inbox::obey_entry(tx, &entry, &board, &mut Tally::default()));
}

fn says(rig: &mut Rig, event: RobotEvent) {
    arrive(rig, InboxItem::Sample(Sample { seq: 1, robot_unix_ms: 0, body: SampleBody::Event(event) }));
}

fn reports(rig: &mut Rig, state: WorkState, step_index: u32) {
    let attempt = attempt(rig);
    let stats = WorkStats { path_mm: 7, ..WorkStats::default() };
    let report = AttemptReport { attempt, state, step_index, opened: false, refusal: None, fault: None, stats };
    says(rig, RobotEvent::Attempt(report));
}

/// It drives to these, one after the other, and says so.
fn is_in(rig: &mut Rig, places: &[&str]) {
    for (nth, place) in places.iter().enumerate() {
        let place_id = PlaceId::parse(place).expect("an id");
        says(rig, RobotEvent::Place { place_id: place_id.clone(), grant_id: 0, news: PlaceNews::Entered });
        if nth + 1 < places.len() {
            says(rig, RobotEvent::Place { place_id, grant_id: 0, news: PlaceNews::Left });
        }
    }
}

/// Where the task is once an event has said that it is done.
fn said_done(rig: &mut Rig) -> Phase {
    reports(rig, WorkState::Succeeded, STEPS);
    rig.task("T1").phase
}

/// The next heartbeat lists the attempt so, at this waypoint. What became of the task in that cycle, as the log calls it.
fn lists(rig: &mut Rig, waypoint: &str, state: WorkState, step_index: u32) -> Vec<&'static str> {
    let attempt = attempt(rig);
    rig.says(&robot_id(), &attempt, state, step_index, 0);
    let applied = rig.view.desired_work["r1"].row.generation;
    let live = Arc::make_mut(rig.board.get_mut(&robot_id()).expect("a robot"));
    live.report.applied_work = applied;
    live.report.vitals.waypoint = WaypointId::parse(waypoint).ok();
    rig.pass(1_000);
    let plan = rig.cycle(Pace::Sweep);
    let kinds = plan.items.iter().flat_map(|item| &item.rows).map(|row| row.kind);
    kinds.filter(|kind| kind.starts_with("task.")).collect()
}

/// Open incidents of a word that was not believed.
fn told(rig: &Rig) -> Vec<Reason> {
    let incidents = rig.view.incidents.values().map(|i| &i.row);
    let open = incidents.filter(|i| i.closed.is_none() && i.reason.code == Code::GoalNotEntered);
    open.map(|i| i.reason.clone()).collect()
}

#[test]
fn a_robot_that_never_left_its_place_is_not_believed_and_gets_no_work() {
    let mut rig = given();
    assert_eq!(said_done(&mut rig), Phase::Running, "its heartbeat is waited for");
    assert_eq!(told(&rig), []);
    assert!(lists(&mut rig, "park-a", WorkState::Succeeded, STEPS).contains(&"task.needs_operator"));
    let task = rig.task("T1");
    assert_eq!((task.phase, task.next_step, &task.opened_robot_id), (Phase::NeedsOperator, 0, &None));
    let reason = task.reason.clone().expect("why");
    assert_eq!((reason.code, reason.metadata["place_id"].as_str()), (Code::GoalNotEntered, "A"));
    for words in ["never seen at A", "midshift task resolve T1", "midshift incident close GOAL_NOT_ENTERED:r1"] {
        assert!(reason.text().contains(words), "{}", reason.text());
    }
    assert_eq!(task.stats.path_mm, 7, "what its event added is kept");
    assert_eq!(told(&rig), [reason]);
    let failures: Vec<_> = rig.view.counters.values().map(|counter| counter.row.failures.clone()).collect();
    assert_eq!(failures, [BTreeMap::from([(FAULT_DISBELIEVED, 1)])], "it counts against what it runs");
    assert_eq!(rig.view.held_by(&robot_id()), None, "it has let go by its own word");
    let why = filters::robot(&rig.view, &rig.board, &robot_id(), &rig.now).expect_err("no work");
    assert_eq!(why.code, Code::GoalNotEntered);
    let (incident_id, reason) = ("GOAL_NOT_ENTERED:r1".to_owned(), "a wrong map in it".to_owned());
    let close = Command::CloseIncident { incident_id, reason };
    let (now, board) = (rig.now, rig.board.clone());
    Plan::default().decide(&mut rig.view, now, "anna", |tx| commands::apply(tx, &board, &close, "anna"));
    let why = filters::robot(&rig.view, &rig.board, &robot_id(), &rig.now).err();
    assert!(why.is_none_or(|why| why.code != Code::GoalNotEntered), "a person has looked");
}

#[test]
fn a_robot_that_was_only_at_the_pick_is_asked_for_the_drop() {
    let mut rig = given();
    is_in(&mut rig, &["A", "park-a"]);
    assert_eq!(said_done(&mut rig), Phase::Running);
    lists(&mut rig, "park-a", WorkState::Succeeded, STEPS);
    assert_eq!(rig.task("T1").phase, Phase::NeedsOperator);
    assert_eq!(told(&rig)[0].metadata["place_id"], "B");
}

#[test]
fn a_robot_that_says_where_it_was_is_believed_by_its_event() {
    let mut rig = given();
    is_in(&mut rig, &["A", "B"]);
    assert_eq!(said_done(&mut rig), Phase::Succeeded);
    assert_eq!((rig.task("T1").stats.path_mm, told(&rig)), (7, vec![]));
}

#[test]
fn a_success_that_the_robot_does_not_list_ends_nothing() {
    let mut rig = given();
    assert_eq!(said_done(&mut rig), Phase::Running);
    assert!(!lists(&mut rig, "park-a", WorkState::Navigating, 0).contains(&"task.needs_operator"));
    assert_eq!((rig.task("T1").phase, told(&rig)), (Phase::Running, vec![]));
    is_in(&mut rig, &["A", "B"]);
    assert_eq!(said_done(&mut rig), Phase::Succeeded);
}

#[test]
fn a_robot_whose_heartbeats_stand_on_its_goals_is_believed() {
    let mut rig = given();
    lists(&mut rig, "A", WorkState::Executing, 1);
    lists(&mut rig, "wait-a", WorkState::Navigating, 2);
    assert_eq!(said_done(&mut rig), Phase::Running, "nobody has seen it at B yet");
    assert!(lists(&mut rig, "B", WorkState::Succeeded, STEPS).contains(&"task.succeeded"));
    assert_eq!(told(&rig), []);
}

#[test]
fn a_robot_that_stood_at_its_first_goal_already_is_believed() {
    let mut rig = given_at("A", |_| {});
    is_in(&mut rig, &["B"]);
    assert_eq!(said_done(&mut rig), Phase::Succeeded);
}

#[test]
fn a_drive_that_may_fail_or_that_ends_where_nothing_is_reserved_asks_for_nothing() {
    let may_fail = |raw: &mut RawTask| {
        (raw.steps[0].continue_on_fail, raw.steps[2].continue_on_fail) = (Some(Some(true)), Some(Some(true)));
    };
    let not_reserved = |raw: &mut RawTask| {
        raw.steps[0].kind = Some(RawStepKind::Goto("a-in".to_owned()));
        raw.steps[2].kind = Some(RawStepKind::Goto("b-in".to_owned()));
    };
    let changes: [&dyn Fn(&mut RawTask); 2] = [&may_fail, &not_reserved];
    for change in changes {
        let mut rig = given_at("park-a", change);
        assert_eq!(said_done(&mut rig), Phase::Succeeded);
    }
}

/// What is asked otherwise than a transport asks it.
type Change<'a> = &'a dyn Fn(&mut RawTask);

/// What makes it impossible to tell.
type Excuse<'a> = &'a dyn Fn(&mut Rig);

#[test]
fn what_nobody_can_tell_is_believed() {
    let older_version = |rig: &mut Rig| {
        let id = attempt(rig).to_string();
        rig.view.attempts.get_mut(id.as_str()).expect("an attempt").row.visited = None;
    };
    let restored = |rig: &mut Rig| {
        Plan::default().decide(&mut rig.view, rig.now, "fleet", |tx| claims::outran(tx, &robot_id(), 9, false));
    };
    let other_map = |rig: &mut Rig| {
        rig.view.sites.get_mut("corridor").expect("a site").row.text = "before".to_owned();
        start(rig);
    };
    let unreadable = |rig: &mut Rig| rig.view.places.retain(|place, _| place != "A" && place != "B");
    let excuses: [(&str, Excuse); 4] = [
        ("an older version began the attempt", &older_version),
        ("the store was restored", &restored),
        ("the map has changed", &other_map),
        ("the rows of the places cannot be read", &unreadable),
    ];
    for (what, excuse) in excuses {
        let mut rig = given();
        excuse(&mut rig);
        assert_eq!((said_done(&mut rig), told(&rig)), (Phase::Succeeded, vec![]), "{what}");
    }
}

/// What its robot said meanwhile is not the whole.
const BREAKS: [(&str, Excuse); 3] = [
    ("events were lost", &|rig| {
        let reason = Code::Overflow.into();
        arrive(rig, InboxItem::Gap(Gap { lane: Lane::Event, from_seq: 1, to_seq: 1, reason }));
    }),
    ("an event could not be read", &|rig| arrive(rig, InboxItem::Poison { seq: 1, detail: "bytes".to_owned() })),
    ("it writes in another ring", &|rig| {
        rig.view.sessions.get_mut("r1").expect("a session").row.ring = "another".to_owned();
    }),
];

#[test]
fn a_robot_of_which_a_part_is_lost_is_asked_for_its_last_goal_alone() {
    for (what, lose) in BREAKS {
        let mut rig = given();
        lose(&mut rig);
        assert_eq!(said_done(&mut rig), Phase::Running, "{what}");
        lists(&mut rig, "A", WorkState::Succeeded, STEPS);
        assert_eq!((rig.task("T1").phase, told(&rig).len()), (Phase::NeedsOperator, 1), "{what}");

        let mut rig = given();
        lose(&mut rig);
        assert_eq!(said_done(&mut rig), Phase::Running, "{what}");
        let became = lists(&mut rig, "B", WorkState::Succeeded, STEPS);
        assert!(became.contains(&"task.succeeded") && told(&rig).is_empty(), "{what}: {became:?}");

        let mut rig = given();
        is_in(&mut rig, &["B", "park-a"]);
        lose(&mut rig);
        assert_eq!((said_done(&mut rig), told(&rig)), (Phase::Succeeded, vec![]), "{what}: it was there before");
    }
}

#[test]
fn a_robot_of_which_a_part_is_lost_owes_no_goal_before_its_last_one() {
    let may_fail = |raw: &mut RawTask| raw.steps[2].continue_on_fail = Some(Some(true));
    let not_reserved = |raw: &mut RawTask| raw.steps[2].kind = Some(RawStepKind::Goto("b-in".to_owned()));
    let starts: [(&str, Change); 3] = [("B", &|_| {}), ("park-a", &may_fail), ("park-a", &not_reserved)];
    for (start, change) in starts {
        for (what, lose) in BREAKS {
            let mut rig = given_at(start, change);
            lose(&mut rig);
            is_in(&mut rig, &["B"]);
            assert_eq!((said_done(&mut rig), told(&rig)), (Phase::Succeeded, vec![]), "{what}, from {start}");
        }
    }
}

#[test]
fn a_robot_that_began_where_its_task_ends_has_to_come_back_there() {
    let mut rig = given_at("B", |_| {});
    lists(&mut rig, "B", WorkState::Navigating, 0);
    let left = RobotEvent::Place { place_id: PlaceId::parse("B").expect("an id"), grant_id: 0, news: PlaceNews::Left };
    says(&mut rig, left);
    is_in(&mut rig, &["A"]);
    assert_eq!(said_done(&mut rig), Phase::Running);
    lists(&mut rig, "A", WorkState::Succeeded, STEPS);
    assert_eq!((rig.task("T1").phase, told(&rig).len()), (Phase::NeedsOperator, 1));
    assert_eq!(told(&rig)[0].metadata["place_id"], "B");
}

#[test]
fn an_attempt_that_was_taken_is_not_refused_behind_steps_that_were_never_done() {
    let mut rig = given();
    reports(&mut rig, WorkState::Refused, STEPS);
    assert_eq!(rig.task("T1").phase, Phase::Running, "its heartbeat is waited for");
    lists(&mut rig, "park-a", WorkState::Refused, STEPS);
    assert_eq!((rig.task("T1").phase, told(&rig).len()), (Phase::NeedsOperator, 1));
}

#[test]
fn an_attempt_owes_nothing_of_the_steps_that_one_before_it_did() {
    let mut rig = given();
    let id = attempt(&rig).to_string();
    let row = &mut rig.view.attempts.get_mut(id.as_str()).expect("an attempt").row;
    row.visited.as_mut().expect("its notes").resume_step = 2;
    row.phase = AttemptPhase::Lost;
    rig.view.desired_work.get_mut("r1").expect("its work").row.assignment = None;
    // A person put the item back meanwhile.
    let mut task = rig.task("T1").clone();
    (task.phase, task.next_step) = (Phase::Queued, 0);
    rig.change(&task);
    reports(&mut rig, WorkState::Aborted, 2);
    assert_eq!((told(&rig), rig.view.held_by(&robot_id())), (vec![], None));
}

#[test]
fn an_attempt_that_is_over_is_not_forgotten_before_it_is_judged() {
    let mut rig = given();
    let id = attempt(&rig);
    rig.view.attempts.get_mut(id.to_string().as_str()).expect("an attempt").row.phase = AttemptPhase::Lost;
    let mut task = rig.task("T1").clone();
    task.phase = Phase::NeedsOperator;
    rig.change(&task);
    rig.says(&robot_id(), &id, WorkState::Succeeded, STEPS, 0);
    said_done(&mut rig);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.view.desired_work["r1"].row.closed, [], "the heartbeat that is to judge it does not count yet");
}

#[test]
fn a_failure_behind_a_pick_where_the_robot_never_was_asks_a_person_and_its_steps_do_not_count() {
    for state in [WorkState::Failed, WorkState::Aborted, WorkState::Suspended] {
        let mut rig = given();
        reports(&mut rig, state, 1);
        assert_eq!(rig.task("T1").phase, Phase::Running, "{state:?}: its heartbeat is waited for");
        lists(&mut rig, "park-a", state, 1);
        let task = rig.task("T1");
        assert_eq!((task.phase, task.next_step, told(&rig).len()), (Phase::NeedsOperator, 0, 1), "{state:?}");
        let text = told(&rig)[0].text().to_owned();
        assert!(text.contains("said that a part of T1 is done and was never seen at A"), "{text}");
    }
}

#[test]
fn a_failure_of_a_robot_that_was_where_it_failed_is_believed_at_once() {
    let mut rig = given();
    is_in(&mut rig, &["A"]);
    reports(&mut rig, WorkState::Failed, 1);
    let task = rig.task("T1");
    assert_eq!((task.phase, task.next_step, told(&rig)), (Phase::NeedsOperator, 1, vec![]));
    assert_eq!(task.reason.as_ref().map(|why| why.code), Some(Code::FaultNotRecoverable));
}

#[test]
fn a_robot_that_lists_an_attempt_no_more_whose_steps_it_claimed_from_afar_is_looked_at() {
    let mut rig = given();
    reports(&mut rig, WorkState::Navigating, 2);
    lists(&mut rig, "park-a", WorkState::Navigating, 2);
    let applied = rig.view.desired_work["r1"].row.generation;
    let live = Arc::make_mut(rig.board.get_mut(&robot_id()).expect("a robot"));
    live.report.attempts.clear();
    live.report.applied_work = applied;
    live.report.hb += 1;
    rig.pass(1_000);
    rig.cycle(Pace::Sweep);
    assert_eq!((rig.task("T1").phase, told(&rig).len()), (Phase::NeedsOperator, 1));
}

#[test]
fn a_step_that_was_claimed_from_afar_is_not_done_unless_it_must_not_be_done_twice() {
    let looks = |raw: &mut RawTask| {
        for at in [1, 3] {
            raw.steps[at].effect = Some(Some(Effect::Repeatable));
        }
    };
    for (change, is_in_a, done) in [(true, false, 0), (true, true, 2), (false, false, 2)] {
        let mut rig = given_at("park-a", |raw| {
            if change {
                looks(raw)
            }
        });
        if is_in_a {
            is_in(&mut rig, &["A"]);
        }
        reports(&mut rig, WorkState::Navigating, 2);
        let task = rig.task("T1");
        assert_eq!((task.next_step, task.opened_robot_id.is_some()), (done, !change), "{change} {is_in_a}");
    }
}

#[test]
fn a_failure_that_only_heartbeats_tell_is_one() {
    let mut rig = given();
    lists(&mut rig, "park-a", WorkState::Failed, 0);
    assert_eq!((rig.task("T1").phase, told(&rig)), (Phase::NeedsOperator, vec![]));
}

#[test]
fn a_place_that_a_person_cleared_is_asked_for_no_more() {
    let mut rig = given();
    for (place, grant_id) in [("A", 1), ("B", 2)] {
        let place_id = PlaceId::parse(place).expect("an id");
        let row = &mut rig.view.places.get_mut(place).expect("a place").row;
        let (state, since) = (HolderState::Granted, rig.now.utc);
        row.holders = vec![PlaceHolder { robot_id: robot_id(), grant_id, state, since, claimed: false }];
        let clear = Command::ClearPlace { place_id, reason: "nobody is there".to_owned() };
        // The robot was not heard when the person looked.
        Plan::default().decide(&mut rig.view, rig.now, "anna", |tx| {
            commands::apply(tx, &Board::new(), &clear, "anna");
        });
    }
    assert_eq!((said_done(&mut rig), told(&rig)), (Phase::Succeeded, vec![]));
}

#[test]
fn a_given_up_attempt_that_comes_back_as_done_is_held_against_the_steps_that_were_left() {
    for (places, is_believed) in [(vec![], false), (vec!["B"], false), (vec!["A", "B"], true)] {
        let mut rig = given();
        let id = attempt(&rig).to_string();
        let row = &mut rig.view.attempts.get_mut(id.as_str()).expect("an attempt").row;
        row.phase = AttemptPhase::Lost;
        rig.view.desired_work.get_mut("r1").expect("its work").row.assignment = None;
        let mut task = rig.task("T1").clone();
        task.phase = Phase::NeedsOperator;
        rig.change(&task);
        is_in(&mut rig, &places);
        let phase = if is_believed { Phase::Succeeded } else { Phase::NeedsOperator };
        assert_eq!(said_done(&mut rig), phase);
        if !is_believed {
            lists(&mut rig, "park-a", WorkState::Succeeded, STEPS);
            assert_eq!((rig.task("T1").phase, told(&rig).len()), (Phase::NeedsOperator, 1));
            assert_eq!(rig.view.held_by(&robot_id()), None, "the robot is free");
        }
    }
}
