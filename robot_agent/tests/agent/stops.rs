//! Fleet stop: what a robot does about stops and about their silence, and what lets it go on. The link's server and the
//! stop service are the test.

use crate::rig::{Rig, StopDesk, action, goto, point};
use midshift_agent::core::Input;
use midshift_agent::stop::{CheckIn, StopNews};
use midshift_core::desired_state::{Assignment, DesiredWork};
use midshift_core::ids::{AreaId, RobotId, StopId};
use midshift_core::robot::WorkState;
use midshift_core::robot::{Load, Pose, StopLevel};
use midshift_core::robot_events::RobotEvent;
use midshift_core::step::{Effect, WorkStep};
use midshift_core::stop::ladder::Stage;
use midshift_core::stop::{Region, Reset, Scope, Stop};
use midshift_core::time::Utc;
use midshift_proto::session::Downlink;
use std::collections::BTreeSet;

pub fn stop_id(n: u64) -> StopId {
    StopId::parse(&format!("STOP-{n}")).expect("an id")
}

pub fn stop(n: u64, level: StopLevel) -> Stop {
    let engaged = Stop::new(stop_id(n), Scope::Fleet, level, Utc(1_700_000_000_000));
    Stop { actor: "anna".into(), reason: "a pallet fell".into(), ..engaged }
}

pub fn reset(n: u64) -> Reset {
    Reset { actor: "bert".into(), reason: "clear".into(), ..Reset::new(stop_id(n), Utc(1_700_000_000_001)) }
}

/// Generation of the latch with the `n`-th message.
pub const SYNCED: u64 = 10;

pub fn desk() -> StopDesk {
    StopDesk { is_there: true, ..StopDesk::default() }
}

pub fn hear_news(rig: &mut Rig, news: StopNews) {
    rig.give(Input::Stop(Box::new(news)));
}

pub fn told(rig: &mut Rig, stops: Vec<Stop>, resets: Vec<Reset>) {
    hear_news(rig, StopNews::Facts { stops, resets, generation: SYNCED });
}

/// A line opens, and nothing is effective.
pub fn attend(rig: &mut Rig) {
    let nonce = rig.ms * 1_000;
    hear_news(rig, StopNews::Attended { nonce });
    hear_news(rig, StopNews::Synced { generation: SYNCED, key: Vec::new() });
}

/// Every check-in that waits is answered.
pub fn answer(rig: &mut Rig) {
    for (nonce, said) in std::mem::take(&mut rig.stop.check_ins) {
        hear_news(rig, StopNews::CheckInAnswer { nonce, generation: said.generation });
    }
}

/// Time passes; both servers answer.
pub fn serve(rig: &mut Rig, ms: u64) {
    for _ in 0..ms / 500 {
        rig.silence(500);
        answer(rig);
        rig.echo();
    }
}

/// Time passes; the link's server answers and the stop service is silent.
pub fn stop_silence(rig: &mut Rig, ms: u64) {
    for _ in 0..ms / 500 {
        rig.pass(500);
        rig.stop.check_ins.clear();
    }
}

pub fn level(rig: &Rig) -> StopLevel {
    let at = crate::rig::now_at(rig.ms);
    rig.core.reported(&at).stop_level
}

pub fn awaiting(rig: &Rig) -> Vec<String> {
    let at = crate::rig::now_at(rig.ms);
    rig.core.reported(&at).awaiting_resume.iter().map(ToString::to_string).collect()
}

pub fn said(rig: &Rig) -> CheckIn {
    rig.stop.check_ins.last().expect("it said something").1.clone()
}

/// Stands at A, is connected to both servers and free to go.
pub fn free() -> Rig {
    freed(Rig::stoppable("A", desk()))
}

pub fn freed(mut rig: Rig) -> Rig {
    rig.connect();
    attend(&mut rig);
    serve(&mut rig, 4_000);
    assert_eq!(level(&rig), StopLevel::None);
    rig
}

