//! A stop service that is silent: a robot slows down and stands, and what lets it go on.

use crate::rig::Rig;
use crate::stops::{
    SYNCED, answer, attend, awaiting, driving, free, hear_news, level, moves, resume, said, serve, speeds, stop_silence,
};
use midshift_agent::core::Input;
use midshift_agent::stop::StopNews;
use midshift_core::desired_state::{AreaRules, DesiredPolicy};
use midshift_core::ids::{AreaId, RobotId, StopId};
use midshift_core::policy::AreaPolicy;
use midshift_core::robot::StopLevel;
use midshift_proto::session::Downlink;

#[test]
fn a_service_that_reads_and_never_answers_slows_and_stands_the_robot_and_is_dialed_again() {
    let mut rig = driving();
    stop_silence(&mut rig, 2_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::None, true));
    stop_silence(&mut rig, 2_000);
    assert_eq!((level(&rig), speeds(&rig)), (StopLevel::Slow, vec![300, 300]));
    assert_eq!(rig.stop.redials, ["no answer"]);
    // Others are dialed, and hang as it did.
    for _ in 0..3 {
        attend(&mut rig);
        stop_silence(&mut rig, 1_000);
    }
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::ControlledStopPosture, false));
}

#[test]
fn answers_that_lay_in_a_buffer_feed_nothing() {
    let mut rig = driving();
    let mut late = Vec::new();
    for _ in 0..14 {
        attend(&mut rig);
        rig.pass(1_000);
        late.append(&mut rig.stop.check_ins);
    }
    assert!(late.len() >= 14 && !moves(&rig));
    let stood = level(&rig);
    for (nonce, _) in late {
        hear_news(&mut rig, StopNews::CheckInAnswer { nonce, generation: SYNCED });
    }
    rig.give(Input::Tick);
    assert_eq!((level(&rig), stood), (StopLevel::ControlledStopPosture, StopLevel::ControlledStopPosture));
    // Nor does the answer to a check-in of another.
    attend(&mut rig);
    (0..9).for_each(|n| hear_news(&mut rig, StopNews::CheckInAnswer { nonce: n, generation: SYNCED }));
    assert_eq!(level(&rig), StopLevel::ControlledStopPosture);
    serve(&mut rig, 4_000);
    assert_eq!((level(&rig), awaiting(&rig).len()), (StopLevel::Halt, 1), "heard again, and a person resumes it");
}

#[test]
fn an_answer_of_a_service_that_has_not_told_all_feeds_nothing_and_another_line_is_made() {
    let mut rig = driving();
    for _ in 0..8 {
        rig.pass(500);
        for (nonce, _) in std::mem::take(&mut rig.stop.check_ins) {
            hear_news(&mut rig, StopNews::CheckInAnswer { nonce, generation: SYNCED + 1 });
        }
    }
    assert_eq!((rig.stop.redials.as_slice(), level(&rig)), (&["a stop was not told"][..], StopLevel::Slow));
}

/// The hall, without people if its rules say so.
fn rules(rig: &mut Rig, without_people: bool) {
    let area = AreaRules { without_people, ..AreaPolicy::default_of(AreaId::parse("hall").expect("a name")).into() };
    let policy =
        DesiredPolicy { robot_id: RobotId::parse("rbt-01").expect("a name"), generation: 5, areas: vec![area] };
    rig.down(Downlink { policy: Some(policy), ..Downlink::default() });
}

#[test]
fn twenty_seconds_without_the_service_slow_a_robot_where_nobody_walks_and_it_goes_on_by_itself() {
    let mut rig = driving();
    rules(&mut rig, true);
    serve(&mut rig, 1_000);
    rig.silence(1_000);
    assert!(said(&rig).is_without_people);
    answer(&mut rig);
    hear_news(&mut rig, StopNews::LineLost);
    stop_silence(&mut rig, 9_000);
    assert_eq!((level(&rig), speeds(&rig)), (StopLevel::None, vec![1_500, 1_500]));
    stop_silence(&mut rig, 11_000);
    assert_eq!((level(&rig), moves(&rig), speeds(&rig)), (StopLevel::Slow, true, vec![300, 300]));
    attend(&mut rig);
    serve(&mut rig, 4_000);
    assert_eq!((level(&rig), awaiting(&rig).len()), (StopLevel::None, 0));
    assert_eq!((moves(&rig), speeds(&rig)), (true, vec![1_500, 1_500]));
}

#[test]
fn thirty_seconds_stand_it_there_too_and_it_still_goes_on_by_itself() {
    let mut rig = driving();
    rules(&mut rig, true);
    serve(&mut rig, 1_000);
    hear_news(&mut rig, StopNews::LineLost);
    stop_silence(&mut rig, 31_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::ControlledStopPosture, false));
    attend(&mut rig);
    serve(&mut rig, 5_000);
    assert_eq!((level(&rig), awaiting(&rig).len(), moves(&rig)), (StopLevel::None, 0, true));
}

#[test]
fn the_same_twenty_seconds_stand_it_among_people_and_a_person_resumes_it() {
    let mut rig = driving();
    rules(&mut rig, false);
    serve(&mut rig, 1_000);
    hear_news(&mut rig, StopNews::LineLost);
    stop_silence(&mut rig, 20_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::ControlledStopPosture, false));
    attend(&mut rig);
    serve(&mut rig, 5_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::Halt, false));
    let waits = awaiting(&rig);
    assert!(waits.len() == 1 && waits[0].starts_with("SILENCE-rbt-01-"), "{waits:?}");
    let silence = StopId::parse(&waits[0]).expect("an id");
    resume(&mut rig, &[silence], true);
    serve(&mut rig, 2_000);
    assert_eq!((level(&rig), moves(&rig)), (StopLevel::None, true));
}

#[test]
fn a_robot_that_does_not_know_where_it_is_counts_as_among_people() {
    let mut rig = free();
    rules(&mut rig, true);
    serve(&mut rig, 1_000);
    rig.silence(1_000);
    assert!(!said(&rig).is_without_people, "no route has told it in which area it stands");
}

#[test]
fn a_restart_of_the_links_server_never_moves_the_ladder() {
    let mut rig = driving();
    rig.give(Input::Disconnected);
    for _ in 0..40 {
        rig.silence(500);
        answer(&mut rig);
        assert_eq!(level(&rig), StopLevel::None);
    }
    rig.connect();
    serve(&mut rig, 1_000);
    assert_eq!(level(&rig), StopLevel::None);
}
