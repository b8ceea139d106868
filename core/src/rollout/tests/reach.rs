//! Who may ask what about roll-outs: robots 0 to 3 stand in the hall, 4 to 7 in the quality room.

use super::*;
use crate::identity::{Caller, TokenId};
use crate::reason::Kind;
use crate::rollout::objects;
use crate::rollout::requests::{Ask, CheckOnly};
use crate::rollout::rows::Act;

fn holder(name: &str, grants: &[&str]) -> Caller {
    let grants = grants.iter().map(|grant| (*grant).to_owned().into()).collect();
    Caller::holder(TokenId::new("t1").expect("an id"), name.into(), grants, false)
}

fn verb(rollout: &str, verb: Verb) -> Command {
    Command::Do { rollout_id: rollout_id(rollout), verb, reason: "because".into() }
}

fn create(rollout: &str, areas: &[&str]) -> Command {
    let mut spec = spec();
    spec.selector.areas = areas.iter().map(|area| AreaId::parse(area).expect("an id")).collect();
    Command::Create { rollout_id: rollout_id(rollout), spec: Arc::new(spec) }
}

impl Rig {
    fn rooms() -> Self {
        let mut rig = Self::new(8);
        (4..8).for_each(|n| rig.robots[n].at = "Q01");
        rig.ticks(2);
        rig
    }

    fn by(&mut self, by: &Caller, command: &Command) -> Result<(), (Kind, Code)> {
        self.ota_turn();
        let mut taken = Ok(());
        let (check_only, by) = (CheckOnly::No, by.clone());
        let ask = Ask { command: command.clone(), seen: None, check_only, request_id: None, by };
        self.ota_plan(|rig, plan| {
            taken = decide_request(&mut rig.ota, &rig.board, rig.now, &ask, plan).map(drop);
        });
        taken.map_err(|refusal| (refusal.kind(), refusal.reason.code))
    }
}

#[test]
fn whoever_may_not_leaves_that_in_the_audit_and_who_only_checks_or_sees_nothing_leaves_nothing() {
    let mut rig = Rig::rooms();
    let (anna, blind) = (holder("anna", &["ota-author", "ota-approver"]), holder("ben", &["ota-approver@quality"]));
    rig.by(&anna, &create("ro", &["hall"])).expect("she is an author");
    rig.by(&anna, &verb("ro", Verb::Submit)).expect("she is an author");
    let approve = verb("ro", Verb::Approve);
    let mut left = |by: &Caller, check_only| {
        let (command, by) = (approve.clone(), by.clone());
        let request_id = Some("q1".to_owned());
        let ask = Ask { command, seen: None, check_only, request_id, by };
        let mut plan = Plan::default();
        let taken = decide_request(&mut rig.ota, &rig.board, rig.now, &ask, &mut plan);
        assert!(taken.is_err());
        let told = plan.items.iter().map(|item| {
            assert!(item.rows.is_empty(), "it says that alone");
            let note = item.note.as_ref().expect("a note");
            (note.action, item.actor.to_string(), note.about.clone(), note.refused)
        });
        told.collect::<Vec<_>>()
    };
    let row = ("rollout.approve", "anna".to_owned(), vec!["rollout:ro".to_owned()], Some(Code::NotYourOwn));
    assert_eq!(left(&anna, CheckOnly::No), [row]);
    assert_eq!(left(&holder("carl", &["viewer"]), CheckOnly::No).len(), 1);
    assert_eq!(left(&anna, CheckOnly::Yes), []);
    assert_eq!(left(&blind, CheckOnly::No), [], "to him it is not there");
}

const DENIED: Result<(), (Kind, Code)> = Err((Kind::Denied, Code::NotPermitted));
const MISSING: Result<(), (Kind, Code)> = Err((Kind::NotFound, Code::RolloutNotFound));

