//! Words about fixed messages, and what a wait comes to.

use super::follow::{Picture, Until, end};
use super::{create, look, parse, report, text};
use crate::pages::Listed;
use clap::Parser;
use midshift_core::reason::{Code, Reason};
use midshift_proto::convert::{duration, shown};
use midshift_proto::ota::v1::{self, GateOutcome, RolloutOutcome, RolloutPause, RolloutPhase, RolloutStep, Suspicion};
use prost_types::Timestamp;

fn at(seconds: i64) -> Option<Timestamp> {
    Some(Timestamp { seconds, nanos: 0 })
}

fn by(actor: &str, reason: &str, seconds: i64) -> Option<v1::RolloutAct> {
    Some(v1::RolloutAct { actor: actor.into(), reason: reason.into(), time: at(seconds) })
}

/// A first wave that came through and is unproven, a second one at work.
fn rollout() -> v1::Rollout {
    let first = v1::RolloutCounts { committed: 1, attempted: 1, ..Default::default() };
    let second = v1::RolloutCounts { staged: 1, draining: 1, trial: 1, attempted: 1, ..Default::default() };
    let all = v1::RolloutCounts {
        committed: 1,
        staged: 1,
        draining: 1,
        trial: 1,
        waiting: 8,
        skipped: 1,
        attempted: 2,
        ..Default::default()
    };
    let wave = |wave, counts, promoted| v1::RolloutWaveState { wave, counts: Some(counts), promoted };
    v1::Rollout {
        rollout_id: "walk-1.5.0".into(),
        spec: Some(v1::RolloutSpec {
            bundle: "ab".repeat(32),
            waves: ["1", "25%", "rest"].map(|w| parse::wave(w).unwrap()).into(),
            ..Default::default()
        }),
        bundle_label: "walk-1.5.0".into(),
        phase: RolloutPhase::Soaking as i32,
        wave: 1,
        in_flight: 1,
        soak_left: Some(duration(8_040)),
        verdicts: vec![unproven()],
        counts: Some(all),
        waves: vec![
            wave(0, first, true),
            wave(1, second, false),
            wave(2, v1::RolloutCounts { waiting: 8, skipped: 1, ..Default::default() }, false),
        ],
        skipped_by_reason: [("SKIPPED_OFFLINE".to_owned(), 1)].into(),
        created: by("anonymous", "", 0),
        approved: by("anonymous", "tried at home", 5),
        start_time: at(10),
        since: at(100),
        etag: "7".into(),
        ..Default::default()
    }
}

fn unproven() -> v1::RolloutVerdict {
    v1::RolloutVerdict {
        wave: 0,
        outcome: GateOutcome::PromotedUnproven as i32,
        reason: Some(shown(&Reason::from(Code::GateUnproven))),
        attempted: 1,
        clean: 1,
        upper_bound_permille: 950,
        log_ratio_micronats: -202_941,
        abort_micronats: 2_890_372,
        promote_micronats: -2_251_292,
        trial: Some(v1::TaskTally { succeeded: 2, failed: 0 }),
        control: Some(v1::TaskTally { succeeded: 40, failed: 1 }),
        e_value_milli: 951,
        time: at(90),
        ..Default::default()
    }
}

fn robot(id: &str, wave: u32, step: RolloutStep) -> v1::RolloutRobot {
    v1::RolloutRobot {
        rollout_id: "walk-1.5.0".into(),
        robot_id: id.into(),
        wave,
        step: step as i32,
        since: at(80),
        from_version: "1.4.0".into(),
        ..Default::default()
    }
}

fn draining() -> v1::RolloutRobot {
    v1::RolloutRobot {
        blocked_by: Some(shown(&Reason::from(Code::BlockedByDrain))),
        blocked_since: at(80),
        deadline: at(680),
        off_work: Some(v1::OffWork { drain_wait: Some(duration(12_300)), ..Default::default() }),
        drain_id: "walk-1.5.0/1".into(),
        ..robot("rbt-04", 1, RolloutStep::Draining)
    }
}

fn on_trial() -> v1::RolloutRobot {
    let off_work = v1::OffWork {
        drain_wait: Some(duration(4_000)),
        park_drive: Some(duration(61_000)),
        parked_to_grant: Some(duration(400)),
        switch: Some(duration(2_500)),
        probation: Some(duration(10_000)),
    };
    v1::RolloutRobot {
        attempted: true,
        trial: Some(v1::TaskTally { succeeded: 1, failed: 0 }),
        off_work: Some(off_work),
        ..robot("rbt-02", 1, RolloutStep::Trial)
    }
}

