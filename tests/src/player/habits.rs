//! How each habit changes what it says.

use super::Player;
use super::habit::Habit;
use super::work::report_of;
use midshift_core::ids::{AttemptId, BundleId, StopId, Subject};
use midshift_core::limits;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{
    Fault, FaultClass, HardwareStop, HeldPlace, Lane, Load, Mode, Pose, ReportedAttempt, ReportedState, StopLevel,
    WorkState,
};
use midshift_core::robot_events::{AttemptReport, PlaceNews, RobotEvent, SampleBody, UNREADABLE_WORK, WorkStats};
use midshift_core::update::{UpdateEvent, UpdateReport, UpdateState};
use rand::RngExt;
use rand::seq::{IndexedRandom, IteratorRandom};

/// Bytes of a text that is as long as makes sense for nobody: four of them fit a message.
const TEXT_BYTES: usize = 8_000;
/// Samples of STATUS at once.
const FLOOD: usize = 32;
/// A number that is far from what others say, and believed by the wire.
const FAR: [u64; 5] = [0, 1, 1 << 20, limits::COUNTED_MAX - 1, limits::COUNTED_MAX];

impl Player {
    /// Changes what it is about to say, and says more, as this habit has it.
    pub(super) fn misbehave(&mut self, habit: Habit, now_ms: u64, report: &mut ReportedState) {
        let chance = match habit {
            // These show when they are asked for something.
            Habit::NeverAnswers | Habit::AnswersLate | Habit::Refuses | Habit::NeverMovesOn | Habit::NeverEnds => {
                return;
            }
            Habit::LetsGo | Habit::CallsImpossible | Habit::NeverGoes => return,
            Habit::WrongClocks | Habit::LosesNumbers => return,
            Habit::FallsSilent | Habit::Restarts | Habit::StartsTwice => 0.05,
            Habit::EndlessLists | Habit::ClaimsUpdates | Habit::EndlessTexts | Habit::FloodsStatus => 0.1,
            _ => 0.3,
        };
        if !self.shows(habit, chance) {
            return;
        }
        match habit {
            Habit::RepeatsItself => self.repeat(),
            Habit::Contradicts => self.contradict(),
            Habit::EndlessLists => self.list_endlessly(report),
            Habit::WrongSteps => self.miscount(report),
            Habit::WrongPlaces => self.misplace(report),
            Habit::WrongLoads => self.mislay(report),
            Habit::ForeignAttempts => self.claim(report),
            Habit::FallsSilent => self.quiet_until = now_ms + self.rng.random_range(1_500..45_000),
            Habit::StartsTwice => self.second = true,
            Habit::Restarts => self.drops = true,
            Habit::WrongGenerations => {
                let far = |player: &mut Self| FAR.choose(&mut player.rng).copied().unwrap_or(0);
                // A day beyond what it was given: as if the server had been restored from a backup.
                let ahead = self.applied + 86_400_000;
                let is_ahead = self.rng.random_bool(0.5);
                report.applied_work = if is_ahead { ahead } else { far(self) };
                (report.applied_policy, report.applied_update) = (far(self), far(self));
                if self.rng.random_bool(0.5) {
                    report.produced.insert(Lane::Event, far(self));
                }
            }
            Habit::Flickers => self.flicker(report),
            Habit::Wanders => self.wander(report),
            Habit::Forgets => report.attempts.clear(),
            Habit::ClaimsUpdates => self.claim_update(report),
            Habit::EndlessTexts => self.talk_endlessly(report),
            Habit::FloodsStatus => self.flood(report),
            _ => {}
        }
    }

    fn repeat(&mut self) {
        let said: Vec<RobotEvent> = self
            .kept
            .iter()
            .rev()
            .take(8)
            .filter_map(|(_, sample)| match &sample.body {
                midshift_core::robot_events::SampleBody::Event(event) => Some(event.clone()),
                midshift_core::robot_events::SampleBody::Status(_) => None,
            })
            .collect();
        said.into_iter().for_each(|event| self.event(event));
        if let Some(report) = self.listed().map(|l| report_of(&l.attempt, l.state, l.step_index, l.opened)) {
            self.event(RobotEvent::Attempt(report.clone()));
            self.event(RobotEvent::Attempt(report));
        }
    }

