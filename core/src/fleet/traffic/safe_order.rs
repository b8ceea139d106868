//! Looks for an order in which robots can drive their whole remaining routes one after the other.
//!
//! A grant is safe if such an order exists behind it. In the order each robot in turn drives from the end of its released stretch to the end of
//! its route and rests there, or in a bay beside, where no remaining route of another needs the last seat. Robots whose turn has not come stand
//! at the ends of their stretches. While none can drive to its end, one that bars another goes to a bay first, or one drives to its next goal. The
//! queue's order is tried first, then others.
//!
//! Invariants:
//! 1. A grant takes the way from nobody: each robot that could drive to its end before it still can behind it.
//! 2. Nobody is let on to where the order would send it aside for others: it would go to and fro.
//! 3. A robot that cannot drive to its end by any order that was found is let on only where that helps another, or as the first that asks among
//!    those that its places connect. Robots appear anywhere, so a round may begin without an order for some; without this rule they would stand
//!    for ever where each next stretch is free.
//! 4. Robots that do not drive now are walls at all that they hold. Who needs a place whose seats walls have taken drives no further in the order
//!    than it stands, and is let on only to where it bars nobody; so those that do not need that place go on.
//! 5. All of it is integers in a fixed order, and bounded: one search looks at the first [`limits::SAFE_ORDER_ROBOTS_MAX`] robots of the connected
//!    part, tries [`limits::SAFE_ORDER_TRIES_MAX`] orders of them and ends after [`limits::SAFE_ORDER_LOOKS_MAX`] looks; once a
//!    round has taken [`limits::SAFE_ORDER_ROUND_LOOKS_MAX`], a search tries the queue's order alone. A robot has at most
//!    [`limits::ROUTE_POINTS_MAX`] points, and at most [`limits::BAYS_TRIED_MAX`] bays are tried for one. Robots beyond that stand. A bay is looked
//!    for beyond the part: two parts may count on the same one, which costs an order at worst, never a place.

use super::bay_ways::{Bay, BayWays, places_on};
use crate::ids::RobotId;
use crate::limits;
use crate::site::{PlaceIx, Site, WaypointIx};
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;

/// What a robot holds at the end of its released stretch, and what the rest of its route leads into. All lists of places are ascending.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Mover {
    /// Places that it holds where it stands then.
    pub here: Vec<PlaceIx>,
    /// Where that is; none: nobody knows, and it goes to no bay.
    pub at: Option<WaypointIx>,
    /// Places that the rest of its route leads into.
    pub way: Vec<PlaceIx>,
    /// Places that it holds at the end of its route.
    pub ends: Vec<PlaceIx>,
    /// Where its route ends.
    pub end_at: Option<WaypointIx>,
    /// Goals that are left, in order.
    pub goals: Vec<WaypointIx>,
    /// It does not drive now, whatever is free.
    pub is_wall: bool,
}

impl Mover {
    /// A robot on a route that is released up to an index of it. `held`: places that it holds now. None: the route has no such index.
    pub fn on_route(
        site: &Site,
        route: &[WaypointIx],
        released: usize,
        goals: Vec<WaypointIx>,
        held: &[PlaceIx],
    ) -> Option<Self> {
        let (at, end_at) = (*route.get(released)?, *route.last()?);
        let driven = places_on(site, &route[..=released]);
        // A standing place beside its route stays with it.
        let is_beside = |place: &&PlaceIx| {
            let stands = site.place(**place).waypoint();
            stands.is_some() && stands != route.first().copied() && !driven.contains(place)
        };
        let beside = held.iter().filter(is_beside);
        let here: BTreeSet<PlaceIx> = match released {
            0 => held.iter().copied().collect(),
            _ => beside.copied().chain(places_at(site, route[released - 1], at)).collect(),
        };
        let here: Vec<PlaceIx> = here.into_iter().collect();
        let ends = match route.len() - 1 {
            last if last == released => here.clone(),
            last => places_at(site, route[last - 1], end_at),
        };
        let way = places_on(site, &route[released..]).into_iter().collect();
        Some(Self { here, at: Some(at), way, ends, end_at: Some(end_at), goals, is_wall: false })
    }