#[test]
fn the_tree_shows_each_wave_and_the_robots_that_are_on_their_way() {
    let robots =
        [draining(), on_trial(), robot("rbt-09", 1, RolloutStep::Staged), robot("rbt-01", 0, RolloutStep::Committed)];
    let mut waves = rollout().waves;
    waves[2].counts = Some(v1::RolloutCounts { staged: 8, ..Default::default() });
    let phase = RolloutPhase::Applying as i32;
    let rollout = v1::Rollout { phase, soak_left: None, skipped_by_reason: Default::default(), waves, ..rollout() };
    let mut lines = text::header(&rollout);
    lines.extend(text::tree(&rollout, robots.iter()));
    let expected = "\
walk-1.5.0  APPLYING  wave 2/3  bundle walk-1.5.0
  since 1970-01-01T00:01:40.000Z, 1 robot out of work
├─ wave 1/3: 1 robot, kept  1 committed
├─ wave 2/3: 3 robots  1 staged, 1 draining, 1 on trial
│    rbt-04  DRAINING  waits: WAITING_FOR_DRAIN
│    rbt-02  TRIAL, 1 tasks done, 0 failed
└─ wave 3/3: 8 robots  8 staged";
    assert_eq!(lines.join("\n"), expected);
}

#[test]
fn the_head_says_how_long_a_wave_is_watched_and_who_was_passed_over() {
    let expected = "\
walk-1.5.0  SOAKING  wave 2/3  bundle walk-1.5.0
  since 1970-01-01T00:01:40.000Z, 1 robot out of work, soak 8.0 s left
  skipped: 1 SKIPPED_OFFLINE";
    assert_eq!(text::header(&rollout()).join("\n"), expected);
}

#[test]
fn the_header_says_who_wants_rates_of_failures_to_end_it_as_long_as_they_may() {
    let said = |change: &dyn Fn(&mut v1::Rollout)| {
        let mut rollout = rollout();
        change(&mut rollout);
        text::header(&rollout).into_iter().find(|line| line.contains("rates of task failures"))
    };
    assert_eq!(said(&|_| {}), None);
    let areas = |r: &mut v1::Rollout| r.acts_on_rates_area_ids = vec!["dock".into(), "hall".into()];
    let by = "  rates of task failures end it too, ";
    assert_eq!(said(&areas), Some(format!("{by}by the rules of dock, hall")));
    let asked = |r: &mut v1::Rollout| r.spec.as_mut().unwrap().acts_on_rates = true;
    assert_eq!(said(&asked), Some(format!("{by}as was asked for")));
    let over = |r: &mut v1::Rollout| (r.phase, _) = (RolloutPhase::Completed as i32, asked(r));
    assert_eq!(said(&over), None);
}

#[test]
fn many_robots_of_one_wave_are_counted_and_not_listed() {
    let robots: Vec<_> = (0..30).map(|n| robot(&format!("rbt-{n:02}"), 1, RolloutStep::Trial)).collect();
    let lines = text::tree(&rollout(), robots.iter());
    assert_eq!(lines.len(), 3 + 12 + 1);
    assert_eq!(lines[14], "│    and 18 more");
}

#[test]
fn before_it_begins_the_tree_says_what_was_asked_for() {
    let draft = v1::Rollout {
        phase: RolloutPhase::Draft as i32,
        waves: Vec::new(),
        start_time: None,
        verdicts: Vec::new(),
        ..rollout()
    };
    let lines = text::tree(&draft, [].iter());
    assert_eq!(lines, ["├─ wave 1/3: 1", "├─ wave 2/3: 25%", "└─ wave 3/3: rest"]);
    assert_eq!(text::next(&draft), "midshift rollout submit walk-1.5.0");
    assert_eq!(&draft.row()[2..6], ["DRAFT", "-", "-", "0"]);
}

#[test]
fn an_unproven_verdict_says_what_is_known_and_no_more() {
    let known = "fewer than 95.0 % fail, with 95 % confidence";
    assert_eq!(
        text::verdict(&unproven(), 3),
        format!(
            "wave 1/3  PROMOTED_UNPROVEN  1 of 1 clean, 0 failed (1 attempted); unproven: of 1 robot, no more is known than that {known}"
        )
    );
    let evidence = text::evidence(&unproven());
    assert_eq!(evidence[1], "robots: log ratio -0.20 (aborts at 2.89, proven at -2.25)");
    let tasks = "tasks: on trial 2 done 0 failed, beside it 40 done 1 failed; E 0.951 of 20: nothing that chance does not explain";
    assert_eq!(evidence[2], tasks);
}

