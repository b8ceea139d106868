//! A scripted robot: obeys its desired state by the rules of the link, one small act a step, unless a test tells it otherwise.

use midshift_core::authority::{Authority, SentHeartbeats};
use midshift_core::desired_state::{Assignment, DesiredWork, RoutePoint};
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::{AttemptId, PlaceId, RobotId, StopId, WaypointId};
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::WorkState;
use midshift_core::robot::{
    Fault, HardwareStop, HeldPlace, Inventory, Lane, Load, Mode, Pose, ReportedAttempt, ReportedState, StopLevel,
    Vitals,
};
use midshift_core::robot_events::{
    AttemptReport, InboxEntry, InboxItem, PlaceNews, RobotEvent, Sample, SampleBody, WorkStats,
};
use midshift_core::session::{LaneMark, Session};
use midshift_core::site::Site;
use midshift_core::step::{Effect, StepKind};
use midshift_core::time::{LinkTime, Now, SiteTime};
use std::collections::BTreeSet;

/// What it does with an offer.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    Accept,
    Refuse(Code),
    Ignore,
    /// It takes it and says in the same breath that it ended so; FAILED: because the work cannot be done as asked; SUCCEEDED: with every step.
    LetGo(WorkState),
    /// It says that it is over, and never took it.
    CallOver,
}

pub struct Robot {
    pub id: RobotId,
    pub here: WaypointId,
    /// Its heartbeats arrive.
    pub talks: bool,
    /// Desired state reaches it.
    pub hears: bool,
    /// Its events arrive.
    pub tells: bool,
    pub answer: Answer,
    /// It drives where it may.
    pub drives: bool,
    /// It does the actions of its steps.
    pub works: bool,
    /// It confirms that it stopped.
    pub confirms: bool,
    /// The next time it begins step `.0` it fails with this.
    pub fails: Option<(u32, Fault)>,
    pub battery_permille: u16,
    pub mode: Mode,
    pub hardware_stop: HardwareStop,
    /// Where it says it is; none: it does not know.
    pub pose: Option<Pose>,
    /// Fleet stops that it obeys.
    pub stops: Vec<StopId>,
    /// Fleet stops that stood it and that nobody has resumed.
    pub awaiting: Vec<StopId>,
    /// A fault that stands.
    pub fault: Option<Fault>,
    pub load: Option<Load>,
    pub inventory: Inventory,
    /// Resume orders it obeyed.
    pub resumed: Vec<Authority>,
    /// Offers it was given, by attempt.
    pub offered: Vec<(AttemptId, Authority)>,
    pub applied: u64,
    pub paused: bool,
    /// How fast it says that it moves.
    pub speed_mm_s: u32,
    /// Attempts that it lists beside its own.
    pub lists: Vec<ReportedAttempt>,
    /// Places that it lists beside its own.
    pub claims: Vec<HeldPlace>,
    /// The step that it says of every attempt, whatever is true.
    pub says_step: Option<u32>,
    /// It never says that it opened a task.
    pub hides_opened: bool,
    session_epoch: u64,
    hb: u64,
    boots: u64,
    produced: u64,
    outbox: Vec<(u64, InboxEntry)>,
    attempts: Vec<ReportedAttempt>,
    finished: BTreeSet<AttemptId>,
    job: Option<Assignment>,
    at: usize,
    step: u32,
    places: Vec<HeldPlace>,
    progress: u64,
    progress_at: SiteTime,
    beaten: Option<LinkTime>,
    sent: SentHeartbeats,
}

/// A fault that may be tried again.
pub fn obstacle() -> Fault {
    Fault {
        code: midshift_core::robot::FAULT_OBSTACLE,
        class: midshift_core::robot::FaultClass::Recoverable,
        message: "something stands there".to_owned(),
    }
}

/// A fault that a person must look at.
pub fn jam() -> Fault {
    Fault {
        code: midshift_core::robot::FAULT_JAM,
        class: midshift_core::robot::FaultClass::Mechanical,
        message: "stuck".to_owned(),
    }
}

/// A fault that says that the work cannot be done as asked.
fn impossible() -> Fault {
    Fault {
        code: midshift_core::robot::FAULT_SEMANTIC,
        class: midshift_core::robot::FaultClass::Semantic,
        message: "not as asked".to_owned(),
    }
}

