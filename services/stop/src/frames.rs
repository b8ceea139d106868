//! Messages to robots as bytes: encoded once, whatever the number of robots that are told.
//!
//! Invariant: no message is larger than [`limits::STOP_TOLD_BYTES`], except for one stop or reset that is, and none is.

use bytes::Bytes;
use midshift_core::limits;
use midshift_core::stop::{Reset, Stop};
use midshift_proto::stop::v1::{self, attend_response::Message as W};
use prost::Message;

fn encoded(message: W) -> Bytes {
    v1::AttendResponse { message: Some(message), facts_generation: 0 }.encode_to_vec().into()
}

fn encoded_facts(facts: v1::StopFacts, facts_generation: u64) -> Bytes {
    v1::AttendResponse { message: Some(W::Facts(facts)), facts_generation }.encode_to_vec().into()
}

/// Encodes stops and resets, in as many messages as they need. `generation` 0: they are a part of what `synced` ends.
pub fn encode_changes<'a>(
    stops: impl IntoIterator<Item = &'a Stop>,
    resets: impl IntoIterator<Item = &'a Reset>,
    generation: u64,
) -> Vec<Bytes> {
    let (mut all, mut next, mut bytes) = (Vec::new(), v1::StopFacts::default(), 0);
    let mut room_for = |more: usize, next: &mut v1::StopFacts| {
        if bytes + more > limits::STOP_TOLD_BYTES && bytes > 0 {
            let full = std::mem::take(next);
            all.push(encoded_facts(full, generation));
            bytes = 0;
        }
        bytes += more;
    };
    // A tag and a length come before each.
    const FRAME: usize = 8;
    for stop in stops {
        let stop = v1::Stop::from(stop);
        room_for(stop.encoded_len() + FRAME, &mut next);
        next.stops.push(stop);
    }
    for reset in resets {
        let reset = v1::Reset::from(reset);
        room_for(reset.encoded_len() + FRAME, &mut next);
        next.resets.push(reset);
    }
    if bytes > 0 {
        all.push(encoded_facts(next, generation));
    }
    all
}

/// All that is effective was said.
pub fn synced(generation: u64, key: &[u8]) -> Bytes {
    encoded(W::Synced(v1::Synced { generation, key: key.to_vec() }))
}

/// The answer to a check-in.
pub fn check_in_answer(nonce: u64, generation: u64) -> Bytes {
    encoded(W::CheckInAnswer(v1::CheckInAnswer { nonce, generation }))
}

/// Dial again.
pub fn move_over() -> Bytes {
    encoded(W::MoveOver(v1::MoveOver {}))
}