#[test]
fn an_abort_among_few_says_what_it_costs_a_good_bundle() {
    let verdict = v1::RolloutVerdict {
        outcome: GateOutcome::Aborted as i32,
        clean: 3,
        failed: 1,
        attempted: 5,
        upper_bound_permille: 752,
        false_abort_permille: Some(78),
        suspicion: Suspicion::Release as i32,
        actor: "eve".into(),
        ..unproven()
    };
    let told = text::verdict(&verdict, 3);
    assert!(told.contains("3 of 4 clean, 1 failed (5 attempted); fewer than 75.2 % fail"), "{told}");
    assert!(told.ends_with("; a good bundle is aborted like this 7.8 % of the time; by eve"), "{told}");
    assert!(text::evidence(&verdict)[2].ends_with("the release is suspected"));
}

#[test]
fn what_work_cost_on_trial_stands_beside_what_it_cost_the_others() {
    let effort = |tasks, ms, energy_mwh| v1::Effort {
        tasks,
        duration: Some(duration(ms)),
        path_mm: 2_000_000,
        energy_mwh,
        hottest_joint_decidegrees: 615,
    };
    let (trial, control) = (effort(10, 412_000, 600), effort(100, 3_900_000, 500));
    let verdict = v1::RolloutVerdict { trial_effort: Some(trial), control_effort: Some(control), ..unproven() };
    let told = "work: on trial 41.2 s a task, 300 mWh a km, joints up to 61.5 °C (n 10, 2.0 km); \
        beside it 39.0 s a task, 250 mWh a km, joints up to 61.5 °C (n 100, 2.0 km)";
    assert_eq!(text::evidence(&verdict).last().map(String::as_str), Some(told));
    assert_eq!(text::evidence(&unproven()).len(), 3, "nothing is said of no work");
}

#[test]
fn one_robot_is_explained_with_what_it_waits_for_and_until_when() {
    let waits = shown(&Reason::from(Code::BlockedByDrain)).message;
    let expected = format!(
        "\
rbt-04 in walk-1.5.0, wave 2/3: DRAINING since 1970-01-01T00:01:20.000Z
  waits for WAITING_FOR_DRAIN: {waits}
  since 1970-01-01T00:01:20.000Z, until 1970-01-01T00:11:20.000Z at most
  ran 1.4.0 before
  out of work: waiting for the drain 12.3 s
  drain walk-1.5.0/1"
    );
    assert_eq!(look::explanation(&rollout(), &draining()), expected);
}

#[test]
fn an_explanation_says_since_when_a_robot_is_lost_and_who_wrote_it_off() {
    let act = v1::RolloutAct { actor: "ana".into(), reason: "crushed".into(), time: at(95) };
    let lost = v1::RolloutRobot { lost: at(90), written_off: Some(act), deadline: None, ..draining() };
    let told = look::explanation(&rollout(), &lost);
    assert!(told.contains("  lost since ") && told.contains("as long as it takes"), "{told}");
    assert!(told.contains("  counts in no budget, written off by ana ") && told.contains("(crushed)"), "{told}");
}

#[test]
fn medians_are_of_each_part_alone_over_the_robots_that_have_it() {
    let robots = [draining(), on_trial(), robot("rbt-09", 1, RolloutStep::Staged)];
    let told = text::off_work_medians(robots.iter()).unwrap();
    let expected = "waiting for the drain 4.0 s (n 2), to its park 1 min 1 s (n 1), parked to permission 0.4 s (n 1), switch 2.5 s (n 1), probation 10.0 s (n 1)";
    assert_eq!(told, expected);
    assert_eq!(text::off_work_medians([robot("rbt-09", 1, RolloutStep::Staged)].iter()), None);
}

