//! Holds the robots of the fleet, with the newest state of each: its check-in, its line, and the stops that it keeps.
//!
//! Invariant: bounded; each robot has a lock of its own that is held for moments, so that whoever reads of all robots holds up nobody.

use crate::outbox::{End, Frame, Outbox};
use crate::threads::lock;
use midshift_core::ids::{RobotId, StopId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::stop::roster::Heard;
use midshift_core::time::{LinkDuration, LinkTime};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError, RwLock, RwLockReadGuard};

/// One robot.
pub struct Robot {
    /// The robot's id.
    pub robot_id: RobotId,
    state: Mutex<RobotState>,
}

/// The state of one robot, as this process knows it.
#[derive(Default)]
pub struct RobotState {
    /// Its newest check-in with this process.
    pub heard: Option<Heard>,
    /// Stops that it keeps and that are not the service's.
    pub foreign: BTreeSet<StopId>,
    /// The start of its agent that was heard last.
    pub boot_id: String,
    /// It stands in the snapshot.
    pub is_listed: bool,
    /// It stands in the snapshot no more: it was retired or revoked. By then its own silence has stood it, and it leaves.
    pub leaves: Option<LinkTime>,
    /// Its line.
    pub line: Option<Arc<Outbox>>,
    /// When its line was begun.
    pub begun: LinkTime,
    /// When it was noted last that another machine was not let in.
    pub held: Option<LinkTime>,
}

/// A robot that begins its line.
pub struct Attaching {
    /// The start of its agent.
    pub boot_id: String,
    /// Stops that it keeps and that are not the service's.
    pub foreign: BTreeSet<StopId>,
}

/// Why a line is refused: another start of the robot is heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HeldByAnother {
    /// So long at least nobody else is let in.
    pub for_now: LinkDuration,
    /// It is to be noted: it was not for a while.
    pub is_news: bool,
}

impl RobotState {
    /// How long its line still counts as heard. None: there is none, or it says nothing.
    fn holds_for(&self, now: LinkTime) -> Option<LinkDuration> {
        self.line.as_ref()?;
        let heard = self.heard.as_ref().map_or(self.begun, |heard| heard.at.max(self.begun));
        let silent = now.since(heard);
        (silent < limits::CHECK_IN_MISSED).then(|| LinkDuration(limits::CHECK_IN_MISSED.as_ms() - silent.as_ms()))
    }
}

impl RobotState {
    /// When its own silence has stood it at the latest. Of one that was never heard: as if it had been until now.
    fn stands_by(&self, now: LinkTime) -> LinkTime {
        match &self.heard {
            Some(heard) => heard.at + heard.around.patience().1,
            None => now + limits::SILENCE_STAND + limits::CHECK_IN,
        }
    }

    /// Nobody speaks of it any more, and by itself it stands.
    fn is_gone(&self, now: LinkTime) -> bool {
        let stands = self.heard.as_ref().is_none_or(|heard| now >= heard.at + heard.around.patience().1);
        self.line.is_none() && stands && self.leaves.is_some_and(|at| now >= at)
    }
}

impl Robot {
    /// Locks its state.
    pub fn state(&self) -> std::sync::MutexGuard<'_, RobotState> {
        lock(&self.state)
    }
}

type Map = BTreeMap<RobotId, Arc<Robot>>;

/// All of them.
#[derive(Default)]
pub struct Robots(RwLock<Map>);

impl Robots {
    fn read(&self) -> RwLockReadGuard<'_, Map> {
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// All, by name.
    pub fn all(&self) -> Vec<Arc<Robot>> {
        self.read().values().cloned().collect()
    }

    /// One of them; made if there is room, or if one that nobody lists and nobody has heard can go.
    ///
    /// # Errors
    /// There is no room.
    pub fn find_or_add(&self, robot_id: &RobotId) -> Result<Arc<Robot>, Refusal> {
        if let Some(robot) = self.read().get(robot_id) {
            return Ok(robot.clone());
        }
        let mut map = self.0.write().unwrap_or_else(PoisonError::into_inner);
        if map.len() >= limits::STOP_ROBOTS_MAX {
            let stray = map.values().find(|robot| is_stray(robot)).map(|robot| robot.robot_id.clone());
            let Some(stray) = stray else {
                let text = format!("{} robots are known and no more are taken", map.len());
                return Err(Refusal::new(Kind::Exhausted, Reason::new(Code::Overloaded, text)));
            };
            map.remove(&stray);
        }
        let robot = || Arc::new(Robot { robot_id: robot_id.clone(), state: Mutex::default() });
        Ok(map.entry(robot_id.clone()).or_insert_with(robot).clone())
    }

    /// Takes over who is listed. One that is listed no more stays, not reachable, until its own silence has stood it.
    pub fn list(&self, listed: &BTreeSet<RobotId>, now: LinkTime) {
        let mut map = self.0.write().unwrap_or_else(PoisonError::into_inner);
        for (robot_id, robot) in map.iter() {
            let mut state = robot.state();
            let was_listed = std::mem::replace(&mut state.is_listed, listed.contains(robot_id));
            if state.is_listed {
                state.leaves = None;
            } else if was_listed {
                state.leaves = Some(state.stands_by(now));
            }
        }
        for robot_id in listed {
            if map.len() >= limits::STOP_ROBOTS_MAX {
                break;
            }
            let state = || Mutex::new(RobotState { is_listed: true, ..RobotState::default() });
            let robot = || Arc::new(Robot { robot_id: robot_id.clone(), state: state() });
            map.entry(robot_id.clone()).or_insert_with(robot);
        }
    }

