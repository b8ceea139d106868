//! The robot's side of places: which it is in, which it may enter, and which grants are used up.
//!
//! Invariant: a place is entered only on a grant that is listed, unused and fresh at that moment; after leaving, the
//! grant is used up; a place that was entered is held until the robot is out of it. A standing place counts as entered
//! when the robot sets out on the lane that leads to it, and as left when the next point is reached: rather too long
//! than too short.

use crate::storage::PlacesRow;
use midshift_core::authority::{Authority, SentHeartbeats, Stale};
use midshift_core::desired_state::{GrantedPlace, RoutePoint};
use midshift_core::ids::PlaceId;
use midshift_core::robot::HeldPlace;
use midshift_core::robot_events::{PlaceNews, RobotEvent};
use midshift_core::time::{LinkDuration, LinkTime};

/// Whether a place may be entered now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Entry {
    /// It is in already.
    Inside,
    /// On this grant; until then, if it ends.
    Granted {
        /// The grant.
        grant_id: u64,
        /// When the permission ends.
        until: LinkTime,
    },
    /// There is a grant, but its authority is over.
    Stale {
        /// The grant.
        grant_id: u64,
        /// What it was anchored to.
        authority: Authority,
        /// What makes it stale.
        why: Stale,
    },
    /// No grant.
    Missing,
}

/// Places of one robot.
#[derive(Clone, Debug, Default)]
pub struct Places {
    /// What must survive a restart.
    pub row: PlacesRow,
    granted: Vec<GrantedPlace>,
    received: LinkTime,
    from_receipt: bool,
}

fn event(place_id: &PlaceId, grant_id: u64, news: PlaceNews) -> RobotEvent {
    RobotEvent::Place { place_id: place_id.clone(), grant_id, news }
}

/// All places to be held on the way to this point.
pub fn needs(point: &RoutePoint) -> impl Iterator<Item = &PlaceId> {
    point.passages.iter().chain(&point.standing)
}

impl Places {
    /// From what was kept. What the robot had set out for counts as entered.
    pub fn restored(mut row: PlacesRow, from_receipt: bool) -> (Self, Vec<RobotEvent>) {
        let mut events = Vec::new();
        for (place_id, grant_id) in std::mem::take(&mut row.committed) {
            if !row.used.contains(&grant_id) && !row.inside.contains_key(&place_id) {
                events.push(event(&place_id, grant_id, PlaceNews::Entered));
                row.inside.insert(place_id, grant_id);
            }
        }
        (Self { row, from_receipt, ..Self::default() }, events)
    }

    /// A newer desired state lists these grants. Gives back those that are no longer listed and were not used.
    pub fn desired(&mut self, grants: &[GrantedPlace], now: LinkTime) -> Vec<RobotEvent> {
        let old = std::mem::replace(&mut self.granted, grants.to_vec());
        self.received = now;
        let mut events = Vec::new();
        for gone in old.iter().filter(|o| !grants.iter().any(|g| g.grant_id == o.grant_id)) {
            events.extend(self.give_back(gone));
        }
        for grant in grants {
            let used = self.row.used.contains(&grant.grant_id);
            match self.row.inside.get_mut(&grant.place_id) {
                Some(on) if *on == 0 && !used => *on = grant.grant_id,
                None if grant.entry.is_none() && !used => {
                    self.row.inside.insert(grant.place_id.clone(), grant.grant_id);
                }
                _ => {}
            }
        }
        self.row.used.retain(|id| grants.iter().any(|g| g.grant_id == *id));
        events
    }

    /// Gives back every grant that was not used: the work they were for is over.
    pub fn give_back_all(&mut self) -> Vec<RobotEvent> {
        let granted = self.granted.clone();
        granted.iter().filter_map(|g| self.give_back(g)).collect()
    }

    fn give_back(&mut self, grant: &GrantedPlace) -> Option<RobotEvent> {
        let used = self.row.used.contains(&grant.grant_id);
        let inside = self.row.inside.values().any(|on| *on == grant.grant_id);
        if used || inside {
            return None;
        }
        self.row.used.insert(grant.grant_id);
        self.row.committed.retain(|_, on| *on != grant.grant_id);
        Some(event(&grant.place_id, grant.grant_id, PlaceNews::NotEntered))
    }

