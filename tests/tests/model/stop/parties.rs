//! The stop service with its file, robots with theirs, what is on the way between them, and people who engage, reset and resume: one state that
//! moves by one action at a time. What a side makes of what it hears is the law that runs ([`Latch`], [`RobotStop`] and its ladder), called in each step.
//!
//! What it leaves out: regions and poses, times other than "answered" and "silent for too long", what is forgotten by age. A message of an open line
//! comes at any time, in any order, any number of times or never; with the line it is gone.

use midshift_core::ids::{RobotId, StopId};
use midshift_core::robot::StopLevel;
use midshift_core::stop::ladder::Around;
use midshift_core::stop::robot::{RobotStop, SavedStops};
use midshift_core::stop::{Latch, Reset, Scope, Stop};
use midshift_core::time::{LinkTime, Now, SiteTime, Utc};
use std::collections::BTreeSet;
use std::sync::OnceLock;

/// How a run is made up. Small numbers: each multiplies the states.
#[derive(Clone, Copy, Debug)]
pub struct Parties {
    /// Each robot, and whether people are around it.
    pub around: &'static [Around],
    /// Stops that people can engage: whose, none: everybody's.
    pub stops: &'static [Option<usize>],
    /// Times that the service is killed, that a robot's program is, that a robot hears nothing for too long.
    pub kills: u8,
    pub restarts: u8,
    pub silences: u8,
    pub naive: Option<Naive>,
}

/// A rule left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Naive {
    /// A reset takes every stop away that its side knows.
    ResetClearsAll,
    /// A reset lets robots go on without a resume.
    ResetResumes,
    /// Who engages is answered before the file has the stop.
    AnsweredBeforeWritten,
    /// Robots hear of a reset before the file has it.
    ResetToldBeforeWritten,
    /// A check-in feeds the robot although the service knows of more than the robot was told.
    FedWhileBehind,
    /// What a robot kept and the service lost stays with the robot.
    NothingTakenBack,
    /// A silence among people ends by itself like any other.
    SilenceEndsItself,
    /// Robots keep nothing in a file.
    NothingKept,
}

/// Names by number.
pub type Names = u8;
/// Names of silences come after those of stops.
const SILENCE: usize = 4;
/// Robots of a run at most.
const ROBOTS: usize = 2;

/// Stops and resets that a side knows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Facts {
    pub engaged: Names,
    pub reset: Names,
}

impl Facts {
    pub fn effective(self) -> Names {
        self.engaged & !self.reset
    }
    fn join(self, other: Self) -> Self {
        Self { engaged: self.engaged | other.engaged, reset: self.reset | other.reset }
    }
    fn holds(self, other: Self) -> bool {
        self.join(other) == self
    }
}

/// What a robot keeps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Known {
    pub facts: Facts,
    /// What waits for a resume: stops and silences.
    pub awaiting: Names,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Stage {
    /// Nobody has answered since it began.
    #[default]
    Begun,
    Heard,
    Silent,
}

/// An open line, as it was begun by the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Line {
    /// All that was effective at its beginning, and resets of what the robot said that it keeps.
    whole: Facts,
    synced: bool,
    /// Said since, and what of it has come.
    said: Facts,
    came: Facts,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Robot {
    pub known: Known,
    pub file: Known,
    pub told: bool,
    pub stage: Stage,
    pub line: Option<Line>,
    /// Silences so far.
    silences: u8,
    /// What people resumed, on its way to the robot again and again.
    resumed: Names,
    /// It may move: what it obeys is less than to stand.
    pub moves: bool,
    /// Facts that came, by name. Only a law looks at it.
    pub heard: Facts,
    /// What stood it, as far as it or its file knows. Only a law looks at it.
    pub stood: Names,
}

impl Robot {
    /// What people resumed for it.
    pub fn let_go(&self) -> Names {
        self.resumed
    }
}

