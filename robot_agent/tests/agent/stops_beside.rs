//! Fleet stop by its second way: what the link says of stops is obeyed, and takes back nothing that the stop service
//! itself has not marked.

use crate::rig::Rig;
use crate::stops::{awaiting, desk, free, freed, hear_news, level, reset, stop, stop_id};
use midshift_agent::stop::StopNews;
use midshift_bundle::keys::SecretKey;
use midshift_core::limits;
use midshift_core::robot::StopLevel;
use midshift_core::stop::{Reset, Stop};
use midshift_core::time::Utc;
use midshift_proto::convert::stop::signed_reset;
use midshift_proto::session::{ClockSample, Downlink, Echo, StopFacts, ToRobot};

fn service() -> SecretKey {
    SecretKey::of_seed([3; 32])
}

fn marked(reset: Reset, key: &SecretKey) -> Reset {
    let proof = key.sign(&signed_reset(&reset)).to_vec();
    Reset { proof, ..reset }
}

fn says(rig: &mut Rig, stops: Vec<Stop>, resets: Vec<Reset>) {
    rig.down(Downlink { stops: Some(StopFacts { stops, resets }), ..Downlink::default() });
}

/// Its stop line has said the key and is cut; stop 1 was heard on the link alone.
fn halted() -> Rig {
    let mut rig = free();
    hear_news(&mut rig, StopNews::Synced { generation: 10, key: service().public().bytes().to_vec() });
    hear_news(&mut rig, StopNews::LineLost);
    says(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    rig
}

fn is_stopped(rig: &Rig) -> bool {
    level(rig) == StopLevel::Halt && rig.core.known_stops().any(|stop| stop.stop_id == stop_id(1))
}

#[test]
fn a_stop_that_is_heard_on_the_link_alone_is_obeyed_kept_and_brought_back() {
    let rig = halted();
    assert!(is_stopped(&rig));
    assert_eq!(awaiting(&rig), ["STOP-1"]);
    assert!(rig.stop.saved.latch.is_effective(&stop_id(1)), "it is in the file");
    let rig = rig.restart();
    assert_eq!(rig.core.known_stops().map(|stop| stop.stop_id.clone()).collect::<Vec<_>>(), [stop_id(1)]);
    assert_eq!(awaiting(&freed_of_silence(rig)), ["STOP-1"]);
}

/// Its line is there again, and says nothing.
fn freed_of_silence(mut rig: Rig) -> Rig {
    rig.connect();
    crate::stops::attend(&mut rig);
    crate::stops::serve(&mut rig, 4_000);
    rig
}

#[test]
fn absence_on_the_link_frees_nothing_and_says_nothing_of_what_was_told() {
    let mut rig = halted();
    says(&mut rig, vec![], vec![]);
    says(&mut rig, vec![stop(2, StopLevel::Slow)], vec![]);
    rig.down(Downlink::default());
    assert!(is_stopped(&rig));
    // Nor does the link stand in for the first words of the stop line.
    let mut rig = Rig::stoppable("A", desk());
    rig.connect();
    says(&mut rig, vec![], vec![]);
    crate::stops::serve(&mut rig, 5_000);
    assert_eq!(level(&rig), StopLevel::Halt, "nobody has told it what is effective");
}

#[test]
fn a_reset_on_the_link_counts_by_the_mark_of_the_stop_service_alone() {
    let mut rig = halted();
    let forged = marked(reset(1), &SecretKey::of_seed([4; 32]));
    let of_another = Reset { stop_id: stop_id(1), ..marked(reset(2), &service()) };
    let older = marked(Reset { reset_unix_ms: Utc(1_699_999_999_999), ..reset(1) }, &service());
    for refused in [reset(1), forged, of_another, older, marked(reset(2), &service())] {
        says(&mut rig, vec![], vec![refused.clone()]);
        assert!(is_stopped(&rig), "freed by {refused:?}");
    }
    says(&mut rig, vec![], vec![marked(reset(1), &service())]);
    assert_eq!((rig.core.known_stops().count(), awaiting(&rig)), (0, vec!["STOP-1".to_owned()]), "a person resumes it");
    says(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    assert_eq!(rig.core.known_stops().count(), 0, "what was reset stays so, whatever is heard late");
}

#[test]
fn before_the_stop_service_has_said_its_key_no_reset_on_the_link_counts() {
    let mut rig = freed(Rig::stoppable("A", desk()));
    says(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    says(&mut rig, vec![], vec![marked(reset(1), &service())]);
    assert!(is_stopped(&rig));
    // On its own line it needs no mark.
    hear_news(&mut rig, StopNews::Facts { stops: vec![], resets: vec![reset(1)], generation: 11 });
    assert_eq!(rig.core.known_stops().count(), 0);
}

#[test]
fn a_list_beyond_its_limit_is_refused_by_itself_and_what_is_latched_stays() {
    let mut rig = halted();
    let resets = (0..=limits::STOPS_MAX as u64).map(|n| marked(reset(n), &service())).collect();
    let echo = Some(Echo { hb: rig.hb, clock: ClockSample::default(), is_clock_doubted: false });
    let stops = Some(StopFacts { stops: vec![stop(5, StopLevel::Slow)], resets });
    let down = ToRobot::Downlink(Box::new(Downlink { echo, stops, ..Downlink::default() }));
    let wire = midshift_proto::link::v1::SessionResponse::from(&down);
    let read = midshift_proto::parse(wire).expect("the rest of the message is read");
    let ToRobot::Downlink(down) = read else { panic!("not a downlink") };
    let why = down.unreadable_stops.clone().unwrap_or_default();
    assert!(down.echo.is_some() && down.stops.is_none() && why.contains("resets"), "{why}");
    rig.down(*down);
    assert!(is_stopped(&rig));
    assert_eq!(rig.core.known_stops().count(), 1, "nothing of it was taken");
}