impl Robot {
    pub fn new(id: &str, waypoint: &str, site: &Site) -> Self {
        let here = WaypointId::parse(waypoint).expect("a waypoint");
        let at = site.find(&here).expect("a waypoint of the site");
        let stands = site.standing_at(at).map(|p| site.place(p).place_id.clone());
        let inside = |place_id| HeldPlace { place_id, grant_id: 0, inside: true };
        Self {
            id: RobotId::parse(id).expect("a robot id"),
            here,
            talks: true,
            hears: true,
            tells: true,
            answer: Answer::Accept,
            drives: true,
            works: true,
            confirms: true,
            fails: None,
            battery_permille: 1_000,
            mode: Mode::Automatic,
            hardware_stop: HardwareStop::None,
            pose: None,
            stops: Vec::new(),
            awaiting: Vec::new(),
            fault: None,
            load: None,
            inventory: Inventory {
                capabilities: ["pick", "place", "charge", "park"].map(str::to_owned).to_vec(),
                payload_g: 10_000,
                software: "1.0.0".to_owned(),
                ..Inventory::default()
            },
            resumed: Vec::new(),
            offered: Vec::new(),
            applied: 0,
            paused: false,
            speed_mm_s: 0,
            lists: Vec::new(),
            claims: Vec::new(),
            says_step: None,
            hides_opened: false,
            session_epoch: 0,
            hb: 0,
            boots: 0,
            produced: 0,
            outbox: Vec::new(),
            attempts: Vec::new(),
            finished: BTreeSet::new(),
            job: None,
            at: 0,
            step: 0,
            places: stands.map(inside).into_iter().collect(),
            progress: 0,
            progress_at: SiteTime(0),
            beaten: None,
            sent: SentHeartbeats::new(0, None),
        }
    }

    // --- what a test does to it

    /// Nothing goes up or down any more.
    pub fn cut(&mut self) {
        (self.talks, self.hears, self.tells) = (false, false, false);
    }
    /// The link is back; a new session is opened by [`super::World::connect`].
    pub fn mend(&mut self) {
        (self.talks, self.hears, self.tells) = (true, true, true);
    }
    /// Events by hand.
    pub fn says(&mut self, event: RobotEvent) {
        self.produced += 1;
        let sample = Sample { seq: self.produced, robot_unix_ms: 0, body: SampleBody::Event(event) };
        let entry = InboxEntry {
            robot_id: self.id.clone(),
            session_epoch: self.session_epoch,
            ring: "ring".to_owned(),
            lane: Lane::Event,
            what: InboxItem::Sample(sample),
            stamp_in_future: false,
        };
        self.outbox.push((self.produced, entry));
    }
    pub fn set_mode(&mut self, mode: Mode) {
        self.mode = mode;
        self.says(RobotEvent::Mode(mode));
    }
    pub fn set_hardware_stop(&mut self, stop: HardwareStop) {
        self.hardware_stop = stop;
        self.paused |= stop != HardwareStop::None;
        self.says(RobotEvent::HardwareStop(stop));
    }
    /// It hears of a fleet stop and stands.
    pub fn stands_for(&mut self, stop_id: &StopId) {
        self.stops.push(stop_id.clone());
        self.awaiting.push(stop_id.clone());
        self.paused = true;
    }
    /// It hears of the reset, and stays where it is.
    pub fn hears_of_the_reset(&mut self, stop_id: &StopId) {
        self.stops.retain(|id| id != stop_id);
    }
    /// A report about an attempt, whatever the robot itself believes.
    pub fn reports(&mut self, attempt: AttemptId, state: WorkState) {
        let report = AttemptReport {
            attempt,
            state,
            step_index: self.step,
            opened: false,
            refusal: None,
            fault: None,
            stats: WorkStats::default(),
        };
        self.says(RobotEvent::Attempt(report));
    }
    /// It restarted inside a step that must not be done twice.
    pub fn forgets_how_far_it_is(&mut self) {
        if let Some(job) = self.job.take() {
            self.tell(&job.attempt, WorkState::StepUnknown, None, None);
        }
    }
    /// Its next heartbeat says how far it is, and no event does.
    pub fn lists_alone(&mut self, attempt: &AttemptId, step_index: u32, opened: bool) {
        for listed in self.attempts.iter_mut().filter(|listed| listed.attempt == *attempt) {
            (listed.step_index, listed.opened) = (step_index, opened);
        }
    }
    /// It restarted and lost everything it knew of its work.
    pub fn forgets_its_work(&mut self) {
        self.job = None;
        self.attempts.clear();
    }
    /// It gives back a place that it has not entered.
    pub fn gives_back(&mut self, place: &str, grant_id: u64) {
        let place_id = PlaceId::parse(place).expect("a place");
        self.places.retain(|p| p.place_id != place_id);
        self.says(RobotEvent::Place { place_id, grant_id, news: PlaceNews::NotEntered });
    }
    pub fn is_idle(&self) -> bool {
        self.job.is_none()
    }
    pub fn session_epoch(&self) -> u64 {
        self.session_epoch
    }
    /// Places its contour reaches into.
    pub fn inside(&self) -> impl Iterator<Item = &str> {
        self.places.iter().filter(|p| p.inside).map(|p| p.place_id.as_str())
    }