#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct State {
    // The service and its file, with resets that wait for the file.
    pub service: Facts,
    pub file: Facts,
    pub pending: Names,
    pub robots: Vec<Robot>,
    // People: what they asked for by name, and which stops they were told are kept.
    pub engaged: Names,
    pub reset: Names,
    pub answered: Names,
    /// A stop that the service had lost came back with a robot.
    pub came_back: bool,
    kills: u8,
    restarts: u8,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Action {
    Engage(usize),
    Reset(usize),
    /// The service's file takes what is new, and who asked is answered.
    Write,
    /// The service is killed, before or in the middle of the write: the file has it and nobody heard so.
    Kill {
        written: bool,
    },
    LineUp(usize),
    LineDown(usize),
    Synced(usize),
    HearStop {
        robot: usize,
        stop: usize,
    },
    HearReset {
        robot: usize,
        stop: usize,
    },
    /// Check-ins are answered as often as it takes.
    Answered(usize),
    Silence(usize),
    /// A robot's file takes what is new.
    Keep(usize),
    /// A robot's program begins again, with what its file has.
    Restart(usize),
    Resume {
        robot: usize,
        name: usize,
    },
    HearResumed(usize),
}

const fn bit(number: usize) -> Names {
    1 << number
}

fn numbers(names: Names) -> impl Iterator<Item = usize> {
    (0..8).filter(move |n| names & bit(*n) != 0)
}

fn robot_id(robot: usize) -> RobotId {
    RobotId::parse(&format!("r{robot}")).expect("a name")
}

fn now(ms: u64, wall: u8) -> Now {
    Now { site: SiteTime(ms), link: LinkTime(ms), utc: Utc(0), wall: Utc(wall.into()), jump: None }
}

/// Silences are named by the robot, after its wall.
fn name(robot: usize, number: usize) -> StopId {
    static NAMES: OnceLock<Vec<Vec<StopId>>> = OnceLock::new();
    let of = |robot: usize| (0..8).map(|number| named(robot, number)).collect();
    NAMES.get_or_init(|| (0..ROBOTS).map(of).collect())[robot][number].clone()
}

fn named(robot: usize, number: usize) -> StopId {
    let named = match number {
        0..SILENCE => format!("STOP-{number}"),
        _ => format!("SILENCE-r{robot}-{}", number - SILENCE),
    };
    StopId::parse(&named).expect("a name")
}

fn names<'a>(ids: impl Iterator<Item = &'a StopId>) -> Names {
    let number = |id: &StopId| {
        let (kind, number) = id.as_str().rsplit_once('-').expect("one of these names");
        number.parse::<usize>().expect("a number") + if kind == "STOP" { 0 } else { SILENCE }
    };
    ids.fold(0, |names, id| names | bit(number(id)))
}

fn reset_of(stop: usize) -> Reset {
    Reset::new(name(0, stop), Utc(0))
}

fn facts_of(latch: &Latch) -> Facts {
    let engaged = names(latch.stops().map(|stop| &stop.stop_id));
    Facts { engaged, reset: names(latch.resets().map(|reset| &reset.stop_id)) }
}

fn effective_of(latch: &Latch) -> Names {
    names(latch.effective().map(|stop| &stop.stop_id))
}

/// What the law calls effective of what a side knows.
pub fn effective(parties: &Parties, facts: Facts) -> Names {
    effective_of(&parties.latch(facts))
}

/// When a robot was answered, and when it has been silent for too long, whoever is around.
const HEARD_MS: u64 = 3_000;
const SILENT_MS: u64 = 60_000;

impl Parties {
    fn is(&self, naive: Naive) -> bool {
        self.naive == Some(naive)
    }

    pub fn first(&self) -> State {
        let robots = vec![Robot::default(); self.around.len()];
        State { robots, kills: self.kills, restarts: self.restarts, ..State::default() }
    }

    fn stop_of(&self, stop: usize) -> Stop {
        let scope = self.stops[stop].map_or(Scope::Fleet, |robot| Scope::Robot(robot_id(robot)));
        Stop::new(name(0, stop), scope, StopLevel::Halt, Utc(0))
    }

    /// Stops over a robot.
    pub fn over(&self, robot: usize, stops: Names) -> Names {
        numbers(stops).filter(|n| self.stops[*n].is_none_or(|of| of == robot)).fold(0, |names, n| names | bit(n))
    }

