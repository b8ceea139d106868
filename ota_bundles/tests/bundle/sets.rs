//! What fits a robot, and every reason why something does not.

use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{Component, ComponentKind, FORMAT, Manifest, SafetyClass, WorkLevels};
use midshift_bundle::set::{Fit, SetManifest, raised};
use std::collections::BTreeMap;

fn component(name: &str, version: &str, kind: ComponentKind, rollback_index: u64) -> Component {
    let plain = Component::new(name, version, kind, version.as_bytes());
    Component { hardware: ["h1".to_owned()].into(), rollback_index, ..plain }
}

pub fn gait(version: &str) -> Component {
    component("gait", version, ComponentKind::Process, 3)
}

fn weights(version: &str) -> Component {
    component("weights", version, ComponentKind::Weights, 3)
}

fn bundle(components: Vec<Component>) -> Manifest {
    Manifest {
        format: FORMAT,
        name: "walk".to_owned(),
        version: "2.0.0".to_owned(),
        description: String::new(),
        hard_stop_codes: Default::default(),
        raises_floor: true,
        components,
    }
}

pub fn robot() -> Fit {
    Fit { model: "h1".to_owned(), ..Fit::default() }
}

pub fn onto(base: &SetManifest, components: Vec<Component>, robot: &Fit) -> Result<SetManifest, Vec<&'static str>> {
    let fitted = base.with(Digest::of_content(b"walk"), &bundle(components), robot);
    fitted.map_err(|unfit| unfit.iter().map(midshift_bundle::set::Unfit::code).collect())
}

fn installed(components: Vec<Component>) -> SetManifest {
    onto(&SetManifest::default(), components, &robot()).expect("fits")
}

#[test]
fn a_bundle_replaces_what_it_names_and_leaves_the_rest() {
    let before = installed(vec![gait("1.0.0"), weights("1.0.0")]);
    let after = onto(&before, vec![weights("1.1.0")], &robot()).expect("fits");
    assert_eq!(after.components["gait"], before.components["gait"]);
    assert_eq!(after.components["weights"].version, "1.1.0");
    assert_eq!(after.program().map(|c| c.name.as_str()), Some("gait"));
    assert_ne!(after.id(), before.id());
    assert_eq!(serde_json::from_slice::<SetManifest>(&after.to_bytes()).expect("reads"), after);
}

#[test]
fn wrong_hardware_a_floor_a_safety_part_and_an_unknown_level_are_all_told_at_once() {
    let mut bad = gait("2.0.0");
    bad.hardware = ["h2".to_owned()].into();
    bad.safety_class = SafetyClass::Related;
    bad.work_level = WorkLevels { lowest: 2, highest: 3 };
    let robot = Fit { floors: BTreeMap::from([("gait".to_owned(), 4)]), ..robot() };
    let told = onto(&SetManifest::default(), vec![bad.clone()], &robot).expect_err("does not fit");
    assert_eq!(told, ["WRONG_HARDWARE", "BELOW_FLOOR", "SAFETY_RELATED", "WORK_LEVEL"]);
    bad = Component {
        hardware: gait("2.0.0").hardware,
        work_level: WorkLevels { lowest: 1, highest: 3 },
        rollback_index: 4,
        ..bad
    };
    let allowed = Fit { allows_safety_related: true, ..robot };
    assert!(onto(&SetManifest::default(), vec![bad], &allowed).is_ok());
}

#[test]
fn the_floor_of_a_directive_holds_for_every_component() {
    let robot = Fit { floor: 4, ..robot() };
    let told = onto(&SetManifest::default(), vec![gait("2.0.0"), weights("1.0.0")], &robot);
    assert_eq!(told.expect_err("does not fit"), ["BELOW_FLOOR", "BELOW_FLOOR"]);
}

#[test]
fn what_a_component_requires_may_be_in_the_bundle_or_on_the_robot_and_must_be_new_enough() {
    let mut hungry = weights("2.0.0");
    hungry.requires = BTreeMap::from([("gait".to_owned(), "1.4.0".to_owned())]);
    for (there, fits) in [("1.3.9", false), ("1.4.0", true), ("1.5.0", true)] {
        let on_the_robot = installed(vec![gait(there)]);
        assert_eq!(onto(&on_the_robot, vec![hungry.clone()], &robot()).is_ok(), fits, "{there}");
        let in_the_bundle = onto(&SetManifest::default(), vec![gait(there), hungry.clone()], &robot());
        assert_eq!(in_the_bundle.is_ok(), fits, "{there}");
    }
    let told = onto(&SetManifest::default(), vec![hungry], &robot());
    assert_eq!(told.expect_err("does not fit"), ["MISSING_COMPONENT"]);
}

#[test]
fn what_a_component_on_the_robot_excludes_keeps_a_bundle_away() {
    let mut jealous = gait("1.0.0");
    jealous.conflicts = BTreeMap::from([("weights".to_owned(), "1.9.0".to_owned())]);
    let before = installed(vec![jealous]);
    assert_eq!(onto(&before, vec![weights("1.9.0")], &robot()), Err(vec!["CONFLICTING_COMPONENT"]));
    assert!(onto(&before, vec![weights("1.9.1")], &robot()).is_ok());
}

#[test]
fn a_robot_has_one_program() {
    let before = installed(vec![gait("1.0.0")]);
    let other = component("dance", "1.0.0", ComponentKind::Process, 3);
    assert_eq!(onto(&before, vec![other], &robot()), Err(vec!["TWO_OF_A_KIND"]));
}

#[test]
fn floors_rise_to_what_was_committed_and_never_above_what_is_kept() {
    let at = |index: u64| installed(vec![component("gait", "1.0.0", ComponentKind::Process, index)]);
    let floors = BTreeMap::from([("gait".to_owned(), 2), ("arm".to_owned(), 9)]);
    let gait_floor = |committed: u64, kept: u64| raised(&floors, &at(committed), &at(kept))["gait"];
    assert_eq!((gait_floor(5, 3), gait_floor(5, 7), gait_floor(1, 1)), (3, 5, 2));
    assert_eq!(raised(&floors, &at(5), &SetManifest::default())["gait"], 5, "nothing of it is kept");
    assert_eq!(raised(&floors, &at(5), &at(5))["arm"], 9, "others stay");
}
