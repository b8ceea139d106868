//! Whose folder it is, who may come in, and that a lock ends with its holder.

use super::{Error, FolderLock, Gate, MARKER, Owner, must_be_of};
use midshift_store::StoreId;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};
use std::sync::Arc;
use tempfile::TempDir;

fn store(id: &str) -> StoreId {
    StoreId(Arc::from(id))
}

fn alone(id: &str) -> Owner {
    Owner::Alone(store(id))
}

fn shared(id: &str, known_bundles: usize) -> Owner {
    Owner::Shared { store_id: store(id), known_bundles }
}

/// Comes and goes at once.
async fn come(dir: &TempDir, owner: &Owner) -> Result<(), Error> {
    FolderLock::acquire(dir.path(), owner).await.map(drop)
}

#[tokio::test]
async fn a_folder_of_another_store_is_refused_to_everybody_and_stays_what_it_is() {
    let dir = TempDir::new().expect("a folder");
    come(&dir, &alone("north")).await.expect("a new folder");
    for owner in [alone("south"), shared("south", 0)] {
        let error = come(&dir, &owner).await.expect_err("it is north's").to_string();
        assert!(error.contains("belongs to store north") && error.contains("this is store south"), "{error}");
    }
    assert!(matches!(must_be_of(dir.path(), &store("south")), Err(Error::OtherStore { .. })));
    assert_eq!(fs::read_to_string(dir.path().join(MARKER)).expect("a marker"), "north\n");
    come(&dir, &shared("north", 3)).await.expect("its own");
    must_be_of(dir.path(), &store("north")).expect("its own");
}

#[tokio::test]
async fn a_folder_from_before_becomes_the_only_process_s_and_is_refused_to_several() {
    let dir = TempDir::new().expect("a folder");
    fs::create_dir(dir.path().join("metadata")).expect("something");
    let error = come(&dir, &shared("north", 0)).await.expect_err("whose is it").to_string();
    assert!(error.contains("has no file store_id") && error.contains("midshift serve"), "{error}");
    assert!(matches!(must_be_of(dir.path(), &store("north")), Err(Error::NoMarker { .. })));
    come(&dir, &alone("north")).await.expect("taken over");
    come(&dir, &shared("north", 0)).await.expect("its own");
}

#[tokio::test]
async fn several_begin_an_empty_folder_only_if_their_store_knows_no_bundle() {
    let dir = TempDir::new().expect("a folder");
    fs::create_dir(dir.path().join("lost+found")).expect("what a new disk has");
    let error = come(&dir, &shared("north", 2)).await.expect_err("the disk is not there").to_string();
    assert!(error.contains("knows 2 bundles") && error.contains("not mounted"), "{error}");
    assert!(must_be_of(dir.path(), &store("north")).is_err(), "nothing was begun");
    come(&dir, &shared("north", 0)).await.expect("a new site");
    must_be_of(dir.path(), &store("north")).expect("begun");
}

#[tokio::test]
async fn what_older_servers_made_of_files_is_taken_away_at_the_start_and_nothing_else_is() {
    let dir = TempDir::new().expect("a folder");
    let folder = dir.path().join("ota");
    for path in ["encoded/ab", "content"] {
        fs::create_dir_all(folder.join(path)).expect("made");
    }
    fs::write(folder.join("encoded/ab/patch"), "bytes").expect("written");
    fs::write(folder.join("kept"), "by somebody").expect("written");
    for _ in 0..2 {
        drop(crate::fixture::service(&dir).await);
        let is_there = ["encoded", "content", "kept"].map(|name| folder.join(name).exists());
        assert_eq!(is_there, [false, true, true]);
    }
}

#[tokio::test]
async fn what_is_not_there_is_not_made_by_who_reads() {
    let dir = TempDir::new().expect("a folder");
    let folder = dir.path().join("volume");
    assert!(matches!(must_be_of(&folder, &store("north")), Err(Error::NoMarker { .. })));
    assert!(!folder.exists());
}