#[test]
fn whoever_wrote_a_roll_out_does_not_approve_it_and_where_nobody_signs_in_everybody_does() {
    let mut rig = Rig::rooms();
    let both = ["ota-author", "ota-approver"];
    let (anna, ben) = (holder("anna", &both), holder("ben", &both));
    rig.by(&anna, &create("ro", &[])).expect("she is an author");
    rig.by(&anna, &verb("ro", Verb::Submit)).expect("she is an author");
    let approve = verb("ro", Verb::Approve);
    assert_eq!(rig.by(&anna, &approve), Err((Kind::Denied, Code::NotYourOwn)));
    assert_eq!(rig.rollout("ro").phase, Phase::Validated);
    assert_eq!(rig.by(&holder("carl", &["ota-author"]), &approve), DENIED);
    rig.by(&ben, &approve).expect("somebody else");
    let Rollout { created, approved, .. } = rig.rollout("ro");
    assert_eq!((created.actor, approved.map(|Act { actor, .. }| actor)), ("anna".to_owned(), Some("ben".to_owned())));
    let local = Caller::local();
    rig.by(&local, &create("own", &[])).expect("nobody signs in");
    rig.by(&local, &verb("own", Verb::Submit)).expect("nobody signs in");
    rig.by(&local, &verb("own", Verb::Approve)).expect("there is nobody else");
}

#[test]
fn a_person_does_not_approve_by_one_token_what_it_wrote_by_another() {
    let mut rig = Rig::rooms();
    let both = ["ota-author", "ota-approver"];
    let of = |name: &str, person: &str| holder(name, &both).with_person(Some(person.into()));
    let laptop = of("laptop", "anna");
    rig.by(&laptop, &create("ro", &[])).expect("she is an author");
    rig.by(&laptop, &verb("ro", Verb::Submit)).expect("she is an author");
    let approve = verb("ro", Verb::Approve);
    // A token without a person is a person of its name.
    for own in [&of("phone", "anna"), &holder("anna", &both)] {
        assert_eq!(rig.by(own, &approve), Err((Kind::Denied, Code::NotYourOwn)));
    }
    rig.by(&of("anna-s-desk", "ben"), &approve).expect("another person");
    let Rollout { created, approved, .. } = rig.rollout("ro");
    assert_eq!((created.actor.as_str(), created.person()), ("laptop", "anna"));
    assert_eq!(approved.map(|act| act.person().to_owned()).as_deref(), Some("ben"));
}

#[test]
fn a_full_push_is_a_right_of_its_own_in_each_area_that_it_is_for() {
    let mut rig = Rig::rooms();
    let push = |id: &str| {
        let Command::Create { rollout_id, spec } = create(id, &["hall"]) else { panic!("it creates") };
        let spec = RolloutSpec { waves: vec![Wave::Rest], allow_full_push: true, ..RolloutSpec::clone(&spec) };
        Command::Create { rollout_id, spec: Arc::new(spec) }
    };
    assert_eq!(rig.by(&holder("anna", &["ota-author"]), &push("a")), DENIED);
    assert_eq!(rig.by(&holder("anna", &["ota-author", "ota-full-push@quality"]), &push("a")), DENIED);
    assert_eq!(rig.by(&holder("ben", &["ota-full-push"]), &push("a")), DENIED, "nor is it to write one");
    assert_eq!(rig.by(&holder("carl", &["ota-author", "ota-full-push@hall"]), &push("a")), Ok(()));
    assert_eq!(rig.by(&holder("anna", &["ota-author"]), &create("b", &["hall"])), Ok(()), "waves need no more");
}

#[test]
fn a_roll_out_is_for_whoever_may_in_all_areas_that_it_is_for() {
    let mut rig = Rig::rooms();
    let anna = holder("anna", &["ota-author@hall", "viewer@quality"]);
    let blind = holder("ben", &["ota-author@hall"]);
    for areas in [&["quality"][..], &["hall", "quality"], &[]] {
        assert_eq!(rig.by(&anna, &create("no", areas)), DENIED, "{areas:?}");
    }
    rig.by(&anna, &create("hall", &["hall"])).expect("her area");
    rig.by(&Caller::local(), &create("quality", &["quality"])).expect("everything");
    rig.by(&Caller::local(), &create("site", &[])).expect("everything");
    for (id, hers, his) in [("hall", Ok(()), Ok(())), ("quality", DENIED, MISSING), ("site", MISSING, MISSING)] {
        assert_eq!(rig.by(&anna, &verb(id, Verb::Submit)), hers, "{id}");
        assert_eq!(rig.by(&blind, &verb(id, Verb::Submit)), his, "{id}");
        let is_seen = |by: &Caller, rig: &Rig| objects::find_seen(&rig.ota, by, &rollout_id(id)).is_ok();
        assert_eq!((is_seen(&anna, &rig), is_seen(&blind, &rig)), (hers != MISSING, his != MISSING), "{id}");
        let rollback = Command::Rollback { of: rollout_id(id), rollout_id: rollout_id("back") };
        let refused = rig.by(&blind, &rollback);
        assert_eq!(refused == MISSING, his == MISSING, "{id}: {refused:?}");
    }
    assert_eq!(rig.by(&blind, &verb("never", Verb::Submit)), MISSING);
}

