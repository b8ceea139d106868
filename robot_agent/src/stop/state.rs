//! Holds what a robot with a stop line knows of stops, and decides when it must check in. Without IO.
//!
//! Invariant: a stop is obeyed before it is written or answered; one that cannot be written is obeyed all the same and
//! said to be not durable. Nothing of the link, of bulk or of the ledger is on its path; what the link says of stops is
//! added to it.

use super::messages::{CheckIn, StopNews, StopOrder};
use super::storage::Loaded;
use midshift_bundle::keys::PublicKey;
use midshift_core::ids::{AreaId, RobotId, StopId, WaypointId};
use midshift_core::limits;
use midshift_core::robot::{Pose, StopLevel};
use midshift_core::stop::ladder::{Around, Stage};
use midshift_core::stop::robot::{Obeyed, RobotStop, SavedStops};
use midshift_core::stop::{Latch, Reset};
use midshift_core::time::{LinkDuration, LinkTime, Now, SiteTime};
use midshift_proto::convert::stop::signed_reset;
use midshift_proto::session::StopFacts;
use std::collections::{BTreeSet, VecDeque};

/// Check-ins whose answer is still taken; older ones fed nothing any more anyway.
const UNANSWERED_MAX: usize = 64;
/// The service knows more than this robot was told for so long: the way down is broken, and another is made.
const BEHIND_MAX: LinkDuration = LinkDuration(2_000);
/// After a write that failed the next one comes after this.
const WRITE_AGAIN: LinkDuration = LinkDuration(1_000);

/// The line at hand.
#[derive(Debug)]
struct Attending {
    nonce: u64,
    /// Sent and not answered, oldest first.
    unanswered: VecDeque<(u64, LinkTime)>,
    /// When something of it was answered last; at first when it was opened.
    answered: LinkTime,
    generation: u64,
    is_synced: bool,
    behind_since: Option<LinkTime>,
    next: LinkTime,
    said: Option<CheckIn>,
}

/// Where the robot was when the areas around it were last known.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Floor {
    pub(crate) at: Option<WaypointId>,
    pub(crate) heading: Option<WaypointId>,
    pub(crate) areas: Vec<AreaId>,
}

/// The stops that a robot with a stop line knows, and how far the stop service and the file have them.
#[derive(Debug)]
pub(crate) struct StopState {
    robot: RobotStop,
    pub(crate) obeyed: Obeyed,
    pub(crate) around: Around,
    /// The level that the body was told last.
    pub(crate) bodily: StopLevel,
    /// It stood, and nothing has let it go on since.
    pub(crate) has_stood: bool,
    /// It was free to move once since it began.
    pub(crate) was_free: bool,
    pub(crate) floor: Floor,
    /// Drives near a stopped part: it is looked at again then, site clock.
    pub(crate) look_at: Option<SiteTime>,
    /// As it was said in a sample last.
    pub(crate) said: (StopLevel, Vec<StopId>, Vec<StopId>),
    line: Option<Attending>,
    /// Number of the newest state that must be kept, of the one being written, of the one that is durable.
    changes: u64,
    writing: Option<u64>,
    durable: u64,
    write_at: LinkTime,
}

impl StopState {
    /// A robot that begins with the stops that it loaded.
    pub(crate) fn begin(robot_id: RobotId, loaded: Loaded, now: LinkTime) -> Self {
        let mut stops = Self {
            robot: RobotStop::begin(robot_id, loaded.saved, now),
            obeyed: Obeyed { level: StopLevel::Halt, stage: Stage::Stand, ..Obeyed::default() },
            around: Around::People,
            bodily: StopLevel::None,
            has_stood: false,
            was_free: false,
            floor: Floor::default(),
            look_at: None,
            said: Default::default(),
            line: None,
            changes: 0,
            writing: None,
            durable: 0,
            write_at: now,
        };
        stops.changed(!loaded.is_durable);
        stops
    }

    /// The stops that must be saved.
    pub(crate) fn saved(&self) -> &SavedStops {
        self.robot.saved()
    }

    /// What waits for a person, at most [`limits::STOPS_MAX`].
    pub(crate) fn awaiting(&self) -> Vec<StopId> {
        self.robot.awaiting(limits::STOPS_MAX)
    }

    /// Effective stops that it lies inside of, at most [`limits::STOPS_MAX`].
    pub(crate) fn inside(&self) -> Vec<StopId> {
        self.obeyed.inside.iter().take(limits::STOPS_MAX).cloned().collect()
    }

    /// Driving alone may bring it into a stopped part.
    pub(crate) fn has_parts(&self) -> bool {
        self.robot.has_parts()
    }

    fn changed(&mut self, is_changed: bool) {
        self.changes += u64::from(is_changed);
    }

    /// People resumed these.
    pub(crate) fn resumed(&mut self, stop_ids: &BTreeSet<StopId>) {
        let is_changed = self.robot.resumed(stop_ids);
        self.changed(is_changed);
    }

    /// Looks at everything at this moment.
    pub(crate) fn look_around(&mut self, now: &Now, pose: Option<&Pose>, around: Around) {
        self.around = around;
        self.obeyed = self.robot.advance(now, pose, around);
        self.changed(self.obeyed.is_changed);
    }

