//! What people may ask of a roll-out in which phase, and that asking twice does it once.

use super::*;

fn code(result: Result<bool, Refusal>) -> Code {
    result.expect_err("it is refused").reason.code
}

#[test]
fn a_roll_out_goes_from_draft_to_its_first_wave_by_the_verbs_of_people() {
    let mut rig = Rig::new(4);
    rig.create("ro", spec());
    for (verb, phase) in [
        (Verb::Submit, Phase::Validated),
        (Verb::Approve, Phase::Approved),
        (Verb::Start { supersede: false }, Phase::Prefetching),
    ] {
        rig.fleet_sleeps = true;
        let before = rig.phase();
        for other in [Verb::Promote, Verb::Pause, Verb::Resume, Verb::RetryFailed] {
            assert_eq!(code(rig.verb("ro", other)), Code::NotAllowedNow);
        }
        assert_eq!(rig.phase(), before);
        rig.must("ro", verb.clone());
        assert!(rig.phase() >= phase);
        assert!(rig.verb("ro", verb).expect("done before"));
    }
    let rollout = rig.rollout("ro");
    assert_eq!(rollout.approved.map(|a| (a.actor, a.reason)), Some(("ana".into(), "because".into())));
    assert!(rollout.started.is_some());
}

#[test]
fn an_id_is_used_once_and_the_same_request_twice_is_one() {
    let mut rig = Rig::new(4);
    rig.create("ro", spec());
    let same = Command::Create { rollout_id: rollout_id("ro"), spec: Arc::new(spec()) };
    assert!(rig.ask(&same).expect("done before"));
    let other = RolloutSpec { bundle: bundle_id(3), ..spec() };
    let other = Command::Create { rollout_id: rollout_id("ro"), spec: Arc::new(other) };
    assert_eq!(code(rig.ask(&other)), Code::RolloutIdTaken);
    let gone = RolloutSpec { bundle: bundle_id(9), ..spec() };
    let gone = Command::Create { rollout_id: rollout_id("x"), spec: Arc::new(gone) };
    assert_eq!(code(rig.ask(&gone)), Code::BundleNotFound);
    assert_eq!(code(rig.verb("nobody", Verb::Start { supersede: false })), Code::RolloutNotFound);
}

#[test]
fn a_stale_etag_is_refused_and_the_newest_is_not() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(60, |r| r.phase() == Phase::Soaking);
    let revision = Revision(rig.ota.rollouts["ro"].row.version);
    let abort = Command::Do { rollout_id: rollout_id("ro"), verb: Verb::Abort, reason: String::new() };
    let ask = |rig: &Rig, seen| check_command(&rig.ota, &rig.board, &abort, Some(seen));
    assert!(ask(&rig, Revision(revision.0 - 1)).is_err());
    assert!(ask(&rig, revision).is_ok());
}

#[test]
fn a_bundle_that_is_taken_back_pauses_its_roll_outs_and_one_that_is_listed_again_lets_them_go_on() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(60, |r| r.phase() == Phase::Soaking);
    let revoked = BTreeSet::from([crate::rollout::projection::rows::Pause::Revoked]);
    rig.put_row(Bundle { listed: false, ..bundle(2) });
    rig.ticks(2);
    assert_eq!(rig.rollout("ro").pauses, revoked);
    rig.put_row(bundle(2));
    rig.ticks(2);
    assert!(rig.rollout("ro").pauses.is_empty());
    rig.ask(&Command::Revoke { bundle: bundle_id(2), reason: "leaks".into() }).expect("allowed");
    rig.ticks(100);
    assert_eq!((rig.rollout("ro").pauses, rig.phase()), (revoked, Phase::Soaking));
    assert_eq!(rig.count(Step::Staged), 3, "no new drain");
    assert_eq!(code(rig.verb("ro", Verb::Resume)), Code::NotAllowedNow);
    rig.must("ro", Verb::Abort);
    rig.until(60, |r| r.phase() == Phase::Aborted);
}

#[test]
fn nothing_is_promoted_while_it_stands_still() {
    let mut rig = Rig::new(3);
    rig.start(RolloutSpec { soak_ms: 60_000, ..spec() });
    rig.until(60, |r| r.phase() == Phase::Soaking);
    rig.must("ro", Verb::Pause);
    assert_eq!(code(rig.verb("ro", Verb::Promote)), Code::NotAllowedNow);
    rig.must("ro", Verb::Resume);
    rig.must("ro", Verb::Promote);
    rig.until(200, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    assert_eq!(rig.count(Step::Committed), 3, "none stays on trial");
}

#[test]
fn a_pause_raises_the_generation_and_so_do_a_resume_and_an_abort() {
    let mut rig = Rig::new(3);
    rig.start(spec());
    let mut last = rig.rollout("ro").generation;
    for verb in [Verb::Pause, Verb::Resume, Verb::Abort] {
        rig.must("ro", verb);
        assert!(rig.rollout("ro").generation > last);
        last = rig.rollout("ro").generation;
    }
}