    fn some_state(&mut self) -> WorkState {
        use WorkState::{
            Aborted, Accepted, Executing, Failed, Navigating, Paused, Refused, StepUnknown, Stopping, Succeeded,
            Suspended,
        };
        let all = [
            Aborted,
            Accepted,
            Executing,
            Failed,
            Navigating,
            Paused,
            Refused,
            StepUnknown,
            Stopping,
            Succeeded,
            Suspended,
        ];
        all.choose(&mut self.rng).copied().unwrap_or(Executing)
    }
    fn some_fault(&mut self) -> Fault {
        let class = [FaultClass::Recoverable, FaultClass::Mechanical, FaultClass::Stop, FaultClass::Semantic];
        let class = class.choose(&mut self.rng).copied().unwrap_or(FaultClass::Stop);
        Fault { code: self.rng.random_range(1..=u32::MAX), class, message: "says so".to_owned() }
    }
    fn some_report(&mut self, attempt: &AttemptId) -> AttemptReport {
        let state = self.some_state();
        let step = [0, 1, 2, 3, 4, 5, 63, 64, u32::MAX].choose(&mut self.rng).copied().unwrap_or(0);
        let refusal = (state == WorkState::Refused).then(|| Code::UnsupportedAction.into());
        let fault = (state == WorkState::Failed).then(|| self.some_fault());
        let stats = WorkStats { path_mm: u64::MAX, energy_mwh: 1, ..WorkStats::default() };
        let stats = if self.rng.random_bool(0.1) { stats } else { WorkStats::default() };
        AttemptReport { refusal, fault, stats, ..report_of(attempt, state, step, self.rng.random_bool(0.5)) }
    }
    /// The attempt at hand, or the newest that it lists.
    fn own(&mut self) -> Option<AttemptId> {
        let at_hand = self.listed().map(|listed| listed.attempt.clone());
        let wanted = self.work.as_ref().and_then(|work| work.assignment.as_ref()).map(|a| a.attempt.clone());
        at_hand.or(wanted).or_else(|| self.state.attempts.last().map(|listed| listed.attempt.clone()))
    }
    fn contradict(&mut self) {
        let Some(attempt) = self.own() else { return };
        for _ in 0..self.rng.random_range(1..4) {
            let report = self.some_report(&attempt);
            self.event(RobotEvent::Attempt(report));
        }
    }

    /// An attempt that it never had: of another's task, of another robot's errand, of an epoch that there is not.
    fn foreign(&mut self) -> AttemptId {
        let errand = self.rng.random_bool(0.2);
        let robot_id = self.around.robots.choose(&mut self.rng).cloned().unwrap_or_else(|| self.robot_id.clone());
        let task = self.around.tasks.choose(&mut self.rng).cloned();
        let epoch = [1, 1, 1, 2, 3, limits::COUNTED_MAX].choose(&mut self.rng).copied().unwrap_or(1);
        match task.filter(|_| !errand) {
            Some(task_id) => AttemptId { subject: Subject::Task(task_id), epoch },
            None => AttemptId { subject: Subject::Errand { robot_id, number: self.rng.random_range(1..5) }, epoch: 1 },
        }
    }
    fn claimed(&mut self) -> ReportedAttempt {
        let (attempt, state) = (self.foreign(), self.some_state());
        let step_index = self.rng.random_range(0..6);
        ReportedAttempt { attempt, state, step_index, progress: 1, route_index: 0, opened: self.rng.random_bool(0.3) }
    }
    fn claim(&mut self, report: &mut ReportedState) {
        let claimed = self.claimed();
        if self.rng.random_bool(0.5) {
            let said = report_of(&claimed.attempt, claimed.state, claimed.step_index, claimed.opened);
            self.event(RobotEvent::Attempt(said));
        }
        if self.rng.random_bool(0.2) {
            // For good: the server is to find it in every heartbeat.
            self.state.attempts.retain(|listed| listed.attempt != claimed.attempt);
            self.state.attempts.push(claimed.clone());
            self.state.attempts.truncate(64);
        }
        report.attempts.push(claimed);
    }

