//! What is counted for and against a bundle, and what the gate behind each wave says with which numbers.

use super::*;
use crate::gates::EffortLimits;
use crate::rollout::projection::rows::Verdict;

fn verdicts(rig: &Rig) -> Vec<(Outcome, Code, u32)> {
    let all = rig.rollout("ro").verdicts;
    all.iter().map(|v: &Verdict| (v.outcome, v.reason.code, v.attempted)).collect()
}

#[test]
fn a_good_bundle_comes_to_all_and_each_verdict_says_what_was_not_proven() {
    let mut rig = Rig::new(13);
    rig.start(RolloutSpec { waves: vec![Wave::Count(1), Wave::Count(3), Wave::Rest], ..spec() });
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    let unproven = (Outcome::PromotedUnproven, Code::GateUnproven);
    let proven = (Outcome::Promoted, Code::GateProven, 13);
    assert_eq!(verdicts(&rig), [(unproven.0, unproven.1, 1), (unproven.0, unproven.1, 4), proven]);
    let bounds: Vec<u16> = rig.rollout("ro").verdicts.iter().map(|v| v.robots.upper_bound_permille).collect();
    assert_eq!(bounds[0], 950, "one clean robot says next to nothing");
    assert!(bounds.is_sorted_by(|a, b| a > b));
    assert_eq!(rig.count(Step::Committed), 13);
    assert!(rig.robots.iter().all(|r| r.version == "2.0.0" && r.kept == "2.0.0"));
}

#[test]
fn a_wave_that_proves_nothing_is_asked_about_if_the_spec_says_so() {
    let mut rig = Rig::new(4);
    rig.start(RolloutSpec { small_wave: crate::rollout::projection::spec::SmallWave::Review, ..spec() });
    rig.until(100, |r| r.phase() == Phase::Review);
    assert_eq!(verdicts(&rig), [(Outcome::Review, Code::GateAsksPerson, 1)]);
    rig.must("ro", Verb::Promote);
    rig.until(100, |r| r.phase() == Phase::Review);
    rig.must("ro", Verb::Promote);
    rig.until(100, |r| r.phase() == Phase::Completed);
    let promoted = rig.rollout("ro").verdicts.into_iter().filter(|v| v.outcome == Outcome::PromotedByPerson);
    assert!(promoted.inspect(|v| assert_eq!(v.actor.as_deref(), Some("ana"))).count() == 2);
}

#[test]
fn work_that_costs_more_than_is_let_pass_is_a_persons_to_judge_and_else_only_shown() {
    let limits = EffortLimits { energy_permille: Some(200), ..EffortLimits::default() };
    let unproven = (Outcome::PromotedUnproven, Code::GateUnproven);
    let too_high = (Outcome::Review, Code::EffortTooHigh);
    for (energy_mwh, effort, expected) in
        [(12, limits, unproven), (13, limits, too_high), (13, EffortLimits::default(), unproven)]
    {
        let mut rig = Rig::new(4);
        rig.trial_energy_mwh = energy_mwh;
        rig.start(RolloutSpec { effort, ..spec() });
        let first = rig.order()[0];
        for _ in 0..200 {
            if !rig.rollout("ro").verdicts.is_empty() {
                break;
            }
            rig.tick();
            (0..4).filter(|n| *n != first).for_each(|n| rig.ends_task(n, true));
        }
        let rollout = rig.rollout("ro");
        let verdict = rollout.verdicts.first().expect("it was judged");
        assert_eq!((verdict.outcome, verdict.reason.code), expected, "{energy_mwh}");
        let efforts = verdict.efforts;
        assert_eq!((efforts.trial.mwh_a_km(), efforts.control.mwh_a_km()), (Some(energy_mwh * 20), Some(200)));
        assert_eq!((efforts.trial.ms_a_task(), efforts.control.ms_a_task()), (Some(20_000), Some(20_000)));
    }
}