    // --- what telemetry needs of it

    pub(super) fn new_session(&mut self, wall_ms: u64) {
        self.session_epoch = (self.session_epoch + 1).max(wall_ms);
        self.hb = 0;
        self.boots += 1;
        self.sent = SentHeartbeats::new(self.session_epoch, None);
    }
    pub(super) fn session(&self) -> Session {
        Session {
            secret: "secret".into(),
            boot_id: format!("boot-{}", self.boots),
            ring: "ring".to_owned(),
            applied_work: self.applied,
            places: self.places.clone(),
            ..Session::new(self.id.clone(), self.session_epoch, self.inventory.clone())
        }
    }
    pub(super) fn lane_mark(&self) -> LaneMark {
        LaneMark::fresh(self.id.clone(), "ring")
    }
    pub(super) fn undelivered(&mut self) -> Vec<(u64, InboxEntry)> {
        std::mem::take(&mut self.outbox)
    }
    pub(super) fn due(&self, now: &Now) -> bool {
        self.talks && self.beaten.is_none_or(|at| now.link.since(at).as_ms() >= 1_000)
    }
    pub(super) fn heartbeat(&mut self, now: &Now) -> NewestHeartbeat {
        self.hb += 1;
        self.beaten = Some(now.link);
        self.sent.sent(self.hb, now.link);
        let vitals = Vitals {
            pose: self.pose,
            waypoint: Some(self.here.clone()),
            battery_permille: self.battery_permille,
            speed_mm_s: self.speed_mm_s,
            ..Vitals::default()
        };
        let report = ReportedState {
            hb: self.hb,
            session_epoch: self.session_epoch,
            applied_work: self.applied,
            produced: [(Lane::Event, self.produced)].into(),
            mode: self.mode,
            vitals,
            load: self.load.clone(),
            attempts: self.listed(),
            places: [self.places.clone(), self.claims.clone()].concat(),
            hardware_stop: self.hardware_stop,
            stop_level: if self.awaiting.is_empty() { StopLevel::None } else { StopLevel::Halt },
            stops: self.stops.clone(),
            awaiting_resume: self.awaiting.clone(),
            fault: self.fault.clone(),
            ..ReportedState::default()
        };
        NewestHeartbeat {
            robot_id: self.id.clone(),
            report,
            processed_at: now.link,
            processed_site: now.site,
            received_unix_ms: now.wall.0,
            progress_at: self.progress_at,
            clock: None,
        }
    }

    fn listed(&self) -> Vec<ReportedAttempt> {
        let mut listed = [self.attempts.clone(), self.lists.clone()].concat();
        for attempt in &mut listed {
            attempt.step_index = self.says_step.unwrap_or(attempt.step_index);
            attempt.opened &= !self.hides_opened;
        }
        listed
    }

    // --- what it does by itself

    pub(super) fn step(&mut self, desired: Option<DesiredWork>, now: &Now) {
        let before = self.progress;
        if let Some(desired) = desired.filter(|d| self.hears && d.generation > self.applied) {
            self.apply(desired, now);
        }
        if !self.paused && self.mode == Mode::Automatic {
            self.act();
        }
        if self.progress != before {
            self.progress_at = now.site;
        }
    }