fn to_c(rig: &Rig) -> Assignment {
    let route = vec![point("A", None, false, &[]), point("B", None, false, &[]), point("C", Some(0), false, &[])];
    rig.offer("T1", 1, vec![goto("C")], route)
}

/// Drives to C over B.
pub fn driving() -> Rig {
    let mut rig = free();
    rig.work(rig.desired(Some(to_c(&rig))));
    assert_eq!((rig.body.goes_to().len(), rig.body.log().paused), (2, false));
    rig.reports();
    rig
}

/// Whether the body is under way.
pub fn moves(rig: &Rig) -> bool {
    let log = rig.body.log();
    !log.paused && (!log.path.is_empty() || log.acting.is_some())
}

pub fn speeds(rig: &Rig) -> Vec<u32> {
    rig.body.log().path.iter().map(|p| p.speed_mm_s).collect()
}

/// What people resumed and whether there is a fresh permission to go on.
pub fn resume(rig: &mut Rig, resumed: &[StopId], is_permitted: bool) {
    let resume = is_permitted.then(|| rig.authority(10_000));
    let order = rig.core.memory().ledger.holder.is_some().then(|| to_c(rig));
    rig.work(DesiredWork { resumed: resumed.to_vec(), resume, ..rig.desired(order) });
}

fn halted() -> Rig {
    let mut rig = driving();
    told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    serve(&mut rig, 1_000);
    assert!(!moves(&rig));
    rig
}

#[test]
fn a_stop_stands_a_driving_robot_within_the_step_that_hears_it_whatever_its_disks_do() {
    let mut rig = driving();
    rig.body.set(|log| log.load = Some(Load { task_id: None, item: "box".into() }));
    rig.slow_disk = true;
    rig.pass(1_000);
    rig.stop.check_ins.clear();
    rig.stop.disk_fails = true;
    told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    assert!(!moves(&rig));
    let said = said(&rig);
    assert_eq!((said.obeys, said.is_still, said.is_durable), (StopLevel::Halt, true, false));
    assert_eq!(said.inside, [stop_id(1)]);
    assert_eq!(rig.body.log().levels.last(), Some(&StopLevel::Halt));
    rig.flush();
    rig.pass(500);
    let reported = rig.reported.clone().expect("a heartbeat");
    assert_eq!((reported.stop_level, reported.stops), (StopLevel::Halt, vec![stop_id(1)]));
    assert_eq!(reported.attempts[0].state, WorkState::Paused);
    assert!(reported.load.is_some() && rig.body.goes_to().len() == 2, "it keeps its load and its order");
    let level_said = |e: &RobotEvent| matches!(e, RobotEvent::FleetStop { level: StopLevel::Halt, stops, .. } if *stops == [stop_id(1)]);
    assert!(rig.events.iter().any(level_said));
}

#[test]
fn a_heartbeat_says_a_stop_at_once_and_not_only_with_the_next_second() {
    let mut rig = driving();
    let quiet = rig.hb;
    while rig.hb == quiet {
        rig.silence(500);
    }
    // Not within the quarter of a second after a heartbeat, and long before the next one.
    let before = rig.hb;
    rig.ms += 300;
    told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    assert!(rig.hb > before);
}

#[test]
fn a_posture_drops_the_order_and_the_work_is_done_from_where_it_stands() {
    let mut rig = driving();
    rig.body.reach();
    rig.pass(500);
    let before = rig.body.log().stops;
    told(&mut rig, vec![stop(1, StopLevel::ControlledStopPosture)], vec![]);
    assert_eq!((rig.body.log().stops, rig.body.goes_to().len()), (before + 1, 0));
    serve(&mut rig, 3_000);
    assert_eq!(rig.body.log().stops, before + 1, "it is told once");
    assert_eq!(rig.states().last(), Some(&(WorkState::Paused, 0)));
    told(&mut rig, vec![], vec![reset(1)]);
    resume(&mut rig, &[stop_id(1)], true);
    serve(&mut rig, 2_000);
    assert_eq!(rig.body.goes_to(), ["C"]);
}