#[test]
fn a_watch_tells_each_change_once() {
    let mut picture = Picture::default();
    let message = |rollout, robots| v1::WatchRolloutResponse { rollout: Some(rollout), robots };
    let before = v1::Rollout { verdicts: Vec::new(), phase: RolloutPhase::Applying as i32, wave: 0, ..rollout() };
    let first = picture.note_changes(message(before.clone(), vec![draining()]));
    assert_eq!(first.len(), 2, "{first:?}");
    assert_eq!(first[0], "1970-01-01T00:01:20.000Z  rbt-04  DRAINING  waits: WAITING_FOR_DRAIN");
    assert!(
        first[1].starts_with("1970-01-01T00:01:40.000Z  walk-1.5.0  APPLYING  wave 1/3  8 waiting"),
        "{}",
        first[1]
    );
    // The same again, and a countdown: nothing to tell.
    let counted = v1::Rollout { soak_left: Some(duration(1)), ..before };
    assert_eq!(picture.note_changes(message(counted.clone(), vec![draining()])), Vec::<String>::new());
    // A task that ends on trial is told, once.
    let works = |succeeded| {
        let trial = Some(v1::TaskTally { succeeded, failed: 0 });
        v1::RolloutRobot { trial, ..robot("rbt-07", 1, RolloutStep::Trial) }
    };
    assert_eq!(picture.note_changes(message(counted.clone(), vec![works(0)])).len(), 1);
    assert_eq!(
        picture.note_changes(message(counted.clone(), vec![works(1)])),
        ["rbt-07  TRIAL, 1 tasks done, 0 failed"]
    );
    assert_eq!(picture.note_changes(message(counted, vec![works(1)])), Vec::<String>::new());
    let news = picture.note_changes(message(rollout(), vec![robot("rbt-04", 1, RolloutStep::Activating)]));
    assert_eq!(news.len(), 3, "{news:?}");
    assert!(news[1].contains("PROMOTED_UNPROVEN") && news[1].contains("fewer than 95.0 % fail"), "{}", news[1]);
    let paused = v1::Rollout { pauses: vec![RolloutPause::Operator as i32], ..rollout() };
    let news = picture.note_changes(message(paused.clone(), Vec::new()));
    assert!(news[0].contains("SOAKING, paused (OPERATOR)"), "{news:?}");
    assert_eq!(text::next(&paused), "midshift rollout resume walk-1.5.0");
    let held = v1::Rollout { pauses: vec![RolloutPause::Content as i32], ..rollout() };
    assert!(text::next(&held).ends_with("midshift rollout resume walk-1.5.0"), "{}", text::next(&held));
    assert!(picture.lines().last().unwrap().starts_with("last verdict: wave 1/3  PROMOTED_UNPROVEN"));
}

fn aborted(phase: RolloutPhase) -> v1::Rollout {
    let abort = v1::RolloutAbort {
        reason: Some(shown(&Reason::from(Code::RolloutAborted))),
        hard: true,
        robot_ids: vec!["rbt-02".into()],
        touched: 2,
        time: at(120),
        actor: String::new(),
    };
    v1::Rollout { phase: phase as i32, abort: Some(abort), ..rollout() }
}

#[test]
fn who_watches_a_bad_release_hears_which_robot_is_behind_its_end() {
    let rollout_id = "walk-1.6.0-bad-at-start".to_owned();
    let aborted = aborted(RolloutPhase::Aborted);
    let abort = v1::RolloutAbort {
        reason: Some(shown(&Reason::from(Code::FailureAmongFew))),
        hard: false,
        robot_ids: vec!["rbt-07".into()],
        touched: 1,
        ..aborted.abort.clone().unwrap()
    };
    let behind = "aborted: FAILURE_AMONG_FEW: A robot failed while fewer than ten were attempted., behind it rbt-07, 1 robot had permission by then";
    assert_eq!(text::abort(&abort), behind);
    let rollout = v1::Rollout { rollout_id, abort: Some(abort), ..aborted };
    let news = Picture::default()
        .note_changes(v1::WatchRolloutResponse { rollout: Some(rollout.clone()), robots: Vec::new() });
    let moved = "walk-1.6.0-bad-at-start  ABORTED  wave 2/3";
    assert!(news.iter().any(|line| line.contains(moved)), "{news:?}");
    let told = end(&rollout, Until::Ended).and_then(Result::err).unwrap().to_string();
    let expected = "\
walk-1.6.0-bad-at-start is ABORTED: FAILURE_AMONG_FEW: A robot failed while fewer than ten were attempted.
  try: midshift rollout get walk-1.6.0-bad-at-start";
    assert_eq!(told, expected);
}