#[test]
fn a_roll_out_in_whose_place_another_begins_must_be_in_reach_too() {
    let mut rig = Rig::rooms();
    let local = Caller::local();
    let begin = |rig: &mut Rig, id: &str, areas: &[&str], by: &Caller, supersede: bool| {
        rig.by(&local, &create(id, areas)).expect("everything");
        rig.by(&local, &verb(id, Verb::Submit)).expect("everything");
        rig.by(&local, &verb(id, Verb::Approve)).expect("everything");
        rig.by(by, &verb(id, Verb::Start { supersede }))
    };
    assert_eq!(begin(&mut rig, "everywhere", &[], &local, false), Ok(()));
    assert_eq!(begin(&mut rig, "hall", &["hall"], &holder("anna", &["ota-author@hall"]), true), DENIED);
    assert!(rig.rollout("everywhere").phase.runs(), "it goes on");
    assert_eq!(rig.by(&holder("ben", &["ota-author"]), &verb("hall", Verb::Start { supersede: true })), Ok(()));
}

#[test]
fn software_of_a_robot_is_for_whoever_may_where_it_stands() {
    let mut rig = Rig::rooms();
    let pin = |n: usize| Command::Pin { robot_id: robot_id(n), reason: "a fair".into() };
    let anna = holder("anna", &["ota-author@hall", "viewer@quality"]);
    let blind = holder("ben", &["ota-author@hall"]);
    let missing = Err((Kind::NotFound, Code::RobotNotFound));
    assert_eq!([rig.by(&anna, &pin(5)), rig.by(&blind, &pin(5)), rig.by(&blind, &pin(99))], [DENIED, missing, missing]);
    rig.by(&anna, &pin(0)).expect("her area");
    assert_eq!(rig.ota.software_of(&robot_id(0)).pin.map(|pin| pin.actor), Some("anna".to_owned()));
    assert_eq!(rig.by(&blind, &Command::Unpin { robot_id: robot_id(5) }), missing);
    let unstick = |n: usize| Command::Unstick { robot_id: robot_id(n), reason: "mended".into() };
    let not_stuck = Err((Kind::Precondition, Code::NotStuck));
    assert_eq!([rig.by(&anna, &unstick(5)), rig.by(&anna, &unstick(0))], [DENIED, not_stuck]);
    assert_eq!(rig.by(&blind, &unstick(5)), missing);
    let sees = |by: &Caller, n: usize| objects::sees_robot(&rig.ota, &rig.board, by, &robot_id(n));
    assert_eq!([sees(&blind, 0), sees(&blind, 5), sees(&anna, 5)], [true, false, true]);
    let revoke = Command::Revoke { bundle: bundle_id(3), reason: "leaks".into() };
    assert_eq!(rig.by(&anna, &revoke), DENIED, "a bundle is the site's");
    let accept = |n: usize| Command::AcceptKey { robot_id: robot_id(n), device_key: "ab".repeat(32) };
    assert_eq!(
        rig.by(&holder("carl", &["ota-author"]), &accept(0)),
        DENIED,
        "who a machine is is no matter of software"
    );
    let admin = holder("dora", &["admin"]);
    assert_eq!((rig.by(&admin, &accept(99)), rig.by(&admin, &accept(0))), (missing, Ok(())));
    assert_eq!(rig.ota.software_of(&robot_id(0)).device_key, Some("ab".repeat(32)));
}
