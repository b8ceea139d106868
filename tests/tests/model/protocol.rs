//! A robot is taken out of work, activates new software once, and is given back: the parties, their rows and what is on the way between
//! them, as one state that moves by one action at a time.
//!
//! What it leaves out: floors, loads and parking (fleet takes a robot when it has no attempt), the directive (a grant stands for it), and what
//! the new software is worth (a switch settles, good or bad). Time is two steps of a grant's life: it passes for the robot first and
//! for the server later, as the rule of authority says; it may pass at any moment, or never.

/// Roll-outs of a run at most: the second is started right after the first was aborted.
pub const ROLLOUTS: usize = 2;

/// How a run is made up. Small numbers: each multiplies the states.
#[derive(Clone, Copy, Debug)]
pub struct Protocol {
    pub robots: usize,
    pub rollouts: usize,
    /// Processes of the rollout service that read, think and write.
    pub planners: usize,
    /// Robots out of work at a time.
    pub wave: usize,
    /// Robots have tasks besides.
    pub tasks: bool,
    /// Times that a roll-out is paused, that a session is cut, that the server is killed.
    pub pauses: u8,
    pub cuts: u8,
    pub kills: u8,
    /// Messages of a kind that can be on the way at once; an older one that has not arrived is lost to a newer one.
    pub held: usize,
    pub naive: Option<Naive>,
}

/// A rule left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Naive {
    /// The next roll-out's drain of a robot has the id of the last one's.
    DrainIdsUsedAgain,
    /// A drain is released when its grant's life has passed, whatever the robot did with it.
    ReleasedByTime,
    /// A drain is released on a heartbeat that came after the grant's life, although the robot sent it within.
    OldHeartbeatBelieved,
    /// A planner writes what it decided, whatever was written since it read.
    NoCompareAndSet,
    /// A grant is good until it is used.
    GrantWithoutLife,
    /// After a pause drains are released as if no grant were on its way.
    PauseTakenForImmediate,
    /// A grant is given as soon as the rows say that the drain holds the robot, and the robot takes it whatever its ledger says.
    LedgerNotAsked,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Holder {
    #[default]
    Nobody,
    Attempt,
    /// Maintenance of the drain with this id.
    Drain(u8),
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Phase {
    #[default]
    Draft,
    Running,
    Paused,
    Aborted,
}

/// Life of a grant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Life {
    Good,
    /// The robot's clock says it is over.
    OverForRobot,
    /// The server's clock says so too, which it never does first.
    OverForServer,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Grant {
    /// The session whose heartbeat it is anchored to; one anchor a session.
    pub session: u8,
    pub life: Life,
}

/// How far a drain is, by the rows of ota and fleet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Asked {
    #[default]
    Never,
    /// `drain_request` stands.
    Requested,
    /// `drain_release` stands.
    Released,
    /// Fleet has acted on the release.
    Over,
}

/// The drain of one robot in one roll-out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Drain {
    pub asked: Asked,
    pub grant: Option<Grant>,
    /// The robot said what came of it.
    pub outcome: bool,
}

/// Section update of the desired state, as far as it lets a robot activate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Order {
    pub rollout: usize,
    pub drain_id: u8,
    pub session: u8,
}

/// What a robot tells of its ledger.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Heartbeat {
    pub session: u8,
    pub holder: Holder,
    pub used: [bool; ROLLOUTS],
    /// Sent past the life of the grant that is anchored to this session: both moments are told by the robot's own clock.
    pub past: [Option<u8>; ROLLOUTS],
}

#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Robot {
    // Rows: fleet's, ota's, telemetry's.
    pub authority: Holder,
    /// Which roll-out's request fleet acted on. Nobody reads it; laws look at it.
    pub held_for: Option<usize>,
    pub drains: [Drain; ROLLOUTS],
    pub session: u8,
    pub last: Option<Heartbeat>,
    // On the way, oldest first.
    pub work_down: Vec<Holder>,
    pub update_down: Vec<Option<Order>>,
    pub up: Vec<Heartbeat>,
    // The machine and its ledger.
    pub holder: Holder,
    pub order: Option<Order>,
    pub ended: bool,
    pub used: [bool; ROLLOUTS],
    /// It switches, or proves itself after it: it can do nothing else, and nobody hears of it.
    pub switching: Option<usize>,
    /// It switches by a grant within its life although the roll-out has stopped: the honest bound of a pause.
    pub after_stop: bool,
    pub untold: [bool; ROLLOUTS],
}

