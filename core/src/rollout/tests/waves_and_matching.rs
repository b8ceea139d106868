//! Whom a roll-out reaches, in which wave, and what is refused before it begins.

use super::*;
use crate::ids::SetId;
use crate::rollout::commands::dry_run::dry_run;
use crate::rollout::members::matching;
use crate::update::{Installed, InstalledSet};

fn sizes(rig: &Rig, waves: Vec<Wave>) -> Vec<u32> {
    let spec = RolloutSpec { waves, allow_full_push: true, ..spec() };
    let run = dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &spec).expect("it may run");
    run.matching.sizes(spec.waves.len())
}

fn refusal(rig: &Rig, spec: &RolloutSpec) -> Code {
    dry_run(&rig.ota, &rig.board, &rollout_id("ro"), spec).expect_err("it is refused").reason.code
}

#[test]
fn waves_take_by_count_percent_label_version_and_rest_each_robot_once() {
    let mut rig = Rig::new(10);
    rig.robots[3].version = "0.8.0".into();
    rig.attach(3, |_| {});
    rig.tick();
    let label = Wave::Label { key: "line".into(), value: "even".into() };
    assert_eq!(sizes(&rig, vec![Wave::Count(1), Wave::Percent(25), Wave::Rest]), [1, 3, 6]);
    assert_eq!(sizes(&rig, vec![Wave::Version("0.8.0".into()), label, Wave::Rest]), [1, 5, 4]);
    assert_eq!(sizes(&rig, vec![Wave::Count(20), Wave::Rest]), [10, 0]);
}

#[test]
fn the_order_comes_of_both_ids_and_not_of_who_came_first() {
    let rig = Rig::new(10);
    let order = |id: &str| {
        let run = dry_run(&rig.ota, &rig.board, &rollout_id(id), &spec()).expect("it may run");
        run.matching.robots.iter().map(|r| r.robot_id.clone()).collect::<Vec<_>>()
    };
    assert_eq!(order("ro"), order("ro"));
    assert_ne!(order("ro"), order("other"));
    let mut by_hash: Vec<RobotId> = (0..10).map(robot_id).collect();
    by_hash.sort_by_key(|r| matching::rank_of(&rollout_id("ro"), r));
    assert_eq!(order("ro"), by_hash);
}

#[test]
fn robots_with_neighbouring_numbers_do_not_stand_side_by_side() {
    for rollout in ["ro", "base-2.0.0", "x"] {
        let mut by_place: Vec<usize> = (0..100).collect();
        by_place.sort_by_key(|n| matching::rank_of(&rollout_id(rollout), &robot_id(*n)));
        let side_by_side = by_place.windows(2).filter(|pair| pair[0].abs_diff(pair[1]) == 1).count();
        assert!(side_by_side < 10, "{rollout}: {side_by_side} pairs, chance has 2");
        assert!(by_place[..10].iter().map(|n| n / 10).collect::<BTreeSet<_>>().len() > 3, "{rollout}");
    }
}

#[test]
fn a_full_push_is_refused_also_behind_a_wave_that_takes_nobody() {
    let rig = Rig::new(20);
    let with = |waves| RolloutSpec { waves, ..spec() };
    assert_eq!(refusal(&rig, &with(vec![Wave::Count(3), Wave::Rest])), Code::RolloutFullPush);
    assert!(dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &with(vec![Wave::Count(2), Wave::Rest])).is_ok());
    let nobody = Wave::Label { key: "line".into(), value: "none".into() };
    assert_eq!(refusal(&rig, &with(vec![nobody, Wave::Rest])), Code::RolloutFullPush);
    let one = RolloutSpec { waves: vec![Wave::Rest], ..spec() };
    assert_eq!(refusal(&rig, &one), Code::InvalidRequest);
}

#[test]
fn a_budget_that_lets_nobody_out_is_told_at_once_and_only_to_whom_it_concerns() {
    let mut rig = Rig::new(10);
    rig.attach(0, |i| i.capabilities = vec!["tow".into()]);
    rig.rules(|s| s.keep_in_work.extend([("lift".into(), 9)]));
    rig.tick();
    assert_eq!(refusal(&rig, &spec()), Code::BudgetImpossible);
    let mut tow = spec();
    tow.selector.robots.insert(robot_id(0));
    assert!(dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &tow).is_ok(), "no robot that lifts is reached");
}

/// Keeps the floors that it was to sign.
struct Floors(std::cell::RefCell<Vec<u64>>);

impl Sign for Floors {
    fn directive(&self, order: &Order) -> String {
        self.0.borrow_mut().push(order.rollback_floor);
        Plain.directive(order)
    }
}

#[test]
fn the_floor_that_is_asked_for_is_signed_and_one_above_the_bundle_is_refused() {
    let mut rig = Rig::new(3);
    let above = RolloutSpec { rollback_floor: 5, ..spec() };
    let refused = dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &above).expect_err("the bundle has 4");
    assert_eq!(refused.violations.iter().map(|v| v.field.as_str()).collect::<Vec<_>>(), ["rollback_floor"]);
    let create = Command::Create { rollout_id: rollout_id("no"), spec: Arc::new(above) };
    assert!(rig.ask(&create).is_err(), "it is not even written down");
    rig.keyless = true;
    rig.start(RolloutSpec { rollback_floor: 4, ..spec() });
    rig.pass(1_000);
    let (floors, heard, mut plan) = (Floors(Vec::new().into()), std::mem::take(&mut rig.heard), Plan::default());
    cycle(&mut rig.ota, rig.now, &rig.board, &heard, Ok(&floors), &mut plan);
    assert_eq!(floors.0.into_inner(), [4, 4, 4]);
}