    /// A robot that has nowhere to go.
    pub fn standing(at: Option<WaypointIx>, held: Vec<PlaceIx>) -> Self {
        Self { ends: held.clone(), here: held, at, end_at: at, ..Self::default() }
    }
}

/// Places that a robot is in at the waypoint behind a lane.
fn places_at(site: &Site, from: WaypointIx, at: WaypointIx) -> Vec<PlaceIx> {
    let is_inside = |place: &&PlaceIx| site.place(**place).inside().is_some_and(|i| i.waypoints.contains(&at));
    match site.standing_at(at) {
        Some(place) => vec![place],
        None => site.passages_of_lane(from, at).iter().filter(is_inside).copied().collect(),
    }
}

/// Seats by place: how many there are, are taken, and are needed by robots that have yet to drive.
struct Seats {
    capacity: Vec<u32>,
    taken: Vec<u32>,
    needed: Vec<u32>,
    /// What was changed, to be undone: the place, and seats taken or needed before.
    changes: Vec<(PlaceIx, u32, u32)>,
}

impl Seats {
    fn change(&mut self, place: PlaceIx, change: impl Fn(&mut u32, &mut u32)) {
        let (taken, needed) = (&mut self.taken[place.at()], &mut self.needed[place.at()]);
        self.changes.push((place, *taken, *needed));
        change(taken, needed);
    }
    fn enter(&mut self, mover: &Mover) {
        mover.here.iter().for_each(|place| self.take_seat(*place));
        mover.way.iter().for_each(|place| self.change(*place, |_, needed| *needed += 1));
    }
    fn leave(&mut self, mover: &Mover) {
        mover.here.iter().for_each(|place| self.change(*place, |taken, _| *taken = taken.saturating_sub(1)));
        mover.way.iter().for_each(|place| self.change(*place, |_, needed| *needed = needed.saturating_sub(1)));
    }
    fn take_seat(&mut self, place: PlaceIx) {
        self.change(place, |taken, _| *taken += 1);
    }
    fn undo(&mut self, mark: usize) {
        for (place, taken, needed) in self.changes.drain(mark..).rev() {
            (self.taken[place.at()], self.needed[place.at()]) = (taken, needed);
        }
    }
    fn has_seat(&self, place: PlaceIx) -> bool {
        self.taken[place.at()] < self.capacity[place.at()]
    }
    /// Whether a robot that rests here from now on leaves a seat to those that need one.
    fn is_spare(&self, place: PlaceIx) -> bool {
        self.needed[place.at()] == 0 || self.taken[place.at()] + 1 < self.capacity[place.at()]
    }
    /// Whether others need a seat here and find none.
    fn is_short(&self, place: PlaceIx, by_itself: u32) -> bool {
        self.needed[place.at()] > by_itself && !self.has_seat(place)
    }
}

/// What a search found.
#[derive(Default)]
struct Order {
    /// Robots that come to their ends.
    ends: BTreeSet<usize>,
    /// Robots that go to a bay on the way.
    aside: BTreeSet<usize>,
    /// The robot that goes first, and the seat of the bay that it goes to; none: it goes on its route.
    first: Option<(usize, Option<PlaceIx>)>,
}

/// Robots of a search that have not come to their ends yet.
struct Left {
    robots: Vec<usize>,
    movers: BTreeMap<usize, Rc<Mover>>,
    /// Those that went to a bay since the last robot went on.
    aside: BTreeSet<usize>,
}

/// Which robots go to a bay in an order.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Aside {
    /// Those that stand where others need the last seat, to bays that nobody needs.
    Bars,
    /// Any, to any: the last thing that is tried.
    Stands,
}

/// All robots of one round of grants, in queue order.
pub(super) struct SafeOrder {
    bays: BayWays,
    seats: Seats,
    robots: Vec<RobotId>,
    movers: Vec<Rc<Mover>>,
    /// Of robots that need a place whose seats walls have taken: all that their routes lead into.
    beyond: BTreeMap<usize, Vec<PlaceIx>>,
    /// Seats that walls have taken.
    walls: Vec<u32>,
    index: BTreeMap<RobotId, usize>,
    /// Robots that hold or need a place, or did so earlier in this round; no walls.
    users: BTreeMap<PlaceIx, BTreeSet<usize>>,
    /// Of connected parts, the robots that can drive to their ends. Empty once something was granted.
    known: BTreeMap<Vec<usize>, Rc<Order>>,
    /// Robots that were refused in this round.
    refused: BTreeSet<usize>,
    /// Robots that searches of this round looked at, each as often as they did.
    looked: usize,
}

