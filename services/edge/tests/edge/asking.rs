//! How much and how fast one may ask, and until when one is answered.

use crate::frames::{dial, until_closed};
use crate::principals::Register;
use crate::world::{HERE, SOON, THERE, World, within};
use midshift_core::overload::bugs::{Bugs, SeededBug};
use midshift_core::reason::Code as Reason;
use midshift_edge::{Config, Rate};
use midshift_proto::status::RETRY_AFTER;
use std::num::NonZeroU32;
use std::sync::Arc;
use tokio::io::AsyncWriteExt;
use tonic::Code;

/// Of a class that a flood of lower ones takes nothing from.
const HEALTH: &str = "/grpc.health.v1.Health/Check";
const ENGAGE: &str = "/midshift.stop.v1.StopService/Engage";
const CANCEL: &str = "/midshift.task.v1.TaskService/CancelTask";
const LIST: &str = "/midshift.task.v1.TaskService/ListTasks";
const WATCH: &str = "/midshift.task.v1.TaskService/WatchTasks";
/// Goes on until it is let go.
const OPEN: &str = "/midshift.telemetry.v1.TelemetryService/WatchRobots";
const FETCH: &str = "/midshift.ota.v1.ChunkService/FetchChunks";

const PAGE: &str = "GET /ready HTTP/1.1\r\nhost: edge\r\n\r\n";

/// A token comes back in a time that no test has.
fn three_at_once() -> Rate {
    Rate { per_second: NonZeroU32::MIN, burst: NonZeroU32::MIN.saturating_add(2) }
}

async fn named(config: Config) -> World {
    World::with(config, Arc::new(Register::default()), None).await
}

#[tokio::test]
async fn who_floods_is_told_when_to_come_back_and_another_is_served() {
    let world = named(Config { rate: three_at_once(), ..Config::default() }).await;
    // Two connections of one principal have one bucket.
    let mut flood = [world.client().await, world.client().await];
    let mut refused = None;
    for turn in 0..1_000 {
        let answered = flood[turn % 2].asked(HEALTH).await;
        if answered.status.code() != Code::Ok {
            refused = Some((turn, answered));
            break;
        }
    }
    let (turn, refused) = refused.expect("a refusal");
    let answer = refused.answer();
    assert!(turn >= 3, "a burst is let in");
    assert_eq!((answer.grpc, answer.code), (Code::ResourceExhausted, Some(Reason::TooManyRequests)));
    assert_eq!(answer.retry_after, Some(RETRY_AFTER));
    assert!(refused.head.headers().contains_key("grpc-status"), "trailers alone: nothing was begun");
    assert_eq!(world.counter("midshift_edge_requests_refused_total", ("reason", "TOO_MANY_REQUESTS")), 1);
    let mut other = world.client_from(THERE).await;
    assert_eq!(other.asked(HEALTH).await.status.code(), Code::Ok);
}

#[tokio::test]
async fn a_flood_of_http_1_hears_429() {
    let world = World::open(Config { rate: three_at_once(), ..Config::default() }).await;
    let mut browser = dial(world.address, HERE).await;
    browser.write_all(PAGE.repeat(200).as_bytes()).await.expect("written");
    browser.write_all(b"GET /ready HTTP/1.1\r\nhost: edge\r\nconnection: close\r\n\r\n").await.expect("written");
    let said = within(until_closed(&mut browser)).await;
    let said = String::from_utf8_lossy(&said);
    assert!(
        said.contains("HTTP/1.1 200") && said.contains("HTTP/1.1 429") && said.contains("retry-after: 1"),
        "{said}"
    );
}

#[tokio::test]
async fn calls_that_stay_open_are_counted_for_their_principal_until_they_end() {
    let world = named(Config { requests_per_principal_max: 1, ..Config::default() }).await;
    let mut client = world.client().await;
    let open = client.begin("/stream", None).await.expect("a stream");
    let open = within(open).await.expect("its head");
    assert_eq!(client.asked("/who").await.answer().code, Some(Reason::TooManyRequests));
    let mut other = world.client_from(THERE).await;
    assert_eq!(other.asked("/who").await.status.code(), Code::Ok);
    drop(open);
    while client.asked("/who").await.status.code() != Code::Ok {}
}

