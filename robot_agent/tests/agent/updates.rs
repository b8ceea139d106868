//! What a robot does with its software: take it, stage it, run it on trial, keep it or go back; and what it does not
//! take.

use crate::release::{Bundle, Releases};
use crate::rig::{Rig, action, place_id};
use midshift_agent::body::BodyNews;
use midshift_agent::core::{ExitReason, Input};
use midshift_agent::sets::Sets;
use midshift_agent::switch::Switch;
use midshift_agent::update::Job;
use midshift_bundle::manifest::SafetyClass;
use midshift_core::ids::DrainId;
use midshift_core::reason::Code;
use midshift_core::robot::{Fault, FaultClass, HardwareStop, Load, Mode};
use midshift_core::robot_events::RobotEvent;
use midshift_core::step::Effect;
use midshift_core::update::{ActivationGrant, DesiredUpdate, Goal, UpdateEvent, UpdateReport, UpdateState};
use midshift_proto::session::Downlink;

/// Milliseconds of site time on probation.
const PROBATION_MS: u64 = 10_000;

pub fn drain(name: &str) -> DrainId {
    DrainId::parse(name).expect("a name")
}

/// The server's side of one update.
#[derive(Clone)]
pub struct Order {
    directive: String,
    pub generation: u64,
    pub drain_id: Option<DrainId>,
    granted: u64,
}

impl Order {
    pub fn new(directive: String) -> Self {
        Self { directive, generation: 100, drain_id: None, granted: 0 }
    }
    pub fn to(&mut self, goal: Goal) -> DesiredUpdate {
        self.generation += 1;
        DesiredUpdate {
            robot_id: midshift_core::ids::RobotId::parse("rbt-01").expect("a name"),
            generation: self.generation,
            goal,
            directive: self.directive.clone(),
            drain_id: self.drain_id.clone(),
            grant: None,
            rate_bytes_s: 0,
            probation_ms: PROBATION_MS,
        }
    }
}

pub fn want(rig: &mut Rig, desired: DesiredUpdate) {
    rig.down(Downlink { update: Some(desired), ..Downlink::default() });
}

/// The server takes the robot out of work, and gives it back.
pub fn maintain(rig: &mut Rig, drain_id: Option<&DrainId>) {
    let mut work = rig.desired(None);
    work.maintenance = drain_id.cloned();
    rig.work(work);
}

pub fn report(rig: &Rig) -> Option<UpdateReport> {
    rig.store.memory().expect("loaded").ledger.software.report(0)
}

pub fn state(rig: &Rig) -> Option<UpdateState> {
    report(rig).map(|r| r.state)
}

pub fn why(rig: &Rig) -> Option<Code> {
    report(rig)?.reason.map(|r| r.code)
}

pub fn switch(rig: &Rig) -> Switch {
    rig.updates.as_ref().expect("has them").sets.clone().holdings().expect("tells").switch
}

pub fn refused(rig: &Rig) -> Vec<Code> {
    let code = |e: &RobotEvent| match e {
        RobotEvent::Update(UpdateEvent::DirectiveRefused { reason, .. }) => Some(reason.code),
        _ => None,
    };
    rig.events.iter().filter_map(code).collect()
}

fn asked(rig: &Rig) -> usize {
    rig.events.iter().filter(|e| matches!(e, RobotEvent::Update(UpdateEvent::Ready { .. }))).count()
}

/// A robot that is connected, and a repository.
pub fn connected() -> (Rig, Releases) {
    let releases = Releases::new();
    let mut rig = Rig::updatable(&releases);
    rig.connect();
    (rig, releases)
}

/// Brings a bundle onto the disk.
pub fn stage(rig: &mut Rig, releases: &Releases, bundle: &Bundle, generation: u64) -> Order {
    let mut order = Order::new(releases.directive(bundle, generation));
    order.generation = generation * 100;
    want(rig, order.to(Goal::Stage));
    order
}

/// A bundle staged by the first directive, and a drain in which it may be activated.
fn stage_in_drain(rig: &mut Rig, releases: &Releases, bundle: &Bundle) -> Order {
    let mut order = stage(rig, releases, bundle, 1);
    order.drain_id = Some(drain("drain-1"));
    maintain(rig, Some(&drain("drain-1")));
    order
}