    fn apply(&mut self, desired: DesiredWork, now: &Now) {
        self.applied = desired.generation;
        self.awaiting.retain(|id| !desired.resumed.contains(id));
        if desired.load_word.is_some_and(|word| word.session_epoch == self.session_epoch) {
            assert!(self.inventory.load_by_memory, "whoever feels its load is not told");
            self.load = None;
        }
        self.obey_holds(&desired, now);
        self.take_grants(&desired, now);
        self.attempts.retain(|a| !desired.closed.contains(&a.attempt));
        let current = self.job.as_ref().map(|j| j.attempt.clone());
        match desired.assignment {
            Some(new) if current.as_ref() == Some(&new.attempt) => {
                if (new.stop || new.suspend) && self.confirms {
                    self.end(WorkState::Aborted, None);
                } else if let Some(job) = &mut self.job {
                    if new.route_number != job.route_number {
                        self.at = 0;
                    }
                    *job = new;
                }
            }
            Some(new) => {
                if current.is_some() && self.confirms {
                    self.end(WorkState::Aborted, None);
                }
                if self.job.is_none() && !new.stop && !self.finished.contains(&new.attempt) {
                    self.offer(new, now);
                }
            }
            None if current.is_some() && self.confirms => self.end(WorkState::Aborted, None),
            None => {}
        }
    }

    fn obey_holds(&mut self, desired: &DesiredWork, now: &Now) {
        if desired.held {
            self.paused = true;
        } else if let Some(resume) = desired.resume.filter(|r| self.paused && self.sent.check(r, now.link).is_ok()) {
            self.paused = false;
            self.resumed.push(resume);
        }
        if let Some(attempt) = self.job.as_ref().map(|j| j.attempt.clone())
            && let Some(listed) = self.attempts.iter_mut().find(|a| a.attempt == attempt)
        {
            listed.state = if self.paused { WorkState::Paused } else { WorkState::Navigating };
        }
    }

    fn take_grants(&mut self, desired: &DesiredWork, now: &Now) {
        let granted =
            |p: &HeldPlace| desired.grants.iter().any(|g| g.place_id == p.place_id && g.grant_id == p.grant_id);
        let gone: Vec<HeldPlace> = self.places.iter().filter(|p| !p.inside && !granted(p)).cloned().collect();
        for place in gone {
            self.places.retain(|p| *p != place);
            self.place(&place.place_id, place.grant_id, PlaceNews::NotEntered);
        }
        for grant in &desired.grants {
            let known = self.places.iter().any(|p| p.place_id == grant.place_id && p.grant_id == grant.grant_id);
            let current = grant.entry.is_some_and(|e| self.sent.check(&e, now.link).is_ok());
            if current && !known {
                let (place_id, grant_id) = (grant.place_id.clone(), grant.grant_id);
                self.places.push(HeldPlace { place_id, grant_id, inside: false });
            }
        }
    }

    fn offer(&mut self, new: Assignment, now: &Now) {
        if !self.offered.iter().any(|(id, _)| *id == new.attempt) {
            self.offered.push((new.attempt.clone(), new.offer));
        }
        let anchored = self.sent.check(&new.offer, now.link).is_ok();
        match self.answer {
            Answer::Accept | Answer::LetGo(_) if !anchored => self.refuse(&new.attempt, Code::StaleAuthority),
            Answer::Accept => self.accept(new),
            Answer::LetGo(state) => {
                let steps = new.steps.len() as u32;
                self.accept(new);
                if state == WorkState::Succeeded {
                    self.step = steps;
                }
                self.end(state, (state == WorkState::Failed).then(impossible));
            }
            Answer::CallOver => {
                self.finished.insert(new.attempt.clone());
                self.tell(&new.attempt, WorkState::Aborted, None, None);
            }
            Answer::Refuse(code) => self.refuse(&new.attempt, code),
            Answer::Ignore => {}
        }
    }

    fn accept(&mut self, new: Assignment) {
        self.at = 0;
        self.step = new.from_step;
        self.tell(&new.attempt, WorkState::Accepted, None, None);
        self.job = Some(new);
    }

    fn refuse(&mut self, attempt: &AttemptId, code: Code) {
        self.finished.insert(attempt.clone());
        self.tell(attempt, WorkState::Refused, Some(code.into()), None);
        self.attempts.retain(|a| a.attempt != *attempt);
    }

    fn end(&mut self, state: WorkState, fault: Option<Fault>) {
        let Some(job) = self.job.take() else { return };
        self.finished.insert(job.attempt.clone());
        self.tell(&job.attempt, state, None, fault);
    }