#[tokio::test]
async fn watches_are_counted_for_their_principal_and_no_other_call_is() {
    let world = named(Config { watches_per_principal_max: 1, ..Config::default() }).await;
    let mut client = world.client().await;
    let open = within(client.begin(OPEN, None).await.expect("a stream")).await.expect("its head");
    assert_eq!(client.asked(OPEN).await.answer().code, Some(Reason::TooManyRequests));
    assert_eq!(client.asked("/who").await.status.code(), Code::Ok);
    let mut other = world.client_from(THERE).await;
    let also = within(other.begin(OPEN, None).await.expect("a stream")).await.expect("its head");
    assert!(!also.headers().contains_key("grpc-status"), "it goes on");
    drop(open);
    loop {
        let again = within(client.begin(OPEN, None).await.expect("a stream")).await.expect("its head");
        if !again.headers().contains_key("grpc-status") {
            break;
        }
    }
}

#[tokio::test]
async fn a_port_with_as_many_watches_as_it_takes_says_so() {
    let world = named(Config { watches_max: 1, ..Config::default() }).await;
    let mut client = world.client().await;
    let _open = within(client.begin(OPEN, None).await.expect("a stream")).await.expect("its head");
    let answer = world.client_from(THERE).await.asked(OPEN).await.answer();
    assert_eq!((answer.grpc, answer.code), (Code::ResourceExhausted, Some(Reason::Overloaded)));
}

#[tokio::test]
async fn a_port_that_is_full_of_calls_says_so() {
    let world = named(Config { requests_max: 1, ..Config::default() }).await;
    let mut client = world.client().await;
    let _open = within(client.begin("/stream", None).await.expect("a stream")).await.expect("its head");
    let mut other = world.client_from(THERE).await;
    let answer = other.asked("/who").await.answer();
    assert_eq!((answer.grpc, answer.code), (Code::ResourceExhausted, Some(Reason::Overloaded)));
}

#[tokio::test]
async fn a_full_port_sheds_the_lowest_first_and_serves_all_again_by_itself() {
    let world = named(Config { requests_max: 10, ..Config::default() }).await;
    let mut flood = world.client().await;
    // As many as come in, of each class in turn, from the lowest on.
    let mut open = Vec::new();
    let mut filled = Vec::new();
    for path in [FETCH, LIST, WATCH, CANCEL, ENGAGE] {
        while let Some(head) = flood.held(path).await {
            open.push(head);
        }
        filled.push(open.len());
    }
    assert_eq!(filled, [6, 7, 8, 9, 10]);
    // Somebody else is served in the order of classes while the flood goes down.
    let mut other = world.client_from(THERE).await;
    let mut answers = async |path| other.asked(path).await.answer();
    let refused = answers(ENGAGE).await;
    assert_eq!((refused.grpc, refused.code), (Code::ResourceExhausted, Some(Reason::Overloaded)));
    assert_eq!(refused.retry_after, Some(RETRY_AFTER));
    for (n, (now, not_yet)) in
        [(ENGAGE, Some(CANCEL)), (CANCEL, Some(WATCH)), (WATCH, Some(LIST)), (LIST, Some(FETCH)), (FETCH, None)]
            .into_iter()
            .enumerate()
    {
        drop(open.pop());
        while world.requests_open() + n + 1 > 10 {
            tokio::task::yield_now().await;
        }
        assert_eq!(answers(now).await.grpc, Code::Ok, "{now}");
        if let Some(not_yet) = not_yet {
            assert_eq!(answers(not_yet).await.code, Some(Reason::Overloaded), "{not_yet}");
        }
    }
    drop(open);
    while flood.asked(FETCH).await.status.code() != Code::Ok {}
}

/// Whether a stop is engaged while a port is as full as it gets of what can wait.
async fn stops_a_full_port(bugs: Bugs) -> bool {
    let world = named(Config { requests_max: 10, bugs, ..Config::default() }).await;
    let mut flood = world.client().await;
    let mut open = Vec::new();
    while let Some(head) = flood.held(FETCH).await {
        open.push(head);
    }
    let mut other = world.client_from(THERE).await;
    other.asked(ENGAGE).await.answer().grpc == Code::Ok
}

#[tokio::test]
async fn a_stop_finds_room_in_a_full_port_and_where_classes_are_alike_it_does_not() {
    assert!(stops_a_full_port(Bugs::default()).await);
    assert!(!stops_a_full_port(Bugs::seeded(&[SeededBug::ClassesAreAlike])).await);
}