    /// Whether `place_id` may be entered now.
    pub fn entry(&self, place_id: &PlaceId, sent: &SentHeartbeats, now: LinkTime) -> Entry {
        if self.row.inside.contains_key(place_id) {
            return Entry::Inside;
        }
        let mut best = Entry::Missing;
        for grant in self.granted.iter().filter(|g| g.place_id == *place_id && !self.row.used.contains(&g.grant_id)) {
            let Some(authority) = grant.entry else { continue };
            let grant_id = grant.grant_id;
            if self.from_receipt {
                let until = self.received + LinkDuration(authority.valid_ms);
                if now <= until {
                    return Entry::Granted { grant_id, until };
                }
            }
            match sent.check(&authority, now) {
                Ok(()) => {
                    let until = sent.ends(&authority).unwrap_or(now);
                    return Entry::Granted { grant_id, until };
                }
                Err(why) => best = Entry::Stale { grant_id, authority, why },
            }
        }
        best
    }

    /// Places of these points that must be written down before the body is told to drive there; none if all are.
    pub fn commit<'a>(
        &mut self,
        points: impl Iterator<Item = &'a RoutePoint>,
        sent: &SentHeartbeats,
        now: LinkTime,
    ) -> bool {
        let mut grew = false;
        for place_id in points.flat_map(needs) {
            if let Entry::Granted { grant_id, .. } = self.entry(place_id, sent, now) {
                grew |= self.row.committed.insert(place_id.clone(), grant_id) != Some(grant_id);
            }
        }
        grew
    }

    /// The robot sets out on the lane that leads to `point`.
    pub fn enter(&mut self, point: &RoutePoint, sent: &SentHeartbeats, now: LinkTime) -> Vec<RobotEvent> {
        let mut events = Vec::new();
        for place_id in needs(point) {
            if let Entry::Granted { grant_id, .. } = self.entry(place_id, sent, now) {
                self.row.committed.remove(place_id);
                self.row.inside.insert(place_id.clone(), grant_id);
                events.push(event(place_id, grant_id, PlaceNews::Entered));
            }
        }
        events
    }

    /// The robot is on the lane to `point` although a permission for it has just ended: what it was sent into, it is
    /// in.
    pub fn entered_late(&mut self, point: &RoutePoint) -> Vec<RobotEvent> {
        let mut events = Vec::new();
        for place_id in needs(point) {
            if let Some(grant_id) = self.row.committed.remove(place_id)
                && !self.row.inside.contains_key(place_id)
            {
                self.row.inside.insert(place_id.clone(), grant_id);
                events.push(event(place_id, grant_id, PlaceNews::Entered));
            }
        }
        events
    }

    /// The robot reached `point`; `next` is the one behind it on the route. It is out of everything that neither of
    /// them needs.
    pub fn reached(&mut self, point: &RoutePoint, next: Option<&RoutePoint>) -> Vec<RobotEvent> {
        let stays = |place: &PlaceId| {
            let goes_on = match next {
                Some(next) => needs(next).any(|p| p == place),
                None => point.standing.is_none() && point.passages.contains(place),
            };
            goes_on || point.standing.as_ref() == Some(place)
        };
        let left: Vec<_> =
            self.row.inside.iter().filter(|(p, _)| !stays(p)).map(|(p, grant)| (p.clone(), *grant)).collect();
        let mut events = Vec::new();
        for (place_id, grant_id) in left {
            self.row.inside.remove(&place_id);
            if grant_id != 0 {
                self.row.used.insert(grant_id);
            }
            events.push(event(&place_id, grant_id, PlaceNews::Left));
        }
        events
    }

    /// The body says that it stands on this place, entered without a grant.
    pub fn stands_on(&mut self, place_id: PlaceId) -> Option<RobotEvent> {
        if self.row.inside.contains_key(&place_id) {
            return None;
        }
        let entered = event(&place_id, 0, PlaceNews::Entered);
        self.row.inside.insert(place_id, 0);
        Some(entered)
    }

    /// Whether the robot, at `point` with `next` behind it, stands inside a passage.
    pub fn in_passage(point: &RoutePoint, next: Option<&RoutePoint>) -> bool {
        let next = next.map(|n| n.passages.as_slice()).unwrap_or_default();
        point.standing.is_none() && point.passages.iter().any(|p| next.contains(p))
    }

    /// What it holds, as the heartbeat says it.
    pub fn held(&self) -> Vec<HeldPlace> {
        let inside = |(place_id, grant_id): (&PlaceId, &u64)| HeldPlace {
            place_id: place_id.clone(),
            grant_id: *grant_id,
            inside: true,
        };
        let mut held: Vec<_> = self.row.inside.iter().map(inside).collect();
        for grant in &self.granted {
            let spent = self.row.used.contains(&grant.grant_id);
            if !spent && !held.iter().any(|h| h.grant_id == grant.grant_id) {
                held.push(HeldPlace { place_id: grant.place_id.clone(), grant_id: grant.grant_id, inside: false });
            }
        }
        held
    }
}
