//! Why the rules of belief are as they are: each is held against one attack and refuses it, and the naive rule does not.

use crate::directives::{directive, open_naively, robot};
use crate::sets;
use crate::shelf::{START, Shelf, key};
use midshift_bundle::bugs::{Bugs, SeededBug};
use midshift_bundle::directive::{Directive, ENVELOPE_BYTES_MAX, LIFE_MS, Rejection};
use midshift_bundle::repository::DAY_MS;
use midshift_bundle::set::{Fit, SetManifest};
use midshift_bundle::trust::Reading;
use midshift_core::time::Utc;
use std::sync::Arc;

/// The real rule refuses the envelope for this reason, and the naive one takes it.
fn is_taken_only_by(bug: SeededBug, envelope: &[u8], now: Utc, why: Rejection) {
    assert_eq!(open_naively(envelope, 4, now, Bugs::default()), Err(why));
    assert!(open_naively(envelope, 4, now, Bugs::seeded(&[bug])).is_ok(), "{bug:?}");
}

#[test]
fn a_strangers_directive_is_refused_and_a_rule_that_asks_for_no_key_takes_it() {
    let strangers = directive().sign(&key(8));
    is_taken_only_by(SeededBug::StrangersSign, &strangers, START, Rejection::NotSigned);
}

#[test]
fn another_robots_directive_is_refused_and_where_any_robot_will_do_it_is_taken() {
    let others = Directive { robot_id: robot("rbt-02"), ..directive() }.sign(&key(7));
    is_taken_only_by(SeededBug::AnyRobotWillDo, &others, START, Rejection::OtherRobot);
}

#[test]
fn an_expired_directive_is_refused_and_where_they_live_for_ever_it_is_taken() {
    let (old, late) = (directive().sign(&key(7)), START.plus_ms(LIFE_MS));
    is_taken_only_by(SeededBug::DirectivesLiveForEver, &old, late, Rejection::Expired);
}

#[test]
fn a_directive_that_is_too_long_is_refused_and_where_length_is_forgotten_it_is_read() {
    let mut long = directive().sign(&key(7));
    long.resize(ENVELOPE_BYTES_MAX + 1, b' ');
    is_taken_only_by(SeededBug::LengthIsForgotten, &long, START, Rejection::TooLong);
}

#[test]
fn a_component_below_the_floor_fits_nobody_and_where_the_floor_is_forgotten_it_does() {
    let onto =
        |bugs| sets::onto(&SetManifest::default(), vec![sets::gait("0.9.0")], &Fit { floor: 4, bugs, ..sets::robot() });
    assert_eq!(onto(Bugs::default()), Err(vec!["BELOW_FLOOR"]));
    assert!(onto(Bugs::seeded(&[SeededBug::FloorIsForgotten])).is_ok());
}

#[tokio::test]
async fn a_frozen_repository_is_noticed_and_where_repositories_live_for_ever_it_is_believed() {
    let shelf = Shelf::new();
    let late = Reading { utc: shelf.now.plus_ms(2 * DAY_MS), is_synced: true };
    let is_believed = async |bugs: &[SeededBug]| {
        let robot = shelf.robot().with(Bugs::seeded(bugs));
        robot.refresh(Arc::new(shelf.documents.clone()), late).await.is_ok()
    };
    assert!(!is_believed(&[]).await);
    assert!(is_believed(&[SeededBug::RepositoriesLiveForEver]).await);
}