/// Whether a port that was full serves again when all that filled it has ended.
async fn serves_again(bugs: Bugs) -> bool {
    let world = named(Config { requests_max: 10, bugs, ..Config::default() }).await;
    let mut flood = world.client().await;
    // Often enough for slots that are not given back to be used up.
    for _ in 0..10 {
        let mut open = Vec::new();
        while let Some(head) = flood.held(FETCH).await {
            open.push(head);
        }
        drop(open);
        while world.requests_open() > 0 {
            tokio::task::yield_now().await;
        }
    }
    let mut other = world.client_from(THERE).await;
    other.asked(FETCH).await.answer().grpc == Code::Ok
}

#[tokio::test]
async fn a_port_that_was_full_serves_again_and_where_seats_are_kept_it_never_does() {
    assert!(serves_again(Bugs::default()).await);
    assert!(!serves_again(Bugs::seeded(&[SeededBug::SeatsAreKept])).await);
}

#[tokio::test]
async fn a_caller_that_floods_with_what_can_wait_can_still_stop() {
    let ten = NonZeroU32::MIN.saturating_add(9);
    let world = named(Config { rate: Rate { per_second: NonZeroU32::MIN, burst: ten }, ..Config::default() }).await;
    let mut flood = world.client().await;
    let mut served = 0;
    while flood.asked(FETCH).await.status.code() == Code::Ok {
        served += 1;
    }
    assert!(served >= 6, "{served}");
    assert_eq!(flood.asked(FETCH).await.answer().code, Some(Reason::TooManyRequests));
    assert_eq!(flood.asked(ENGAGE).await.status.code(), Code::Ok);
}

#[tokio::test]
async fn a_callers_time_ends_a_call_that_hangs() {
    let world = World::open(Config::default()).await;
    let mut client = world.client().await;
    let late = client.ask("/hang", Some("50m")).await.expect("an answer");
    assert_eq!((late.answer().grpc, late.answer().code), (Code::DeadlineExceeded, Some(Reason::DeadlineExceeded)));
}

#[tokio::test]
async fn a_callers_time_ends_a_stream_that_has_begun() {
    let world = World::open(Config::default()).await;
    let mut client = world.client().await;
    let stream = within(client.begin("/stream", Some("50m")).await.expect("a stream")).await.expect("its head");
    assert!(!stream.headers().contains_key("grpc-status"), "the head came before the end");
    let late = within(crate::world::whole(stream)).await.expect("an end with a status");
    assert_eq!((late.answer().grpc, late.answer().code), (Code::DeadlineExceeded, Some(Reason::DeadlineExceeded)));
    assert_eq!(client.asked("/who").await.status.code(), Code::Ok, "its connection goes on");
}

#[tokio::test]
async fn the_ports_own_time_is_for_the_head_and_streams_outlive_it() {
    let world = World::open(Config { head: SOON, ..Config::default() }).await;
    let mut client = world.client().await;
    let session = within(client.begin("/pulse", None).await.expect("a stream")).await.expect("its head");
    // Begun after the session and ended by the port's time: so much time has gone by for the session too.
    for _ in 0..2 {
        assert_eq!(client.ask("/hang", Some("1H")).await.expect("an answer").status.code(), Code::DeadlineExceeded);
    }
    client.asked("/poke").await;
    assert!(within(session.into_body().data()).await.expect("a word").is_ok());
}

#[tokio::test]
async fn a_time_that_is_none_is_refused_and_not_ignored() {
    let world = World::open(Config::default()).await;
    let answer = world.client().await.ask("/who", Some("soon")).await.expect("an answer").answer();
    assert_eq!((answer.grpc, answer.violations[0].field.as_str()), (Code::InvalidArgument, "grpc-timeout"));
}

#[tokio::test]
async fn a_fault_of_a_service_ends_the_call_that_met_it_and_nothing_else_on_its_connection() {
    let world = World::open(Config::default()).await;
    let mut client = world.client().await;
    let session = within(client.begin("/pulse", None).await.expect("a stream")).await.expect("its head");
    for _ in 0..3 {
        let answer = client.asked("/panic").await.answer();
        assert_eq!((answer.grpc, answer.code), (Code::Internal, Some(Reason::Internal)));
    }
    client.asked("/poke").await;
    assert!(within(session.into_body().data()).await.expect("a word").is_ok());
    assert_eq!((world.counter("midshift_edge_panics_total", ("at", "call")), world.requests_open()), (3, 1));
}
