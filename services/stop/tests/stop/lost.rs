//! A stop service begins with nothing engaged only at a first start that was announced; without its memory it begins with the fleet stopped.

use crate::harness::{Folder, Server, eventually, fleet, halt, id_of};
use midshift_core::stop::Stop;
use midshift_core::stop::latch::MEMORY_LOST;
use midshift_proto::stop::v1;
use midshift_stop::{Copied, FIRST, announce_first_start, latch};
use std::fs;
use std::path::Path;

/// Something that happens to a folder, and its name.
type Loss = (&'static str, fn(&Path));

/// Each way in which a folder loses what it kept.
const LOSSES: [Loss; 6] = [
    ("the folder", |folder| fs::remove_dir_all(folder).unwrap()),
    ("the latch", |folder| fs::remove_file(folder.join("latch")).unwrap()),
    ("the key", |folder| fs::remove_file(folder.join("key.pem")).unwrap()),
    ("both", |folder| ["latch", "key.pem"].iter().for_each(|name| fs::remove_file(folder.join(name)).unwrap())),
    ("a torn latch", |folder| fs::write(folder.join("latch"), [7; 4096]).unwrap()),
    ("a torn key", |folder| fs::write(folder.join("key.pem"), [200; 64]).unwrap()),
];

/// A folder in which one stop was engaged and one was reset, and the names of both.
async fn used() -> (Folder, [String; 2]) {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    assert!(server.engaged().await.is_empty(), "it is new");
    let [stands, over] =
        [server.engage(fleet()).await.unwrap(), server.engage(fleet()).await.unwrap()].map(|a| id_of(&a));
    server.reset(&over).await;
    server.end().await;
    (folder, [stands, over])
}

/// The stops by which it says that its memory was lost.
async fn lost(server: &Server) -> Vec<v1::Stop> {
    let stops = server.status().await.stops.into_iter().filter_map(|engaged| engaged.stop);
    stops.filter(|stop| stop.stop_id.starts_with(MEMORY_LOST)).collect()
}

#[tokio::test]
async fn each_way_of_losing_the_memory_begins_with_the_fleet_stopped_until_that_stop_is_reset() {
    for (way, lose) in LOSSES {
        let (folder, [stands, _]) = used().await;
        lose(&folder.path());
        let mut found = Vec::new();
        for _ in 0..2 {
            let server = Server::start(&folder.path()).await;
            found = lost(&server).await;
            assert_eq!(found.len(), 1, "{way}: {found:?}");
            assert_eq!((&found[0].scope, found[0].level), (&fleet().scope, halt()), "{way}");
            assert!(found[0].reason.contains("without its memory"), "{way}: {}", found[0].reason);
            let has_latch = way.contains("key");
            assert_eq!(server.engaged().await.contains(&stands), has_latch, "{way}: what is left is not forgotten");
            server.kill();
        }
        let server = Server::start(&folder.path()).await;
        assert!(server.reset(&found[0].stop_id).await.was_engaged, "{way}");
        server.end().await;
        let server = Server::start(&folder.path()).await;
        assert!(lost(&server).await.is_empty(), "{way}: a person has looked");
    }
}

#[tokio::test]
async fn an_announcement_opens_one_start_and_no_other() {
    let folder = Folder::new();
    assert!(folder.path().join(FIRST).exists());
    let server = Server::start(&folder.path()).await;
    assert!(server.engaged().await.is_empty());
    assert!(!folder.path().join(FIRST).exists(), "it is gone before anybody is answered");
    assert!(!announce_first_start(&folder.path()).unwrap(), "and nobody announces another one beside a latch");
    server.end().await;
    for left in ["latch", "key.pem"] {
        // Whoever puts the file there by hand opens nothing either.
        fs::write(folder.path().join(FIRST), "by hand").unwrap();
        fs::remove_file(folder.path().join(if left == "latch" { "key.pem" } else { "latch" })).unwrap();
        let server = Server::start(&folder.path()).await;
        assert_eq!(lost(&server).await.len(), 1, "{left} is left");
        assert!(!folder.path().join(FIRST).exists());
        server.end().await;
    }
}

#[tokio::test]
async fn a_first_start_that_was_cut_short_is_begun_again() {
    for has_key in [true, false] {
        let folder = Folder::new();
        drop(crate::kept::opened(&folder));
        // As it was before the last things that it did.
        fs::write(folder.path().join(FIRST), "announced").unwrap();
        if !has_key {
            fs::remove_file(folder.path().join("key.pem")).unwrap();
        }
        let server = Server::start(&folder.path()).await;
        assert!(server.engaged().await.is_empty(), "with its key: {has_key}");
    }
}

#[tokio::test]
async fn what_the_store_has_as_engaged_is_taken_back_before_anybody_is_answered_and_what_was_reset_is_not() {
    let (folder, names) = used().await;
    let (_, before) = latch(&folder.path()).unwrap().unwrap();
    let stops: Vec<Stop> = names.iter().map(|name| before.stop(&name.parse().unwrap()).unwrap().clone()).collect();
    Copied { stops: stops.clone() }.write(&folder.path()).unwrap();
    let server = Server::start(&folder.path()).await;
    assert_eq!(server.engaged().await, [names[0].clone()], "the other one was reset, and that is known here");
    server.end().await;
    fs::remove_file(folder.path().join("latch")).unwrap();
    Copied { stops: stops[..1].to_vec() }.write(&folder.path()).unwrap();
    let server = Server::start(&folder.path()).await;
    assert!(server.engaged().await.contains(&names[0]) && !lost(&server).await.is_empty());
    // Also of a store that comes back later.
    Copied { stops }.write(&folder.path()).unwrap();
    eventually(async || server.engaged().await.contains(&names[1]).then_some(())).await;
    eventually(async || server.status().await.durable.then_some(())).await;
    server.kill();
    fs::remove_file(folder.path().join(Copied::NAME)).unwrap();
    assert_eq!(Server::start(&folder.path()).await.engaged().await.len(), 3, "and they are kept again");
}