#[test]
fn in_whatever_order_and_however_often_it_is_told_it_obeys_the_same() {
    let say: [fn(&mut Rig); 4] = [
        |rig| told(rig, vec![stop(1, StopLevel::Halt)], vec![]),
        |rig| told(rig, vec![], vec![reset(1)]),
        |rig| told(rig, vec![stop(2, StopLevel::Halt)], vec![]),
        |rig| hear_news(rig, StopNews::Synced { generation: SYNCED, key: Vec::new() }),
    ];
    let mut orders = 0;
    for order in 0..256 {
        let order = [order % 4, order / 4 % 4, order / 16 % 4, order / 64];
        if BTreeSet::from(order).len() < 4 {
            continue;
        }
        orders += 1;
        let mut rig = driving();
        for at in order {
            say[at](&mut rig);
            say[at](&mut rig);
        }
        order.iter().for_each(|at| say[*at](&mut rig));
        let reported = rig.core.reported(&crate::rig::now_at(rig.ms));
        assert_eq!((reported.stop_level, reported.stops), (StopLevel::Halt, vec![stop_id(2)]), "{order:?}");
        assert!(!moves(&rig));
    }
    assert_eq!(orders, 24);
}

#[test]
fn a_reset_moves_nobody_and_neither_does_half_of_a_resume() {
    let mut rig = halted();
    told(&mut rig, vec![], vec![reset(1)]);
    serve(&mut rig, 3_000);
    assert_eq!((moves(&rig), level(&rig), awaiting(&rig)), (false, StopLevel::Halt, vec!["STOP-1".into()]));
    resume(&mut rig, &[], true);
    serve(&mut rig, 3_000);
    assert!(!moves(&rig), "a permission, and nobody resumed the stop");
    resume(&mut rig, &[stop_id(7)], true);
    serve(&mut rig, 3_000);
    assert!(!moves(&rig), "another stop was resumed");
    resume(&mut rig, &[stop_id(1)], false);
    serve(&mut rig, 3_000);
    assert_eq!((level(&rig), awaiting(&rig).len()), (StopLevel::None, 0));
    assert!(!moves(&rig), "resumed, and no permission to go on");
    resume(&mut rig, &[], true);
    serve(&mut rig, 1_000);
    assert!(moves(&rig));
    assert_eq!(rig.states().last(), Some(&(WorkState::Navigating, 0)));
}

#[test]
fn reset_and_resume_let_it_go_on_in_either_order() {
    for is_reset_first in [true, false] {
        let mut rig = halted();
        if is_reset_first {
            told(&mut rig, vec![], vec![reset(1)]);
        }
        // Not in the very millisecond of the heartbeat that was answered last.
        rig.ms += 1;
        resume(&mut rig, &[stop_id(1)], true);
        assert!(!moves(&rig));
        if !is_reset_first {
            serve(&mut rig, 2_000);
            assert!(!moves(&rig), "resumed, and still engaged as far as it knows");
            rig.ms += 1;
            told(&mut rig, vec![], vec![reset(1)]);
            assert!(!moves(&rig), "a heartbeat sent since was not answered yet");
        }
        serve(&mut rig, 2_000);
        assert!(moves(&rig), "reset first: {is_reset_first}");
    }
}

#[test]
fn a_permission_that_grew_old_while_it_was_stopped_moves_nobody() {
    let mut rig = halted();
    resume(&mut rig, &[stop_id(1)], true);
    serve(&mut rig, 12_000);
    told(&mut rig, vec![], vec![reset(1)]);
    serve(&mut rig, 3_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::None, false));
    resume(&mut rig, &[], true);
    serve(&mut rig, 1_000);
    assert!(moves(&rig));
}

#[test]
fn a_desired_state_of_before_the_stop_lets_nobody_go_on() {
    let mut rig = driving();
    let before = DesiredWork {
        resume: Some(rig.authority(10_000)),
        resumed: vec![stop_id(1)],
        generation: 7,
        ..rig.desired(Some(to_c(&rig)))
    };
    told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    told(&mut rig, vec![], vec![reset(1)]);
    rig.down(Downlink { work: Some(before), ..Downlink::default() });
    serve(&mut rig, 3_000);
    assert_eq!((moves(&rig), level(&rig)), (false, StopLevel::Halt));
}

