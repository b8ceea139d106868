//! Which bundles are still needed, and until when.

use super::*;
use crate::limits::ROLLOUT_NAMES_DAYS;
use crate::rollout::projection::retention::needed_bundles;

fn names(rig: &Rig) -> BTreeSet<BundleId> {
    needed_bundles(&rig.ota, &rig.now)
}

fn bundles<const N: usize>(numbers: [u32; N]) -> BTreeSet<BundleId> {
    numbers.map(bundle_id).into()
}

/// The site clock stands behind the time in which an ended roll-out names its bundle.
fn long_after(rig: &mut Rig) {
    rig.now.utc = rig.now.utc.plus_ms(ROLLOUT_NAMES_DAYS * 24 * 3_600_000 + 1);
}

#[test]
fn a_roll_out_names_its_bundle_from_the_first_word_on_until_long_after_its_end() {
    let mut rig = Rig::new(4);
    assert_eq!(names(&rig), bundles([]));
    rig.start(spec());
    assert_eq!(names(&rig), bundles([2]));
    rig.must("ro", Verb::Abort);
    rig.until(100, |r| r.rollout("ro").phase == Phase::Aborted);
    rig.ticks(4);
    assert_eq!(names(&rig), bundles([2]), "it may be asked for again");
    rig.now.utc = Utc(0);
    assert_eq!(names(&rig), bundles([2]), "a clock that went back ends nothing");
    rig.now.utc = rig.rollout("ro").since;
    long_after(&mut rig);
    assert_eq!(names(&rig), bundles([]));
}

#[test]
fn what_newcomers_get_and_what_robots_keep_is_named_however_long_ago_it_was() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    long_after(&mut rig);
    assert_eq!(names(&rig), bundles([2]));
    let mut view = rig.rebuilt();
    view.area_bundles.clear();
    assert_eq!(needed_bundles(&view, &rig.now), bundles([2]), "robots keep it");
    let mut view = rig.rebuilt();
    view.software.clear();
    assert_eq!(needed_bundles(&view, &rig.now), bundles([2]), "newcomers get it");
    view.area_bundles.clear();
    assert_eq!(needed_bundles(&view, &rig.now), bundles([]));
}

#[test]
fn robots_name_what_they_run_try_would_go_back_to_and_fetch() {
    let mut rig = Rig::new(2);
    let mut robot = RobotSoftware::new(robot_id(0));
    (robot.committed, robot.previous) = (Some(bundle_id(1)), Some(bundle_id(7)));
    (robot.on_trial, robot.report) =
        (Some(bundle_id(8)), Some(fresh_report(UpdateState::Downloading, &bundle_id(9), 1)));
    rig.put_row(robot);
    let mut view = rig.rebuilt();
    assert_eq!(needed_bundles(&view, &rig.now), bundles([1, 7, 8, 9]));
    rig.retire(0);
    view = rig.rebuilt();
    assert_eq!(needed_bundles(&view, &rig.now), bundles([]), "a retired robot needs nothing any more");
}
