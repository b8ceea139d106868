//! A robot into whose trust file a person put another root: the last way on when root keys are lost or stolen.

use crate::metadata::rule;
use crate::shelf::{Documents, Seeds, Shelf, target};
use midshift_bundle::trust::Trusted;

/// A repository of other people, who begin anew.
fn new_project() -> Shelf {
    let mut shelf = Shelf::new();
    shelf.seeds = Seeds { root: 61, targets: 62, snapshot: 63, timestamp: 64 };
    (shelf.documents, shelf.root_version) = (Documents::default(), 0);
    shelf.rotate(shelf.seeds);
    shelf.first_root = shelf.documents.0["1.root.json"].clone();
    (shelf.targets, shelf.targets_version, shelf.online_version) = (Vec::new(), 0, 0);
    shelf.release(&[target("walk-2.0.0.manifest", b"anew")]);
    shelf
}

/// As a robot that has written down what it believed and starts with this root in its file.
fn started(robot: &Trusted, root: &[u8]) -> Trusted {
    let written = serde_json::to_string(robot).expect("is JSON");
    serde_json::from_str::<Trusted>(&written).expect("reads").from_root(root).expect("a root")
}

#[tokio::test]
async fn a_root_of_other_people_counts_once_a_person_has_put_it_there_and_never_before() {
    let (mut old, new) = (Shelf::new(), new_project());
    old.publish(1_000_000);
    let robot = old.shown_to(&old.robot()).await.expect("believed").trusted;
    let robot = started(&robot, &old.first_root);
    assert_eq!(rule(&new.shown_to(&robot).await.expect_err("nobody put it there")), "VerifyMetadata");

    let robot = started(&robot, &new.first_root);
    let taken = new.shown_to(&robot).await.expect("the versions of before count for nothing");
    assert_eq!(taken.targets.keys().collect::<Vec<_>>(), ["walk-2.0.0.manifest"]);
    assert_eq!(taken.trusted.time_floor(), robot.time_floor(), "it is as late as it was");
    let robot = started(&taken.trusted, &new.first_root);
    assert_eq!(robot, taken.trusted, "from then on it is the root that it came with");
    assert_eq!(rule(&old.shown_to(&robot).await.expect_err("they are nobody any more")), "VerifyMetadata");
}

#[tokio::test]
async fn another_root_of_the_same_people_takes_no_version_back() {
    let mut shelf = Shelf::new();
    shelf.publish(7);
    let robot = shelf.shown_to(&shelf.robot()).await.expect("believed").trusted;
    let mut older = shelf.clone();
    older.publish(6);
    shelf.rotate(shelf.seeds);
    shelf.freshen();
    // A file that was written after the change.
    let newer = started(&robot, &shelf.documents.0["2.root.json"]);
    assert_ne!(newer, robot);
    assert_eq!(rule(&older.shown_to(&newer).await.expect_err("6 is below 7")), "Older");
    let newest = shelf.shown_to(&newer).await.expect("believed").trusted;
    assert_eq!(started(&newest, &shelf.first_root), newest, "an older file says nothing new");
}

#[tokio::test]
async fn what_a_version_wrote_that_did_not_note_the_first_root_stays_believed() {
    let shelf = Shelf::new();
    let robot = shelf.shown_to(&shelf.robot()).await.expect("believed").trusted;
    let mut page = serde_json::to_value(&robot).expect("is JSON");
    page.as_object_mut().expect("an object").remove("origin").expect("it was noted");
    let unnoted: Trusted = serde_json::from_value(page).expect("reads");
    assert_ne!(unnoted, robot);
    assert_eq!(started(&unnoted, &shelf.first_root), robot);
}
