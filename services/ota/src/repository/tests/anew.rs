//! A new project on a server that had another one: the last way on when root keys are lost or stolen.

use super::published;
use crate::fixture::{START, Seeds, files, key, root, targets};
use crate::repository::{Act, Error};
use midshift_bundle::repository::PEOPLE_LIFE_MS;
use midshift_bundle::trust::Trusted;
use std::fs;

#[tokio::test]
async fn a_server_takes_a_new_project_once_the_documents_of_the_old_one_were_moved_away() {
    let (room, _) = published().await;
    let seeds = Seeds { root: 61, targets: 62, snapshot: 63, timestamp: 64 };
    for (name, seed) in [("snapshot-9", seeds.snapshot), ("timestamp-9", seeds.timestamp)] {
        key(seed).write(&room.dir.path().join("keys").join(format!("{name}.pem"))).expect("written");
    }
    let first = root(1, seeds, START.plus_ms(PEOPLE_LIFE_MS), &[seeds.root]);
    let more = files("walk", "2.0.0");
    room.bring(&more).await;
    let document = targets(None, &more, seeds.targets);
    let roots = || vec![first.clone()];
    let room = room.restarted().await;
    let error = room.repository.publish(roots(), document.clone(), 0, Act::of_release(START)).await;
    assert!(matches!(error, Err(Error::Moved { newest: 1, expected: 0 })), "{error:?}");

    fs::rename(room.metadata(), room.dir.path().join("old-metadata")).expect("moved away");
    let room = room.restarted().await;
    room.repository.publish(roots(), document, 0, Act::of_release(START)).await.expect("published");
    let robot = Trusted::new(&first).expect("a root");
    let taken = room.shown_to(&robot, START).await.expect("believed");
    assert!(taken.targets.keys().any(|name| name == "walk-2.0.0.manifest"), "{:?}", taken.targets);
}