/// Drains the robot, lets it ask, and grants.
pub fn activate(rig: &mut Rig, order: &mut Order, name: &str) {
    order.drain_id = Some(drain(name));
    maintain(rig, order.drain_id.clone().as_ref());
    want(rig, order.to(Goal::Activate));
    grant(rig, order, 5_000);
}

fn grant(rig: &mut Rig, order: &mut Order, valid_ms: u64) {
    order.granted += 1;
    let authority = rig.authority(valid_ms);
    let grant_id = order.generation * 10 + order.granted;
    let mut desired = order.to(Goal::Activate);
    desired.grant = Some(ActivationGrant { grant_id, drain_id: desired.drain_id.clone().expect("a drain"), authority });
    want(rig, desired);
}

/// The program ended to switch; the launcher starts the one of the record.
pub fn relaunch(rig: Rig) -> Rig {
    assert_eq!(rig.exit, Some(ExitReason::Switched), "{:?}", report(&rig));
    let mut rig = rig.restart();
    rig.connect();
    rig
}

/// Runs a bundle to its trial.
pub fn on_trial(rig: Rig, releases: &Releases, bundle: &Bundle, generation: u64) -> (Rig, Order) {
    let mut rig = rig;
    let mut order = stage(&mut rig, releases, bundle, generation);
    assert_eq!(state(&rig), Some(UpdateState::Staged), "{:?}", report(&rig));
    activate(&mut rig, &mut order, &format!("drain-{generation}"));
    let mut rig = relaunch(rig);
    assert_eq!(state(&rig), Some(UpdateState::Probation));
    maintain(&mut rig, order.drain_id.as_ref());
    rig.pass(PROBATION_MS + 1_000);
    assert_eq!(state(&rig), Some(UpdateState::Trial), "{:?}", report(&rig));
    (rig, order)
}

pub fn committed(rig: Rig, releases: &Releases, bundle: &Bundle, generation: u64) -> Rig {
    let (mut rig, mut order) = on_trial(rig, releases, bundle, generation);
    maintain(&mut rig, None);
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!(state(&rig), Some(UpdateState::Committed));
    rig
}

pub fn name_of(rig: &Rig) -> String {
    report(rig).and_then(|r| r.set).expect("a set").to_string()
}

#[test]
fn a_bundle_is_staged_while_the_robot_works_run_in_a_drain_and_kept() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    rig.work(rig.desired(Some(rig.offer("T1", 1, vec![action("pick", Effect::Repeatable)], vec![]))));
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    assert_eq!(state(&rig), Some(UpdateState::Staged));
    assert!(rig.body.log().acting.is_some(), "it works on");
    assert_eq!(switch(&rig), Switch::default(), "what runs is untouched");
    want(&mut rig, order.to(Goal::Activate));
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::Staged), None), "it has a task");
    rig.body.done();
    rig.pass(1_000);
    let rig = {
        activate(&mut rig, &mut order, "drain-1");
        relaunch(rig)
    };
    let set = name_of(&rig);
    assert_eq!((switch(&rig).running(), switch(&rig).kept()), (set.as_str(), Some("factory")));
    let mut rig = rig;
    maintain(&mut rig, order.drain_id.as_ref());
    rig.pass(PROBATION_MS + 1_000);
    assert!(switch(&rig).trial.is_some_and(|t| t.is_proven));
    assert!(rig.reported.as_ref().is_some_and(|r| r.update.as_ref().is_some_and(|u| u.state == UpdateState::Trial)));
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!(state(&rig), Some(UpdateState::Committed));
    let committed = switch(&rig);
    assert_eq!(
        (committed.running(), committed.kept(), committed.trial.as_ref()),
        (set.as_str(), Some("factory"), None)
    );
}

#[test]
fn work_is_refused_on_probation_and_taken_on_trial() {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut rig = rig;
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    activate(&mut rig, &mut order, "drain-1");
    let mut rig = relaunch(rig);
    rig.work(rig.desired(Some(rig.offer("T1", 1, vec![action("pick", Effect::Repeatable)], vec![]))));
    assert_eq!(rig.refusals(), ["IN_MAINTENANCE"]);
    rig.pass(PROBATION_MS + 1_000);
    rig.work(rig.desired(Some(rig.offer("T1", 2, vec![action("pick", Effect::Repeatable)], vec![]))));
    assert_eq!(rig.refusals(), [] as [String; 0]);
    assert!(rig.body.log().acting.is_some());
}

