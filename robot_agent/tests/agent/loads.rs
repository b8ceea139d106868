//! A load that its body cannot feel, and a person's word that it is not there.

use crate::rig::Rig;
use crate::test_body::TestBody;
use midshift_agent::body::BodyNews;
use midshift_agent::bugs::Bugs;
use midshift_agent::memory::MemoryStore;
use midshift_core::desired_state::{DesiredWork, LoadWord};
use midshift_core::robot::Load;
use midshift_core::robot_events::RobotEvent;

/// A robot that is heard and carries a box, by memory alone or not.
fn carrying(load_by_memory: bool) -> Rig {
    let body = TestBody::at("A");
    body.set(|log| log.load_by_memory = load_by_memory);
    let mut rig = Rig::with(body, MemoryStore::new(), Bugs::default());
    rig.connect();
    rig.body.says(a_box());
    rig.pass(3_000);
    rig
}

fn a_box() -> BodyNews {
    BodyNews::Load(Some(Load { task_id: None, item: "box".into() }))
}

/// The server tells a person's word against the newest heartbeat of this session and those before.
fn tell_load_word(rig: &mut Rig, session_epoch: u64, hb: u64) {
    let load_word = Some(LoadWord { session_epoch, hb });
    rig.work(DesiredWork { load_word, ..rig.desired(None) });
}

fn is_listed(rig: &Rig) -> bool {
    rig.reported.as_ref().expect("a heartbeat").load.is_some()
}

#[test]
fn a_load_that_is_only_remembered_is_forgotten_by_a_persons_word_and_the_server_hears_of_it() {
    let mut rig = carrying(true);
    assert!(is_listed(&rig));
    let (epoch, hb) = (rig.epoch, rig.hb);
    tell_load_word(&mut rig, epoch, hb);
    assert_eq!(rig.body.log().load, None);
    rig.pass(1_000);
    assert!(!is_listed(&rig) && rig.events.contains(&RobotEvent::Load(None)), "{:?}", rig.events);
}

#[test]
fn a_load_that_the_body_feels_stays_whatever_a_person_says() {
    let mut rig = carrying(false);
    let (epoch, hb) = (rig.epoch, rig.hb);
    tell_load_word(&mut rig, epoch, hb);
    rig.pass(1_000);
    assert!(rig.body.log().load.is_some() && is_listed(&rig));
}

#[test]
fn a_word_about_an_earlier_load_takes_no_newer_one_away() {
    let mut rig = carrying(true);
    let (epoch, hb) = (rig.epoch, rig.hb);
    // It laid that one down and took the next, which looks the same.
    rig.body.says(BodyNews::Load(None));
    rig.body.says(a_box());
    tell_load_word(&mut rig, epoch, hb);
    rig.pass(2_000);
    tell_load_word(&mut rig, epoch, hb);
    assert!(rig.body.log().load.is_some(), "the heartbeat of that word did not list it");
    let hb = rig.hb;
    tell_load_word(&mut rig, epoch, hb);
    assert_eq!(rig.body.log().load, None, "this one did");
}

#[test]
fn a_word_of_an_earlier_session_takes_nothing_away() {
    let mut rig = carrying(true);
    let (epoch, hb) = (rig.epoch, rig.hb);
    rig.connect();
    rig.pass(2_000);
    tell_load_word(&mut rig, epoch, hb);
    assert!(rig.body.log().load.is_some(), "its heartbeats are counted anew");
}