#[test]
fn a_wave_without_work_is_a_persons_to_judge_after_its_time() {
    let mut rig = Rig::new(4);
    rig.works = false;
    rig.start(spec());
    rig.until(60, |r| r.phase() == Phase::Gate);
    rig.ticks(30);
    assert_eq!(rig.phase(), Phase::Gate, "work is waited for");
    rig.until(60, |r| r.phase() == Phase::Review);
    assert_eq!(verdicts(&rig), [(Outcome::Review, Code::NoExposure, 1)]);
}

#[test]
fn a_robot_that_is_kept_out_of_work_is_not_waited_for_and_proves_nothing() {
    let mut rig = Rig::new(5);
    rig.start(spec());
    let n = rig.order()[1];
    let since = rig.now.utc;
    rig.control(n, |c| c.breaker = Some(since));
    rig.robots[n].idles = true;
    rig.until(200, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    assert_eq!(rig.robot_in("ro", n).step, Step::Committed, "it has the bundle as all others");
    let last = rig.rollout("ro").verdicts.pop().expect("a verdict");
    assert_eq!((last.attempted, last.robots.outcomes.clean), (5, 4));
}

#[test]
fn if_nobody_of_a_wave_may_work_a_person_is_asked() {
    let mut rig = Rig::new(2);
    rig.start(spec());
    let n = rig.order()[0];
    let since = rig.now.utc;
    rig.control(n, |c| c.breaker = Some(since));
    rig.robots[n].idles = true;
    rig.until(200, |r| r.phase() == Phase::Review);
    assert_eq!(verdicts(&rig), [(Outcome::Review, Code::NoExposure, 1)]);
}

#[test]
fn one_failure_among_few_aborts_and_says_how_often_that_happens_to_good_bundles() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { waves: vec![Wave::Count(1), Wave::Rest], ..spec() });
    let n = rig.order()[0];
    rig.until(60, |r| r.step(n) == Step::Trial);
    rig.goes_back(n, Some(Code::BreakerOnTrial));
    rig.tick();
    assert!(rig.phase().goes_back());
    assert_eq!(verdicts(&rig), [(Outcome::Aborted, Code::FailureAmongFew, 1)]);
    assert_eq!(rig.rollout("ro").verdicts[0].robots.false_abort_permille, Some(20));
    rig.until(60, |r| r.phase() == Phase::Aborted);
    assert!(rig.ota.quarantines.contains_key(format!("{}/{}", robot_id(n), bundle_id(2)).as_str()));
}

#[test]
fn a_wave_of_which_all_failed_is_reviewed_and_never_followed_by_the_next() {
    let mut rig = Rig::new(6);
    rig.fates(Fate::Probation);
    rig.start(RolloutSpec { small_wave_failure: crate::rollout::projection::spec::SmallWaveFailure::Review, ..spec() });
    let n = rig.order()[0];
    rig.until(60, |r| r.robot_in("ro", n).moments.switched.is_some());
    rig.goes_back(n, Some(Code::BreakerOnTrial));
    rig.until(5, |r| r.phase() == Phase::Review);
    assert_eq!(verdicts(&rig), [(Outcome::Review, Code::GateInconclusive, 1)]);
    rig.ticks(20);
    assert_eq!(rig.rollout("ro").wave, 0);
    assert_eq!(rig.count(Step::Staged), 5);
}

#[test]
fn a_canary_that_was_retired_on_trial_proves_nothing() {
    let mut rig = Rig::new(4);
    rig.start(RolloutSpec { waves: vec![Wave::Count(1), Wave::Rest], ..spec() });
    let n = rig.order()[0];
    rig.until(60, |r| r.step(n) == Step::Trial);
    rig.retire(n);
    rig.until(60, |r| r.phase() == Phase::Review);
    assert_eq!(verdicts(&rig), [(Outcome::Review, Code::GateInconclusive, 1)]);
}