#[test]
fn a_label_of_a_person_goes_before_the_robots_own_in_selectors_and_waves() {
    let mut rig = Rig::new(4);
    rig.control(0, |c| drop(c.labels.insert("line".into(), "odd".into())));
    rig.tick();
    let odd = Wave::Label { key: "line".into(), value: "odd".into() };
    assert_eq!(sizes(&rig, vec![odd, Wave::Rest]), [3, 1], "two say so of themselves");
    let mut selected = RolloutSpec { waves: vec![Wave::Count(1), Wave::Rest], ..spec() };
    selected.selector.labels.insert("line".into(), "odd".into());
    let run = dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &selected).expect("it may run");
    assert!(run.matching.robots.iter().any(|m| m.robot_id == robot_id(0)), "{:?}", run.matching.robots);
}

#[test]
fn who_is_left_out_is_told_with_the_reason() {
    let mut rig = Rig::new(6);
    rig.attach(0, |i| i.model = "m9".into());
    rig.retire(1);
    rig.ask(&Command::Pin { robot_id: robot_id(2), reason: "trial".into() }).expect("allowed");
    rig.tick();
    let run = dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &spec()).expect("it may run");
    let codes: Vec<(Code, u32)> = run.matching.left_out_by_code().into_iter().collect();
    let expected = [Code::SkippedIncompatible, Code::SkippedPinned, Code::SkippedRetired];
    assert_eq!(codes, expected.map(|code| (code, 1)));
    let mut nobody = spec();
    nobody.selector.models.insert("m9".into());
    assert_eq!(refusal(&rig, &nobody), Code::RolloutMatchesNobody);
}

#[test]
fn a_dry_run_tells_who_has_too_little_room_and_who_lacks_what_the_bundle_needs() {
    let mut rig = Rig::new(4);
    rig.put_row(Bundle { requires: [("map".to_owned(), "1.2.0".to_owned())].into(), ..bundle(2) });
    for (n, free_bytes, map) in [(0, 1_199, Some("1.2.0")), (1, 1_200, Some("1.1.9")), (2, u64::MAX, None)] {
        let session = rig.row::<Session>(robot_id(n).as_str()).expect("it attached");
        rig.put_row(Session { installed: Some(installed(n, free_bytes, map)), ..session });
    }
    rig.tick();
    let run = dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &spec()).expect("it may run");
    // The fourth robot said nothing: nothing is held against it.
    let (room, needs) =
        (run.caveats.iter().find(|c| c.contains("room")), run.caveats.iter().find(|c| c.contains("map")));
    assert!(room.is_some_and(|c| c.ends_with("said last: r000")), "{:?}", run.caveats);
    assert!(needs.is_some_and(|c| c.ends_with("seen on: r001, r002")), "{:?}", run.caveats);
    let live = rig.board.get_mut(&robot_id(1)).expect("it is heard");
    Arc::make_mut(live).report.free_bytes = Some(10);
    let run = dry_run(&rig.ota, &rig.board, &rollout_id("ro"), &spec()).expect("it may run");
    assert!(
        run.caveats.iter().any(|c| c.ends_with("said last: r000, r001")),
        "what heartbeats say counts: {:?}",
        run.caveats
    );
}

fn installed(n: usize, free_bytes: u64, map: Option<&str>) -> Installed {
    let set = SetId::parse(&"ab".repeat(32)).expect("an id");
    Installed {
        robot_id: robot_id(n),
        boot_id: String::new(),
        device_key: String::new(),
        model: "m1".to_owned(),
        free_bytes,
        running: set.clone(),
        current: set.clone(),
        previous: None,
        sets: vec![InstalledSet {
            set,
            bundle: None,
            version: "walk 1.0.0".to_owned(),
            components: map.map(|version| ("map".to_owned(), version.to_owned())).into_iter().collect(),
            components_left_out: 0,
        }],
    }
}

#[test]
fn a_second_roll_out_of_the_same_robots_is_refused_or_takes_the_place_of_the_first() {
    let mut rig = Rig::new(6);
    rig.start(spec());
    rig.until(60, |r| r.phase() == Phase::Soaking);
    let other = RolloutSpec { bundle: bundle_id(3), ..spec() };
    rig.create("next", other);
    rig.must("next", Verb::Submit);
    rig.must("next", Verb::Approve);
    let refused = rig.verb("next", Verb::Start { supersede: false }).expect_err("it overlaps");
    assert_eq!(refused.reason.code, Code::RolloutOverlap);
    rig.must("next", Verb::Start { supersede: true });
    assert!(rig.phase().goes_back());
    let begun = |r: &Rig| r.rollout("next").phase == Phase::Applying;
    rig.until(60, |r| begun(r) || r.phase() == Phase::Superseded);
    assert!(!begun(&rig), "the older one goes back first");
    rig.until(300, |r| r.rollout("next").phase == Phase::Completed);
    assert!(rig.robots.iter().all(|r| r.version == "3.0.0"));
}