    /// Whether a robot has said that it keeps this stop, lies inside of it or waits for its resume.
    pub fn knows(&self, stop_id: &StopId) -> bool {
        self.read().values().any(|robot| {
            let state = robot.state();
            let says = |heard: &Heard| heard.inside.contains(stop_id) || heard.awaiting.contains(stop_id);
            state.foreign.contains(stop_id) || state.heard.as_ref().is_some_and(says)
        })
    }

    /// Removes robots that left the roster, have no line, and stand by their own silence. Returns whether any went.
    pub fn let_go(&self, now: LinkTime) -> bool {
        if !self.read().values().any(|robot| robot.state().is_gone(now)) {
            return false;
        }
        let mut map = self.0.write().unwrap_or_else(PoisonError::into_inner);
        map.retain(|_, robot| !robot.state().is_gone(now));
        true
    }

    /// Tells all lines of a change.
    pub fn tell_lines(&self, frame: &Frame, now: LinkTime) -> usize {
        let mut told = 0;
        for robot in self.read().values() {
            if let Some(line) = &robot.state().line {
                line.add_change(frame, now);
                told += 1;
            }
        }
        told
    }

    /// All lines.
    pub fn lines(&self) -> Vec<Arc<Outbox>> {
        self.read().values().filter_map(|robot| robot.state().line.clone()).collect()
    }

    /// A line begins; an older one of the same robot ends. A start of it that is heard keeps its line: whoever has a copy of its key takes nothing over, and says
    /// nothing in its place.
    ///
    /// # Errors
    /// Another start of this robot is heard.
    pub fn attach(robot: &Robot, line: &Arc<Outbox>, comes: Attaching, now: LinkTime) -> Result<(), HeldByAnother> {
        let Attaching { boot_id, foreign } = comes;
        let mut state = robot.state();
        if state.boot_id != boot_id {
            if let Some(for_now) = state.holds_for(now) {
                let is_news = state.held.is_none_or(|at| now.since(at) >= limits::LINE_HELD_NOTED_EVERY);
                if is_news {
                    state.held = Some(now);
                }
                return Err(HeldByAnother { for_now, is_news });
            }
            // What another start confirmed confirms nothing of this one.
            if let Some(heard) = &mut state.heard {
                heard.generation = 0;
            }
            state.boot_id = boot_id;
        }
        (state.foreign, state.begun) = (foreign, now);
        if let Some(older) = state.line.replace(line.clone()) {
            older.end(End::Refused(Refusal::new(Kind::Conflict, Code::LineReplaced)), now);
        }
        Ok(())
    }

    /// A line is over.
    pub fn detach(robot: &Robot, line: &Arc<Outbox>) {
        let mut state = robot.state();
        if state.line.as_ref().is_some_and(|current| Arc::ptr_eq(current, line)) {
            state.line = None;
        }
    }
}

fn is_stray(robot: &Robot) -> bool {
    let state = robot.state();
    !state.is_listed && state.line.is_none()
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::robot::StopLevel;
    use midshift_core::stop::ladder::{Around, Stage};

    fn heard(at: LinkTime, around: Around) -> Heard {
        let (inside, awaiting) = (BTreeSet::new(), BTreeSet::new());
        let (level, stage) = (StopLevel::None, Stage::Heard);
        Heard { at, generation: 1, is_durable: true, level, is_still: false, inside, stage, around, awaiting }
    }

    #[test]
    fn one_that_is_listed_no_more_leaves_when_its_own_silence_has_stood_it_and_not_before() {
        let robots = Robots::default();
        let names = |robots: &Robots| robots.all().iter().map(|r| r.robot_id.to_string()).collect::<Vec<_>>().join(" ");
        robots.list(&[1, 2, 3].map(id).into(), LinkTime(0));
        robots.find_or_add(&id(1)).unwrap().state().heard = Some(heard(LinkTime(9_000), Around::People));
        robots.find_or_add(&id(2)).unwrap().state().heard = Some(heard(LinkTime(9_000), Around::Robots));
        // One that nobody ever listed: it has a line before it has a session.
        robots.find_or_add(&id(4)).unwrap().state().heard = Some(heard(LinkTime(9_000), Around::People));
        robots.list(&BTreeSet::new(), LinkTime(10_000));
        for (ms, left) in
            [(14_999, "r1 r2 r3 r4"), (15_000, "r2 r3 r4"), (39_000, "r3 r4"), (40_999, "r3 r4"), (41_000, "r4")]
        {
            robots.let_go(LinkTime(ms));
            assert_eq!(names(&robots), left, "at {ms} ms");
        }
        // Listed again in time it stays.
        robots.list(&[1].map(id).into(), LinkTime(50_000));
        robots.list(&BTreeSet::new(), LinkTime(51_000));
        robots.list(&[1].map(id).into(), LinkTime(52_000));
        assert!(!robots.let_go(LinkTime(200_000)));
    }

    fn id(n: usize) -> RobotId {
        RobotId::parse(&format!("r{n}")).unwrap()
    }

    #[test]
    fn the_roster_is_bounded_and_who_nobody_lists_goes_first() {
        let robots = Robots::default();
        robots.list(&(1..limits::STOP_ROBOTS_MAX).map(id).collect(), LinkTime(0));
        robots.find_or_add(&id(0)).unwrap();
        robots.find_or_add(&id(99_999)).unwrap();
        assert_eq!(robots.all().len(), limits::STOP_ROBOTS_MAX);
        assert!(robots.all().iter().all(|robot| robot.robot_id != id(0)), "the stray one went");
        robots.find_or_add(&id(99_999)).unwrap().state().line = Some(Arc::new(Outbox::new(BTreeSet::new())));
        assert_eq!(robots.find_or_add(&id(99_998)).err().map(|refusal| refusal.kind()), Some(Kind::Exhausted));
    }
}
