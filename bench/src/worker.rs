//! Robots that do in no time what they are given: they are at each goal once they may be, and do what is to be done there.
//!
//! Each says what a robot of somebody else's would: that it took the work, then at each goal which places it left and entered and how far it
//! is, once a second a heartbeat with a STATUS sample, and one as soon as it is free. Called by `task`.

use crate::robot::{self, RobotReceiver, RobotSender};
use midshift_core::desired_state::{Assignment, DesiredWork, GrantedPlace};
use midshift_core::ids::WaypointId;
use midshift_core::limits;
use midshift_core::robot::{HeldPlace, ReportedAttempt, WorkState};
use midshift_core::robot_events::{AttemptReport, PlaceNews, RobotEvent, WorkStats};
use midshift_core::site::Site;
use midshift_core::step::StepKind;
use midshift_sim::fleet::FleetConfig;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

/// So many robots of a site, each at a standing place of its own, until `stop`.
pub async fn run(server: String, site: Site, robots: usize, stop: CancellationToken) -> anyhow::Result<()> {
    let parks = FleetConfig::new(Arc::new(site), robots, 1).starting_waypoints()?;
    let mut workers = JoinSet::new();
    for (number, here) in parks.into_iter().enumerate() {
        let server = server.clone();
        workers.spawn(async move { Worker::attach(&server, &format!("rbt-{number:02}"), here).await?.work().await });
    }
    tokio::select! {
        ended = workers.join_next() => ended.map_or(Ok(()), |ended| ended?),
        () = stop.cancelled() => Ok(()),
    }
}

struct Worker {
    sender: RobotSender,
    receiver: RobotReceiver,
    /// Route it is on, and how many of its points are behind it.
    route: (u32, usize),
}

impl Worker {
    async fn attach(server: &str, name: &str, here: WaypointId) -> anyhow::Result<Self> {
        let (sender, receiver, _) = robot::attach(server, name, Some(here)).await?;
        Ok(Self { sender, receiver, route: (0, 0) })
    }

    async fn work(mut self) -> anyhow::Result<()> {
        let mut beat = interval(Duration::from_millis(limits::HEARTBEAT.as_ms()));
        beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                down = self.receiver.receive() => if let Some(work) = down?.work {
                    self.obey(&work).await?;
                },
                _ = beat.tick() => self.sender.beat(true).await?,
            }
        }
    }

    async fn obey(&mut self, work: &DesiredWork) -> anyhow::Result<()> {
        self.sender.reported.applied_work = work.generation;
        if self.sender.reported.places.is_empty() {
            let here = work.grants.iter().filter(|grant| grant.entry.is_none());
            self.sender.reported.places = here.map(held).collect();
        }
        let Some(assignment) = &work.assignment else {
            let was_busy = !std::mem::take(&mut self.sender.reported.attempts).is_empty();
            return if was_busy { self.sender.beat(false).await } else { Ok(()) };
        };
        let mut events = Vec::new();
        if self.sender.reported.attempts.iter().all(|known| known.attempt != assignment.attempt) {
            self.route = (assignment.route_number, 0);
            self.sender.reported.attempts = vec![ReportedAttempt {
                attempt: assignment.attempt.clone(),
                state: WorkState::Accepted,
                step_index: assignment.from_step,
                progress: 0,
                route_index: 0,
                opened: false,
            }];
            events.push(self.report());
        }
        let before = self.sender.reported.attempts[0].clone();
        self.go(assignment, &work.grants, &mut events);
        self.act(assignment);
        if self.sender.reported.attempts[0].step_index > before.step_index {
            events.push(self.report());
        }
        if !events.is_empty() {
            self.sender.send_events(events).await?;
        }
        Ok(())
    }

    /// To the last point that it may go to.
    fn go(&mut self, assignment: &Assignment, grants: &[GrantedPlace], events: &mut Vec<RobotEvent>) {
        if self.route.0 != assignment.route_number {
            self.route = (assignment.route_number, 0);
        }
        let free = assignment.released_index.map_or(0, |last| last as usize + 1);
        for point in assignment.route.iter().take(free).skip(self.route.1) {
            let reported = &mut self.sender.reported;
            reported.vitals.waypoint = Some(point.waypoint.clone());
            reported.vitals.odometer_mm += 1_000;
            let entered = point.passages.iter().chain(&point.standing);
            let entered: Vec<_> =
                entered.filter(|place| reported.places.iter().all(|h| h.place_id != **place)).collect();
            if !entered.is_empty() {
                for left in reported.places.drain(..) {
                    events.push(news(&left, PlaceNews::Left));
                }
            }
            for place in entered {
                let held = grants.iter().find(|grant| grant.place_id == *place).map(held);
                events.extend(held.iter().map(|held| news(held, PlaceNews::Entered)));
                reported.places.extend(held);
            }
            let attempt = &mut reported.attempts[0];
            attempt.progress += 1;
            attempt.state = WorkState::Navigating;
            if let Some(step) = point.ends_step {
                attempt.step_index = attempt.step_index.max(step + 1);
            }
        }
        self.route.1 = self.route.1.max(free.min(assignment.route.len()));
    }

    /// What is to be done where it is.
    fn act(&mut self, assignment: &Assignment) {
        let attempt = &mut self.sender.reported.attempts[0];
        let here = assignment.steps.iter().skip(attempt.step_index as usize);
        let done = here.take_while(|step| !matches!(step.kind, StepKind::Goto { .. })).count() as u32;
        if done > 0 {
            attempt.step_index += done;
            attempt.progress += 1;
            attempt.opened = true;
        }
        if attempt.step_index as usize == assignment.steps.len() {
            attempt.state = WorkState::Succeeded;
        }
    }

    /// Of its only attempt, as it stands.
    fn report(&self) -> RobotEvent {
        let ReportedAttempt { attempt, state, step_index, opened, .. } = self.sender.reported.attempts[0].clone();
        let (refusal, fault, stats) = (None, None, WorkStats::default());
        RobotEvent::Attempt(AttemptReport { attempt, state, step_index, opened, refusal, fault, stats })
    }
}

/// A place that it is in.
fn held(grant: &GrantedPlace) -> HeldPlace {
    HeldPlace { place_id: grant.place_id.clone(), grant_id: grant.grant_id, inside: true }
}

fn news(held: &HeldPlace, news: PlaceNews) -> RobotEvent {
    RobotEvent::Place { place_id: held.place_id.clone(), grant_id: held.grant_id, news }
}
