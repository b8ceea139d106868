//! Whoever has not shown who it is takes a share of its own, and nothing of what robots and people have.

use crate::frames::{dial, until_closed};
use crate::login::{Port, code, secret};
use crate::world::{Client, within};
use midshift_core::identity::Secret;
use midshift_core::reason::Code;
use midshift_core::time::LinkDuration;
use midshift_edge::Config;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use tokio::net::TcpStream;
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

const SESSION: &str = "/midshift.link.v1.LinkService/Session";
const LIST: &str = "/midshift.task.v1.TaskService/ListTasks";
const HEALTH: &str = "/grpc.health.v1.Health/Check";
const WATCH: &str = "/grpc.health.v1.Health/Watch";

/// A port of 64 connections: 16 of them for peers that have not authenticated, a quarter of what the others leave of these for one address.
fn small() -> Config {
    let tls_handshake = LinkDuration::from_secs(600);
    Config { connections_max: 64, connections_per_network_max: 16, tls_handshake, ..Config::default() }
}

/// Connections of that address that say nothing, until the next one is closed at once.
async fn fill(port: &Port, from: [u8; 4]) -> Vec<TcpStream> {
    let refused = || port.world.counter("midshift_edge_refused_total", ("port", "business"));
    let (mut silent, before) = (Vec::new(), refused());
    loop {
        let open = port.world.open_connections() as usize;
        let mut next = dial(port.world.address, from).await;
        let taken = async {
            while refused() == before && port.world.open_connections() as usize == open {
                tokio::task::yield_now().await;
            }
        };
        within(taken).await;
        if refused() > before {
            within(until_closed(&mut next)).await;
            return silent;
        }
        silent.push(next);
    }
}

#[tokio::test]
async fn addresses_of_strangers_fill_a_share_of_the_port_and_robots_and_people_come_in_all_the_same() {
    let port = Port::with(small()).await;
    let mut silent = Vec::new();
    for host in 11..15 {
        let of_one = fill(&port, [127, 0, 0, host]).await;
        assert!((1..=4).contains(&of_one.len()), "{} of one address", of_one.len());
        silent.extend(of_one);
    }
    assert!(silent.len() < 16, "there is room for one more address: {}", silent.len());
    assert!(port.world.counter("midshift_edge_refused_total", ("reason", "strangers_per_network_max")) >= 4);
    // More of one address than may be unauthenticated in all: each is one of them until it has shown who it is, and no longer.
    let mut robots = Vec::new();
    for n in 0..8 {
        let mut robot = port.client(Some(&port.robot(&format!("r{n}")))).await;
        assert_eq!(code(&mut robot, SESSION, None).await, Ok(format!("robot:r{n}")));
        robots.push(robot);
    }
    let token = secret();
    port.knows(&token, &["viewer"], i64::MAX);
    let bearer = format!("Bearer {}", token.reveal(Secret::TOKEN));
    let mut people = Vec::new();
    for _ in 0..8 {
        let mut person = port.client(None).await;
        assert_eq!(code(&mut person, LIST, Some(&bearer)).await, Ok("anna".to_owned()));
        people.push(person);
    }
}

#[tokio::test]
async fn open_calls_of_nobody_have_a_share_of_their_own() {
    let port = Port::with(Config { requests_max: 16, requests_per_principal_max: 8, ..Config::default() }).await;
    let mut unauthenticated = port.client(None).await;
    let mut open = Vec::new();
    while let Some(call) = unauthenticated.held(HEALTH).await {
        open.push(call);
    }
    assert_eq!(open.len(), 2, "a quarter of all, and of that as much as of all");
    assert_eq!(code(&mut unauthenticated, HEALTH, None).await, Err(Code::TooManyRequests));
    let mut robot = port.client(Some(&port.robot("r7"))).await;
    assert_eq!(code(&mut robot, SESSION, None).await, Ok("robot:r7".to_owned()));
    drop(open);
    let again = async { while code(&mut unauthenticated, HEALTH, None).await.is_err() {} };
    within(again).await;
}

#[tokio::test]
async fn nobody_watches_health_without_signing_in() {
    let port = Port::open().await;
    let mut unauthenticated = port.client(None).await;
    assert_eq!(code(&mut unauthenticated, WATCH, None).await, Err(Code::SignInNeeded));
    assert!(code(&mut unauthenticated, HEALTH, None).await.is_ok());
    let mut robot = port.client(Some(&port.robot("r7"))).await;
    assert!(code(&mut robot, WATCH, None).await.is_ok());
}

/// Counts lines of the log that people see without asking for more, and the bytes of their fields.
#[derive(Clone, Default)]
struct Log {
    lines: Arc<AtomicUsize>,
    bytes: Arc<AtomicUsize>,
    /// Lines that say no peer, and are therefore written however many there are.
    unmarked: Arc<AtomicUsize>,
}

impl Subscriber for Log {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        *metadata.level() <= Level::INFO
    }
    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }
    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn event(&self, event: &Event<'_>) {
        self.lines.fetch_add(1, Ordering::Relaxed);
        let is_marked = event.metadata().fields().field("peer").is_some();
        self.unmarked.fetch_add(usize::from(!is_marked), Ordering::Relaxed);
        let mut bytes = 0;
        event.record(&mut |_: &tracing::field::Field, value: &dyn std::fmt::Debug| bytes += format!("{value:?}").len());
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
    }
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

#[tokio::test]
async fn each_line_of_a_flood_of_denials_names_its_peer_so_that_it_can_be_counted_and_is_short() {
    let log = Log::default();
    let _kept = tracing::subscriber::set_default(log.clone());
    let port = Port::open().await;
    let long = format!("/{}", "x".repeat(8_000));
    let mut client: Client = port.client(None).await;
    for _ in 0..200 {
        assert_eq!(code(&mut client, &long, Some("Bearer of nothing")).await, Err(Code::TokenUnknown));
    }
    let (lines, bytes) = (log.lines.load(Ordering::Relaxed), log.bytes.load(Ordering::Relaxed));
    assert_eq!((lines, log.unmarked.load(Ordering::Relaxed)), (200, 0));
    assert!(bytes < lines * 400, "{bytes} bytes in {lines} lines");
}
