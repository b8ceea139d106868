//! Listens for the beacons of launchers: datagrams of a robot whose agent does not run, because it is being started or tried.
//!
//! Invariant: a hint for display, never evidence. Nobody proves anything with a datagram: anybody in the network can send one, so nothing is
//! decided by it, nothing is written down, and only robots that once said Hello have one. Called by the server.

use crate::projection::LinkProjection;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::time::{Clock, LinkDuration, LinkTime, Now};
use midshift_proto::convert;
use midshift_proto::telemetry::v1;
use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Mutex, PoisonError};
use tokio::net::UdpSocket;

/// First words of a beacon: what it is, and its format.
const HEAD: [&str; 2] = ["midshift-beacon", "1"];
/// Letters of a set's name.
const SET_MAX: usize = 64;
/// Datagrams of one source are counted over this.
const WINDOW: LinkDuration = LinkDuration(1_000);

/// What a beacon says.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Beacon {
    robot_id: RobotId,
    /// The set that is being started.
    set: String,
    /// Which start it is since it last ran well.
    tries: u32,
}

impl Beacon {
    /// Reads a datagram, to the letter; words that a newer launcher adds at its end are not looked at.
    fn parse(datagram: &[u8]) -> Option<Self> {
        if datagram.len() > limits::BEACON_BYTES {
            return None;
        }
        let text = std::str::from_utf8(datagram).ok()?.strip_suffix('\n')?;
        let words: Vec<&str> = text.split(' ').collect();
        let [what, format, robot_id, set, tries, since, ..] = words[..] else { return None };
        let is_set =
            (1..=SET_MAX).contains(&set.len()) && set.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit());
        // Since when by the robot's clock: not held against ours.
        number::<u64>(since)?;
        let tries = number::<u32>(tries)?;
        let robot_id = RobotId::parse(robot_id).ok()?;
        ([what, format] == HEAD && is_set).then(|| Self { robot_id, set: set.to_owned(), tries })
    }
}

/// A number as a program writes it: digits only.
fn number<T: std::str::FromStr>(text: &str) -> Option<T> {
    text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse().ok()).flatten()
}

/// The newest beacon of a robot.
#[derive(Clone, Debug)]
struct Heard {
    beacon: Beacon,
    /// The first that said the same.
    first: LinkTime,
    newest: LinkTime,
}

/// Beacons by robot, and who sent how many.
#[derive(Debug, Default)]
pub struct BeaconListener(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    heard: BTreeMap<RobotId, Heard>,
    window: LinkTime,
    sources: BTreeMap<IpAddr, u32>,
}

impl BeaconListener {
    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a datagram in; the robot it is about, if it was one that counts.
    fn take_in(
        &self,
        datagram: &[u8],
        from: IpAddr,
        now: LinkTime,
        knows: impl Fn(&RobotId) -> bool,
    ) -> Option<RobotId> {
        let mut state = self.state();
        if now.since(state.window) >= WINDOW {
            state.window = now;
            state.sources.clear();
        }
        let has_room = state.sources.len() < limits::BEACON_SOURCES_MAX;
        let sent = match state.sources.get_mut(&from) {
            Some(sent) => sent,
            None if has_room => state.sources.entry(from).or_default(),
            None => return None,
        };
        *sent = sent.saturating_add(1);
        if *sent > limits::BEACONS_PER_SOURCE {
            return None;
        }
        let beacon = Beacon::parse(datagram).filter(|beacon| knows(&beacon.robot_id))?;
        let robot_id = beacon.robot_id.clone();
        if !state.heard.contains_key(&robot_id) && state.heard.len() >= limits::BEACONS_MAX {
            state.heard.retain(|_, heard| is_fresh(heard, now));
            if state.heard.len() >= limits::BEACONS_MAX {
                return None;
            }
        }
        let before = state.heard.get(&robot_id).filter(|heard| heard.beacon == beacon && is_fresh(heard, now));
        let first = before.map_or(now, |heard| heard.first);
        state.heard.insert(robot_id.clone(), Heard { beacon, first, newest: now });
        Some(robot_id)
    }

    /// What is shown of a robot that was heard last at `live`; none: nothing, or the robot itself spoke since.
    pub fn hint(&self, robot_id: &RobotId, live: Option<LinkTime>, now: &Now) -> Option<v1::Beacon> {
        let state = self.state();
        let heard = state.heard.get(robot_id).filter(|heard| is_fresh(heard, now.link))?;
        if live.is_some_and(|live| live >= heard.newest) {
            return None;
        }
        let left_ms = limits::BEACON_BACK_WITHIN.as_ms().saturating_sub(now.link.since(heard.first).as_ms());
        Some(v1::Beacon {
            set_id: heard.beacon.set.clone(),
            tries: heard.beacon.tries,
            expected_back: Some(convert::timestamp(now.wall.plus_ms(left_ms))),
            age: Some(convert::duration(now.link.since(heard.newest).as_ms())),
        })
    }
}

fn is_fresh(heard: &Heard, now: LinkTime) -> bool {
    now.since(heard.newest) <= limits::BEACON_SHOWN
}