#[test]
fn a_robot_that_stays_on_probation_keeps_no_wave_waiting_for_ever() {
    let mut rig = Rig::new(5);
    rig.checks_rebuild = false;
    rig.start(RolloutSpec { waves: vec![Wave::Count(1), Wave::Rest], ..spec() });
    rig.until(60, |r| r.rollout("ro").wave == 1);
    let n = rig.order()[1];
    rig.robots[n].fate = Fate::Probation;
    rig.ticks(30);
    assert_eq!(rig.phase(), Phase::Applying);
    rig.pass(crate::limits::STAGED_WITHIN.as_ms());
    rig.turn();
    rig.until(60, |r| r.phase() == Phase::Completed);
    assert!(rig.robot_in("ro", n).drain_id.is_some(), "it is not given work");
    assert_eq!(rig.rollout("ro").verdicts.last().expect("one").robots.outcomes.clean, 4);
}

#[test]
fn soak_and_exposure_stand_still_while_the_roll_out_does() {
    let mut rig = Rig::new(4);
    rig.works = false;
    rig.start(RolloutSpec { soak_ms: 60_000, ..spec() });
    rig.until(60, |r| r.phase() == Phase::Soaking);
    let left = |rig: &Rig| rig.rollout("ro").soak.expect("it soaks").left(rig.ota.served_ms(&rig.now));
    rig.must("ro", Verb::Pause);
    let before = left(&rig);
    rig.ticks(100);
    assert_eq!(left(&rig), before);
    rig.must("ro", Verb::Resume);
    rig.ticks(10);
    assert_eq!(left(&rig), before - 10_000);
}

fn fault(code: u32) -> RobotEvent {
    let fault = Fault { code, class: crate::robot::FaultClass::Recoverable, message: String::new() };
    RobotEvent::Fault { fault, cleared: false }
}

#[test]
fn a_code_of_the_manifest_ends_it_at_once_and_others_do_not() {
    let (mut rig, n) = canary_on_trial();
    rig.say_event(n, fault(7));
    rig.tick();
    assert!(rig.rollout("ro").abort.is_none());
    rig.say_event(n, fault(66));
    rig.ota_turn();
    let abort = rig.rollout("ro").abort.expect("it ends");
    assert_eq!((abort.reason.code, abort.hard, abort.robots), (Code::HardStopCode, true, vec![robot_id(n)]));
}

#[test]
fn hard_stops_act_also_while_the_roll_out_stands_still() {
    let (mut rig, n) = canary_on_trial();
    rig.must("ro", Verb::Pause);
    rig.say_event(n, fault(66));
    rig.ota_turn();
    assert!(rig.phase().goes_back());
}

#[test]
fn a_stop_counts_within_ten_minutes_of_the_switch_also_in_the_breath_in_which_the_trial_began() {
    for (later_ms, counts) in [(0, true), (590_000, true), (700_000, false)] {
        let mut rig = Rig::new(4);
        rig.checks_rebuild = false;
        rig.start(RolloutSpec { soak_ms: 3_000_000, ..spec() });
        let n = rig.order()[0];
        rig.robots[n].fate = Fate::Probation;
        rig.until(60, |r| r.robot_in("ro", n).moments.switched.is_some());
        rig.report(n, UpdateState::Trial);
        if later_ms > 0 {
            rig.ota_turn();
            rig.pass(later_ms);
        }
        rig.say_event(n, RobotEvent::HardwareStop(HardwareStop::Manual));
        rig.ota_turn();
        assert_eq!(rig.rollout("ro").abort.is_some(), counts, "{later_ms}");
    }
}

#[test]
fn no_permission_is_given_in_the_breath_in_which_a_hard_stop_is_heard() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { waves: vec![Wave::Count(2), Wave::Rest], allow_full_push: true, ..spec() });
    let (a, b) = (rig.order()[0], rig.order()[1]);
    rig.robots[b].fate = Fate::NeverReady;
    rig.until(60, |r| r.step(a) == Step::Trial && r.step(b) == Step::Activating);
    let drain_id = rig.robot_in("ro", b).drain_id.expect("a drain");
    let set = crate::ids::SetId::parse("factory").expect("an id");
    rig.say_event(b, RobotEvent::Update(UpdateEvent::Ready { drain_id, set }));
    rig.say_event(a, fault(66));
    rig.ota_turn();
    assert!(rig.phase().goes_back());
    assert!(!rig.robot_in("ro", b).attempted);
}