    // --- the law that runs, on what is known

    fn latch(&self, facts: Facts) -> Latch {
        let mut latch = Latch::default();
        numbers(facts.engaged).for_each(|n| {
            latch.engage(self.stop_of(n));
        });
        numbers(facts.reset).for_each(|n| {
            latch.reset(reset_of(n));
        });
        latch
    }

    fn saved(&self, robot: usize, known: Known) -> SavedStops {
        SavedStops {
            latch: self.latch(known.facts),
            awaiting: self.ids(robot, known.awaiting),
            ..SavedStops::default()
        }
    }

    fn ids(&self, robot: usize, names: Names) -> BTreeSet<StopId> {
        numbers(names).map(|n| name(robot, n)).collect()
    }

    fn patience(&self, robot: usize) -> Around {
        if self.is(Naive::SilenceEndsItself) { Around::Robots } else { self.around[robot] }
    }

    /// A robot as it came to what it is.
    fn lives(&self, at: usize, robot: &Robot) -> RobotStop {
        // It has given the silence that goes on its name itself.
        let silence = bit(SILENCE + usize::from(robot.silences));
        let own = if robot.stage == Stage::Silent { silence } else { 0 };
        let known = Known { awaiting: robot.known.awaiting & !own, ..robot.known };
        let mut stop = RobotStop::begin(robot_id(at), self.saved(at, known), LinkTime(0));
        if robot.told {
            stop.merge_snapshot(Latch::default());
        }
        if robot.stage != Stage::Begun {
            (1..4).for_each(|s| stop.answered(LinkTime(s * 1_000)));
            stop.advance(&now(HEARD_MS, robot.silences), None, self.patience(at));
        }
        if robot.stage == Stage::Silent {
            stop.advance(&now(SILENT_MS, robot.silences), None, self.patience(at));
            // A silence that goes on after its resume has its name already.
            if robot.known.awaiting & silence == 0 {
                stop.resumed(&self.ids(at, silence));
            }
        }
        stop
    }

    /// Something happens to a robot, and it looks what it has to obey.
    fn happens(&self, at: usize, robot: &mut Robot, stage: Stage, happens: impl FnOnce(&mut RobotStop)) {
        let mut stop = self.lives(at, robot);
        happens(&mut stop);
        let ms = match (robot.stage, stage) {
            (Stage::Silent, Stage::Heard) => SILENT_MS + HEARD_MS,
            (_, Stage::Silent) => SILENT_MS,
            _ => HEARD_MS,
        };
        let obeyed = stop.advance(&now(ms, robot.silences), None, self.patience(at));
        let awaiting = names(stop.saved().awaiting.iter());
        robot.known = Known { facts: facts_of(&stop.saved().latch), awaiting };
        (robot.told, robot.stage) = (stop.is_told(), stage);
        robot.moves = obeyed.level < StopLevel::Halt;
        robot.stood |= awaiting | self.over(at, effective_of(&stop.saved().latch));
    }

    /// Resets that a side takes over.
    fn resets(&self, facts: Facts, resets: Names) -> Names {
        let all = self.is(Naive::ResetClearsAll) && resets != 0;
        if all { resets | facts.effective() } else { resets }
    }

    fn merged(&self, facts: Facts, news: Facts) -> Facts {
        let mut latch = self.latch(facts);
        latch.merge(self.latch(Facts { reset: self.resets(facts, news.reset), ..news }));
        facts_of(&latch)
    }

    /// A robot that is answered feeds its ladder only when it was told all that the service knows.
    pub fn is_answered(&self, robot: &Robot) -> bool {
        let behind = |line: &Line| !line.came.holds(line.said) && !self.is(Naive::FedWhileBehind);
        robot.line.as_ref().is_some_and(|line| line.synced && !behind(line))
    }

    // --- what may happen