#[tokio::test(start_paused = true)]
async fn who_is_alone_shares_with_nobody_and_who_shares_with_nobody_who_is_alone() {
    let dir = TempDir::new().expect("a folder");
    let one = FolderLock::acquire(dir.path(), &alone("north")).await.expect("alone").expect("asked");
    one.let_in().await.expect("nobody");
    for owner in [alone("north"), shared("north", 0)] {
        assert!(matches!(come(&dir, &owner).await, Err(Error::InUse { .. })));
    }
    drop(one);
    let one = FolderLock::acquire(dir.path(), &shared("north", 0)).await.expect("first").expect("asked");
    one.let_in().await.expect("others may come");
    assert!(matches!(come(&dir, &alone("north")).await, Err(Error::InUse { .. })));
}

#[tokio::test(start_paused = true)]
async fn the_first_mends_before_others_come_and_each_has_a_number_of_its_own() {
    let dir = TempDir::new().expect("a folder");
    let owner = shared("north", 0);
    let first = FolderLock::acquire(dir.path(), &owner).await.expect("first").expect("asked");
    assert!(first.is_first);
    let mut coming = Box::pin(FolderLock::acquire(dir.path(), &owner));
    for _ in 0..10 {
        tokio::select! {
            biased;
            _ = &mut coming => panic!("the first is not ready"),
            () = tokio::time::sleep(super::LOOK_AGAIN) => {}
        }
    }
    first.let_in().await.expect("ready");
    let second = coming.await.expect("let in").expect("asked");
    assert!(!second.is_first);
    assert_ne!(first.number, second.number);
    drop((first, second));
    // A program that another test starts in this moment has our locks until it runs its own code.
    let third = loop {
        let came = FolderLock::acquire(dir.path(), &owner).await.expect("let in").expect("asked");
        if came.is_first {
            break came;
        }
        drop(came);
        tokio::task::yield_now().await;
    };
    assert!(third.number > 2);
}

#[test]
fn a_number_is_drawn_once_whatever_the_file_held_before() {
    let dir = TempDir::new().expect("a folder");
    let path = dir.path().join("in-use.lock");
    for (before, drawn) in [("", 1), ("9", 10), ("99\n", 100), ("what nobody wrote, and longer than a number", 1)] {
        fs::write(&path, before).expect("written");
        let numbers = [(); 3].map(|()| super::next_number(&path).expect("drawn"));
        assert_eq!(numbers, [drawn, drawn + 1, drawn + 2], "{before:?}");
    }
}

#[tokio::test]
async fn the_lock_of_a_process_that_is_killed_is_free() {
    let dir = TempDir::new().expect("a folder");
    let path = dir.path().join("gate.lock");
    // It becomes cat, which answers once it has the lock.
    let mut holder = Command::new("flock");
    holder.args(["--no-fork", "--exclusive"]).arg(&path).arg("cat").stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut holder = holder.spawn().expect("flock of util-linux");
    holder.stdin.as_mut().expect("a pipe").write_all(b"held\n").expect("written");
    let mut answer = String::new();
    BufReader::new(holder.stdout.as_mut().expect("a pipe")).read_line(&mut answer).expect("an answer");
    assert_eq!(answer, "held\n");
    let gate = Gate::new(Some(path));
    let mut taking = Box::pin(gate.take_turn());
    tokio::select! {
        biased;
        _ = &mut taking => panic!("it is held"),
        () = tokio::task::yield_now() => {}
    }
    holder.kill().expect("killed");
    holder.wait().expect("gone");
    taking.await.expect("free");
}

#[tokio::test(start_paused = true)]
async fn nobody_waits_for_a_turn_without_end() {
    let dir = TempDir::new().expect("a folder");
    let gate = || Gate::new(Some(dir.path().join("gate.lock")));
    let held = gate().take_turn().await.expect("free");
    assert!(matches!(gate().take_turn().await, Err(crate::content::Error::Busy { .. })));
    drop(held);
    gate().take_turn().await.expect("free again");
}