    fn list_endlessly(&mut self, report: &mut ReportedState) {
        let stop = |n: usize| StopId::parse(&format!("STOP-20260101-{n:010}")).ok();
        let stops: Vec<StopId> = (0..256).filter_map(stop).collect();
        match self.rng.random_range(0..5) {
            0 => report.attempts.extend((0..200).map(|_| self.claimed())),
            1 => {
                let many = [256, 257, 2_000, 19_000].choose(&mut self.rng).copied().unwrap_or(256);
                let subject = |n: u64| Subject::Errand { robot_id: self.robot_id.clone(), number: n };
                let attempt = |n| AttemptId { subject: subject(n), epoch: 1 };
                report.attempts.extend((0..many).map(|n| ReportedAttempt {
                    attempt: attempt(n),
                    state: WorkState::Aborted,
                    step_index: 0,
                    progress: 0,
                    route_index: 0,
                    opened: false,
                }));
            }
            2 => {
                let all = self.around.places.clone();
                let held = |place_id| HeldPlace { place_id, grant_id: 0, inside: true };
                report.places = all.into_iter().map(held).collect();
            }
            3 => (report.stops, report.awaiting_resume) = (stops.clone(), stops),
            _ => {
                let level = StopLevel::Halt;
                self.event(RobotEvent::FleetStop { level, stops: stops.clone(), awaiting_resume: stops });
                (0..128).for_each(|_| self.event(RobotEvent::Mode(Mode::Automatic)));
            }
        }
    }

    fn miscount(&mut self, report: &mut ReportedState) {
        let Some(attempt) = self.own() else { return };
        let steps = self.job.as_ref().map_or(4, |job| job.assignment.steps.len() as u32);
        let step = [0, steps, steps + 1, 64, u32::MAX].choose(&mut self.rng).copied().unwrap_or(0);
        let state = [WorkState::Executing, WorkState::Succeeded, WorkState::Aborted, WorkState::Suspended];
        let state = state.choose(&mut self.rng).copied().unwrap_or(WorkState::Executing);
        if self.rng.random_bool(0.5) {
            self.event(RobotEvent::Attempt(report_of(&attempt, state, step, false)));
        } else if let Some(listed) = report.attempts.iter_mut().find(|listed| listed.attempt == attempt) {
            (listed.step_index, listed.opened) = (step, false);
        }
    }

    fn misplace(&mut self, report: &mut ReportedState) {
        let grant_id = [0, 0, 7, u64::MAX].choose(&mut self.rng).copied().unwrap_or(0);
        match self.rng.random_range(0..4) {
            0 => {
                let many = [1, 2, 8, 9, usize::MAX].choose(&mut self.rng).copied().unwrap_or(1);
                let some = self.around.places.clone().into_iter().sample(&mut self.rng, many.min(64));
                let held = |place_id| HeldPlace { place_id, grant_id, inside: true };
                report.places = some.into_iter().map(held).collect();
            }
            1 => report.places.clear(),
            _ => {
                let news = [PlaceNews::Entered, PlaceNews::Left, PlaceNews::NotEntered];
                let news = news.choose(&mut self.rng).copied().unwrap_or(PlaceNews::Left);
                if let Some(place_id) = self.some_place() {
                    self.place(&place_id, grant_id, news);
                }
            }
        }
    }

    fn mislay(&mut self, report: &mut ReportedState) {
        let task_id = self.around.tasks.choose(&mut self.rng).cloned().filter(|_| self.rng.random_bool(0.7));
        let load = self.rng.random_bool(0.7).then(|| Load { task_id, item: "something".to_owned() });
        if self.rng.random_bool(0.5) {
            self.event(RobotEvent::Load(load.clone()));
        }
        if self.rng.random_bool(0.3) {
            self.state.load = load.clone();
        }
        report.load = load;
    }

