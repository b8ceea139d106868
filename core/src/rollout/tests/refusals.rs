//! What robots refuse: each refusal keeps its meaning, and content that is not what was signed holds a roll-out.

use super::*;
use crate::rollout::judgement::refusals;
use crate::rollout::projection::rows::Pause;
use crate::rollout::robots::due;
use crate::rollout::robots::machine::Move;

fn is_held(rig: &Rig) -> bool {
    rig.rollout("ro").pauses.contains(&Pause::Content)
}

fn why(rig: &Rig, n: usize) -> Code {
    rig.robot_in("ro", n).why.expect("a reason").code
}

/// A robot that has the bundle finds that its bytes changed on its disk.
fn finds_other_bytes(rig: &mut Rig, n: usize) {
    let report = rig.robots[n].report.clone().expect("an update");
    let reason = Some(Code::BundleCorrupt.into());
    rig.report_update(n, UpdateReport { state: UpdateState::Refused, reason, ..report });
}

#[test]
fn a_refusal_keeps_its_code_and_holds_nothing_unless_it_speaks_of_the_content() {
    let mut rig = Rig::new(5);
    rig.start(spec());
    let (full, unfit) = (rig.order()[3], rig.order()[4]);
    (rig.robots[full].fate, rig.robots[unfit].fate) = (Fate::Refuses(Code::NoRoom), Fate::Unfit);
    rig.until(400, |r| r.phase() == Phase::Completed);
    assert_eq!((why(&rig, full), why(&rig, unfit)), (Code::NoRoom, Code::BundleUnfit));
    assert!(!rig.incidents().contains(&Code::ContentRefused), "neither speaks of the content");
}

#[test]
fn a_canary_that_gets_other_bytes_holds_the_roll_out_until_a_person_resumes_it_and_ends_nothing() {
    let mut rig = Rig::new(6);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Refuses(Code::BundleCorrupt);
    rig.ticks(60);
    let rollout = rig.rollout("ro");
    assert!(is_held(&rig) && rollout.phase.runs() && rollout.abort.is_none(), "{rollout:?}");
    assert_eq!((why(&rig, n), rig.ota.robots.values().any(|r| r.row.attempted)), (Code::BundleCorrupt, false));
    assert_eq!(rig.incidents(), [Code::ContentRefused], "it is told once");
    rig.must("ro", Verb::Resume);
    rig.until(400, |r| r.phase() == Phase::Completed);
    assert_eq!(rig.robots.iter().filter(|r| r.version == "2.0.0").count(), 5);
}

#[test]
fn behind_the_first_wave_two_robots_hold_it_and_after_a_resume_only_one_more_does() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { soak_ms: 600_000, ..spec() });
    let order = rig.order();
    rig.robots[order[3]].fate = Fate::Refuses(Code::BundleCorrupt);
    rig.until(60, |r| r.phase() == Phase::Soaking);
    assert_eq!((why(&rig, order[3]), is_held(&rig)), (Code::BundleCorrupt, false));
    finds_other_bytes(&mut rig, order[4]);
    rig.tick();
    assert!(is_held(&rig));
    rig.must("ro", Verb::Resume);
    rig.ticks(3);
    let seen = BTreeSet::from([robot_id(order[3]), robot_id(order[4])]);
    assert_eq!((is_held(&rig), rig.rollout("ro").refusals_seen), (false, seen), "a person has seen these two");
    finds_other_bytes(&mut rig, order[5]);
    rig.tick();
    assert!(is_held(&rig));
}

#[test]
fn a_person_has_seen_robots_and_not_so_many_of_them() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { soak_ms: 600_000, ..spec() });
    let order = rig.order();
    rig.robots[order[3]].fate = Fate::Refuses(Code::BundleCorrupt);
    rig.until(60, |r| r.phase() == Phase::Soaking);
    assert_eq!(why(&rig, order[3]), Code::BundleCorrupt);
    let seen = |n: usize| Rollout { refusals_seen: BTreeSet::from([robot_id(n)]), ..rig.rollout("ro") };
    assert_eq!(refusals::find_pause(&rig.ota, &seen(order[3])), None);
    // That one is tried once more, and refuses nothing at this moment.
    assert_eq!(refusals::find_pause(&rig.ota, &seen(order[4])), Some(Pause::Content), "nobody has seen the other");
}

#[test]
fn nobody_is_tried_again_while_the_roll_out_stands_still() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(5, |r| r.phase() == Phase::Applying);
    let rollout = Rollout { second_pass: true, ..rig.rollout("ro") };
    let refused = Some(Code::MetadataRefused.into());
    let r = RolloutRobot { step: Step::Skipped, why: refused, ..rig.robot_in("ro", rig.order()[1]) };
    let due = |rollout: &Rollout| due::decide_move(&rig.ota, &rig.board, &rig.now, rollout, &r);
    assert_eq!(due(&rollout), Some(Move::Again));
    let held = Rollout { pauses: BTreeSet::from([Pause::Content]), ..rollout };
    assert_eq!(due(&held), None, "its refusal would be forgotten, and the roll-out go on");
}
