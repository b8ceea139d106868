//! Old STATUS: what gathered without a session goes beside the next one, in order and once, and holds nothing up.

use crate::rig::{Rig, ack, items, welcome};
use midshift_agent::body::BodyNews;
use midshift_agent::core::Input;
use midshift_agent::replay::Replayed;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::robot::{Lane, Mode};
use midshift_core::robot_events::InboxItem;
use midshift_proto::session::{Downlink, LaneAck, LaneBatch, Welcome};

fn numbers(items: &[InboxItem]) -> Vec<u64> {
    let seq = |item: &InboxItem| match item {
        InboxItem::Sample(sample) => sample.seq,
        other => panic!("{other:?}"),
    };
    items.iter().map(seq).collect()
}

fn on_link(rig: &Rig, lane: Lane) -> Vec<u64> {
    numbers(&items(&rig.messages, lane))
}

fn range_of(batch: &LaneBatch) -> (u64, u64) {
    let all = numbers(&batch.items);
    assert!(all.windows(2).all(|pair| pair[1] == pair[0] + 1), "{all:?}");
    (all[0], all[all.len() - 1])
}

/// First and last number of each batch that went over bulk.
fn beside(rig: &Rig) -> Vec<(u64, u64)> {
    beside_from(rig, 0)
}

/// Without the first ones.
fn beside_from(rig: &Rig, at: usize) -> Vec<(u64, u64)> {
    rig.replays[at..].iter().map(|replay| range_of(&replay.batch)).collect()
}

/// A robot that had no session for so long, milliseconds, and has one again.
fn back_after(ms: u64) -> Rig {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.give(Input::Disconnected);
    rig.silence(ms);
    rig.messages.clear();
    rig.connect();
    rig
}

fn produced(rig: &Rig) -> u64 {
    rig.core.memory().ring.lane(Lane::Status).produced
}

fn answer(rig: &mut Rig, replayed: Replayed) {
    rig.give(Input::Replayed(rig.epoch, replayed));
}

/// The server has stored the newest batch.
fn stored(rig: &mut Rig) {
    let (_, last) = *beside(rig).last().expect("a batch");
    answer(rig, Replayed::Stored(ack(Lane::Status, last)));
}

fn failed() -> Replayed {
    Replayed::Failed("lost".to_owned())
}

#[test]
fn after_a_break_events_come_first_then_the_live_heartbeat_and_old_status_goes_beside_the_session() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.give(Input::Disconnected);
    rig.messages.clear();
    rig.body.says(BodyNews::Mode(Mode::Manual));
    rig.silence(600_000);
    assert_eq!(rig.messages.len(), 0);
    let old = produced(&rig);
    assert!((257..400).contains(&old), "{old}");
    rig.connect();
    assert_eq!((on_link(&rig, Lane::Event), on_link(&rig, Lane::Status)), (vec![1], vec![]));
    assert_eq!((rig.hb, beside(&rig)), (1, vec![(1, 256)]));
    let replay = &rig.replays[0];
    let said = (replay.robot_id.as_str(), replay.session_epoch, replay.session_secret.reveal(), replay.batch.lane);
    assert_eq!(said, ("rbt-01", rig.epoch, "secret", Lane::Status));
    // As long as there is no answer: heartbeats and events go, no other batch does, and newer samples wait.
    rig.body.says(BodyNews::Mode(Mode::Automatic));
    rig.pass(20_000);
    assert_eq!((on_link(&rig, Lane::Event), on_link(&rig, Lane::Status)), (vec![1, 2], vec![]));
    assert!(rig.hb >= 20 && rig.replays.len() == 1, "{}", rig.hb);
    stored(&mut rig);
    let all = produced(&rig);
    assert!(all > old);
    assert_eq!(beside(&rig), [(1, 256), (257, all)], "with what came since");
    stored(&mut rig);
    rig.pass(20_000);
    assert_eq!((rig.replays.len(), on_link(&rig, Lane::Status)[0]), (2, all + 1), "and then it is live");
    assert!(rig.core.memory().ring.lane(Lane::Status).acked == all);
}

#[test]
fn batches_follow_each_other_at_the_pace_of_the_robot() {
    let mut rig = back_after(1_800_000);
    stored(&mut rig);
    assert_eq!(rig.replays.len(), 1);
    rig.pass(500);
    assert_eq!(rig.replays.len(), 1);
    rig.pass(500);
    assert_eq!(beside(&rig), [(1, 256), (257, 512)]);
}

#[test]
fn a_little_old_status_goes_on_the_session() {
    for (many, is_little) in [(limits::REPLAY_ON_LINK_MAX, true), (limits::REPLAY_ON_LINK_MAX + 1, false)] {
        let mut rig = Rig::at("A");
        rig.give(Input::Disconnected);
        while produced(&rig) < many as u64 {
            rig.silence(500);
        }
        rig.connect();
        let went = (on_link(&rig, Lane::Status).len(), rig.replays.len());
        assert_eq!(went, if is_little { (many, 0) } else { (0, 1) });
    }
}