#[test]
fn another_robots_directive_an_older_one_a_strangers_and_an_expired_one_install_nothing() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let other = midshift_core::ids::RobotId::parse("rbt-02").expect("a name");
    let expired = midshift_core::time::Utc(1);
    for (n, bad) in [
        releases.directive_as(&bundle, 5, |d| d.robot_id = other),
        releases.directive_as(&bundle, 5, |d| d.expires = expired),
        Releases::new().directive_as(&bundle, 5, |d| d.generation = 0),
        "{}".to_owned(),
    ]
    .into_iter()
    .enumerate()
    {
        let mut order = Order::new(bad);
        order.generation += n as u64;
        want(&mut rig, order.to(Goal::Stage));
        assert_eq!(refused(&rig).len(), n + 1);
        assert_eq!((refused(&rig)[n], state(&rig)), (Code::DirectiveRefused, None));
    }
    let mut rig = committed(rig, &releases, &bundle, 7);
    let before = refused(&rig).len();
    let older = releases.release("1.2.0");
    let mut order = Order::new(releases.directive(&older, 6));
    order.generation = 10_000;
    want(&mut rig, order.to(Goal::Stage));
    assert_eq!((refused(&rig).len(), state(&rig)), (before + 1, Some(UpdateState::Committed)));
    assert_eq!(releases.served(), bundle_bytes(&bundle));
}

fn bundle_bytes(bundle: &Bundle) -> u64 {
    bundle.length + bundle.manifest.length()
}

#[test]
fn a_bundle_that_no_release_lists_is_not_taken_whatever_the_directive_says() {
    let (mut rig, releases) = connected();
    let stranger = Releases::new().release("6.6.6");
    let mut order = Order::new(releases.directive(&stranger, 1));
    want(&mut rig, order.to(Goal::Stage));
    assert_eq!((refused(&rig), state(&rig), releases.served()), (vec![Code::DirectiveRefused], None, 0));
    let bundle = releases.release("1.1.0");
    let mut order = Order::new(releases.directive_as(&bundle, 2, |d| d.manifest_length += 1));
    order.generation += 10;
    want(&mut rig, order.to(Goal::Stage));
    assert_eq!((refused(&rig).len(), state(&rig), releases.served()), (2, None, 0), "a length that lies");
}

#[test]
fn what_does_not_fit_the_robot_is_refused_before_its_bytes_come() {
    let (mut rig, releases) = connected();
    let wrong = releases.release_as("1.1.0", |m| m.components[0].hardware = ["other".to_owned()].into());
    stage(&mut rig, &releases, &wrong, 1);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleUnfit)));
    let safety = releases.release_as("1.2.0", |m| m.components[1].safety_class = SafetyClass::Related);
    stage(&mut rig, &releases, &safety, 2);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleUnfit)));
    let below = releases.release("1.3.0");
    let mut order = Order::new(releases.directive_as(&below, 3, |d| d.rollback_floor = 1));
    order.generation = 300;
    want(&mut rig, order.to(Goal::Stage));
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleUnfit)));
    assert_eq!(releases.served(), wrong.length + safety.length + below.length, "only manifests came");
    let good = releases.release("1.4.0");
    committed(rig, &releases, &good, 4);
}

#[test]
fn a_robot_without_room_for_a_bundle_and_its_longest_file_as_it_comes_says_so_and_keeps_what_it_has() {
    for missing in [1, 0] {
        let (mut rig, releases) = connected();
        let bundle = releases.release("1.1.0");
        let lengths = bundle.manifest.components.iter().map(|c| c.length);
        let needed = lengths.clone().sum::<u64>() + lengths.max().expect("a program");
        rig.updates.as_ref().expect("has them").sets.limit(needed - missing);
        rig.pass(130_000);
        stage(&mut rig, &releases, &bundle, 1);
        let refused = (Some(UpdateState::Refused), Some(Code::NoRoom));
        let expected = if missing > 0 { refused } else { (Some(UpdateState::Staged), None) };
        assert_eq!((state(&rig), why(&rig)), expected, "{missing}");
        assert_eq!(switch(&rig), Switch::default());
    }
}