#[test]
fn the_breaker_on_trial_counts_and_one_of_before_does_not() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let n = rig.order()[0];
    let before = rig.now.utc;
    rig.until(60, |r| r.step(n) == Step::Trial);
    rig.control(n, |c| c.breaker = Some(before));
    rig.tick();
    assert_eq!(rig.robot_in("ro", n).failure, None);
    let at = rig.now.utc;
    rig.control(n, |c| c.breaker = Some(at));
    rig.ota_turn();
    assert_eq!(rig.robot_in("ro", n).failure.expect("it failed").code, Code::BreakerOnTrial);
    assert!(rig.phase().goes_back());
}

/// Three of eight robots in the hall work on trial, and then half of their tasks fail: the release is suspected.
fn suspected(acts_on_rates: bool, prepare: impl FnOnce(&mut Rig)) -> Rig {
    let mut rig = Rig::new(8);
    rig.checks_rebuild = false;
    rig.works = false;
    let waves = vec![Wave::Count(3), Wave::Rest];
    rig.start(RolloutSpec { waves, allow_full_push: true, soak_ms: 3_000_000, acts_on_rates, ..spec() });
    rig.until(60, |r| r.phase() == Phase::Soaking);
    prepare(&mut rig);
    for _ in 0..10 {
        for n in 0..8 {
            let trial = rig.step(n) == Step::Trial;
            (0..4).for_each(|_| rig.ends_task(n, !trial));
            (0..4).for_each(|_| rig.ends_task(n, true));
        }
        rig.pass(60_000);
        rig.ota_turn();
    }
    assert_eq!(rig.rollout("ro").tasks.suspicion(), crate::gates::Suspicion::Release);
    rig
}

fn ended_by(rig: &Rig) -> Option<(Code, Option<String>)> {
    rig.rollout("ro").abort.map(|a| (a.reason.code, a.reason.metadata.get("area_ids").cloned()))
}

/// Puts rules of the area of quality, where no robot of a rig begins.
fn quality_acts(rig: &mut Rig) {
    let mut rules = AreaPolicy::default_of(AreaId::parse("quality").expect("an id"));
    rules.software.acts_on_rates = true;
    rig.put_row(rules);
}

#[test]
fn a_rate_of_task_failures_is_shown_and_ends_it_only_if_that_was_asked_for() {
    for acts in [false, true] {
        let rig = suspected(acts, |_| {});
        assert_eq!(ended_by(&rig), acts.then_some((Code::RateTooHigh, None)));
        assert!(rig.rollout("ro").abort.is_none_or(|a| !a.hard));
    }
}

#[test]
fn a_rate_of_task_failures_ends_it_where_the_rules_of_the_area_say_so() {
    let rig = suspected(false, |rig| rig.rules(|s| s.acts_on_rates = true));
    assert_eq!(ended_by(&rig), Some((Code::RateTooHigh, Some("hall".to_owned()))));
}

#[test]
fn rules_of_an_area_in_which_no_robot_was_given_permission_end_nothing_and_rules_that_are_put_later_do() {
    let mut rig = suspected(false, |rig| {
        quality_acts(rig);
        let untouched = rig.order()[7];
        rig.robots[untouched].at = "door-2";
        rig.ticks(2);
        assert!(!rig.robot_in("ro", untouched).attempted);
        let area = rig.ota.software_of(&robot_id(untouched)).area;
        assert_eq!(area.map(|a| a.to_string()).as_deref(), Some("quality"), "it is seen there");
    });
    assert_eq!(ended_by(&rig), None);
    rig.rules(|s| s.acts_on_rates = true);
    rig.ota_turn();
    assert_eq!(ended_by(&rig), Some((Code::RateTooHigh, Some("hall".to_owned()))));
}

