//! The root of a site: made once, kept, and never replaced by accident.

use crate::world::World;
use midshift_identity::{Duty, Error};
use std::os::unix::fs::PermissionsExt;

#[tokio::test]
async fn a_second_start_finds_the_root_and_the_certificate_of_the_first() {
    let world = World::new();
    let first = world.open().await.expect("opened").proof().borrow().clone();
    let again = world.open().await.expect("opened again").proof().borrow().clone();
    assert!(first == again, "the same root, key and certificate");
    assert_eq!(first.chain_pem.matches("BEGIN CERTIFICATE").count(), 2, "the root stands behind the leaf");
    let public = std::fs::read_to_string(world.folder().join(midshift_identity::PUBLIC_FILE)).expect("a file");
    assert_eq!(public, first.authority_pem);
}

#[tokio::test]
async fn keys_are_for_their_owner_alone_and_a_folder_that_is_open_to_others_is_refused() {
    let world = World::new();
    drop(world.open().await.expect("opened"));
    for name in ["authority.pem", "server.key"] {
        let mode = world.folder().join(name).metadata().expect("a file").permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "{name}");
    }
    std::fs::set_permissions(world.folder(), std::fs::Permissions::from_mode(0o755)).expect("opened to others");
    let refused = world.open().await.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(refused.contains("(mode 755)") && refused.contains("chmod go="), "{refused}");
}

#[tokio::test]
async fn a_store_that_knows_a_root_gets_no_second_one_from_an_empty_folder() {
    let world = World::new();
    drop(world.open().await.expect("opened"));
    std::fs::rename(world.folder(), world.dir.path().join("kept")).expect("moved away");
    assert!(matches!(world.open().await, Err(Error::OtherCertificateAuthority { .. })));
    std::fs::remove_dir_all(world.folder()).expect("what it made is no authority");
    std::fs::rename(world.dir.path().join("kept"), world.folder()).expect("brought back");
    assert!(world.open().await.is_ok());
}

#[tokio::test]
async fn another_process_on_the_same_store_gets_a_certificate_of_the_same_root() {
    let world = World::new();
    let authority = world.open().await.expect("opened");
    let shutdown = tokio_util::sync::CancellationToken::new();
    let (running, ends) = (authority.clone(), shutdown.clone());
    let running = tokio::spawn(async move { running.run(ends).await });
    let member = world.open_in(world.dir.path().join("gateway"), Duty::Member).await.expect("answered");
    let (ours, theirs) = (authority.proof().borrow().clone(), member.proof().borrow().clone());
    assert_eq!(ours.authority_pem, theirs.authority_pem);
    assert_ne!(ours.key_pem, theirs.key_pem, "each process has a key of its own");
    assert!(!world.dir.path().join("gateway/authority.pem").exists(), "and one has the authority's");
    shutdown.cancel();
    running.await.expect("it ends");
}

#[tokio::test]
async fn a_server_renews_its_certificate_at_half_of_its_life_and_keeps_its_key() {
    let world = World::new();
    let first = world.open().await.expect("opened").proof().borrow().clone();
    let half = midshift_core::limits::SERVER_CERTIFICATE_VALID.as_ms() / 2;
    world.pass_ms(half + 1_000);
    let later = world.open().await.expect("opened again").proof().borrow().clone();
    assert_eq!(first.key_pem, later.key_pem);
    assert_ne!(first.chain_pem, later.chain_pem);
}

#[tokio::test]
async fn a_server_that_starts_with_a_wall_in_doubt_keeps_the_certificate_that_it_has() {
    let world = World::new();
    let chain = async || world.open().await.expect("opened").proof().borrow().chain_pem.clone();
    let first = chain().await;
    let valid_ms = midshift_core::limits::SERVER_CERTIFICATE_VALID.as_ms().cast_signed();
    world.set_ms(valid_ms);
    assert_eq!(chain().await, first, "a new one would begin when the wall is wrong no more");
    world.clock.accept_wall();
    assert_ne!(chain().await, first);
}