#[test]
fn the_room_for_software_is_told_when_it_has_changed_by_a_tenth() {
    let (mut rig, _releases) = connected();
    let told = |rig: &Rig| -> Vec<u64> {
        rig.messages.iter().filter_map(|m| m.heartbeat.as_ref()?.reported.free_bytes).collect()
    };
    let becomes = |rig: &mut Rig, room: u64| {
        rig.updates.as_ref().expect("has them").sets.limit(room);
        rig.pass(130_000);
    };
    becomes(&mut rig, 1_000);
    assert_eq!(told(&rig).last(), Some(&1_000));
    let before = told(&rig).len();
    becomes(&mut rig, 950);
    assert_eq!(told(&rig).len(), before, "a twentieth less is no news");
    becomes(&mut rig, 890);
    assert_eq!(told(&rig)[before..], [890]);
}

#[test]
fn bytes_that_are_not_what_was_signed_are_refused_and_the_next_good_ones_taken() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.corrupt(true);
    stage(&mut rig, &releases, &bundle, 1);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleCorrupt)));
    releases.corrupt(false);
    committed(rig, &releases, &bundle, 2);
}

#[test]
fn a_cut_network_is_waited_out() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.cut(true);
    stage(&mut rig, &releases, &bundle, 1);
    rig.pass(5_000);
    assert_eq!((state(&rig), refused(&rig)), (None, vec![]));
    releases.cut(false);
    rig.pass(60_000);
    assert_eq!(state(&rig), Some(UpdateState::Staged));
    let jobs = &rig.updates.as_ref().expect("has them").jobs;
    let asked = jobs.iter().filter(|job| matches!(job, Job::Refresh { .. })).count();
    assert!((2..10).contains(&asked), "{asked} times in 65 s");
}

#[test]
fn nothing_is_activated_with_work_a_load_a_stop_or_out_of_its_drain() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    let tried = |rig: &mut Rig, order: &mut Order| {
        grant(rig, order, 5_000);
        let by = report(rig).and_then(|r| r.reason).and_then(|r| r.metadata.get("by").cloned());
        assert_eq!((state(rig), rig.exit), (Some(UpdateState::Staged), None), "{by:?}");
        by
    };
    order.drain_id = Some(drain("drain-1"));
    assert_eq!(tried(&mut rig, &mut order).as_deref(), Some("drain"), "nobody holds it");
    maintain(&mut rig, Some(&drain("drain-0")));
    assert_eq!(tried(&mut rig, &mut order).as_deref(), Some("drain"), "an older drain holds it");
    rig.body.set(|b| b.load = Some(Load { task_id: None, item: "box".into() }));
    maintain(&mut rig, Some(&drain("drain-1")));
    assert_eq!(tried(&mut rig, &mut order).as_deref(), Some("load"));
    rig.body.says(BodyNews::HardwareStop(HardwareStop::Manual));
    rig.body.set(|b| b.load = None);
    assert_eq!(tried(&mut rig, &mut order).as_deref(), Some("stop"));
    rig.body.set(|b| b.battery_permille = 150);
    rig.body.says(BodyNews::HardwareStop(HardwareStop::None));
    assert_eq!(tried(&mut rig, &mut order).as_deref(), Some("battery"));
    rig.body.set(|b| b.battery_permille = 700);
    grant(&mut rig, &mut order, 5_000);
    relaunch(rig);
}

#[test]
fn a_robot_in_a_passage_does_not_change_its_software() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    let mut work = rig.desired(None);
    work.maintenance = Some(drain("drain-1"));
    work.grants =
        vec![midshift_core::desired_state::GrantedPlace { place_id: place_id("P1"), grant_id: 5, entry: None }];
    order.drain_id = work.maintenance.clone();
    let mut places = rig.store.memory().expect("loaded").ledger.places;
    places.inside.insert(place_id("P1"), 5);
    rig.store.commit_now(&[midshift_agent::store::Op::Places(places)]);
    let mut rig = rig.restart();
    rig.connect();
    rig.work(work);
    grant(&mut rig, &mut order, 5_000);
    let by = report(&rig).and_then(|r| r.reason).and_then(|r| r.metadata.get("by").cloned());
    assert_eq!((rig.exit, by.as_deref()), (None, Some("passage")));
}