/// What a planner means to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Decision {
    Request {
        robot: usize,
        rollout: usize,
    },
    Grant {
        robot: usize,
        rollout: usize,
    },
    /// The same grant anchored to the new session.
    Reanchor {
        robot: usize,
        rollout: usize,
    },
    Release {
        robot: usize,
        rollout: usize,
    },
}

#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct State {
    pub phases: [Phase; ROLLOUTS],
    pub robots: Vec<Robot>,
    /// Decided and not yet written, by planners that are alike.
    pub decided: Vec<Decision>,
    pub pauses: u8,
    pub cuts: u8,
    pub kills: u8,
    /// A grant was written although its roll-out did not run.
    pub granted_in_pause: bool,
    /// A robot activated although its roll-out did not run and the grant's life had passed by the server's clock.
    pub activated_late: bool,
    /// A robot activated although its ledger's holder was not the grant's drain.
    pub activated_unheld: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Action {
    Pause(usize),
    Resume(usize),
    Abort(usize),
    StartNext,
    Decide(Decision),
    Write(Decision),
    Assign(usize),
    Take { robot: usize, rollout: usize },
    Free { robot: usize, rollout: usize },
    TaskEndArrives(usize),
    OutcomeArrives { robot: usize, rollout: usize },
    HeartbeatArrives { robot: usize, place: usize },
    SendHeartbeat(usize),
    HearWork { robot: usize, place: usize },
    HearUpdate { robot: usize, place: usize },
    EndTask(usize),
    Activate(usize),
    Settle(usize),
    LifePasses { robot: usize, rollout: usize },
    Cut(usize),
    KillServer,
}

/// Something that is written under one revision.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Row {
    Rollout(usize),
    Drain { robot: usize, rollout: usize },
    Authority(usize),
    Session(usize),
}

impl Decision {
    /// Whether it was made from this row.
    fn reads(self, row: Row) -> bool {
        match self {
            Self::Request { robot, rollout } => [Row::Rollout(rollout), Row::Drain { robot, rollout }].contains(&row),
            Self::Grant { robot, rollout } | Self::Reanchor { robot, rollout } => {
                [Row::Rollout(rollout), Row::Drain { robot, rollout }, Row::Authority(robot), Row::Session(robot)]
                    .contains(&row)
            }
            Self::Release { robot, rollout } => row == Row::Drain { robot, rollout },
        }
    }
}

impl Protocol {
    fn is(&self, naive: Naive) -> bool {
        self.naive == Some(naive)
    }

    pub fn drain_id(&self, rollout: usize) -> u8 {
        if self.is(Naive::DrainIdsUsedAgain) { 0 } else { rollout as u8 }
    }

    pub fn first(&self) -> State {
        let mut state = State {
            robots: vec![Robot::default(); self.robots],
            pauses: self.pauses,
            cuts: self.cuts,
            kills: self.kills,
            ..State::default()
        };
        state.phases[0] = Phase::Running;
        state
    }

    // --- what may happen

    pub fn possible(&self, state: &State) -> Vec<Action> {
        let mut found = Vec::new();
        for rollout in 0..self.rollouts {
            match state.phases[rollout] {
                Phase::Running if state.pauses > 0 => found.extend([Action::Pause(rollout), Action::Abort(rollout)]),
                Phase::Running => found.push(Action::Abort(rollout)),
                Phase::Paused => found.extend([Action::Resume(rollout), Action::Abort(rollout)]),
                Phase::Aborted if rollout + 1 < self.rollouts && state.phases[rollout + 1] == Phase::Draft => {
                    found.push(Action::StartNext);
                }
                Phase::Draft | Phase::Aborted => {}
            }
        }
        found.extend(state.decided.iter().map(|d| Action::Write(*d)));
        if state.kills > 0 {
            found.push(Action::KillServer);
        }
        for (at, robot) in state.robots.iter().enumerate() {
            self.of_robot(at, robot, &mut found);
            if state.cuts > 0 {
                found.push(Action::Cut(at));
            }
            for rollout in 0..self.rollouts {
                self.of_drain(state, at, rollout, &mut found);
            }
        }
        found
    }