/// Listens until it is dropped.
pub async fn listen(beacons: &BeaconListener, projection: &LinkProjection, clock: &dyn Clock, socket: &UdpSocket) {
    // One byte more than a beacon has: a longer one is seen to be too long.
    let mut datagram = [0; limits::BEACON_BYTES + 1];
    loop {
        let (length, from): (usize, SocketAddr) = match socket.recv_from(&mut datagram).await {
            Ok(received) => received,
            Err(error) => {
                tracing::debug!(%error, "a beacon could not be received");
                tokio::time::sleep(std::time::Duration::from_millis(100)).await;
                continue;
            }
        };
        let now = clock.now().link;
        let knows = |robot_id: &RobotId| projection.rows().sessions.contains_key(robot_id);
        let taken = beacons.take_in(&datagram[..length], from.ip(), now, knows);
        let counted = if taken.is_some() { "taken" } else { "dropped" };
        metrics::counter!("midshift_beacons_total", "what" => counted).increment(1);
        if let Some(robot_id) = taken {
            projection.touch(&robot_id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::time::{SiteTime, Utc};

    const FROM: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

    fn robot(name: &str) -> RobotId {
        RobotId::parse(name).expect("a name")
    }

    fn now(ms: u64) -> Now {
        Now { site: SiteTime(0), link: LinkTime(ms), utc: Utc(0), wall: Utc(1_000_000), jump: None }
    }

    fn hears(beacons: &BeaconListener, text: &str, ms: u64) -> bool {
        beacons.take_in(text.as_bytes(), FROM, LinkTime(ms), |id| id.as_str().starts_with("r")).is_some()
    }

    #[test]
    fn a_beacon_is_read_to_the_letter_or_not_at_all() {
        let good = "midshift-beacon 1 r1 factory 2 1700000000\n";
        let read = Beacon { robot_id: robot("r1"), set: "factory".to_owned(), tries: 2 };
        assert_eq!(Beacon::parse(good.as_bytes()), Some(read.clone()));
        let newer = good.replace('\n', " curious 7\n");
        assert_eq!(Beacon::parse(newer.as_bytes()), Some(read), "a newer launcher says more");
        let wrong = [
            String::new(),
            good.trim_end().to_owned(),
            format!("{good}\n"),
            format!(" {good}"),
            good.replace("beacon 1", "beacon 2"),
            good.replace("midshift", "Midshift"),
            good.replace(" factory", "  factory"),
            good.replace("factory", "../etc"),
            good.replace("factory", &"a".repeat(65)),
            good.replace(" 2 ", " -2 "),
            good.replace(" 2 ", " +2 "),
            good.replace(" 2 ", " 4294967296 "),
            good.replace("1700000000", "now"),
            good.replace("r1", "r 1"),
            good.replace("r1", &"r".repeat(300)),
        ];
        for wrong in wrong {
            assert_eq!(Beacon::parse(wrong.as_bytes()), None, "{wrong:?}");
        }
        assert_eq!(Beacon::parse(&[b"midshift-beacon 1 r1 ", &[0xff][..], b" 2 1\n"].concat()), None);
    }

    #[test]
    fn a_hint_is_shown_while_beacons_come_and_the_robot_does_not_speak_itself() {
        let beacons = BeaconListener::default();
        let id = robot("r1");
        assert!(beacons.hint(&id, None, &now(0)).is_none());
        assert!(hears(&beacons, "midshift-beacon 1 r1 v1 1 7\n", 10_000));
        assert!(hears(&beacons, "midshift-beacon 1 r1 v1 1 8\n", 11_000));
        let hint = beacons.hint(&id, Some(LinkTime(9_000)), &now(11_500)).expect("is shown");
        assert_eq!((hint.set_id.as_str(), hint.tries), ("v1", 1));
        assert_eq!(hint.expected_back, Some(convert::timestamp(Utc(1_000_000 + 15_000 - 1_500))), "since the first");
        assert_eq!(hint.age, Some(convert::duration(500)));
        assert!(beacons.hint(&id, Some(LinkTime(11_000)), &now(11_500)).is_none(), "it is heard itself");
        assert!(beacons.hint(&id, None, &now(16_001)).is_none(), "nothing came for 5 s");
        assert!(hears(&beacons, "midshift-beacon 1 r1 v1 2 9\n", 20_000));
        let hint = beacons.hint(&id, None, &now(20_000)).expect("is shown");
        assert_eq!((hint.tries, hint.expected_back), (2, Some(convert::timestamp(Utc(1_015_000)))));
    }

    #[test]
    fn strangers_fill_no_table_and_one_source_is_heard_only_so_often() {
        let beacons = BeaconListener::default();
        assert!(!hears(&beacons, "midshift-beacon 1 stranger v1 1 7\n", 0));
        let heard = (0..1_000).filter(|_| hears(&beacons, "midshift-beacon 1 r1 v1 1 7\n", 5)).count();
        assert_eq!(heard, limits::BEACONS_PER_SOURCE as usize - 1);
        assert!(hears(&beacons, "midshift-beacon 1 r1 v1 1 7\n", 1_000), "the next second");
        let sources = (0..2 * limits::BEACON_SOURCES_MAX as u32).map(|n| IpAddr::V4(n.into()));
        let heard = sources.filter(|from| {
            beacons.take_in(b"midshift-beacon 1 r1 v1 1 7\n", *from, LinkTime(1_500), |_| true).is_some()
        });
        assert_eq!(heard.count(), limits::BEACON_SOURCES_MAX - 1, "sources of one second are counted too");
        assert_eq!(beacons.state().heard.len(), 1);
    }

    #[test]
    fn the_table_of_robots_has_an_end_and_makes_room_of_what_is_old() {
        let beacons = BeaconListener::default();
        let take = |n: usize, ms: u64| {
            let text = format!("midshift-beacon 1 r{n} v1 1 7\n");
            beacons.take_in(text.as_bytes(), IpAddr::V4((n as u32 % 1_000).into()), LinkTime(ms), |_| true).is_some()
        };
        assert!((0..limits::BEACONS_MAX).all(|n| take(n, 1_000 + n as u64 / 5)));
        let full = 1_000 + limits::BEACONS_MAX as u64 / 5;
        assert!(!take(limits::BEACONS_MAX, full), "all of them are fresh");
        assert!(take(limits::BEACONS_MAX, full + 10_000));
        assert_eq!(beacons.state().heard.len(), 1);
    }
}
