//! Each way in which a roll-out of the story can be bad is one objection that names it.

use super::super::budget::Fullest;
use super::{OffWork, Played, Story, verdict};
use midshift_proto::ota::v1;

const ROBOTS: usize = 20;

/// One that nobody can object to.
fn played(is_good: bool) -> Played {
    Played {
        bundle: "walk 2.0.0".to_owned(),
        is_good,
        phase: if is_good { "COMPLETED" } else { "ABORTED" }.to_owned(),
        robots_that_ran_it: if is_good { ROBOTS } else { 2 },
        activated_after_abort: 0,
        begun_at_once_most: 2,
        touched_at_abort: (!is_good).then_some(2),
        touched: if is_good { 20 } else { 2 },
        canary: 2,
        off_work_most: 2,
        off_work_allowed: 2,
        areas: vec![Fullest { area_id: "hall".to_owned(), out: 2, may: 2 }],
        budget_broken: Vec::new(),
        kept_by: if is_good { ROBOTS } else { 0 },
        elsewhere: Vec::new(),
        verdicts: Vec::new(),
        abort: (!is_good).then(|| "BUNDLE_FAILS: it fails (r-1)".to_owned()),
        off_work: OffWork { parked_to_grant_ms: Some(5_000), ..OffWork::default() },
        wall_s: 60.0,
        tasks_per_hour: 900.0,
    }
}

type Break = fn(&mut Played);

#[test]
fn each_figure_that_is_wrong_is_one_objection_that_names_it() {
    let both: [(Break, &str); 4] = [
        (|p| p.budget_broken = vec!["hall: 3 robots were out of work".to_owned()], "hall: 3 robots were out of work"),
        (|p| p.areas.clear(), "nobody was seen to be taken out of work for it"),
        (|p| p.begun_at_once_most = 3, "new software began on 3 robots within one probation, 2 may"),
        (|p| p.elsewhere = vec!["r-7".to_owned()], "r-7 run something else"),
    ];
    let good: [(Break, &str); 5] = [
        (|p| p.phase = "PAUSED".to_owned(), "it is PAUSED and should be COMPLETED"),
        (|p| p.kept_by = 19, "19 of 20 robots keep it"),
        (|p| p.robots_that_ran_it = 19, "it ever ran on 19 of 20 robots"),
        (|p| p.off_work.parked_to_grant_ms = Some(5_001), "parked to permitted took 5001 ms"),
        (|p| p.off_work.parked_to_grant_ms = None, "parked to permitted took"),
    ];
    let bad: [(Break, &str); 7] = [
        (|p| p.phase = "COMPLETED".to_owned(), "it is COMPLETED and should be ABORTED"),
        (|p| p.abort = None, "it has no evidence"),
        (|p| p.touched = 3, "3 robots were touched, the canary has 2"),
        (|p| p.robots_that_ran_it = 3, "3 robots were touched, the canary has 2"),
        (|p| p.robots_that_ran_it = 0, "no body ever ran it"),
        (|p| p.activated_after_abort = 1, "1 activated it after the abort"),
        (|p| p.kept_by = 1, "1 robots keep it"),
    ];
    for (is_good, breaks) in [(true, both.iter().chain(&good)), (false, both.iter().chain(&bad))] {
        assert_eq!(played(is_good).objections(ROBOTS), Vec::<String>::new());
        for (spoil, told) in breaks {
            let mut spoiled = played(is_good);
            spoil(&mut spoiled);
            let why = spoiled.objections(ROBOTS);
            assert!(why.len() == 1 && why[0].starts_with("walk 2.0.0: ") && why[0].contains(told), "{told}: {why:?}");
        }
    }
}

#[test]
fn a_story_counts_robots_of_both_kinds_and_has_the_objections_of_all_its_roll_outs() {
    let mut story = Story {
        robots_in_process: 15,
        robots_launched: 5,
        body_speed: 5.0,
        tasks_per_hour_before: 1_000.0,
        acts: vec![played(true), played(false)],
    };
    assert_eq!(story.objections(), Vec::<String>::new());
    story.acts[0].kept_by = 19;
    story.acts[1].kept_by = 1;
    assert_eq!(story.objections().len(), 2);
    story.robots_launched = 4;
    assert_eq!(story.objections().len(), 2, "19 are all now, and it ran on one more");
}

#[test]
fn a_verdict_counts_waves_from_one() {
    let first = v1::RolloutVerdict { wave: 0, clean: 3, failed: 1, ..v1::RolloutVerdict::default() };
    let told = verdict(&first);
    assert!(told.starts_with("wave 1: ") && told.contains("n 4, failed 1"), "{told}");
}