    fn of_robot(&self, at: usize, robot: &Robot, found: &mut Vec<Action>) {
        let asked = robot.drains.iter().any(|d| d.asked == Asked::Requested);
        if self.tasks && robot.authority == Holder::Nobody && !asked {
            found.push(Action::Assign(at));
        }
        if robot.ended {
            found.push(Action::TaskEndArrives(at));
        }
        found.extend((0..robot.up.len()).map(|place| Action::HeartbeatArrives { robot: at, place }));
        if robot.switching.is_some() {
            found.push(Action::Settle(at));
            return;
        }
        if robot.up.last().or(robot.last.as_ref()) != Some(&self.heartbeat(robot)) {
            found.push(Action::SendHeartbeat(at));
        }
        found.extend((0..robot.work_down.len()).map(|place| Action::HearWork { robot: at, place }));
        found.extend((0..robot.update_down.len()).map(|place| Action::HearUpdate { robot: at, place }));
        if robot.holder == Holder::Attempt {
            found.push(Action::EndTask(at));
        }
        if robot.order.is_some_and(|order| self.may_activate(robot, order)) {
            found.push(Action::Activate(at));
        }
    }

    fn of_drain(&self, state: &State, robot: usize, rollout: usize, found: &mut Vec<Action>) {
        let row = &state.robots[robot];
        let drain = row.drains[rollout];
        let older = row.drains[..rollout].iter().any(|d| d.asked == Asked::Requested);
        if row.authority == Holder::Nobody && drain.asked == Asked::Requested && !older {
            found.push(Action::Take { robot, rollout });
        }
        if drain.asked == Asked::Released {
            found.push(Action::Free { robot, rollout });
        }
        if row.untold[rollout] {
            found.push(Action::OutcomeArrives { robot, rollout });
        }
        if drain.grant.is_some_and(|grant| grant.life != Life::OverForServer) {
            found.push(Action::LifePasses { robot, rollout });
        }
        if state.decided.len() < self.planners {
            let decisions = [
                (self.may_request(state, robot, rollout), Decision::Request { robot, rollout }),
                (self.may_grant(state, robot, rollout), Decision::Grant { robot, rollout }),
                (self.may_reanchor(state, robot, rollout), Decision::Reanchor { robot, rollout }),
                (self.may_release(state, robot, rollout), Decision::Release { robot, rollout }),
            ];
            found.extend(decisions.into_iter().filter(|(may, _)| *may).map(|(_, d)| Action::Decide(d)));
        }
    }

    // --- the rules of the rollout service

    fn may_request(&self, state: &State, robot: usize, rollout: usize) -> bool {
        state.phases[rollout] == Phase::Running
            && state.robots[robot].drains[rollout].asked == Asked::Never
            && in_flight(state, rollout) < self.wave
    }

    /// Only while the robot is held by this very drain, said so in this session, and the roll-out runs.
    fn may_grant(&self, state: &State, robot: usize, rollout: usize) -> bool {
        let row = &state.robots[robot];
        let held = Holder::Drain(self.drain_id(rollout));
        let ready = row.last.is_some_and(|hb| hb.session == row.session && hb.holder == held);
        let ready = ready || self.is(Naive::LedgerNotAsked);
        let drain = row.drains[rollout];
        let open = drain.asked == Asked::Requested && drain.grant.is_none();
        state.phases[rollout] == Phase::Running && open && row.authority == held && ready
    }

    fn may_reanchor(&self, state: &State, robot: usize, rollout: usize) -> bool {
        let row = &state.robots[robot];
        let held = Holder::Drain(self.drain_id(rollout));
        let drain = row.drains[rollout];
        let standing = drain.grant.is_some_and(|g| g.session != row.session) && drain.asked == Asked::Requested;
        let unused = row.last.is_some_and(|hb| hb.session == row.session && hb.holder == held && !hb.used[rollout]);
        state.phases[rollout] == Phase::Running && standing && !drain.outcome && row.authority == held && unused
    }

    /// No grant was written, or its outcome was told, or the robot said past its life, in this session, that it did not use it.
    fn may_release(&self, state: &State, robot: usize, rollout: usize) -> bool {
        let row = &state.robots[robot];
        let drain = row.drains[rollout];
        if drain.asked != Asked::Requested {
            return false;
        }
        let Some(grant) = drain.grant else { return true };
        let unused = row.last.filter(|hb| hb.session == row.session && !hb.used[rollout]);
        let over = grant.life == Life::OverForServer;
        let wrongly = match self.naive {
            Some(Naive::ReleasedByTime) => over,
            Some(Naive::OldHeartbeatBelieved) => over && unused.is_some(),
            Some(Naive::PauseTakenForImmediate) => state.phases[rollout] != Phase::Running,
            _ => false,
        };
        drain.outcome || unused.is_some_and(|hb| hb.past[rollout] == Some(grant.session)) || wrongly
    }