    pub fn possible(&self, state: &State) -> Vec<Action> {
        let mut found = Vec::new();
        for stop in 0..self.stops.len() {
            // A name is never used again, and a reset can be asked for by anyone who saw the stop.
            if state.engaged & bit(stop) == 0 {
                found.push(Action::Engage(stop));
            } else if (state.service.reset | state.pending) & bit(stop) == 0 {
                found.push(Action::Reset(stop));
            }
        }
        if state.file != self.written(state) || state.answered != state.service.engaged {
            found.push(Action::Write);
        }
        if state.kills > 0 {
            found.push(Action::Kill { written: false });
            if state.file != self.written(state) {
                found.push(Action::Kill { written: true });
            }
        }
        for (at, robot) in state.robots.iter().enumerate() {
            self.of_robot(state, at, robot, &mut found);
        }
        found
    }

    fn of_robot(&self, state: &State, at: usize, robot: &Robot, found: &mut Vec<Action>) {
        match &robot.line {
            None => found.push(Action::LineUp(at)),
            Some(line) => {
                found.push(Action::LineDown(at));
                if !line.synced {
                    found.push(Action::Synced(at));
                }
                found.extend(numbers(line.said.engaged).map(|stop| Action::HearStop { robot: at, stop }));
                found.extend(numbers(line.said.reset).map(|stop| Action::HearReset { robot: at, stop }));
            }
        }
        if robot.stage != Stage::Heard && self.is_answered(robot) {
            found.push(Action::Answered(at));
        }
        if robot.stage == Stage::Heard && robot.silences < self.silences {
            found.push(Action::Silence(at));
        }
        if state.restarts > 0 {
            found.push(Action::Restart(at));
            if robot.file != robot.known && !self.is(Naive::NothingKept) {
                found.push(Action::Keep(at));
            }
        }
        let open = robot.known.awaiting & !robot.resumed;
        found.extend(numbers(open).map(|name| Action::Resume { robot: at, name }));
        if robot.known.awaiting & robot.resumed != 0 {
            found.push(Action::HearResumed(at));
        }
    }

    /// The file after a write: also resets that count only then.
    fn written(&self, state: &State) -> Facts {
        self.merged(state.service, Facts { reset: state.pending, ..Facts::default() })
    }

    // --- what comes of it

    pub fn after(&self, state: &State, action: Action) -> State {
        let mut next = state.clone();
        match action {
            Action::Engage(stop) => {
                next.engaged |= bit(stop);
                self.engage(&mut next, bit(stop));
                if self.is(Naive::AnsweredBeforeWritten) {
                    next.answered = next.service.engaged;
                }
            }
            Action::Reset(stop) => {
                next.reset |= bit(stop);
                next.pending |= bit(stop);
                if self.is(Naive::ResetToldBeforeWritten) {
                    self.settle(&mut next);
                }
            }
            Action::Write => {
                next.file = self.written(&next);
                next.answered = next.service.engaged;
                self.settle(&mut next);
            }
            Action::Kill { written } => {
                next.kills -= 1;
                if written {
                    next.file = self.written(&next);
                }
                (next.service, next.pending) = (next.file, 0);
                next.robots.iter_mut().for_each(|robot| robot.line = None);
            }
            Action::Resume { robot, name } => next.robots[robot].resumed |= bit(name),
            Action::LineUp(robot) => self.attend(&mut next, robot),
            Action::Restart(at) => {
                next.restarts -= 1;
                self.restart(at, &mut next.robots[at]);
                if next.restarts == 0 {
                    // Nobody reads a file again.
                    next.robots.iter_mut().for_each(|robot| robot.file = Known::default());
                }
            }
            _ => self.robot_after(&mut next, action),
        }
        next
    }