impl SafeOrder {
    /// `seats`: how many each place has, 0 where nobody is let in, and how many of them robots have that are not among `movers`.
    pub fn new(bays: BayWays, seats: Vec<(u32, u32)>, movers: Vec<(RobotId, Mover)>) -> Self {
        let (capacity, taken): (Vec<u32>, Vec<u32>) = seats.into_iter().unzip();
        let needed = vec![0; taken.len()];
        let mut walls = taken.clone();
        let held_by_walls = movers.iter().filter(|(_, mover)| mover.is_wall).flat_map(|(_, mover)| &mover.here);
        held_by_walls.for_each(|place| walls[place.at()] += 1);
        let mut order = Self {
            bays,
            seats: Seats { capacity, taken, needed, changes: Vec::new() },
            index: movers.iter().enumerate().map(|(ix, (robot_id, _))| (robot_id.clone(), ix)).collect(),
            robots: Vec::new(),
            movers: Vec::new(),
            beyond: BTreeMap::new(),
            walls,
            users: BTreeMap::new(),
            known: BTreeMap::new(),
            refused: BTreeSet::new(),
            looked: 0,
        };
        for (ix, (robot_id, mover)) in movers.into_iter().enumerate() {
            order.robots.push(robot_id);
            order.movers.push(Rc::default());
            order.place(ix, mover);
        }
        order
    }

    /// Whether a place that the robot needs has no seat but those that walls have taken.
    pub fn is_walled(&self, robot_id: &RobotId) -> bool {
        self.index.get(robot_id).is_some_and(|ix| self.beyond.contains_key(ix))
    }

    /// Whether the robot would leave a seat of the place to others that need one.
    pub fn is_spare(&self, place: PlaceIx) -> bool {
        self.seats.is_spare(place)
    }

    /// Notes what the robot was granted. A robot that is not among them is left out.
    pub fn note_grant(&mut self, robot_id: &RobotId, after: Mover) {
        if let Some(ix) = self.index.get(robot_id).copied() {
            self.seats.leave(&self.movers[ix]);
            self.place(ix, after);
        }
    }

    /// Checks that the robot can be let on to where it stands `after` a grant.
    ///
    /// # Errors
    /// Robots in its way, perhaps none that is known: there is no order behind it, or a worse one than before it.
    pub fn check_grant(&mut self, robot_id: &RobotId, after: &Mover) -> Result<(), Vec<RobotId>> {
        let Some(ix) = self.index.get(robot_id).copied() else { return Ok(()) };
        let (after, beyond) = self.cut_at_walls(after.clone());
        let part = self.find_part(ix, &after);
        let before = self.find_known(&part);
        if before.ends.len() == part.len() && self.begins_order(&before, ix, &after) {
            return Ok(());
        }
        let mark = self.seats.changes.len();
        self.seats.leave(&self.movers[ix]);
        self.seats.enter(&after);
        // Its seat is counted as taken.
        let leaves_seat = |place: &PlaceIx| self.seats.needed[place.at()] == 0 || self.seats.has_seat(*place);
        let bars_nobody = beyond.is_none() || after.here.iter().all(leaves_seat);
        let stood = std::mem::replace(&mut self.movers[ix], Rc::new(after));
        // All that is asked of it: it need not be the best.
        let is_enough =
            |then: &Order| before.ends.is_subset(&then.ends) && then.ends.contains(&ix) && !then.aside.contains(&ix);
        let then = self.search(&part, is_enough);
        let after = std::mem::replace(&mut self.movers[ix], stood);
        self.seats.undo(mark);
        let is_first = || !part.iter().any(|other| self.refused.contains(other));
        let helps = then.ends.contains(&ix) || then.ends.len() > before.ends.len() || is_first();
        // From where it must make room for others again, it would go to and fro for ever.
        let stays = !then.aside.contains(&ix);
        if before.ends.is_subset(&then.ends) && bars_nobody && helps && stays {
            return Ok(());
        }
        Err(self.name_robots(ix, &after, beyond.as_deref(), &part, (&before.ends, &then.ends)))
    }