    fn flicker(&mut self, report: &mut ReportedState) {
        let mode = [Mode::Automatic, Mode::Manual, Mode::Service].choose(&mut self.rng).copied().unwrap_or_default();
        let stop = [HardwareStop::None, HardwareStop::Manual, HardwareStop::AutoAck, HardwareStop::Remote];
        let stop = stop.choose(&mut self.rng).copied().unwrap_or_default();
        let fault = self.some_fault();
        match self.rng.random_range(0..5) {
            0 => {
                self.event(RobotEvent::Mode(mode));
                report.mode = mode;
            }
            1 => {
                self.alarm(RobotEvent::HardwareStop(stop));
                report.hardware_stop = stop;
            }
            2 => {
                self.alarm(RobotEvent::Fault { fault: fault.clone(), cleared: false });
                report.fault = Some(fault);
            }
            3 => (report.stop_level, report.field_violation) = (StopLevel::ControlledStopPosture, true),
            _ => self.alarm(RobotEvent::BatteryCritical { battery_permille: 0 }),
        }
    }

    fn wander(&mut self, report: &mut ReportedState) {
        let vitals = &mut report.vitals;
        vitals.waypoint = self.around.waypoints.choose(&mut self.rng).cloned().filter(|_| self.rng.random_bool(0.8));
        vitals.battery_permille = self.rng.random_range(0..=1_000);
        vitals.charging = self.rng.random_bool(0.5);
        vitals.speed_mm_s = [0, 1_000, u32::MAX].choose(&mut self.rng).copied().unwrap_or(0);
        vitals.odometer_mm = [0, 1, u64::MAX].choose(&mut self.rng).copied().unwrap_or(0);
        let far = [0, i32::MIN, i32::MAX].choose(&mut self.rng).copied().unwrap_or(0);
        vitals.pose = self.rng.random_bool(0.5).then_some(Pose { x_mm: far, y_mm: far, theta_mrad: far });
    }

    fn talk_endlessly(&mut self, report: &mut ReportedState) {
        let text = "and so on ".repeat(TEXT_BYTES / 10);
        match self.rng.random_range(0..4) {
            0 => report.load = Some(Load { task_id: None, item: text }),
            1 => report.fault = Some(Fault { message: text, ..self.some_fault() }),
            2 => {
                let what = ["offer", UNREADABLE_WORK].choose(&mut self.rng).copied().unwrap_or_default().to_owned();
                self.event(RobotEvent::StaleAuthority { what, detail: text });
            }
            _ => {
                let Some(attempt) = self.own() else { return };
                let why = Reason::new(Code::UnsupportedAction, text.clone()).with("said", text);
                let refused = report_of(&attempt, WorkState::Refused, 0, false);
                self.event(RobotEvent::Attempt(AttemptReport { refusal: Some(why), ..refused }));
            }
        }
    }

    fn flood(&mut self, report: &mut ReportedState) {
        for _ in 0..FLOOD {
            let mut said = report.clone();
            self.wander(&mut said);
            self.produce(Lane::Status, SampleBody::Status(said.vitals));
        }
    }

    fn claim_update(&mut self, report: &mut ReportedState) {
        let state = UpdateState::ALL.choose(&mut self.rng).copied().unwrap_or(UpdateState::Stuck);
        let Ok(bundle) = BundleId::parse(&"0a".repeat(32)) else { return };
        let update = UpdateReport {
            state,
            bundle,
            directive_generation: self.rng.random_range(0..3),
            set: None,
            drain_id: None,
            grant_id: 0,
            tries: 0,
            progress_permille: 0,
            reason: None,
        };
        self.event(RobotEvent::Update(UpdateEvent::Changed(update.clone())));
        report.update = Some(update);
    }
}
