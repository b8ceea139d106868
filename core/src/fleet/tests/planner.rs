//! Rules of the planner: a person puts them, and the planner reads them.

use super::super::commands::{self, Command};
use super::*;
use crate::fleet::objects;
use crate::identity::{Caller, TokenId};
use crate::ids::SiteId;
use crate::planner_policy::{AssignmentPolicy, PlannerPolicy};
use crate::reason::{Code, Kind, Refusal};

fn put_policy(rig: &mut Rig, policy: PlannerPolicy, seen: Option<Revision>) -> Result<Plan, Refusal> {
    let command = Command::PutPlanner(policy);
    let Rig { view, board, now, .. } = rig;
    commands::check(view, board, now, &command, seen)?;
    let mut plan = Plan::default();
    plan.decide(view, *now, "ana", |tx| commands::apply(tx, board, &command, "ana"));
    Ok(plan)
}

#[test]
fn the_planner_has_its_default_until_a_person_puts_rules_and_those_from_then_on() {
    let mut rig = Rig::new();
    let default = PlannerPolicy::default_of(rig.view.site.site_id().clone());
    assert_eq!(rig.view.planner(), default);
    let new = PlannerPolicy { policy: AssignmentPolicy::FifoNearest, horizon_ms: 0, ..default };
    let plan = put_policy(&mut rig, new.clone(), Some(Revision(0))).expect("nobody ever put any");
    assert_eq!(rig.view.planner(), new);
    let [item] = plan.items.as_slice() else { panic!("{:?}", plan.items) };
    assert_eq!((item.rows[0].kind, item.rows[0].key.clone()), ("planner.policy_put", new.key()));
    let note = item.note.as_ref().expect("it is noted");
    assert_eq!((note.action, note.about.as_slice()), ("planner.put", &[format!("site:{}", new.site_id)][..]));
    assert_eq!(note.with["policy"], *new.body());
}

#[test]
fn rules_of_the_planner_that_moved_meanwhile_or_are_of_another_site_are_refused() {
    let mut rig = Rig::new();
    let default = PlannerPolicy::default_of(rig.view.site.site_id().clone());
    put_policy(&mut rig, default.clone(), None).expect("whatever it is");
    let moved = put_policy(&mut rig, default.clone(), Some(Revision(0))).expect_err("somebody was faster");
    assert_eq!((moved.kind(), moved.reason.code), (Kind::Conflict, Code::EtagMismatch));
    put_policy(&mut rig, default.clone(), Some(Revision(1))).expect("as it was seen");
    let elsewhere = SiteId::parse("elsewhere").expect("an id");
    let bad = put_policy(&mut rig, PlannerPolicy { site_id: elsewhere, horizon_ms: 60_001, ..default.clone() }, None);
    let fields: Vec<_> = bad.expect_err("not here").violations.into_iter().map(|v| v.field).collect();
    assert_eq!(fields, ["policy.site_id", "policy.horizon"]);
    assert_eq!(rig.view.planner(), default);
}

#[test]
fn a_right_in_one_area_is_not_enough_to_put_rules_of_the_planner() {
    let rig = Rig::new();
    let area = &rig.view.site.areas()[0].area_id;
    let command = Command::PutPlanner(PlannerPolicy::default_of(rig.view.site.site_id().clone()));
    for (grant, may) in [(format!("operator@{area}"), false), ("viewer".into(), false), ("operator".into(), true)] {
        let by = Caller::holder(TokenId::new("t1").expect("an id"), "ana".into(), [grant.clone().into()].into(), false);
        let answer = objects::permit(&rig.view, &rig.board, &by, &command);
        assert_eq!(answer.is_ok(), may, "{grant}");
        assert!(answer.err().is_none_or(|refused| refused.kind() == Kind::Denied), "{grant}");
    }
}

#[test]
fn rules_of_the_planner_of_a_newer_version_stand_aside_and_the_default_holds() {
    let mut rig = Rig::new();
    let default = PlannerPolicy::default_of(rig.view.site.site_id().clone());
    let put = PlannerPolicy { horizon_ms: 0, ..default.clone() };
    rig.absorb(&put);
    assert_eq!(rig.view.planner(), put);
    let body = put.body().replace("\"rolling\"", "\"by_auction\"");
    assert_ne!(body, *put.body());
    let row = Row { key: put.key(), revision: Revision(2), index: put.index(), body: body.into() };
    rig.view.absorb(&row.key, row.revision, Some(&row)).expect("kept aside");
    assert_eq!(rig.view.planner(), default);
    assert!(rig.view.unknown_rows.refusal_of([&row.key].into_iter()).is_some(), "nobody writes over it");
}