#[test]
fn a_grant_that_was_held_back_longer_than_it_lives_activates_nobody_and_another_is_asked_for() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage_in_drain(&mut rig, &releases, &bundle);
    want(&mut rig, order.to(Goal::Activate));
    assert_eq!(asked(&rig), 1);
    let mut late = order.to(Goal::Activate);
    let authority = rig.authority(5_000);
    late.grant = Some(ActivationGrant { grant_id: 9, drain_id: drain("drain-1"), authority });
    rig.pass(12_000);
    want(&mut rig, late);
    assert_eq!((state(&rig), rig.exit, rig.stale()), (Some(UpdateState::Staged), None, 1));
    rig.pass(10_000);
    assert!(asked(&rig) >= 2);
    grant(&mut rig, &mut order, 5_000);
    relaunch(rig);
}

#[test]
fn a_grant_is_used_once() {
    let (rig, releases) = connected();
    let first = releases.release("1.1.0");
    let (mut rig, mut order) = on_trial(rig, &releases, &first, 1);
    let used = rig.store.memory().expect("loaded").ledger.software.grant_id;
    want(&mut rig, order.to(Goal::Revert));
    let mut rig = relaunch(rig);
    rig.pass(1_000);
    assert_eq!(state(&rig), Some(UpdateState::RolledBack));
    let second = releases.release("1.2.0");
    let mut order = stage(&mut rig, &releases, &second, 2);
    order.drain_id = Some(drain("drain-1"));
    maintain(&mut rig, Some(&drain("drain-1")));
    let mut again = order.to(Goal::Activate);
    let authority = rig.authority(5_000);
    again.grant = Some(ActivationGrant { grant_id: used, drain_id: drain("drain-1"), authority });
    want(&mut rig, again);
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::Staged), None));
}

#[test]
fn a_body_that_fails_its_test_with_the_new_software_goes_back() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    activate(&mut rig, &mut order, "drain-1");
    let broken = Fault { code: 5_001, class: FaultClass::Mechanical, message: "the left knee".into() };
    rig.body.set(|b| b.broken = Some(broken));
    let rig = relaunch(rig);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::RollingBack), Some(Code::SelfTestFailed)));
    rig.body.set(|b| b.broken = None);
    let rig = relaunch(rig);
    assert_eq!((state(&rig), switch(&rig)), (Some(UpdateState::RolledBack), Switch { number: 2, ..Switch::default() }));
}

#[test]
fn software_that_does_not_reach_its_server_goes_back_and_one_that_does_is_proven() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    activate(&mut rig, &mut order, "drain-1");
    assert_eq!(rig.exit, Some(ExitReason::Switched));
    let mut rig = rig.restart();
    rig.silence(599_000);
    assert_eq!(state(&rig), Some(UpdateState::Probation));
    rig.silence(2_000);
    assert_eq!((rig.exit, why(&rig)), (Some(ExitReason::Switched), Some(Code::LostServer)));
}

#[test]
fn an_answer_at_the_beginning_of_a_probation_does_not_end_it() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    activate(&mut rig, &mut order, "drain-1");
    let mut rig = relaunch(rig);
    rig.silence(PROBATION_MS + 1_000);
    assert_eq!(state(&rig), Some(UpdateState::Probation), "it was heard, and not since");
    rig.echo();
    assert_eq!(state(&rig), Some(UpdateState::Trial));
}

#[test]
fn an_order_for_the_set_that_runs_already_is_answered_and_changes_nothing() {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut rig = committed(rig, &releases, &bundle, 1);
    let (before, served) = (switch(&rig), releases.served());
    let mut order = stage(&mut rig, &releases, &bundle, 2);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::SkippedCurrent)));
    assert!(releases.served() <= served + bundle.length, "only its manifest came");
    for goal in [Goal::Activate, Goal::Revert] {
        want(&mut rig, order.to(goal));
        rig.pass(5_000);
        assert_eq!((switch(&rig), state(&rig), rig.exit), (before.clone(), Some(UpdateState::Refused), None));
    }
}

#[test]
fn a_floor_rises_with_a_commit_never_above_what_is_kept_and_never_on_trial() {
    let (rig, releases) = connected();
    let indexed = |version: &str, index: u64| releases.release_as(version, |m| m.components[0].rollback_index = index);
    let floor = |rig: &Rig| rig.store.memory().expect("loaded").ledger.software.floors.get("gait").copied();
    let rig = committed(rig, &releases, &indexed("1.1.0", 3), 1);
    assert_eq!(floor(&rig), Some(3), "what the robot came with has no index");
    let (rig, _) = on_trial(rig, &releases, &indexed("1.2.0", 5), 2);
    assert_eq!(floor(&rig), Some(3));
    let mut rig = rig;
    let mut order = Order::new(releases.directive(&indexed("1.2.0", 5), 2));
    order.generation = 290;
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!((state(&rig), floor(&rig)), (Some(UpdateState::Committed), Some(3)), "1.1.0 is kept");
    let mut rig = committed(rig, &releases, &indexed("1.3.0", 6), 3);
    assert_eq!(floor(&rig), Some(5));
    stage(&mut rig, &releases, &indexed("1.0.0", 4), 4);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleUnfit)));
}

