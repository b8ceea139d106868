//! Too many connections: one more is closed at once, whoever is inside stays, and there is room again when one leaves.

use crate::frames::{dial, until_closed};
use crate::world::{HERE, THERE, World, within};
use midshift_edge::Config;
use tonic::Code;

#[tokio::test]
async fn an_address_fills_its_own_places_and_nobody_elses() {
    let world = World::open(Config { connections_per_network_max: 1, ..Config::default() }).await;
    let mut first = world.client().await;
    assert_eq!(first.asked("/who").await.status.code(), Code::Ok);
    let mut second = dial(world.address, HERE).await;
    within(until_closed(&mut second)).await;
    assert_eq!(world.counter("midshift_edge_refused_total", ("reason", "connections_per_network_max")), 1);
    let mut elsewhere = world.client_from(THERE).await;
    assert_eq!(elsewhere.asked("/who").await.header("address"), "127.0.0.2");
    assert_eq!(first.asked("/who").await.status.code(), Code::Ok);
    drop(first);
    within(world.admitted_from(HERE)).await;
}

#[tokio::test]
async fn a_full_port_closes_one_more_at_once_and_takes_the_next_when_one_has_left() {
    let world = World::open(Config { connections_max: 2, ..Config::default() }).await;
    let mut inside = [world.client().await, world.client_from(THERE).await];
    for client in &mut inside {
        assert_eq!(client.asked("/who").await.status.code(), Code::Ok);
    }
    assert_eq!(world.open_connections(), 2.0);
    for from in [HERE, THERE] {
        within(until_closed(&mut dial(world.address, from).await)).await;
    }
    assert_eq!(world.counter("midshift_edge_refused_total", ("reason", "connections_max")), 2);
    let [mut stays, leaves] = inside;
    drop(leaves);
    within(world.admitted_from(THERE)).await;
    assert_eq!(stays.asked("/who").await.status.code(), Code::Ok);
}

#[tokio::test]
async fn who_only_connects_counts_until_it_is_closed() {
    let config = Config { connections_max: 1, first_request: crate::world::SOON, ..Config::default() };
    let world = World::open(config).await;
    let mut silent = dial(world.address, HERE).await;
    within(until_closed(&mut silent)).await;
    within(world.admitted_from(HERE)).await;
    assert_eq!(world.counter("midshift_edge_closed_total", ("reason", "no_request")), 1);
}
