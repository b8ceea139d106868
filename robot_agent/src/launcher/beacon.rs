//! The launcher's sign of life to the server while no agent runs.
//!
//! Invariant: sent blind once a second; nobody has to hear it, and nothing is decided by it.

use super::choose::Start;
use super::orders::Orders;
use std::net::UdpSocket;
use std::time::Duration;

/// Time between two beacons.
pub(super) const BEACON_EVERY: Duration = Duration::from_secs(1);

/// Tells the server once a second that the robot is there while no agent runs. A hint for people: sent blind, believed
/// by nobody.
pub(super) struct Beacon {
    socket: Option<(UdpSocket, String)>,
    robot_id: String,
    /// What runs, and the second since which no agent is heard.
    text: String,
}

impl Beacon {
    /// As the command line has it.
    pub(super) fn new(orders: &Orders) -> Self {
        let Some((to, robot_id)) = orders.beacon.clone() else {
            return Self { socket: None, robot_id: String::new(), text: String::new() };
        };
        let socket = UdpSocket::bind("[::]:0").or_else(|_| UdpSocket::bind("0.0.0.0:0"));
        Self { socket: socket.ok().map(|socket| (socket, to)), robot_id, text: String::new() }
    }

    /// A program is started, at this second of Unix time.
    pub(super) fn begins(&mut self, start: &Start, since_unix_s: u64) {
        let tries = start.tries.count_of(&start.set);
        self.text = format!("midshift-beacon 1 {} {} {tries} {since_unix_s}\n", self.robot_id, start.set);
    }

    /// Sends one.
    pub(super) fn send(&self) {
        if let Some((socket, to)) = &self.socket {
            // Nobody has to hear it.
            let _ = socket.send_to(self.text.as_bytes(), to.as_str());
        }
    }

    /// Waits, and sends one a second.
    pub(super) fn pause(&self, pause: Duration) {
        let mut left = pause;
        loop {
            self.send();
            let part = left.min(BEACON_EVERY);
            std::thread::sleep(part);
            left -= part;
            if left.is_zero() {
                return;
            }
        }
    }
}
