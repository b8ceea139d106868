//! Who may be connected: asked at the handshake and whenever the answer may have changed.

use crate::frames::{GOAWAY, HEADERS, Raw, dial, until_closed};
use crate::world::{HERE, THERE, World, within};
use http::HeaderMap;
use midshift_core::identity::Caller;
use midshift_core::reason::Refusal;
use midshift_edge::{Config, Denied, Peer, Principals};
use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::{Arc, Mutex};
use tokio::sync::watch;
use tonic::Code;

/// Everybody by address, but those on the list.
#[derive(Default)]
pub struct Register {
    denied: Mutex<BTreeSet<IpAddr>>,
    changed: watch::Sender<u64>,
}

impl Register {
    fn revoke(&self, address: [u8; 4]) {
        self.denied.lock().expect("not poisoned").insert(Ipv4Addr::from(address).into());
        self.touch();
    }
    fn touch(&self) {
        self.changed.send_modify(|n| *n += 1);
    }
}

impl Principals for Register {
    fn admit(&self, peer: &Peer) -> Result<(), Denied> {
        let address = peer.address.ip();
        if self.denied.lock().expect("not poisoned").contains(&address) {
            return Err(Denied::Revoked);
        }
        Ok(())
    }
    fn caller(&self, _: &Peer, _: &HeaderMap) -> Result<Caller, Refusal> {
        Ok(Caller::local())
    }
    fn changed(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }
}

#[tokio::test]
async fn a_revoked_principals_connection_is_cut_and_anothers_goes_on() {
    let register = Arc::new(Register::default());
    let world = World::with(Config::default(), register.clone(), None).await;
    let mut stays = world.client().await;
    assert_eq!(stays.asked("/who").await.header("principal"), "anonymous");
    let mut stream = stays.begin("/pulse", None).await.expect("a stream");
    let mut stream = within(&mut stream).await.expect("its head").into_body();
    let mut goes = Raw::dial(world.address, THERE).await;
    goes.call(1, "/stream").await;
    within(goes.next(HEADERS)).await.expect("the head of a stream");
    register.touch();
    stays.asked("/poke").await;
    assert!(within(stream.data()).await.expect("a word").is_ok(), "a change that is not about them cuts nobody");
    register.revoke(THERE);
    let frames = within(goes.rest()).await;
    assert!(!frames.iter().any(|f| f.kind == GOAWAY), "cut, not asked: {frames:?}");
    world.closed_for("denied").await;
    stays.asked("/poke").await;
    assert!(within(stream.data()).await.expect("a word").is_ok());
}

#[tokio::test]
async fn a_denied_principal_does_not_come_in() {
    let register = Arc::new(Register::default());
    register.revoke(THERE);
    let world = World::with(Config::default(), register, None).await;
    let mut denied = dial(world.address, THERE).await;
    assert_eq!(within(until_closed(&mut denied)).await, b"");
    world.closed_for("denied").await;
    let mut other = world.client_from(HERE).await;
    assert_eq!(other.asked("/who").await.status.code(), Code::Ok);
}