    /// Takes in what the line brings.
    pub(crate) fn take_news(&mut self, now: LinkTime, news: StopNews) {
        match news {
            StopNews::Attended { nonce } => {
                self.line = Some(Attending {
                    nonce,
                    unanswered: VecDeque::new(),
                    answered: now,
                    generation: 0,
                    is_synced: false,
                    behind_since: None,
                    // The first one follows what it is told, which comes at once.
                    next: now + limits::CHECK_IN,
                    said: None,
                });
            }
            StopNews::Facts { stops, resets, generation } => {
                let is_changed = self.robot.merge_changes(stops, resets);
                self.changed(is_changed);
                // Before all was said, one part of it is no state of the latch.
                if let Some(line) = self.line.as_mut().filter(|line| line.is_synced) {
                    line.knows(generation);
                }
            }
            StopNews::Synced { generation, key } => {
                let is_changed = self.robot.merge_snapshot(Latch::default());
                let is_changed = self.robot.set_mark_key(key) || is_changed;
                self.changed(is_changed);
                if let Some(line) = &mut self.line {
                    line.is_synced = true;
                    line.knows(generation);
                    line.next = now;
                }
            }
            StopNews::CheckInAnswer { nonce, generation } => {
                let fed = self.line.as_mut().and_then(|line| line.answered(now, nonce, generation));
                fed.into_iter().for_each(|sent| self.robot.answered(sent));
            }
            StopNews::LineLost => self.line = None,
            StopNews::Saved { number, is_durable } => {
                self.writing = None;
                if is_durable {
                    self.durable = self.durable.max(number);
                } else {
                    self.write_at = now + WRITE_AGAIN;
                }
            }
        }
    }

    /// Adds what the link brings of stops: the second way, for one whose own line is cut. It feeds no ladder and ends
    /// no wait for the first words on that line.
    pub(crate) fn merge_link_facts(&mut self, facts: StopFacts) {
        let key = self.saved().key.clone();
        let is_changed = self.robot.merge_relayed(facts.stops, facts.resets, |reset| is_marked(&key, reset));
        self.changed(is_changed);
    }

    /// What is to be said and written now.
    pub(crate) fn due_orders(&mut self, now: LinkTime, is_still: bool) -> Vec<StopOrder> {
        let mut orders = Vec::new();
        if self.writing.is_none() && self.changes > self.durable && now >= self.write_at {
            self.writing = Some(self.changes);
            orders.push(StopOrder::Save(self.changes, Box::new(self.saved().clone())));
        }
        let check_in = self.check_in(is_still);
        let Some(line) = &mut self.line else { return orders };
        if let Some(why) = line.is_broken(now) {
            self.line = None;
            orders.push(StopOrder::Redial(why));
            return orders;
        }
        let is_urgent = line.said.as_ref().is_some_and(|said| check_in.is_urgent_after(said));
        if now < line.next && !is_urgent {
            return orders;
        }
        let nonce = line.nonce;
        line.nonce = nonce.wrapping_add(1);
        line.next = now + limits::CHECK_IN;
        line.said = Some(check_in.clone());
        if line.unanswered.len() == UNANSWERED_MAX {
            line.unanswered.pop_front();
        }
        line.unanswered.push_back((nonce, now));
        orders.push(StopOrder::CheckIn(nonce, Box::new(check_in)));
        orders
    }

    fn check_in(&self, is_still: bool) -> CheckIn {
        CheckIn {
            generation: self.line.as_ref().map_or(0, |line| line.generation),
            is_durable: self.durable >= self.changes,
            obeys: self.obeyed.level,
            is_still,
            inside: self.inside(),
            awaiting_resume: self.awaiting(),
            silence: self.obeyed.stage,
            is_without_people: self.around == Around::Robots,
        }
    }

    /// When it must be looked at again, link clock.
    pub(crate) fn next_at(&self) -> Option<LinkTime> {
        let write = (self.writing.is_none() && self.changes > self.durable).then_some(self.write_at);
        let line = self.line.as_ref().map(Attending::next_at);
        [write, line, self.robot.silence_at(self.around)].into_iter().flatten().min()
    }
}

/// Whether the stop service with this key has marked the reset. Before it has said its key nobody can tell.
fn is_marked(key: &[u8], reset: &Reset) -> bool {
    PublicKey::from_bytes(key).is_some_and(|key| key.verifies(&signed_reset(reset), &reset.proof))
}

impl Attending {
    fn knows(&mut self, generation: u64) {
        self.generation = self.generation.max(generation);
        self.behind_since = None;
    }

    /// When the check-in was sent that this answers. None: it answers none, or the service knows of what it has not
    /// told yet.
    fn answered(&mut self, now: LinkTime, nonce: u64, generation: u64) -> Option<LinkTime> {
        let at = self.unanswered.iter().position(|(sent, _)| *sent == nonce)?;
        let (_, sent) = self.unanswered.remove(at)?;
        // Answers come in order: what was asked before is not answered any more.
        self.unanswered.drain(..at);
        self.answered = now;
        if generation > self.generation {
            self.behind_since.get_or_insert(now);
            return None;
        }
        Some(sent)
    }

    /// Since when it has waited for an answer.
    fn waits_since(&self) -> LinkTime {
        self.unanswered.front().map_or(self.answered, |(_, sent)| (*sent).max(self.answered))
    }

    fn is_broken(&self, now: LinkTime) -> Option<&'static str> {
        if now.since(self.waits_since()) >= limits::CHECK_IN_MISSED {
            return Some("no answer");
        }
        let behind = self.behind_since.is_some_and(|since| now.since(since) >= BEHIND_MAX);
        behind.then_some("a stop was not told")
    }

    fn next_at(&self) -> LinkTime {
        let silent = self.waits_since() + limits::CHECK_IN_MISSED;
        let behind = self.behind_since.map(|since| since + BEHIND_MAX);
        [Some(self.next), Some(silent), behind].into_iter().flatten().min().unwrap_or(self.next)
    }
}