    /// Says where an attempt is and lists it so.
    fn tell(&mut self, attempt: &AttemptId, state: WorkState, refusal: Option<Reason>, fault: Option<Fault>) {
        self.progress += 1;
        let opened = self.load.is_some() || self.attempts.iter().any(|a| a.attempt == *attempt && a.opened);
        let opened = opened && !self.hides_opened;
        let listed = ReportedAttempt {
            attempt: attempt.clone(),
            state,
            step_index: self.step,
            progress: self.progress,
            route_index: self.at as u32,
            opened,
        };
        self.attempts.retain(|a| a.attempt != *attempt);
        self.attempts.push(listed);
        let stats = WorkStats { path_mm: 1_000, duration_ms: 1_000, energy_mwh: 1_000, ..WorkStats::default() };
        let report = AttemptReport {
            attempt: attempt.clone(),
            state,
            step_index: self.says_step.unwrap_or(self.step),
            opened,
            refusal,
            fault,
            stats,
        };
        self.says(RobotEvent::Attempt(report));
    }

    fn place(&mut self, place_id: &PlaceId, grant_id: u64, news: PlaceNews) {
        self.says(RobotEvent::Place { place_id: place_id.clone(), grant_id, news });
    }

    fn act(&mut self) {
        let Some(job) = self.job.clone() else { return };
        if let Some((_, fault)) = self.fails.take_if(|(step, _)| *step == self.step) {
            self.end(WorkState::Failed, Some(fault));
            return;
        }
        match job.steps.get(self.step as usize).map(|s| (&s.kind, s.effect)) {
            None => self.end(WorkState::Succeeded, None),
            Some((StepKind::Goto { .. }, _)) => self.drive(&job),
            Some((StepKind::Action { name, params }, effect)) if self.works => {
                match name.as_str() {
                    "pick" => {
                        let task_id = job.attempt.subject.task_id().cloned();
                        self.load = Some(Load { task_id, item: "box".to_owned() });
                    }
                    "place" => self.load = None,
                    "charge" => self.battery_permille = params["stop_permille"].as_u64().expect("permille") as u16,
                    _ => {}
                }
                if effect == Effect::AtMostOnce
                    && let Some(listed) = self.attempts.iter_mut().find(|a| a.attempt == job.attempt)
                {
                    listed.opened = true;
                }
                self.step += 1;
                self.tell(&job.attempt, WorkState::Executing, None, None);
            }
            Some((StepKind::Wait { .. }, _)) => {
                self.step += 1;
                self.tell(&job.attempt, WorkState::Executing, None, None);
            }
            Some(_) => {}
        }
    }

    fn drive(&mut self, job: &Assignment) {
        if job.route[self.at].ends_step == Some(self.step) {
            self.step = if self.step == job.from_step { job.resume_step.max(self.step + 1) } else { self.step + 1 };
            self.tell(&job.attempt, WorkState::Navigating, None, None);
            return;
        }
        let next = self.at + 1;
        if !self.drives || job.released_index.is_none_or(|r| (next as u32) > r) {
            return;
        }
        let point = &job.route[next];
        let needed: Vec<PlaceId> = point.passages.iter().chain(&point.standing).cloned().collect();
        if needed.iter().any(|n| !self.places.iter().any(|p| p.place_id == *n)) {
            return;
        }
        self.move_to(point, &needed);
        if next + 1 == job.route.len()
            && let Some(seat) = &point.standing
        {
            // At its goal it is out of the passages that led there.
            self.move_to(point, std::slice::from_ref(seat));
        }
        self.at = next;
        self.progress += 1;
        if let Some(listed) = self.attempts.iter_mut().find(|a| a.attempt == job.attempt) {
            listed.route_index = next as u32;
        }
    }

    fn move_to(&mut self, point: &RoutePoint, needed: &[PlaceId]) {
        let left: Vec<HeldPlace> =
            self.places.iter().filter(|p| p.inside && !needed.contains(&p.place_id)).cloned().collect();
        for place in needed {
            let Some(held) = self.places.iter_mut().find(|p| p.place_id == *place && !p.inside) else { continue };
            held.inside = true;
            let grant_id = held.grant_id;
            self.place(place, grant_id, PlaceNews::Entered);
        }
        for place in left {
            self.places.retain(|p| *p != place);
            self.place(&place.place_id, place.grant_id, PlaceNews::Left);
        }
        self.here = point.waypoint.clone();
    }
}