    fn robot_after(&self, next: &mut State, action: Action) {
        match action {
            Action::LineDown(at) => next.robots[at].line = None,
            Action::Synced(at) => {
                let robot = &mut next.robots[at];
                let line = robot.line.as_mut().expect("it is open");
                line.synced = true;
                let whole = line.whole;
                self.hear_news(at, robot, whole);
                self.happens(at, robot, robot.stage, |stop| {
                    stop.merge_snapshot(Latch::default());
                });
            }
            Action::HearStop { robot, stop } => {
                self.comes(robot, &mut next.robots[robot], Facts { engaged: bit(stop), reset: 0 });
            }
            Action::HearReset { robot, stop } => {
                self.comes(robot, &mut next.robots[robot], Facts { engaged: 0, reset: bit(stop) });
            }
            Action::Answered(at) => {
                let robot = &mut next.robots[at];
                let from = if robot.stage == Stage::Silent { SILENT_MS } else { 0 };
                self.happens(at, robot, Stage::Heard, |stop| {
                    (1..4).for_each(|s| stop.answered(LinkTime(from + s * 1_000)));
                });
            }
            Action::Silence(at) => {
                let robot = &mut next.robots[at];
                robot.silences += 1;
                // While one waits for its resume, no further one has a name.
                let waits = numbers(robot.known.awaiting).any(|name| name >= SILENCE);
                if self.around[at] == Around::People && !waits {
                    robot.stood |= bit(SILENCE + usize::from(robot.silences));
                }
                self.happens(at, robot, Stage::Silent, |_| {});
            }
            Action::Keep(at) => next.robots[at].file = next.robots[at].known,
            Action::HearResumed(at) => {
                let robot = &mut next.robots[at];
                let resumed = self.ids(at, robot.resumed);
                self.happens(at, robot, robot.stage, |stop| {
                    stop.resumed(&resumed);
                });
            }
            other => unreachable!("{other:?} is not of one robot"),
        }
    }

    fn comes(&self, at: usize, robot: &mut Robot, news: Facts) {
        let line = robot.line.as_mut().expect("it is open");
        line.came = line.came.join(news);
        self.hear_news(at, robot, news);
    }

    fn hear_news(&self, at: usize, robot: &mut Robot, news: Facts) {
        robot.heard = robot.heard.join(news);
        let stops = numbers(news.engaged).map(|n| self.stop_of(n)).collect();
        let resets = self.resets(robot.known.facts, news.reset);
        let (told, over) = (numbers(resets).map(reset_of).collect(), self.ids(at, resets));
        self.happens(at, robot, robot.stage, |stop| {
            stop.merge_changes(stops, told);
            if self.is(Naive::ResetResumes) {
                stop.resumed(&over);
            }
        });
    }

    /// The service counts stops at once and tells all lines.
    fn engage(&self, next: &mut State, stops: Names) {
        next.service = self.merged(next.service, Facts { engaged: stops, reset: 0 });
        self.tell_news(next, Facts { engaged: stops, reset: 0 });
    }

    /// Resets count when the file had its turn with them.
    fn settle(&self, next: &mut State) {
        let resets = Facts { engaged: 0, reset: std::mem::take(&mut next.pending) };
        next.service = self.merged(next.service, resets);
        self.tell_news(next, resets);
    }

    fn tell_news(&self, next: &mut State, news: Facts) {
        let lines = next.robots.iter_mut().filter_map(|robot| robot.line.as_mut());
        lines.for_each(|line| line.said = line.said.join(news));
    }

    /// A robot says what it keeps; what the service lost of it is engaged again. Then it is told all that is effective.
    fn attend(&self, next: &mut State, at: usize) {
        let known = next.service.engaged | next.service.reset;
        let listed = effective(self, next.robots[at].known.facts);
        let lost = listed & !known;
        if lost != 0 && !self.is(Naive::NothingTakenBack) {
            self.engage(next, lost);
            next.came_back = true;
        }
        let (said, came) = Default::default();
        let whole = Facts { engaged: effective(self, next.service), reset: next.service.reset & listed };
        next.robots[at].line = Some(Line { whole, synced: false, said, came });
    }

    /// What was not in its file is gone, and nobody can ask it for that.
    fn restart(&self, at: usize, robot: &mut Robot) {
        let file = robot.file;
        if !self.is(Naive::NothingKept) {
            robot.stood &= file.awaiting | file.facts.engaged;
        }
        (robot.known, robot.heard, robot.line) = (file, file.facts, None);
        (robot.told, robot.stage) = (false, Stage::Begun);
        self.happens(at, robot, Stage::Begun, |_| {});
    }
}
