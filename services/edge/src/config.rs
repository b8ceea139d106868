//! What an edge allows: every limit of a port in one typed place.
//!
//! Invariant: nothing here is unlimited. The values of [`Config::default`] stand in `core::limits` with their unit and why; times are of the
//! link clock.

use midshift_core::limits;
use midshift_core::overload::bugs::Bugs;
use midshift_core::time::LinkDuration;
use std::num::NonZeroU32;
use std::time::Duration;

/// Limits of one port.
#[derive(Clone, Debug)]
pub struct Config {
    /// Which port this is, as metrics and logs name it.
    pub port: &'static str,
    /// Connections, handshakes included. With TLS a quarter of them, and no more, has not shown yet who it is ([`limits::STRANGERS_PART`]).
    pub connections_max: usize,
    /// Of these, from one IPv4 address or one /64 of IPv6. A proxy in front is one address.
    pub connections_per_network_max: usize,
    /// Time for a TLS handshake.
    pub tls_handshake: LinkDuration,
    /// Time from then until the head of the first request is there, HTTP/2 preface included.
    pub first_request: LinkDuration,
    /// Time for each head of an HTTP/1.1 connection, and how long one may be kept between two requests.
    pub http1_head: LinkDuration,
    /// Time without any stream.
    pub idle: LinkDuration,
    /// Pause between pings of an HTTP/2 connection.
    pub keepalive_every: LinkDuration,
    /// Time for the answer to a ping.
    pub keepalive_within: LinkDuration,
    /// How often it is asked whether a connection without a certificate may still be there.
    pub asked_again: LinkDuration,
    /// Streams of one connection at a time; a peer is told so and waits.
    pub streams_per_connection: u32,
    /// Bytes of the header list of an HTTP/2 request.
    pub header_list_bytes: u32,
    /// How old a connection gets; none: as old as it likes.
    pub age: Option<Age>,
    /// Requests under way, streams included. A quarter of them, and no more than [`limits::STRANGER_REQUESTS_MAX`], is of nobody known.
    pub requests_max: usize,
    /// Of these, of one principal.
    pub requests_per_principal_max: usize,
    /// Watches, which go on for as long as their caller likes.
    pub watches_max: usize,
    /// Of these, of one principal.
    pub watches_per_principal_max: usize,
    /// How fast one principal may ask.
    pub rate: Rate,
    /// Principals whose rate is remembered.
    pub rates_remembered: usize,
    /// Time until the head of an answer. Streams may go on for as long as they like after it.
    pub head: LinkDuration,
    /// What is still open so long after the stop is cut.
    pub drain: LinkDuration,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            port: "business",
            connections_max: limits::CONNECTIONS_MAX,
            connections_per_network_max: limits::CONNECTIONS_PER_NETWORK_MAX,
            tls_handshake: limits::TLS_HANDSHAKE_WITHIN,
            first_request: limits::FIRST_REQUEST_WITHIN,
            http1_head: limits::HTTP1_HEAD_WITHIN,
            idle: limits::CONNECTION_IDLE,
            keepalive_every: limits::KEEPALIVE_EVERY,
            keepalive_within: limits::KEEPALIVE_WITHIN,
            asked_again: limits::CONNECTION_ASKED_AGAIN,
            streams_per_connection: limits::STREAMS_PER_CONNECTION,
            header_list_bytes: limits::HEADER_LIST_BYTES,
            age: Some(Age::after(limits::CONNECTION_AGE)),
            requests_max: limits::REQUESTS_MAX,
            requests_per_principal_max: limits::REQUESTS_PER_PRINCIPAL_MAX,
            watches_max: limits::WATCHES_MAX,
            watches_per_principal_max: limits::WATCHES_PER_PRINCIPAL_MAX,
            rate: Rate::default(),
            rates_remembered: limits::RATES_REMEMBERED,
            head: limits::UNARY_DEADLINE,
            drain: limits::HARD_DRAIN,
            bugs: Bugs::default(),
        }
    }
}

/// A rate with room for bursts.
#[derive(Clone, Copy, Debug)]
pub struct Rate {
    /// Requests a second, for long.
    pub per_second: NonZeroU32,
    /// Requests at once.
    pub burst: NonZeroU32,
}

impl Default for Rate {
    fn default() -> Self {
        const fn at_least_one(n: u32) -> NonZeroU32 {
            match NonZeroU32::new(n) {
                Some(n) => n,
                None => NonZeroU32::MIN,
            }
        }
        Self {
            per_second: const { at_least_one(limits::REQUESTS_PER_SECOND) },
            burst: const { at_least_one(limits::REQUESTS_BURST) },
        }
    }
}

/// When a connection is old, and how it is asked to go: its streams are told, then the peer, then it is closed.
#[derive(Clone, Copy, Debug)]
pub struct Age {
    /// Usual age.
    pub after: LinkDuration,
    /// So much younger or older, permille of it: connections that came together do not go together. At most 1000.
    pub jitter_permille: u32,
    /// From telling its streams ([`crate::Peer::go_away`]) to GOAWAY.
    pub notice: LinkDuration,
    /// From GOAWAY to the close.
    pub grace: LinkDuration,
}

impl Age {
    /// That age, a tenth of it as jitter, and the usual time to go.
    pub const fn after(after: LinkDuration) -> Self {
        Self { after, jitter_permille: 100, notice: limits::CONNECTION_NOTICE, grace: limits::CONNECTION_GRACE }
    }

    /// The age of one connection; `draw` is even over all of `u32`.
    pub(crate) fn drawn(&self, draw: u32) -> Duration {
        let after_us = u128::from(self.after.as_ms()) * 1000;
        let jitter = u128::from(self.jitter_permille.min(1000));
        let spread_us = after_us * 2 * jitter / 1000;
        let us = after_us * (1000 - jitter) / 1000 + spread_us * u128::from(draw) / u128::from(u32::MAX);
        Duration::from_micros(u64::try_from(us).unwrap_or(u64::MAX))
    }
}

/// For tokio.
pub(crate) const fn std(duration: LinkDuration) -> Duration {
    Duration::from_millis(duration.as_ms())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ages_lie_evenly_around_the_usual_one_and_never_outside_the_jitter() {
        let age = Age { jitter_permille: 250, ..Age::after(LinkDuration::from_secs(100)) };
        assert_eq!(age.drawn(0), Duration::from_secs(75));
        assert_eq!(age.drawn(u32::MAX), Duration::from_secs(125));
        assert_eq!(age.drawn(u32::MAX / 2).as_secs(), 99);
        let wide = Age { jitter_permille: 5_000, ..age };
        assert_eq!(wide.drawn(0), Duration::ZERO, "jitter of more than all is all");
        let endless = Age::after(LinkDuration(u64::MAX));
        assert_eq!(endless.drawn(u32::MAX), Duration::from_micros(u64::MAX));
    }
}