    // --- the rules of the robot

    /// A grant of this session, within its life, never used, while the ledger's holder is its drain.
    pub fn may_activate(&self, robot: &Robot, order: Order) -> bool {
        let rollout = order.rollout;
        let good = robot.drains[rollout].grant.is_some_and(|g| g.session == order.session && g.life == Life::Good);
        let held = robot.holder == Holder::Drain(order.drain_id) || self.is(Naive::LedgerNotAsked);
        let same = order.session == robot.session;
        let alive = good || self.is(Naive::GrantWithoutLife);
        same && alive && held && !robot.used[rollout] && robot.switching.is_none()
    }

    fn heartbeat(&self, robot: &Robot) -> Heartbeat {
        let past = robot.drains.map(|d| d.grant.filter(|g| g.life != Life::Good).map(|g| g.session));
        Heartbeat { session: robot.session, holder: robot.holder, used: robot.used, past }
    }

    // --- what comes of it

    pub fn after(&self, state: &State, action: Action) -> State {
        let mut next = state.clone();
        match action {
            Action::Pause(rollout) => {
                next.pauses -= 1;
                self.turn(&mut next, rollout, Phase::Paused);
            }
            Action::Resume(rollout) => self.turn(&mut next, rollout, Phase::Running),
            Action::Abort(rollout) => self.turn(&mut next, rollout, Phase::Aborted),
            Action::StartNext => self.turn(&mut next, 1, Phase::Running),
            Action::Decide(decision) => {
                next.decided.push(decision);
                next.decided.sort();
            }
            Action::Write(decision) => {
                let at = next.decided.iter().position(|d| *d == decision).expect("it was decided");
                next.decided.remove(at);
                self.write(&mut next, decision);
            }
            Action::Assign(robot) => self.hold(&mut next, robot, Holder::Attempt, None),
            Action::Take { robot, rollout } => {
                self.hold(&mut next, robot, Holder::Drain(self.drain_id(rollout)), Some(rollout));
            }
            Action::Free { robot, rollout } => {
                next.robots[robot].drains[rollout].asked = Asked::Over;
                self.wrote(&mut next, Row::Drain { robot, rollout });
                if next.robots[robot].authority == Holder::Drain(self.drain_id(rollout)) {
                    self.hold(&mut next, robot, Holder::Nobody, None);
                }
            }
            Action::TaskEndArrives(robot) => {
                next.robots[robot].ended = false;
                if next.robots[robot].authority == Holder::Attempt {
                    self.hold(&mut next, robot, Holder::Nobody, None);
                }
            }
            Action::OutcomeArrives { robot, rollout } => {
                next.robots[robot].untold[rollout] = false;
                next.robots[robot].drains[rollout].outcome = true;
                self.wrote(&mut next, Row::Drain { robot, rollout });
            }
            Action::LifePasses { robot, rollout } => {
                let grant = next.robots[robot].drains[rollout].grant.as_mut().expect("it has a life");
                grant.life = if grant.life == Life::Good { Life::OverForRobot } else { Life::OverForServer };
            }
            Action::Cut(robot) => {
                next.cuts -= 1;
                self.reconnect(&mut next, robot);
            }
            Action::KillServer => {
                next.kills -= 1;
                next.decided.clear();
                for robot in 0..next.robots.len() {
                    self.reconnect(&mut next, robot);
                    // After a start every life counts as begun at that moment.
                    for grant in next.robots[robot].drains.iter_mut().filter_map(|d| d.grant.as_mut()) {
                        if grant.life == Life::OverForServer {
                            grant.life = Life::OverForRobot;
                        }
                    }
                }
            }
            _ => self.machine(&mut next, action),
        }
        next
    }