fn stiff(rig: &Rig) -> Assignment {
    let step = WorkStep { pause_allowed: false, cancel_allowed: false, ..action("pick", Effect::CheckFirst) };
    rig.offer("T1", 1, vec![step], vec![])
}

#[test]
fn an_action_that_may_not_be_paused_stands_too_and_goes_on_by_permission_only() {
    let mut rig = free();
    rig.work(rig.desired(Some(stiff(&rig))));
    assert!(moves(&rig));
    told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    assert!(!moves(&rig));
    told(&mut rig, vec![], vec![reset(1)]);
    rig.work(DesiredWork { resumed: vec![stop_id(1)], ..rig.desired(Some(stiff(&rig))) });
    serve(&mut rig, 2_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::None, false));
    rig.work(DesiredWork { resume: Some(rig.authority(10_000)), ..rig.desired(Some(stiff(&rig))) });
    serve(&mut rig, 1_000);
    assert!(moves(&rig));
}

#[test]
fn what_stood_it_stands_it_again_after_it_was_killed() {
    let mut rig = halted().restart();
    assert_eq!((level(&rig), rig.core.known_stops().count()), (StopLevel::Halt, 1));
    // A stop service that has forgotten it.
    rig.connect();
    attend(&mut rig);
    rig.work(rig.desired(Some(to_c(&rig))));
    serve(&mut rig, 5_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::Halt, false));
    rig.silence(1_000);
    assert_eq!(said(&rig).inside, [stop_id(1)]);
}

#[test]
fn what_was_reset_while_it_was_dead_still_waits_for_its_resume() {
    let mut rig = halted().restart();
    rig.connect();
    attend(&mut rig);
    told(&mut rig, vec![], vec![reset(1)]);
    rig.work(rig.desired(Some(to_c(&rig))));
    serve(&mut rig, 5_000);
    assert_eq!((level(&rig), moves(&rig), awaiting(&rig)), (StopLevel::Halt, false, vec!["STOP-1".into()]));
    resume(&mut rig, &[stop_id(1)], false);
    serve(&mut rig, 2_000);
    assert!(!moves(&rig), "the permission is needed after a restart too");
    resume(&mut rig, &[], true);
    serve(&mut rig, 2_000);
    assert!(moves(&rig));
}

#[test]
fn a_stop_that_cannot_be_written_is_obeyed_said_to_be_not_durable_and_written_later() {
    let mut rig = driving();
    rig.silence(1_000);
    assert!(said(&rig).is_durable);
    answer(&mut rig);
    rig.stop.disk_fails = true;
    told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    serve(&mut rig, 2_000);
    rig.silence(1_000);
    assert_eq!((said(&rig).obeys, said(&rig).is_durable), (StopLevel::Halt, false));
    assert_eq!(rig.stop.saved.latch.stops().count(), 0);
    rig.stop.disk_fails = false;
    serve(&mut rig, 2_000);
    rig.silence(1_000);
    assert!(said(&rig).is_durable);
    assert!(rig.stop.saved.awaiting.contains(&stop_id(1)));
}

#[test]
fn a_robot_that_starts_stands_until_it_was_told_and_answered() {
    let mut rig = Rig::stoppable("A", desk());
    rig.connect();
    serve(&mut rig, 5_000);
    assert_eq!(level(&rig), StopLevel::Halt, "no line");
    rig.work(rig.desired(Some(to_c(&rig))));
    assert_eq!((rig.refusals(), moves(&rig)), (vec!["ROBOT_STOPPED".into()], false));
    hear_news(&mut rig, StopNews::Attended { nonce: 5 });
    serve(&mut rig, 5_000);
    assert_eq!(level(&rig), StopLevel::Halt, "answered, and not told");
    let mut rig = Rig::stoppable("A", desk());
    rig.connect();
    attend(&mut rig);
    rig.pass(2_000);
    assert_eq!(level(&rig), StopLevel::Halt, "told, and not answered");
    attend(&mut rig);
    serve(&mut rig, 4_000);
    assert_eq!((level(&rig), awaiting(&rig).len()), (StopLevel::None, 0), "a start waits for nobody");
    let about_stops = |e: &RobotEvent| matches!(e, RobotEvent::FleetStop { .. });
    assert!(!rig.events.iter().any(about_stops), "and is no news");
}

