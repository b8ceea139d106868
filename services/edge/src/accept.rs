//! Accepts connections without spinning: sorts the errors of accept(2), and pauses when the process lacks resources.
//!
//! Invariants:
//! 1. Without descriptors or memory the loop pauses. Each pause is twice the one before, up to a second.
//! 2. A connection that died in the queue causes no pause.
//! 3. Every error is counted. The log has the first failure of a series of the port, and
//!    its end.
//!
//! No spare descriptor is kept for closing peers. A peer in the queue costs nothing and is served once there is room. A
//! closed peer dials again at once, and another thread may take the freed descriptor first.

use crate::config::std;
use crate::listen::Listen;
use midshift_core::limits::{ACCEPT_PAUSE, ACCEPT_PAUSE_MAX};
use std::io::{self, ErrorKind};
use std::net::SocketAddr;
use std::time::Duration;
use tokio::time::{Instant, sleep_until};

/// Whether an error is of the one connection that was taken from the queue. accept(2) hands such out too.
fn of_one_connection(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::ConnectionAborted
            | ErrorKind::ConnectionReset
            | ErrorKind::ConnectionRefused
            | ErrorKind::HostUnreachable
            | ErrorKind::NetworkUnreachable
            | ErrorKind::NetworkDown
            | ErrorKind::Interrupted
    )
}

/// The pause after `failures` in a row, of which there is one at least.
fn pause(failures: u32) -> Duration {
    let doublings = failures.saturating_sub(1).min(16);
    (std(ACCEPT_PAUSE) * (1 << doublings)).min(std(ACCEPT_PAUSE_MAX))
}

/// A listener that waits when it must.
pub(crate) struct Accept<L> {
    listener: L,
    port: &'static str,
    failures: u32,
    paused_until: Option<Instant>,
}

impl<L: Listen> Accept<L> {
    pub fn new(listener: L, port: &'static str) -> Self {
        Self { listener, port, failures: 0, paused_until: None }
    }

    /// The next connection; none: there will be no more. Cancel safe.
    pub async fn next(&mut self) -> Option<(L::Io, SocketAddr)> {
        loop {
            if let Some(until) = self.paused_until {
                sleep_until(until).await;
                self.paused_until = None;
            }
            match self.listener.accept().await {
                Ok(accepted) => {
                    self.worked();
                    return accepted;
                }
                Err(error) => self.failed(&error),
            }
        }
    }

    fn worked(&mut self) {
        if self.failures > 0 {
            let (port, failures) = (self.port, self.failures);
            tracing::info!(port, peer = "any", failures, "connections are accepted again");
            self.failures = 0;
        }
    }

    fn failed(&mut self, error: &io::Error) {
        let of_one = of_one_connection(error);
        let what = if of_one { "connection" } else { "port" };
        metrics::counter!("midshift_edge_accept_errors_total", "port" => self.port, "of" => what).increment(1);
        if of_one {
            return;
        }
        if self.failures == 0 {
            let port = self.port;
            tracing::warn!(port, peer = "any", %error, "connections cannot be accepted; trying again, ever more slowly");
        }
        self.failures = self.failures.saturating_add(1);
        self.paused_until = Some(Instant::now() + pause(self.failures));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::VecDeque;
    use tokio::io::{DuplexStream, duplex};

    /// errno of Linux.
    const EMFILE: i32 = 24;
    const ECONNABORTED: i32 = 103;

    /// What accept answers, one after the other; then EMFILE for ever.
    #[derive(Default)]
    struct Script {
        answers: VecDeque<io::Result<DuplexStream>>,
        asked: u32,
    }

    impl Listen for Script {
        type Io = DuplexStream;
        async fn accept(&mut self) -> io::Result<Option<(DuplexStream, SocketAddr)>> {
            self.asked += 1;
            let answer = self.answers.pop_front().unwrap_or_else(|| Err(io::Error::from_raw_os_error(EMFILE)));
            answer.map(|io| Some((io, SocketAddr::from(([127, 0, 0, 1], 1)))))
        }
    }

    fn errors(errno: i32, times: usize) -> impl Iterator<Item = io::Result<DuplexStream>> {
        (0..times).map(move |_| Err(io::Error::from_raw_os_error(errno)))
    }

    #[tokio::test(start_paused = true)]
    async fn without_descriptors_it_asks_ever_more_slowly_and_goes_on_when_there_is_one() {
        let answers = errors(EMFILE, 12).chain([Ok(duplex(1).0)]).collect();
        let (mut accept, begun) = (Accept::new(Script { answers, asked: 0 }, "test"), Instant::now());
        assert!(accept.next().await.is_some());
        // 100, 200, 400, 800 ms, then a second each.
        assert_eq!((accept.listener.asked, begun.elapsed().as_secs_f64()), (13, 9.5));
        accept.listener.answers.extend(errors(EMFILE, 1).chain([Ok(duplex(1).0)]));
        let begun = Instant::now();
        assert!(accept.next().await.is_some());
        assert_eq!(begun.elapsed(), std(ACCEPT_PAUSE), "what is over is forgotten");
    }

    #[tokio::test(start_paused = true)]
    async fn a_pause_that_is_looked_away_from_still_counts() {
        let mut accept = Accept::new(Script::default(), "test");
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(10) {
            assert!(tokio::time::timeout(Duration::from_millis(10), accept.next()).await.is_err());
        }
        assert!(accept.listener.asked <= 14, "asked {} times in ten seconds", accept.listener.asked);
    }

    #[tokio::test(start_paused = true)]
    async fn connections_that_died_in_the_queue_keep_nobody_waiting() {
        let answers = errors(ECONNABORTED, 1_000).chain([Ok(duplex(1).0)]).collect();
        let (mut accept, begun) = (Accept::new(Script { answers, asked: 0 }, "test"), Instant::now());
        assert!(accept.next().await.is_some());
        assert_eq!((accept.listener.asked, begun.elapsed()), (1_001, Duration::ZERO));
    }

    #[test]
    fn pauses_double_up_to_a_second() {
        let pauses: Vec<u128> = [1, 2, 3, 4, 5, u32::MAX].map(|n| pause(n).as_millis()).into();
        assert_eq!(pauses, [100, 200, 400, 800, 1_000, 1_000]);
    }
}