    /// What happens on the robot and on its way to it and from it.
    fn machine(&self, next: &mut State, action: Action) {
        match action {
            Action::HeartbeatArrives { robot, place } => {
                let robot = &mut next.robots[robot];
                robot.last = robot.up.drain(..=place).next_back();
            }
            Action::SendHeartbeat(robot) => {
                let robot = &mut next.robots[robot];
                let heartbeat = self.heartbeat(robot);
                self.send(&mut robot.up, heartbeat);
            }
            Action::HearWork { robot, place } => {
                let robot = &mut next.robots[robot];
                robot.holder = robot.work_down.drain(..=place).next_back().expect("it was sent");
            }
            Action::HearUpdate { robot, place } => {
                let robot = &mut next.robots[robot];
                robot.order = robot.update_down.drain(..=place).next_back().expect("it was sent");
            }
            Action::EndTask(robot) => {
                next.robots[robot].holder = Holder::Nobody;
                next.robots[robot].ended = true;
            }
            Action::Activate(at) => {
                let robot = &mut next.robots[at];
                let order = robot.order.take().expect("it has a grant");
                robot.used[order.rollout] = true;
                robot.switching = Some(order.rollout);
                let over = robot.drains[order.rollout].grant.is_some_and(|g| g.life == Life::OverForServer);
                next.activated_unheld |= robot.holder != Holder::Drain(order.drain_id);
                let stopped = next.phases[order.rollout] != Phase::Running;
                robot.after_stop = stopped && !over;
                next.activated_late |= stopped && over;
            }
            Action::Settle(robot) => {
                let robot = &mut next.robots[robot];
                robot.after_stop = false;
                if let Some(rollout) = robot.switching.take() {
                    robot.untold[rollout] = true;
                }
            }
            other => unreachable!("{other:?} is the server's"),
        }
    }

    fn turn(&self, next: &mut State, rollout: usize, phase: Phase) {
        next.phases[rollout] = phase;
        self.wrote(next, Row::Rollout(rollout));
    }

    fn write(&self, next: &mut State, decision: Decision) {
        match decision {
            Decision::Request { robot, rollout } => {
                next.robots[robot].drains[rollout].asked = Asked::Requested;
                self.wrote(next, Row::Rollout(rollout));
                self.wrote(next, Row::Drain { robot, rollout });
            }
            Decision::Grant { robot, rollout } | Decision::Reanchor { robot, rollout } => {
                next.granted_in_pause |= next.phases[rollout] != Phase::Running;
                let row = &mut next.robots[robot];
                row.drains[rollout].grant = Some(Grant { session: row.session, life: Life::Good });
                let order = Order { rollout, drain_id: self.drain_id(rollout), session: row.session };
                self.send(&mut row.update_down, Some(order));
                self.wrote(next, Row::Drain { robot, rollout });
            }
            Decision::Release { robot, rollout } => {
                let row = &mut next.robots[robot];
                row.drains[rollout].asked = Asked::Released;
                if row.drains[rollout].grant.is_some() {
                    self.send(&mut row.update_down, None);
                }
                self.wrote(next, Row::Rollout(rollout));
                self.wrote(next, Row::Drain { robot, rollout });
            }
        }
    }

    fn hold(&self, next: &mut State, robot: usize, holder: Holder, held_for: Option<usize>) {
        let row = &mut next.robots[robot];
        (row.authority, row.held_for) = (holder, held_for);
        self.send(&mut row.work_down, holder);
        self.wrote(next, Row::Authority(robot));
    }

    /// A new session: what was on the way is gone, the newest desired state is sent again.
    fn reconnect(&self, next: &mut State, robot: usize) {
        let row = &mut next.robots[robot];
        row.session += 1;
        row.up.clear();
        row.work_down.drain(..row.work_down.len().saturating_sub(1));
        row.update_down.drain(..row.update_down.len().saturating_sub(1));
        self.wrote(next, Row::Session(robot));
    }

    /// Whoever decided from this row will not get it written.
    fn wrote(&self, next: &mut State, row: Row) {
        if !self.is(Naive::NoCompareAndSet) {
            next.decided.retain(|decision| !decision.reads(row));
        }
    }

    fn send<T>(&self, way: &mut Vec<T>, message: T) {
        way.push(message);
        if way.len() > self.held {
            way.remove(0);
        }
    }
}

/// Robots of a roll-out whose drain is not released.
pub fn in_flight(state: &State, rollout: usize) -> usize {
    state.robots.iter().filter(|robot| robot.drains[rollout].asked == Asked::Requested).count()
}