#[test]
fn work_that_was_under_way_at_a_restart_goes_on_without_a_resume_if_nobody_stopped_it() {
    let mut rig = driving().restart();
    rig.connect();
    rig.work(rig.desired(Some(to_c(&rig))));
    rig.pass(3_000);
    assert!(!moves(&rig));
    attend(&mut rig);
    serve(&mut rig, 4_000);
    assert!(moves(&rig));
}

#[test]
fn slow_caps_the_drive_under_way_at_once_and_gives_it_back_without_a_resume() {
    let mut rig = driving();
    assert_eq!(speeds(&rig), [1_500, 1_500]);
    rig.slow_disk = true;
    rig.pass(1_000);
    told(&mut rig, vec![stop(1, StopLevel::Slow)], vec![]);
    assert_eq!((speeds(&rig), moves(&rig)), (vec![300, 300], true));
    rig.flush();
    serve(&mut rig, 1_000);
    assert_eq!((speeds(&rig), level(&rig)), (vec![300, 300], StopLevel::Slow));
    told(&mut rig, vec![], vec![reset(1)]);
    assert_eq!((speeds(&rig), level(&rig), awaiting(&rig).len()), (vec![1_500, 1_500], StopLevel::None, 0));
    assert!(moves(&rig));
    assert_eq!(rig.body.log().levels, [StopLevel::Halt, StopLevel::None, StopLevel::Slow, StopLevel::None]);
}

#[test]
fn slow_does_not_wait_for_a_grant_that_waits_for_the_disk() {
    let mut rig = free();
    let work = |rig: &Rig, grants| {
        let route = vec![point("A", None, false, &[]), point("B", None, false, &[]), point("C", Some(0), true, &[])];
        DesiredWork { grants, ..rig.desired(Some(rig.offer("T1", 1, vec![goto("C")], route))) }
    };
    rig.work(work(&rig, vec![]));
    rig.slow_disk = true;
    rig.work(work(&rig, vec![rig.grant("C", 11)]));
    assert_eq!(rig.body.goes_to(), ["B"], "the grant is not on the ledger yet");
    told(&mut rig, vec![stop(1, StopLevel::Slow)], vec![]);
    assert_eq!(speeds(&rig), [300]);
    rig.flush();
    assert_eq!((rig.body.goes_to().len(), speeds(&rig)), (2, vec![300, 300]));
}

#[test]
fn what_was_halted_under_a_slow_stop_goes_on_slowly() {
    let mut rig = halted();
    told(&mut rig, vec![stop(2, StopLevel::Slow)], vec![reset(1)]);
    resume(&mut rig, &[stop_id(1)], true);
    serve(&mut rig, 2_000);
    assert_eq!((moves(&rig), speeds(&rig)), (true, vec![300, 300]));
}

/// A stop of the part around B, which lies 5 m from A.
fn around_b() -> Stop {
    let region = Some(Region::of_box(4_500, -500, 5_500, 500));
    Stop { scope: Scope::Area(AreaId::parse("hall").expect("a name")), region, ..stop(1, StopLevel::Halt) }
}

fn stand_at(rig: &Rig, x_mm: i32) {
    rig.body.set(|log| log.pose = Pose { x_mm, ..Pose::default() });
}