#[test]
fn a_wait_ends_with_the_code_of_its_end() {
    let code = |rollout: &v1::Rollout, until| end(rollout, until).map(|e| e.map_or_else(|exit| exit.code(), |()| 0));
    let of = |phase: RolloutPhase| v1::Rollout { phase: phase as i32, ..rollout() };
    let both = |rollout: &v1::Rollout| [code(rollout, Until::Completed), code(rollout, Until::Ended)];
    assert_eq!(both(&rollout()), [None, None]);
    assert_eq!(both(&of(RolloutPhase::Completed)), [Some(0), Some(0)]);
    let short = v1::Rollout { outcome: RolloutOutcome::Incomplete as i32, ..of(RolloutPhase::Completed) };
    assert_eq!(both(&short), [Some(14), Some(14)]);
    assert_eq!(both(&of(RolloutPhase::Review)), [Some(11), None]);
    assert_eq!(both(&aborted(RolloutPhase::Aborting)), [Some(12), None]);
    assert_eq!(both(&aborted(RolloutPhase::RollingBack)), [Some(12), None]);
    assert_eq!(both(&aborted(RolloutPhase::Aborted)), [Some(12), Some(12)]);
    assert_eq!(both(&of(RolloutPhase::Superseded)), [Some(12), Some(12)]);
}

#[test]
fn history_is_in_order_and_says_who_did_what() {
    let robots = [v1::RolloutRobot { failure: Some(shown(&Reason::from(Code::RobotLost))), ..on_trial() }];
    let events = look::events(&aborted(RolloutPhase::Aborted), &robots);
    let whats: Vec<_> = events.iter().map(|e| e.what).collect();
    assert_eq!(whats, ["created", "approved", "started", "robot", "verdict", "phase", "aborted"]);
    assert_eq!(events[1].text, "approved by anonymous (tried at home)");
    assert!(events[6].text.starts_with("aborted at once: ROLLOUT_ABORTED: "), "{}", events[6].text);
}

/// A roll-out that ended early, by somebody who types what a page would obey, and its robots.
fn reported() -> (v1::Rollout, [v1::RolloutRobot; 2]) {
    let (trial, control) = (tally(3, 1), tally(40, 2));
    let approved = by("eve", "<script>alert(1)</script> & \"so\"", 5);
    let rollout = v1::Rollout { trial, control, approved, ..aborted(RolloutPhase::Aborted) };
    let failed = v1::RolloutRobot { failure: Some(shown(&Reason::from(Code::RobotLost))), ..on_trial() };
    (rollout, [failed, robot("rbt-09", 1, RolloutStep::Skipped)])
}

fn tally(succeeded: u64, failed: u64) -> Option<v1::TaskTally> {
    Some(v1::TaskTally { succeeded, failed })
}

#[test]
fn a_report_is_one_document_with_people_verdicts_robots_tasks_and_what_happened() {
    let (rollout, robots) = reported();
    let document = report::document(&rollout, &robots).unwrap();
    let said =
        |pointer: &str| document.pointer(pointer).map(|v| v.as_str().map_or_else(|| v.to_string(), str::to_owned));
    for (pointer, expected) in [
        ("/rollout/approved/actor", "eve"),
        ("/rollout/verdicts/0/clean", "1"),
        ("/rollout/abort/reason/code", "ROLLOUT_ABORTED"),
        ("/rollout/control/succeeded", "40"),
        ("/robots/0/robotId", "rbt-02"),
        ("/robots/0/failure/code", "ROBOT_LOST"),
        ("/events/0/what", "created"),
    ] {
        assert_eq!(said(pointer).as_deref(), Some(expected), "{pointer}");
    }
}

#[test]
fn a_page_says_the_same_and_what_somebody_typed_is_text_in_it() {
    let (rollout, robots) = reported();
    let page = report::page(&rollout, &robots);
    for part in [
        "<h1>Roll-out walk-1.5.0</h1>",
        "approved by eve",
        "&lt;script&gt;alert(1)&lt;/script&gt; &amp; &quot;so&quot;",
        "<td>PROMOTED_UNPROVEN</td><td>1</td><td>1</td><td>0</td>",
        "<td>rbt-02</td><td>wave 2/3</td><td>TRIAL</td>",
        "<td>rbt-09</td><td>wave 2/3</td><td>SKIPPED</td>",
        "on trial 3 done, 1 failed; beside it 40 done, 2 failed",
        "aborted at once: ROLLOUT_ABORTED",
    ] {
        assert!(page.contains(part), "{part} in {page}");
    }
    assert!(!page.contains("<script"), "{page}");
}

