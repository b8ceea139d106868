//! Fleet stops on their second way to robots: the site's one copy of them, composed into what each session has still to say.
//!
//! Invariant: it adds and never takes back: a stop that is not in the copy is not said to be over. The stop line of a robot does not wait for this, nor this for it.
//! Called by the session.

use midshift_core::ids::{RobotId, StopId};
use midshift_core::limits;
use midshift_core::stop::record::StopRecord;
use midshift_core::stop::{Reset, Scope, Stop};
use midshift_proto::session::StopFacts;
use std::cmp::Reverse;
use std::collections::{BTreeMap, VecDeque};
use std::future::pending;
use std::sync::Arc;
use tokio::sync::watch;

/// The copy of the site's stops, by name.
pub type SiteStops = BTreeMap<StopId, Arc<StopRecord>>;

/// What one session says of them.
pub struct StopNews {
    site: watch::Receiver<Arc<SiteStops>>,
    said: Arc<SiteStops>,
    due: VecDeque<StopFacts>,
}

impl StopNews {
    /// Of a session that has said nothing yet.
    pub fn new(mut site: watch::Receiver<Arc<SiteStops>>) -> Self {
        site.mark_changed();
        Self { site, said: Arc::default(), due: VecDeque::new() }
    }

    /// What is to be said next, as soon as there is something. Waited for by nobody it is not lost.
    pub async fn next(&mut self, robot_id: &RobotId) -> StopFacts {
        loop {
            if let Some(part) = self.due.pop_front() {
                return part;
            }
            if self.site.changed().await.is_err() {
                return pending().await;
            }
            let now = self.site.borrow_and_update().clone();
            self.due = compose(robot_id, &self.said, &now);
            self.said = now;
        }
    }
}

/// What a robot has not heard of the copy: all but the stops of other robots alone, the most restrictive first, then the newest resets.
fn compose(robot_id: &RobotId, said: &SiteStops, now: &SiteStops) -> VecDeque<StopFacts> {
    let concerns = |stop: &Stop| !matches!(&stop.scope, Scope::Robot(other) if other != robot_id);
    let is_new = |id: &StopId, record: &Arc<StopRecord>| said.get(id) != Some(record);
    let fresh = || now.iter().filter(|(id, record)| concerns(&record.stop) && is_new(id, record)).map(|(_, r)| &**r);
    let mut stops: Vec<&Stop> = fresh().filter(|record| record.is_effective()).map(|record| &record.stop).collect();
    stops.sort_by_key(|stop| Reverse((stop.level, &stop.scope)));
    let mut resets: Vec<&Reset> = fresh().filter_map(|record| record.reset.as_ref()).collect();
    resets.sort_by_key(|reset| Reverse(reset.reset_unix_ms));
    resets.truncate(limits::LINK_RESETS_MAX);
    StopFacts::parts(stops, resets)
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::AreaId;
    use midshift_core::robot::StopLevel;
    use midshift_core::stop::Region;
    use midshift_core::time::Utc;

    fn id(n: usize) -> StopId {
        StopId::parse(&format!("STOP-{n:04}")).unwrap()
    }

    fn robot(name: &str) -> RobotId {
        RobotId::parse(name).unwrap()
    }

    fn record(n: usize, scope: Scope, is_reset: bool) -> StopRecord {
        let (actor, reason, region) = ("anna".to_owned(), "a pallet fell".to_owned(), Some(Region::of_box(0, 0, 9, 9)));
        let bare = Stop::new(id(n), scope, StopLevel::Halt, Utc(1));
        let stop = Stop { actor: actor.clone(), reason, region, proof: vec![7; 64], ..bare };
        let reset = || {
            let (reason, proof) = ("clear".to_owned(), vec![8; 64]);
            Reset { actor, reason, proof, ..Reset::new(id(n), Utc(n as i64)) }
        };
        StopRecord { stop, reset: is_reset.then(reset) }
    }

    fn site(records: impl IntoIterator<Item = StopRecord>) -> SiteStops {
        records.into_iter().map(|record| (record.stop.stop_id.clone(), Arc::new(record))).collect()
    }

    fn names(facts: &VecDeque<StopFacts>) -> (Vec<String>, Vec<String>) {
        let stops = facts.iter().flat_map(|part| part.stops.iter().map(|stop| stop.stop_id.to_string()));
        let resets = facts.iter().flat_map(|part| part.resets.iter().map(|reset| reset.stop_id.to_string()));
        (stops.collect(), resets.collect())
    }

    #[test]
    fn each_robot_hears_whole_what_its_own_pose_may_lie_in_and_not_the_stops_of_others_alone() {
        let area = Scope::Area(AreaId::parse("hall").unwrap());
        let all = site([
            record(1, Scope::Robot(robot("r1")), false),
            record(2, Scope::Robot(robot("r2")), false),
            record(3, area.clone(), false),
            record(4, Scope::Fleet, false),
            record(5, Scope::Fleet, true),
        ]);
        let facts = compose(&robot("r1"), &SiteStops::new(), &all);
        let (stops, resets) = names(&facts);
        assert_eq!((stops.join(" "), resets.join(" ")), ("STOP-0004 STOP-0003 STOP-0001".into(), "STOP-0005".into()));
        assert_eq!(facts[0].stops[1], record(3, area, false).stop, "with its boxes and its mark");
        let (stops, _) = names(&compose(&robot("r2"), &SiteStops::new(), &all));
        assert_eq!(stops.join(" "), "STOP-0004 STOP-0003 STOP-0002");
    }

    #[test]
    fn what_was_said_is_not_said_again_and_what_left_the_copy_is_not_said_to_be_over() {
        let before = site([record(1, Scope::Fleet, false), record(2, Scope::Fleet, false)]);
        let after = site([record(2, Scope::Fleet, true), record(3, Scope::Fleet, false)]);
        let (stops, resets) = names(&compose(&robot("r1"), &before, &after));
        assert_eq!((stops.join(" "), resets.join(" ")), ("STOP-0003".into(), "STOP-0002".into()));
        assert!(compose(&robot("r1"), &after, &site([])).is_empty());
        assert!(compose(&robot("r1"), &after, &after.clone()).is_empty());
    }

    #[test]
    fn the_fullest_copy_goes_down_in_parts_that_every_robot_reads_with_the_newest_resets_alone() {
        let stops = (0..limits::STOPS_MAX + 2).map(|n| record(n, Scope::Fleet, false));
        let resets = (1_000..1_000 + limits::RESETS_MAX).map(|n| record(n, Scope::Fleet, true));
        let facts = compose(&robot("r1"), &SiteStops::new(), &site(stops.chain(resets)));
        let (stops, resets) = names(&facts);
        assert_eq!((stops.len(), resets.len()), (limits::STOPS_MAX + 2, limits::LINK_RESETS_MAX));
        assert_eq!(resets[0], format!("STOP-{}", 999 + limits::RESETS_MAX));
        assert!(facts.len() > 1);
        for part in facts {
            assert!(part.stops.len() <= limits::STOPS_MAX && part.resets.len() <= limits::STOPS_MAX);
            let wire = midshift_proto::stop::v1::StopFacts::from(&part);
            assert!(prost::Message::encoded_len(&wire) <= limits::STOP_TOLD_BYTES);
            assert_eq!(midshift_proto::parse::<StopFacts, _>(wire), Ok(part));
        }
    }
}