    /// The seat of the bay to which this robot goes, if the order as it is begins with that: nobody else goes on before it.
    pub fn seat_aside(&mut self, robot_id: &RobotId) -> Option<PlaceIx> {
        let ix = self.index.get(robot_id).copied()?;
        let stands = self.movers[ix].clone();
        let part = self.find_part(ix, &stands);
        self.find_known(&part).first.and_then(|(first, seat)| seat.filter(|_| first == ix))
    }

    /// Whether a grant is what an order of all begins with: the same order holds behind it.
    fn begins_order(&self, order: &Order, ix: usize, after: &Mover) -> bool {
        let (stands, Some((first, seat))) = (&self.movers[ix], order.first) else { return false };
        let leads_to = |seat: &PlaceIx| after.here.contains(seat) || after.way.contains(seat);
        let is_on_route =
            || after.here.iter().chain(&after.way).all(|p| stands.way.contains(p) || stands.here.contains(p));
        first == ix && seat.map_or_else(is_on_route, |seat| leads_to(&seat))
    }

    /// Notes that the robot was refused for want of an order: those behind it that have none themselves do not overtake it.
    pub fn note_refused(&mut self, robot_id: &RobotId) {
        self.refused.extend(self.index.get(robot_id));
    }

    fn place(&mut self, ix: usize, mover: Mover) {
        let (mover, beyond) = self.cut_at_walls(mover);
        self.seats.enter(&mover);
        self.seats.changes.clear();
        self.known.clear();
        if !mover.is_wall {
            for place in mover.here.iter().chain(&mover.way) {
                self.users.entry(*place).or_default().insert(ix);
            }
        }
        self.beyond.remove(&ix);
        self.beyond.extend(beyond.map(|way| (ix, way)));
        self.movers[ix] = Rc::new(mover);
    }

    /// A robot that meets a place whose seats walls have taken has nowhere to go: what its route would lead into comes beside it.
    fn cut_at_walls(&self, mover: Mover) -> (Mover, Option<Vec<PlaceIx>>) {
        let is_shut = |place: &PlaceIx| {
            self.walls[place.at()] >= self.seats.capacity[place.at()] && mover.here.binary_search(place).is_err()
        };
        if mover.is_wall || !mover.way.iter().any(is_shut) {
            return (mover, None);
        }
        (Mover::standing(mover.at, mover.here), Some(mover.way))
    }

    /// Robots whose places connect them with the robot as it stands and as it would stand, it among them, in queue order.
    fn find_part(&self, ix: usize, after: &Mover) -> Vec<usize> {
        let mut part = BTreeSet::from([ix]);
        let mut seen: BTreeSet<PlaceIx> = BTreeSet::new();
        let own = &self.movers[ix];
        let mut ahead: Vec<PlaceIx> =
            [&own.here, &own.way, &after.here, &after.way].into_iter().flatten().copied().collect();
        while let Some(place) = ahead.pop() {
            if !seen.insert(place) {
                continue;
            }
            for user in self.users.get(&place).into_iter().flatten() {
                if part.insert(*user) {
                    ahead.extend(self.movers[*user].here.iter().chain(&self.movers[*user].way));
                }
            }
        }
        let mut part: Vec<usize> = part.into_iter().collect();
        if part.len() > limits::SAFE_ORDER_ROBOTS_MAX {
            part.truncate(limits::SAFE_ORDER_ROBOTS_MAX - 1);
            if !part.contains(&ix) {
                part.push(ix);
            }
        }
        part
    }

    fn find_known(&mut self, part: &[usize]) -> Rc<Order> {
        if let Some(known) = self.known.get(part) {
            return known.clone();
        }
        let found = Rc::new(self.search(part, |_| false));
        self.known.insert(part.to_vec(), found.clone());
        found
    }