#[test]
fn a_plan_tells_waves_whom_it_leaves_out_and_what_to_mind() {
    let waves: Vec<_> = ["1", "rest"].map(|w| parse::wave(w).unwrap()).into();
    let offline = shown(&Reason::from(Code::SkippedOffline));
    let plan = v1::PlanRolloutResponse {
        wave_sizes: vec![1, 4],
        left_out_by_reason: [("SKIPPED_OFFLINE".to_owned(), 1)].into(),
        left_out: vec![v1::RolloutLeftOut { robot_id: "rbt-03".into(), reason: Some(offline.clone()) }],
        strata: vec![v1::RolloutStratum { model: "h1".into(), robots: 5, in_first_wave: true, ..Default::default() }],
        bytes: 1_048_576,
        least: Some(duration(720_000)),
        caveats: vec!["it is short".into()],
    };
    let expected = format!(
        "\
walk-1.5.0 would reach 5 robots
  wave 1/2: 1 robot  (1)
  wave 2/2: 4 robots  (rest)
  left out: 1 SKIPPED_OFFLINE
    rbt-03  SKIPPED_OFFLINE: {}
  each robot fetches at most 1048576 bytes; it takes 12 min 0 s of site time at least
  mind: it is short
MODEL  RUNS  AREA  CAN  ROBOTS  IN WAVE 1
h1     -     -     -    5       yes",
        offline.message
    );
    assert_eq!(create::describe_plan("walk-1.5.0", &waves, &plan), expected);
}

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    create: create::Create,
}

#[test]
fn flags_become_the_spec_and_what_no_flag_says_is_left_to_the_server() {
    let plain = Line::parse_from(["create", "walk-1.5.0"]).create.spec();
    assert_eq!(plain, v1::RolloutSpec { bundle: "walk-1.5.0".into(), ..Default::default() });
    let flags = "create trial --bundle walk-1.5.0 --waves 1,25%,rest --soak 10s --probation 1m --drain-within 2h --exposure-tasks 0 \
        --exposure-within 90s --max-in-flight 2 --area hall,dock --robot r1 --robot r2 --label site=north --model h1 --from-version 1.4.0 \
        --small-wave review --small-wave-failure review --abort-scope trial --allow-full-push --rate 5MiB --acts-on-rates \
        --complete-percent 75 --lost-after 1h --write-off-lost \
        --rollback-floor 3 --max-slower 20 --max-hotter 5";
    let spec = Line::parse_from(flags.split_whitespace()).create.spec();
    let expected = v1::RolloutSpec {
        bundle: "walk-1.5.0".into(),
        selector: Some(v1::RolloutSelector {
            robot_ids: vec!["r1".into(), "r2".into()],
            area_ids: vec!["hall".into(), "dock".into()],
            labels: [("site".to_owned(), "north".to_owned())].into(),
            models: vec!["h1".into()],
            versions: vec!["1.4.0".into()],
        }),
        waves: ["1", "25%", "rest"].map(|w| parse::wave(w).unwrap()).into(),
        max_in_flight: Some(2),
        drain_within: Some(duration(7_200_000)),
        probation: Some(duration(60_000)),
        soak: Some(duration(10_000)),
        exposure_tasks: Some(0),
        exposure_within: Some(duration(90_000)),
        small_wave: v1::SmallWave::Review as i32,
        small_wave_failure: v1::SmallWaveFailure::Review as i32,
        abort_scope: v1::AbortScope::Trial as i32,
        allow_full_push: true,
        rate_bytes_s: 5 << 20,
        acts_on_rates: true,
        complete_percent: Some(75),
        lost_after: Some(duration(3_600_000)),
        writes_off_lost: true,
        rollback_floor: 3,
        effort: Some(v1::EffortLimits {
            slower_permille: Some(200),
            energy_permille: None,
            hotter_decidegrees: Some(50),
        }),
    };
    assert_eq!(spec, expected);
}

#[test]
fn flags_that_contradict_each_other_are_refused() {
    let parse = |flags: &str| Line::try_parse_from(flags.split_whitespace()).is_ok();
    assert!(parse("create a --start --supersede"));
    for bad in [
        "create a --dry-run --start",
        "create a --supersede",
        "create a --waves 1,,rest",
        "create a --soak 10",
        "create a --rate fast",
    ] {
        assert!(!parse(bad), "{bad}");
    }
}