#[test]
fn rules_of_an_area_with_a_robot_that_was_given_permission_and_never_ran_it_end_nothing() {
    let rig = suspected(false, |rig| {
        quality_acts(rig);
        let dawdles = rig.order()[7];
        rig.robots[dawdles].at = "door-2";
        rig.ticks(2);
        let given = RolloutRobot { attempted: true, ..rig.robot_in("ro", dawdles) };
        rig.put_row(given);
        rig.ota_turn();
        let row = rig.robot_in("ro", dawdles);
        assert!(row.attempted && row.moments.on_trial.is_none());
    });
    assert_eq!(ended_by(&rig), None);
}

#[test]
fn a_robot_on_trial_that_drives_into_an_area_that_says_so_ends_it() {
    let rig = suspected(false, |rig| {
        quality_acts(rig);
        let on_trial = rig.order()[0];
        rig.robots[on_trial].at = "door-2";
        rig.ticks(2);
    });
    assert_eq!(ended_by(&rig), Some((Code::RateTooHigh, Some("quality".to_owned()))));
}

#[test]
fn who_says_that_rates_end_it_is_told_before_it_begins() {
    let mut rig = Rig::new(4);
    let caveats = |rig: &Rig, spec: &RolloutSpec| {
        let run = crate::rollout::commands::dry_run::dry_run(&rig.ota, &rig.board, &rollout_id("ro"), spec)
            .expect("it may begin");
        run.caveats.into_iter().filter(|c| c.starts_with("rates of task failures")).collect::<Vec<_>>()
    };
    quality_acts(&mut rig);
    rig.tick();
    assert_eq!(caveats(&rig, &spec()), Vec::<String>::new());
    let asked = RolloutSpec { acts_on_rates: true, ..spec() };
    assert!(caveats(&rig, &asked)[0].ends_with("as is asked for"));
    rig.rules(|s| s.acts_on_rates = true);
    rig.tick();
    assert!(caveats(&rig, &spec())[0].ends_with("the rules of hall say so"));
}

#[test]
fn robots_that_come_and_go_keep_no_gate_waiting_and_who_is_dark_then_is_not_called_clean() {
    let mut rig = Rig::new(12);
    let waves = vec![Wave::Count(11), Wave::Rest];
    let rules = RolloutSpec { waves, allow_full_push: true, exposure_tasks: 0, ..spec() };
    rig.start(rules);
    rig.until(100, |r| r.phase() == Phase::Soaking);
    let wave: Vec<usize> = rig.order()[..11].to_vec();
    // One second in 44 each, four seconds apart: less than a quarter is there at any moment, and all were heard in 44
    // seconds.
    for t in 0..120 {
        wave.iter().enumerate().for_each(|(i, n)| rig.robots[*n].is_off = t % 44 != i * 4);
        rig.tick();
        if rig.rollout("ro").promoted == 1 {
            break;
        }
    }
    let verdict = rig.rollout("ro").verdicts.pop().expect("a verdict");
    assert_eq!((verdict.outcome, verdict.attempted), (Outcome::PromotedUnproven, 11));
    let clean = verdict.robots.outcomes.clean;
    assert!((1..11).contains(&clean), "{clean} of 11: not those that are dark");
}

#[test]
fn a_wave_that_is_dark_whole_is_waited_for_though_it_was_heard_at_its_gate() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { exposure_tasks: 1_000, exposure_within_ms: 60_000, ..spec() });
    let n = rig.order()[0];
    rig.until(60, |r| r.phase() == Phase::Gate);
    rig.ticks(25);
    rig.robots[n].is_off = true;
    rig.ticks(60);
    assert_eq!(rig.phase(), Phase::Gate, "its time is over, and nobody is there to be judged");
    rig.robots[n].is_off = false;
    rig.ticks(2);
    assert_eq!((rig.phase(), verdicts(&rig)[0].1), (Phase::Review, Code::NoExposure));
}