    /// Which of these can drive to their ends one after the other, and who goes first: of all orders that are tried the first that is enough, or
    /// the first that serves most.
    fn search(&mut self, part: &[usize], is_enough: impl Fn(&Order) -> bool) -> Order {
        let tries = if self.looked < limits::SAFE_ORDER_ROUND_LOOKS_MAX { limits::SAFE_ORDER_TRIES_MAX } else { 1 };
        let (mut best, mut looks) = (Order::default(), 0);
        for nth in 0..tries {
            let found = self.try_order(shuffle(part, nth), &mut looks);
            let is_found = is_enough(&found);
            if nth == 0 || is_found || found.ends.len() > best.ends.len() {
                best = found;
            }
            if is_found || best.ends.len() == part.len() || looks >= limits::SAFE_ORDER_LOOKS_MAX {
                break;
            }
        }
        self.looked += looks;
        best
    }

    fn try_order(&mut self, robots: Vec<usize>, looks: &mut usize) -> Order {
        let mark = self.seats.changes.len();
        let movers = robots.iter().map(|ix| (*ix, self.movers[*ix].clone())).collect();
        let mut left = Left { robots, movers, aside: BTreeSet::new() };
        let mut found = Order { ends: left.robots.iter().copied().collect(), ..Order::default() };
        let mut first = None;
        while !left.robots.is_empty() && *looks < limits::SAFE_ORDER_LOOKS_MAX {
            *looks += left.robots.len();
            let moved = self.drive_all_to_end(&mut left).map(|ix| (ix, None));
            let moved = moved.or_else(|| self.move_aside(&mut left, Aside::Bars));
            let moved = moved.or_else(|| self.drive_to_goal(&mut left).map(|ix| (ix, None)));
            let moved = moved.or_else(|| self.move_aside(&mut left, Aside::Stands));
            let Some((_, seat)) = moved else { break };
            first = first.or(moved);
            // Who goes aside and nobody goes on behind it has gone for nothing.
            if seat.is_none() {
                found.aside.append(&mut left.aside);
                found.first = found.first.or(first);
            }
        }
        self.seats.undo(mark);
        found.ends.retain(|ix| !left.robots.contains(ix));
        found
    }

    /// Drives all to their ends that can, in turn. The first of them.
    fn drive_all_to_end(&mut self, left: &mut Left) -> Option<usize> {
        let mut first = None;
        let movers = &left.movers;
        left.robots.retain(|ix| {
            let is_there = self.drive_to_end(&movers[ix]);
            first = first.or(is_there.then_some(*ix));
            !is_there
        });
        first
    }

    /// Drives the robot over its whole way to a place where it rests, if it can.
    fn drive_to_end(&mut self, mover: &Mover) -> bool {
        let mark = self.seats.changes.len();
        self.seats.leave(mover);
        let is_open = |place: &PlaceIx| self.seats.has_seat(*place) || mover.here.contains(place);
        if mover.way.iter().all(is_open) && self.rest(mover) {
            return true;
        }
        self.seats.undo(mark);
        false
    }

    fn rest(&mut self, mover: &Mover) -> bool {
        if mover.ends.iter().all(|place| self.seats.is_spare(*place)) {
            mover.ends.iter().for_each(|place| self.seats.take_seat(*place));
            return true;
        }
        let Some(end_at) = mover.end_at else { return false };
        let bays = self.bays.find_near(end_at);
        let Some(bay) = bays.iter().find(|bay| self.is_free(&bay.way, bay.seat)) else { return false };
        self.seats.take_seat(bay.seat);
        true
    }

    fn is_free(&self, way: &[PlaceIx], seat: PlaceIx) -> bool {
        self.seats.is_spare(seat) && way.iter().all(|place| self.seats.has_seat(*place))
    }

