//! A file that changed on the disk, found by the process that does not lead.

use super::*;
use midshift_core::drain_request::INCIDENT;
use midshift_core::rows::{Entry, Seq};

#[tokio::test(start_paused = true)]
async fn a_damaged_file_that_only_the_standby_has_read_is_told_once() {
    let world = World::new();
    let (leader, standby, _) = with_a_release(&world).await;
    let content = files("walk", "1.0.0").remove(1).1;
    let digest = Digest::of_content(&content);
    let path = world.dir.path().join("ota").join("content").join(digest.to_string());
    std::fs::write(path, vec![0; content.len()]).expect("damaged");
    let opened = standby.ota.opened().expect("keys");
    assert!(!*opened.leads.borrow(), "the other one leads");
    assert!(opened.downloads.listed(digest).await.is_err(), "it is handed out to nobody");
    secs(5).await;
    let page = world.store.feed(Seq(0), &Log::ALL, 1_000).await.expect("a store");
    let names = digest.to_string();
    let is_told = |e: &&Entry| &*e.kind == INCIDENT && e.body.as_deref().is_some_and(|body| body.contains(&names));
    assert_eq!(page.entries.iter().filter(is_told).count(), 1);
    assert!(opened.downloads.damaged().is_empty(), "and is forgotten once it is written");
    leader.end().await;
    standby.end().await;
}