#[test]
fn a_stop_of_a_part_stands_who_is_inside_by_pose_and_who_does_not_know() {
    let mut rig = driving();
    told(&mut rig, vec![around_b()], vec![]);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::None, true), "it is at A");
    let mut rig = driving();
    stand_at(&rig, 4_000);
    told(&mut rig, vec![around_b()], vec![]);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::Halt, false));
    let mut rig = driving();
    rig.body.set(|log| log.waypoint = None);
    told(&mut rig, vec![around_b()], vec![]);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::Halt, false), "it does not know where it is");
    let mut rig = driving();
    told(&mut rig, vec![Stop { region: None, ..around_b() }], vec![]);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::Halt, false), "nobody says where");
    let mut rig = driving();
    let other = Scope::Robot(RobotId::parse("rbt-02").expect("a name"));
    told(&mut rig, vec![Stop { scope: other, ..stop(1, StopLevel::Halt) }], vec![]);
    assert!(moves(&rig));
}

#[test]
fn a_robot_that_drives_into_a_stopped_part_stands_at_its_border() {
    let mut rig = driving();
    told(&mut rig, vec![around_b()], vec![]);
    let mut x_mm = 0;
    while moves(&rig) && x_mm < 5_000 {
        let now = crate::rig::now_at(rig.ms);
        let wake = rig.core.next_wake(&now);
        let step = wake.site.map_or(1_000, |at| at.since(now.site).as_ms()).min(wake.link.since(now.link).as_ms());
        assert!(step <= 100, "it looks after {step} ms");
        rig.ms += step.max(1);
        x_mm += 150 * step as i32 / 100;
        stand_at(&rig, x_mm);
        rig.give(Input::Tick);
        answer(&mut rig);
    }
    assert!((2_500..2_700).contains(&x_mm), "it stands {x_mm} mm from where it set out");
    assert_eq!(awaiting(&rig), ["STOP-1"]);
}

#[test]
fn while_it_stands_nothing_begins_and_the_time_of_its_attempt_stands_still() {
    let mut rig = halted();
    serve(&mut rig, 700_000);
    assert_eq!(rig.states().iter().find(|(state, _)| state.is_over()), None, "600 s were allowed");
    // Another task: the work at hand is taken back, and nothing else is begun.
    let other = Assignment { attempt: crate::rig::attempt("T2", 1), ..to_c(&rig) };
    rig.work(rig.desired(None));
    serve(&mut rig, 1_000);
    assert_eq!(rig.states().last(), Some(&(WorkState::Aborted, 0)));
    rig.work(rig.desired(Some(Assignment { offer: rig.authority(5_000), ..other })));
    assert_eq!(rig.refusals(), ["ROBOT_STOPPED"]);
    assert!(!moves(&rig));
}

#[test]
fn an_errand_to_a_posture_or_a_charger_begins_nothing_either() {
    for name in ["park", "charge"] {
        let mut rig = free();
        let steps = vec![action("pick", Effect::Repeatable), action(name, Effect::Repeatable)];
        rig.work(rig.desired(Some(rig.offer("T1", 1, steps, vec![]))));
        told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
        rig.body.done();
        serve(&mut rig, 2_000);
        let log = rig.body.log();
        assert_eq!((log.parks, log.charging), (0, false), "{name}");
        assert_eq!(rig.states().last(), Some(&(WorkState::Paused, 1)));
    }
}

#[test]
fn a_line_says_once_a_second_what_is_so_and_at_once_what_has_changed() {
    let mut rig = free();
    rig.stop.check_ins.clear();
    for _ in 0..20 {
        rig.silence(500);
        let waiting = rig.stop.check_ins.last().cloned();
        waiting
            .into_iter()
            .for_each(|(nonce, _)| hear_news(&mut rig, StopNews::CheckInAnswer { nonce, generation: SYNCED }));
    }
    assert_eq!(rig.stop.check_ins.len(), 10);
    let nonces: BTreeSet<u64> = rig.stop.check_ins.iter().map(|(nonce, _)| *nonce).collect();
    assert_eq!(nonces.len(), 10, "each has a number of its own");
    told(&mut rig, vec![stop(1, StopLevel::Slow)], vec![]);
    let said = said(&rig);
    assert_eq!((rig.stop.check_ins.len() > 10, said.obeys, said.silence), (true, StopLevel::Slow, Stage::Heard));
}