#[test]
fn a_server_that_does_not_know_the_call_gets_it_on_the_session_at_a_quarter_of_the_credit() {
    let mut rig = back_after(600_000);
    let old = produced(&rig);
    answer(&mut rig, Replayed::NotServed);
    rig.pass(1_000);
    let first = on_link(&rig, Lane::Status);
    assert_eq!((first[0], first.len()), (1, 64 * 1024 / 4 / 192));
    // Acknowledged in steps, everything comes, in order and once.
    while rig.core.memory().ring.lane(Lane::Status).acked < old {
        let sent = *on_link(&rig, Lane::Status).last().expect("some");
        rig.down(Downlink { acks: vec![ack(Lane::Status, sent)], ..Downlink::default() });
        rig.pass(1_000);
    }
    let all = on_link(&rig, Lane::Status);
    assert_eq!(all, (1..=all.len() as u64).collect::<Vec<_>>());
    assert_eq!(rig.replays.len(), 1);
}

#[test]
fn what_is_lost_in_the_middle_goes_on_later_from_what_the_server_has() {
    let mut rig = back_after(1_800_000);
    stored(&mut rig);
    rig.pass(1_000);
    answer(&mut rig, failed());
    rig.silence(500);
    assert_eq!(beside(&rig), [(1, 256), (257, 512)]);
    rig.pass(500);
    assert_eq!(beside(&rig), [(1, 256), (257, 512), (257, 512)]);
    // It had been stored, and the session said so.
    rig.down(Downlink { acks: vec![ack(Lane::Status, 512)], ..Downlink::default() });
    answer(&mut rig, failed());
    rig.pass(2_000);
    assert_eq!(beside(&rig)[3..], [(513, 768)]);
    assert!(on_link(&rig, Lane::Status).is_empty());
}

#[test]
fn after_as_many_failures_in_a_row_the_session_takes_what_is_left() {
    let mut rig = back_after(600_000);
    for tries in 1..=limits::REPLAY_TRIES as usize {
        assert_eq!((rig.replays.len(), on_link(&rig, Lane::Status)), (tries, vec![]));
        // One that changes nothing counts as one that failed.
        answer(&mut rig, if tries == 1 { Replayed::Stored(ack(Lane::Status, 0)) } else { failed() });
        rig.pass(4_000);
    }
    assert_eq!(on_link(&rig, Lane::Status)[0], 1);
    assert_eq!(rig.replays.len(), limits::REPLAY_TRIES as usize);
}

#[test]
fn an_answer_for_the_session_before_says_nothing_and_the_next_one_begins_from_what_is_stored() {
    let mut rig = back_after(1_800_000);
    stored(&mut rig);
    rig.pass(1_000);
    let before = rig.epoch;
    rig.give(Input::Disconnected);
    rig.give(Input::Replayed(before, Replayed::NotServed));
    rig.connect();
    assert_eq!(beside(&rig)[2..], [(257, 512)]);
    rig.give(Input::Replayed(before, Replayed::NotServed));
    rig.give(Input::Replayed(before, Replayed::Stored(ack(Lane::Status, 512))));
    rig.pass(2_000);
    assert_eq!((rig.replays.len(), on_link(&rig, Lane::Status)), (3, vec![]), "it waits for its own answer");
    stored(&mut rig);
    rig.pass(1_000);
    assert_eq!(beside(&rig)[3..], [(513, 768)]);
}

#[test]
fn a_hole_that_the_server_saw_in_old_status_is_said() {
    let mut rig = back_after(1_800_000);
    stored(&mut rig);
    rig.pass(1_000);
    // It lost its memory of the first batch, which was freed.
    answer(&mut rig, Replayed::Stored(LaneAck { lane: Lane::Status, seq: 0, expect: Some(1) }));
    rig.pass(1_000);
    let batch = &rig.replays[2].batch;
    let InboxItem::Gap(gap) = &batch.items[0] else { panic!("{:?}", batch.items[0]) };
    assert_eq!((gap.from_seq, gap.to_seq, gap.reason.code), (1, 256, Code::FreedAfterAck));
    assert_eq!(numbers(&batch.items[1..])[0], 257);
    answer(&mut rig, Replayed::Stored(ack(Lane::Status, 511)));
    rig.pass(1_000);
    assert_eq!(beside_from(&rig, 3), [(512, 767)]);
}

#[test]
fn a_robot_that_is_only_observed_sends_nothing_beside_its_session() {
    let mut rig = Rig::at("A");
    rig.give(Input::Disconnected);
    rig.silence(600_000);
    rig.connect_as(Welcome { session_epoch: 9, observed: true, ..welcome() });
    rig.pass(2_000);
    assert_eq!(rig.replays.len(), 0);
}