#[test]
fn a_newer_directive_replaces_what_was_only_staged_and_the_kept_set_stays() {
    let (rig, releases) = connected();
    let [one, two, three] = ["1.1.0", "1.2.0", "1.3.0"].map(|v| releases.release(v));
    let mut rig = committed(rig, &releases, &one, 1);
    let first = name_of(&rig);
    stage(&mut rig, &releases, &two, 2);
    assert_eq!(switch(&rig).kept(), Some("factory"));
    let rig = committed(rig, &releases, &three, 3);
    assert_eq!(switch(&rig).kept(), Some(first.as_str()), "not the one that never ran");
    let held = rig.updates.as_ref().expect("has them").sets.clone().holdings().expect("tells").sets;
    assert_eq!(held.len(), 2, "what is neither running nor kept is gone");
}

#[test]
fn an_update_that_is_given_up_before_it_ran_leaves_everything_as_it_was() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    want(&mut rig, order.to(Goal::Revert));
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::RevertAsked)));
    let held = rig.updates.as_ref().expect("has them").sets.clone().holdings().expect("tells");
    assert_eq!((held.switch, held.sets.len()), (Switch::default(), 0));
}

#[test]
fn a_robot_that_is_not_set_up_for_it_leaves_its_software_alone() {
    let releases = Releases::new();
    let bundle = releases.release("1.1.0");
    let mut rig = Rig::at("A");
    rig.connect();
    let mut order = Order::new(releases.directive(&bundle, 1));
    want(&mut rig, order.to(Goal::Stage));
    rig.pass(5_000);
    assert_eq!((state(&rig), releases.served()), (None, 0));
}

#[test]
fn what_was_asked_of_the_disk_is_on_the_ledger_first() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage_in_drain(&mut rig, &releases, &bundle);
    rig.slow_disk = true;
    grant(&mut rig, &mut order, 5_000);
    assert_eq!((switch(&rig), rig.exit), (Switch::default(), None), "SWITCHING is not durable");
    rig.flush();
    rig.give(Input::Tick);
    assert_eq!(rig.exit, Some(ExitReason::Switched));
    assert!(switch(&rig).trial.is_some());
}

#[test]
fn a_switch_that_waits_for_the_disk_is_not_made_once_its_grant_has_ended_or_something_came_between() {
    type Change = fn(&mut Rig);
    let changes: [(&str, Change); 5] = [
        ("grant", |rig| rig.silence(6_000)),
        ("stop", |rig| rig.body.says(BodyNews::HardwareStop(HardwareStop::Manual))),
        ("mode", |rig| rig.body.says(BodyNews::Mode(Mode::Manual))),
        ("load", |rig| rig.body.set(|b| b.load = Some(Load { task_id: None, item: "box".into() }))),
        ("", |rig| rig.silence(3_000)),
    ];
    for (by, change) in changes {
        let (mut rig, releases) = connected();
        let bundle = releases.release("1.1.0");
        let mut order = stage(&mut rig, &releases, &bundle, 1);
        order.drain_id = Some(drain("drain-1"));
        maintain(&mut rig, Some(&drain("drain-1")));
        rig.slow_disk = true;
        grant(&mut rig, &mut order, 5_000);
        change(&mut rig);
        rig.give(Input::Tick);
        rig.flush();
        rig.give(Input::Tick);
        if by.is_empty() {
            assert_eq!(rig.exit, Some(ExitReason::Switched), "nothing came between");
            continue;
        }
        let told = report(&rig).and_then(|r| r.reason).and_then(|r| r.metadata.get("by").cloned());
        assert_eq!((state(&rig), rig.exit, told.as_deref()), (Some(UpdateState::Staged), None, Some(by)));
        assert_eq!(switch(&rig), Switch::default(), "{by}: what runs is untouched");
    }
}