    /// Moves the last robot to a bay that may go to one and was not moved since somebody went on: which, and the seat.
    fn move_aside(&mut self, left: &mut Left, who: Aside) -> Option<(usize, Option<PlaceIx>)> {
        for ix in left.robots.iter().rev().filter(|ix| !left.aside.contains(ix)) {
            let mover = left.movers[ix].clone();
            let by_itself = |place: &PlaceIx| u32::from(mover.way.binary_search(place).is_ok());
            let bars = || mover.here.iter().any(|place| self.seats.is_short(*place, by_itself(place)));
            let Some(at) = mover.at.filter(|_| who == Aside::Stands || bars()) else { continue };
            let mark = self.seats.changes.len();
            self.seats.leave(&mover);
            let bays = self.bays.find_near(at);
            let is_open = |bay: &&Bay| bay.way.iter().all(|place| self.seats.has_seat(*place));
            let mut open = bays.iter().filter(|bay| !mover.here.contains(&bay.seat)).filter(is_open);
            let bay = match who {
                Aside::Bars => open.find(|bay| self.seats.is_spare(bay.seat)),
                Aside::Stands => open.next(),
            };
            let way = bay.and_then(|bay| Some((bay, self.bays.find_places(bay.at, &mover.goals)?)));
            if let Some((bay, way)) = way {
                let moved = match mover.goals.is_empty() {
                    true => Mover::standing(Some(bay.at), vec![bay.seat]),
                    false => Mover { here: vec![bay.seat], at: Some(bay.at), way, ..Mover::clone(&mover) },
                };
                self.seats.enter(&moved);
                left.movers.insert(*ix, Rc::new(moved));
                left.aside.insert(*ix);
                return Some((*ix, Some(bay.seat)));
            }
            self.seats.undo(mark);
        }
        None
    }

    /// Drives the first robot that can to its next goal, whether or not others need the seat there.
    fn drive_to_goal(&mut self, left: &mut Left) -> Option<usize> {
        for ix in &left.robots {
            let mover = left.movers[ix].clone();
            let Some((at, (goal, goals))) = mover.at.zip(mover.goals.split_first()) else { continue };
            let Some(seat) = self.bays.find_seat(*goal) else { continue };
            let ways = self.bays.find_places(at, &[*goal]).zip(self.bays.find_places(*goal, goals));
            let Some((leg, way)) = ways else { continue };
            let mark = self.seats.changes.len();
            self.seats.leave(&mover);
            if leg.iter().all(|place| self.seats.has_seat(*place) || mover.here.contains(place)) {
                let ends = if goals.is_empty() { vec![seat] } else { mover.ends.clone() };
                let goals = goals.to_vec();
                let moved = Mover { here: vec![seat], at: Some(*goal), way, ends, goals, ..Mover::clone(&mover) };
                self.seats.enter(&moved);
                left.movers.insert(*ix, Rc::new(moved));
                return Some(*ix);
            }
            self.seats.undo(mark);
        }
        None
    }

    /// Robots that a refused grant is told with: those that it would take the way from, else those in the robot's own way.
    fn name_robots(
        &self,
        ix: usize,
        after: &Mover,
        beyond: Option<&[PlaceIx]>,
        part: &[usize],
        (before, then): (&BTreeSet<usize>, &BTreeSet<usize>),
    ) -> Vec<RobotId> {
        let way = beyond.unwrap_or(&after.way);
        let others = || (0..self.movers.len()).filter(|other| *other != ix);
        let holds = |place: &PlaceIx| !self.seats.has_seat(*place) && way.contains(place);
        let groups: [Vec<usize>; 4] = [
            before.difference(then).copied().filter(|other| *other != ix).collect(),
            others().filter(|other| self.movers[*other].here.iter().any(holds)).collect(),
            others().filter(|other| self.movers[*other].way.iter().any(|place| after.here.contains(place))).collect(),
            part.iter().copied().filter(|other| *other != ix).collect(),
        ];
        let named = groups.into_iter().find(|group| !group.is_empty()).unwrap_or_default();
        named.into_iter().take(limits::CROWD_NAMED_MAX).map(|other| self.robots[other].clone()).collect()
    }
}

/// These in the nth order: the 0th is as they come, the others are drawn by their number.
fn shuffle(part: &[usize], nth: u64) -> Vec<usize> {
    let mut shuffled = part.to_vec();
    let mut drawn = nth;
    for at in (1..shuffled.len()).rev().filter(|_| nth > 0) {
        drawn = drawn.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        shuffled.swap(at, (drawn >> 33) as usize % (at + 1));
    }
    shuffled
}

#[cfg(test)]
mod tests;
