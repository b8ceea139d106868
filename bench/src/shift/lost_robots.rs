//! Robots that fall silent inside a passage for one, and the person who clears what the server keeps for them.
//!
//! A silent robot goes on by itself to the next place where it may stand; the server cannot know that, and keeps all
//! that it granted. After some minutes a person looks, and clears each place of it where it is not, by the command of an
//! operator. A minute later its radio is mended.
//!
//! Invariant: the person clears no place that a body stands in.

use super::control_plane::ControlPlane;
use midshift_core::ids::RobotId;
use midshift_core::site::{PlaceKind, Site};
use midshift_core::time::{SiteDuration, SiteTime};
use midshift_proto::fleet::v1::Place;
use midshift_sim::faults::Injected;
use midshift_sim::fleet::Fleet;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

/// When each of them is lost, thousandths of the shift: drawn from such a range.
const LOST_PERMILLE: [Range<u64>; 2] = [150..350, 450..650];
/// A person comes after this.
const PERSON_AFTER: SiteDuration = SiteDuration::from_secs(600);
/// The radio is mended after this.
const SILENT_FOR: SiteDuration = SiteDuration::from_secs(660);

/// What is told of lost robots.
#[derive(Clone, Copy, Debug, Default)]
pub struct LossReport {
    /// Robots that were lost inside a passage.
    pub robots: usize,
    /// Places that a person cleared.
    pub cleared: u64,
    /// Longest time from the loss of a robot until a place that it held was free, or the shift over, milliseconds.
    pub longest_hold_ms: u64,
    /// The same of passages.
    pub longest_passage_hold_ms: u64,
}

struct LostRobot {
    robot_id: RobotId,
    since: SiteTime,
    /// Ids of the places that it held when it was lost and holds still, heard again or not. None: not asked yet.
    held: Option<BTreeSet<String>>,
}

/// The watch over robots that are lost.
pub struct LostRobots {
    site: Arc<Site>,
    fleet: Arc<Fleet>,
    rng: ChaCha8Rng,
    /// When the next ones are lost, the last first.
    due: Vec<SiteTime>,
    lost: Vec<LostRobot>,
    report: LossReport,
}

impl LostRobots {
    /// Nobody is lost yet; moments are drawn for a shift of this length.
    pub fn new(site: Arc<Site>, fleet: Arc<Fleet>, lasts: Duration, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6c6f_7374);
        let lasts_ms = lasts.as_millis() as u64;
        let mut due: Vec<_> =
            LOST_PERMILLE.map(|range| SiteTime(lasts_ms * rng.random_range(range) / 1_000)).into_iter().collect();
        due.reverse();
        Self { site, fleet, rng, due, lost: Vec::new(), report: LossReport::default() }
    }

    /// What came of it so far.
    pub fn report(&self) -> LossReport {
        self.report
    }

    /// Loses who is due, notes what the server keeps for those that are lost, and clears it once a person is there.
    ///
    /// # Errors
    /// The planner does not answer.
    pub async fn look_at_robots(&mut self, plane: &ControlPlane, now: SiteTime) -> anyhow::Result<()> {
        if self.due.last().is_some_and(|due| *due <= now)
            && let Some(robot_id) = self.draw_inside()
        {
            self.fleet.inject(now, &robot_id, Injected::DropNetwork(SILENT_FOR));
            self.lost.push(LostRobot { robot_id, since: now, held: None });
            self.report.robots += 1;
            self.due.pop();
        }
        let is_over = |held: &Option<BTreeSet<String>>| held.as_ref().is_some_and(BTreeSet::is_empty);
        self.lost.retain(|robot| now.since(robot.since) < SILENT_FOR || !is_over(&robot.held));
        if self.lost.is_empty() {
            return Ok(());
        }
        let held = held_places(plane.list_held_places().await?);
        for robot in &mut self.lost {
            let places = held.get(robot.robot_id.as_str()).map_or(&[][..], Vec::as_slice);
            let held_ms = now.since(robot.since).as_ms();
            let ids = || places.iter().map(|place| place.place_id.clone()).collect();
            let kept = robot.held.get_or_insert_with(ids);
            kept.retain(|place_id| places.iter().any(|place| place.place_id == *place_id));
            for place in places.iter().filter(|place| kept.contains(&place.place_id)) {
                self.report.longest_hold_ms = self.report.longest_hold_ms.max(held_ms);
                if is_passage(&self.site, place) {
                    self.report.longest_passage_hold_ms = self.report.longest_passage_hold_ms.max(held_ms);
                }
            }
            if (PERSON_AFTER..SILENT_FOR).contains(&now.since(robot.since)) {
                let inside = self.fleet.robot(&robot.robot_id).map(|robot| robot.lock().inside().clone());
                let inside = inside.unwrap_or_default();
                for place in places.iter().filter(|place| !inside.iter().any(|id| id.as_str() == place.place_id)) {
                    // What moved meanwhile is looked at again in the next round.
                    self.report.cleared += u64::from(plane.clear_place(place).await.is_ok());
                }
            }
        }
        Ok(())
    }

    /// One of the robots inside a passage for one that are not lost already.
    fn draw_inside(&mut self) -> Option<RobotId> {
        let is_lost = |robot_id: &RobotId| self.lost.iter().any(|robot| robot.robot_id == *robot_id);
        let is_inside = |robot_id: &RobotId| {
            let inside = self.fleet.robot(robot_id).map(|robot| robot.lock().inside().clone()).unwrap_or_default();
            let places = inside.iter().filter_map(|place_id| self.site.find_place(place_id));
            places.map(|place| self.site.place(place)).any(|p| p.kind() == PlaceKind::Passage && p.capacity == 1)
        };
        let robots = self.fleet.robots().iter().map(|robot| robot.robot_id());
        let all: Vec<&RobotId> = robots.filter(|robot_id| !is_lost(robot_id) && is_inside(robot_id)).collect();
        all.choose(&mut self.rng).copied().cloned()
    }
}

fn is_passage(site: &Site, place: &Place) -> bool {
    let place_id = place.place_id.parse().ok();
    let found = place_id.and_then(|place_id| site.find_place(&place_id));
    found.is_some_and(|place| site.place(place).kind() == PlaceKind::Passage)
}

/// Places by the robots that hold them.
fn held_places(places: Vec<Place>) -> BTreeMap<String, Vec<Place>> {
    let mut held: BTreeMap<String, Vec<Place>> = BTreeMap::new();
    for place in places {
        for holder in &place.holders {
            held.entry(holder.robot_id.clone()).or_default().push(place.clone());
        }
    }
    held
}
