//! Who was turned away: handed to whoever writes it down, so that it can be read afterwards.
//!
//! Invariant: nothing waits for it. What is handed over is limited, for each caller and for all, so that no flood of refusals fills a disk; what was left
//! out is counted, and the count goes with the next one that is not.

use crate::quota_key::QuotaKey;
use crate::rates::{Bucket, Rates};
use midshift_core::identity::Actor;
use midshift_core::limits;
use midshift_core::overload::Class;
use midshift_core::reason::{Code, Reason};
use midshift_core::time::LinkDuration;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use tokio::sync::mpsc;
use tokio::time::Instant;

/// One request that was denied for who asked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Denial {
    /// Who, by which token; `nobody`: it showed something worthless.
    pub actor: Actor,
    /// The IPv4 address, or the /64 of IPv6, that it came from.
    pub network: IpAddr,
    /// What it asked for; cut at [`limits::DENIED_PATH_BYTES`].
    pub path: String,
    /// The robot that it named, if the refusal says which.
    pub robot_id: Option<String>,
    /// Why not.
    pub code: Code,
    /// Denials of this port since the one handed over before that were not.
    pub left_out: u64,
}

/// Where a port hands them over.
pub struct Denials {
    port: &'static str,
    sink: mpsc::Sender<Denial>,
    each: Rates<QuotaKey>,
    all: Rates<()>,
    left_out: AtomicU64,
}

const fn bucket(every: LinkDuration, burst: u32) -> Bucket {
    Bucket { token: crate::config::std(every), burst }
}

impl Denials {
    /// Of a port, and what it hands over.
    pub fn new(port: &'static str) -> (Self, mpsc::Receiver<Denial>) {
        let (sink, told) = mpsc::channel(limits::DENIALS_QUEUED_MAX);
        let each = bucket(limits::DENIALS_EVERY, limits::DENIALS_BURST);
        let all = bucket(limits::DENIALS_ALL_EVERY, limits::DENIALS_ALL_BURST);
        let (each, all) = (Rates::new(each, limits::RATES_REMEMBERED), Rates::new(all, 1));
        (Self { port, sink, each, all, left_out: AtomicU64::new(0) }, told)
    }

    /// Whether one more of this key may leave a trace. It counts as one that did.
    fn is_fit(&self, key: &QuotaKey) -> bool {
        let now = Instant::now();
        self.each.admit(key, now, Class::Stop) && self.all.admit(&(), now, Class::Stop)
    }

    /// Hands it over, if one more of this key may leave a trace.
    pub(crate) fn report(&self, key: &QuotaKey, actor: Actor, network: IpAddr, path: &str, reason: &Reason) {
        let Some(place) = self.is_fit(key).then(|| self.sink.try_reserve().ok()).flatten() else {
            self.left_out.fetch_add(1, Relaxed);
            metrics::counter!("midshift_edge_denials_left_out_total", "port" => self.port).increment(1);
            return;
        };
        let path = cut(path).to_owned();
        let (robot_id, code) = (reason.metadata.get("robot_id").cloned(), reason.code);
        place.send(Denial { actor, network, path, robot_id, code, left_out: self.left_out.swap(0, Relaxed) });
    }
}

/// As much of a path as is kept and shown.
pub(crate) fn cut(path: &str) -> &str {
    path.get(..path.floor_char_boundary(limits::DENIED_PATH_BYTES)).unwrap_or_default()
}
