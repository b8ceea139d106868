//! One step of the core: takes one input at one moment, drives the body, and says what to keep and what to send.
//!
//! Invariant: no clock, no randomness, no waiting. Nothing that depends on a write leaves before [`Input::Persisted`]
//! said that the write is durable: no message of it, no movement on it. What each input means is decided in the rooms
//! beside this file.

use super::interface::{ExitReason, Input, Output, Wake};
use super::lanes::STATUS_SAMPLE_BYTES;
use super::state::{AgentCore, Session};
use super::work::Work;
use crate::stop::StopNews;
use crate::storage::{Applied, Op, SessionMemory};
use crate::transport::replay::{Pace, Replayed};
use midshift_core::authority::SentHeartbeats;
use midshift_core::desired_state::DesiredPolicy;
use midshift_core::ids::PlaceId;
use midshift_core::limits;
use midshift_core::robot::{Fault, FaultClass, Lane, ReportedState, StopLevel, Vitals};
use midshift_core::robot_events::{RobotEvent, SampleBody};
use midshift_core::time::{LinkDuration, Now, SiteDuration, Utc};
use midshift_proto::session::{ClockSample, Downlink, Heartbeat, LaneAck, LaneBatch, StatusReplay, Uplink, Welcome};

/// Above the critical threshold by this much the battery may become critical again, permille.
const BATTERY_HYSTERESIS: u16 = 20;

impl AgentCore {
    /// Takes one input at one moment and says what to do about it.
    pub fn step(&mut self, now: Now, input: Input) -> Vec<Output> {
        let mut out = Vec::new();
        (self.wake_link, self.wake_site) = (None, None);
        if let Input::Persisted(batch) = input {
            self.persisted(batch);
        }
        self.elapse(&now);
        self.take_news(&now);
        let yields = self.config.bugs.stop_yields_to_disk() && self.writes.in_flight.is_some();
        match &input {
            Input::Stop(news) if !yields => self.apply_stop_news(&now, StopNews::clone(news)),
            Input::Down(down) => self.apply_stops_of_link(&now, down),
            _ => {}
        }
        self.obey(&now);
        match input {
            Input::Start => self.start(&now),
            Input::Tick | Input::Persisted(_) | Input::Stop(_) => {}
            Input::Connected(welcome) => self.connected(&now, welcome),
            Input::Down(down) => {
                // What the body has just ended is over before the server's word about it is heard.
                self.advance(&now);
                self.down(&now, *down);
            }
            Input::Disconnected => self.session = None,
            Input::Done(done) => self.job_done(&now, *done),
            Input::Replayed(session_epoch, replayed) => self.replayed(&now, session_epoch, replayed),
            Input::Fenced => {
                self.fences += 1;
                self.session = None;
                if self.fences >= 2 {
                    out.push(Output::Exit(ExitReason::FencedTwice));
                }
            }
        }
        self.obey(&now);
        self.advance(&now);
        self.say_stop(&now, &mut out);
        out.extend(self.pursue_update(&now).map(Output::Exit));
        let beat = self.beat(&now);
        self.write_events(&now);
        self.persist(&now, beat, &mut out);
        self.start_job(&mut out);
        self.send(&now, beat, &mut out);
        out
    }

    /// When to call again.
    pub fn next_wake(&self, now: &Now) -> Wake {
        let replay = self.pace.next_at(now.link).filter(|_| self.session.is_some() && self.sender.replays_apart());
        let (stop_link, stop_site) = self.stop_wakes();
        let link = [Some(self.next_beat), self.wake_link, self.throttle.next_at(), replay, stop_link];
        let body = self.body.next_change(now.site);
        let site = [Some(self.next_status), body, self.times_out_at(now), self.wake_site, stop_site];
        Wake {
            link: link.into_iter().flatten().min().unwrap_or(self.next_beat),
            site: site.into_iter().flatten().min(),
        }
    }

    /// What the robot believes of itself now, as Hello and heartbeat say it.
    pub fn reported(&self, now: &Now) -> ReportedState {
        let session = self.session.as_ref();
        ReportedState {
            hb: session.map_or(0, |s| s.hb),
            session_epoch: session.map_or(0, |s| s.epoch),
            applied_work: self.memory.ledger.applied.work,
            applied_policy: self.memory.ledger.applied.policy,
            applied_update: self.memory.ledger.applied.update,
            produced: Lane::ALL.into_iter().map(|lane| (lane, self.memory.ring.lane(lane).produced)).collect(),
            mode: self.mode,
            vitals: self.vitals(now),
            load: self.body.load(),
            attempts: self.reported_attempts(now),
            places: self.places.held(),
            stop_level: self.stop_level(),
            stops: self.stops_inside(),
            awaiting_resume: self.stops_awaiting(),
            map_version: self.body.map_version(),
            free_bytes: self.holdings().map(|holdings| holdings.free_bytes),
            hardware_stop: self.hardware_stop,
            field_violation: self.body.state(now.site).field_violation,
            fault: self.unfit.as_ref().or(self.standing_fault.as_ref()).cloned(),
            update: self.update_report().filter(|u| session.is_none() || !u.state.is_over()),
        }
    }

    /// The process ends: nobody drives the body any more, so it stands.
    pub fn halt(&mut self, now: Now) {
        if self.work.is_some() || !self.body.standstill(now.site) {
            self.body.stop(now.site, StopLevel::Halt);
        }
    }

    fn vitals(&self, now: &Now) -> Vitals {
        let state = self.body.state(now.site);
        Vitals {
            pose: Some(state.pose),
            waypoint: state.waypoint,
            speed_mm_s: state.speed_mm_s,
            battery_permille: state.battery_permille,
            charging: state.charging,
            hottest_joint_decidegrees: state.hottest_joint_decidegrees,
            odometer_mm: state.odometer_mm,
            loaded_odometer_mm: state.loaded_odometer_mm,
            energy_mwh: state.energy_mwh,
        }
    }

    fn start(&mut self, now: &Now) {
        if !self.body.standstill(now.site) {
            self.body.stop(now.site, StopLevel::Halt);
        }
        if let Err(fault) = self.body.self_test(now.site) {
            self.failed_test(fault);
        }
        self.note_where_it_stands();
        self.write_places();
        self.judge_intent();
    }

    /// Standing places are called like their waypoints.
    pub(crate) fn note_where_it_stands(&mut self) {
        for waypoint in self.body.stands_on() {
            if let Ok(place_id) = PlaceId::parse(waypoint.as_str()) {
                let event = self.places.stands_on(place_id);
                event.into_iter().for_each(|e| self.emit(Lane::Event, e));
            }
        }
    }

    fn connected(&mut self, now: &Now, welcome: Welcome) {
        self.sent = SentHeartbeats::new(welcome.session_epoch, self.sent.lease_from());
        self.session = Some(Session {
            epoch: welcome.session_epoch,
            hb: 0,
            observed: welcome.observed,
            told_map: String::new(),
            told_room: None,
        });
        self.listed_load.clear();
        let old = &self.memory.ledger.session;
        if old.store_id != welcome.store_id {
            self.answered.clear();
            if !old.store_id.is_empty() {
                self.write(Op::Applied(Applied::default()), true);
            }
        }
        let memory = SessionMemory {
            session_epoch: welcome.session_epoch,
            secret: welcome.session_secret,
            store_id: welcome.store_id,
        };
        self.write(Op::Session(memory), true);
        for ack in &welcome.acks {
            for op in self.memory.ring.jump(ack.lane, ack.seq) {
                tracing::error!(lane = ack.lane.as_str(), watermark = ack.seq, "ring behind server, numbers moved on");
                self.write(op, true);
            }
        }
        welcome.acks.iter().for_each(|ack| self.acked(ack));
        self.sender.connected(&self.memory.ring, welcome.status_credit_bytes as usize);
        self.pace = Pace::default();
        if welcome.observed {
            // Nothing of it is stored, whichever way it goes.
            self.sender.replay_on_link();
        }
        welcome.acks.iter().for_each(|ack| self.expected(ack));
        self.period = LinkDuration(u64::from(welcome.heartbeat_period_ms).clamp(100, limits::AUTHORITY.as_ms() / 3));
        // The server may give less; more than both ends were built for it cannot give.
        self.authority = LinkDuration(u64::from(welcome.authority_ms).min(limits::AUTHORITY.as_ms()));
        self.status_period = SiteDuration(u64::from(welcome.status_period_ms).max(100));
        self.next_beat = now.link;
        self.clock = None;
    }

    fn down(&mut self, now: &Now, down: Downlink) {
        let observed = self.is_observed();
        if let Some(echo) = down.echo {
            if !observed {
                self.sent.echoed(echo.hb);
                self.update.server_reached = Some(now.link);
            }
            self.clock = Some(ClockSample { t4_us: now.wall.0 * 1000, ..echo.clock });
            if !echo.is_clock_doubted {
                self.told_the_time(Utc(echo.clock.t3_us / 1000));
            }
        }
        for ack in &down.acks {
            self.acked(ack);
            self.expected(ack);
        }
        if let Some(bytes) = down.status_credit_bytes {
            self.sender.credit(bytes as usize);
        }
        if let Some(policy) = down.policy {
            self.on_policy(policy);
        }
        if let Some(update) = down.update {
            self.on_update(update);
        }
        if let Some(why) = down.unreadable_work {
            self.cannot_read_work(&why);
        }
        if let Some(work) = down.work {
            self.on_work(now, work);
        }
    }

    fn on_policy(&mut self, policy: DesiredPolicy) {
        let mut applied = self.memory.ledger.applied;
        if policy.generation < applied.policy {
            tracing::warn!(generation = policy.generation, applied = applied.policy, "older policy refused");
            return;
        }
        if policy.areas != self.memory.ledger.policy {
            self.write(Op::Policy(policy.areas), true);
        }
        applied.policy = policy.generation;
        self.write(Op::Applied(applied), false);
    }

    fn acked(&mut self, ack: &LaneAck) {
        if let Some(op) = self.memory.ring.ack(ack.lane, ack.seq) {
            self.write(op, false);
        }
    }

    fn expected(&mut self, ack: &LaneAck) {
        let Some(expect) = ack.expect else { return };
        if let Some(op) = self.memory.ring.expected(ack.lane, expect) {
            self.write(op, true);
        }
        self.sender.rewind(ack.lane, expect);
    }

    /// No work is accepted until the body says that this fault is over, or a later process begins with a test that
    /// passes. It is told as one that a person must look at: nobody may wait for it to pass by itself.
    fn failed_test(&mut self, fault: Fault) {
        tracing::error!(robot_id = %self.config.robot_id, code = fault.code, "the body failed its test");
        let class = if fault.class == FaultClass::Recoverable { FaultClass::Mechanical } else { fault.class };
        let fault = Fault { class, ..fault };
        self.unfit = Some(fault.clone());
        self.fault_changed(fault, true);
    }

    /// What falls due by time alone. True: a heartbeat is due.
    fn beat(&mut self, now: &Now) -> bool {
        let beat = now.link >= self.next_beat;
        let early = if beat { SiteDuration(self.status_period.as_ms() / 4) } else { SiteDuration(0) };
        if now.site + early >= self.next_status {
            self.next_status = now.site + self.status_period;
            let vitals = self.vitals(now);
            self.check_battery(vitals.battery_permille);
            for op in self.memory.ring.append(Lane::Status, now.wall.0, SampleBody::Status(vitals)) {
                self.write(op, false);
            }
        }
        if beat {
            self.beat_floor = now.link + LinkDuration(self.period.as_ms() / 4);
            self.next_beat = (self.next_beat + self.period).max(now.link + LinkDuration(self.period.as_ms() / 2));
            self.note_progress(now);
        }
        beat
    }

    fn note_progress(&mut self, now: &Now) {
        let odometer_mm = self.body.state(now.site).odometer_mm;
        if odometer_mm != self.odometer_mm || self.work.as_ref().is_some_and(Work::goes_on_by_itself) {
            self.progress += 1;
        }
        self.odometer_mm = odometer_mm;
    }

    fn check_battery(&mut self, battery_permille: u16) {
        let critical = self.limits.battery_critical_permille;
        if battery_permille < critical && !self.battery_critical {
            self.battery_critical = true;
            self.emit(Lane::Critical, RobotEvent::BatteryCritical { battery_permille });
        } else if battery_permille >= critical + BATTERY_HYSTERESIS {
            self.battery_critical = false;
        }
    }

    fn write_events(&mut self, now: &Now) {
        self.write_places();
        while let Some((lane, event)) = self.throttle.ready(now.link) {
            for op in self.memory.ring.append(lane, now.wall.0, SampleBody::Event(event)) {
                self.write(op, true);
            }
        }
    }

    fn persist(&mut self, now: &Now, beat: bool, out: &mut Vec<Output>) {
        let due = self.writes.urgent || beat || self.writes.ops.len() >= limits::SAMPLES_PER_MESSAGE;
        if self.writes.in_flight.is_some() || self.writes.ops.is_empty() || !due {
            return;
        }
        let forget = self.memory.ledger.forgettable(now.wall.0);
        forget.into_iter().for_each(|op| self.write(op, false));
        self.writes.batch += 1;
        self.writes.urgent = false;
        let lanes = Lane::ALL.map(|lane| self.memory.ring.lane(lane).produced);
        self.writes.in_flight = Some((self.writes.batch, self.writes.given, lanes));
        out.push(Output::Persist(self.writes.batch, std::mem::take(&mut self.writes.ops)));
    }

    fn persisted(&mut self, batch: u64) {
        if let Some((number, given, lanes)) = self.writes.in_flight
            && number == batch
        {
            self.writes.in_flight = None;
            self.writes.durable = given;
            self.sender.durable(lanes);
        }
    }

    /// Critical, event, the live heartbeat, then STATUS, which travels with heartbeats, or what is old of it beside
    /// them.
    fn send(&mut self, now: &Now, beat: bool, out: &mut Vec<Output>) {
        if self.session.is_none() {
            return;
        }
        let mut message = Uplink::default();
        self.send_lane(Lane::Critical, &mut message, out);
        self.send_lane(Lane::Event, &mut message, out);
        if beat {
            message.heartbeat = self.heartbeat(now);
        }
        let waiting = self.memory.ring.lane(Lane::Status).samples.len();
        if beat || waiting > limits::SAMPLES_PER_MESSAGE / 8 {
            self.send_lane(Lane::Status, &mut message, out);
        }
        if message != Uplink::default() {
            out.push(Output::Send(Box::new(message)));
        }
        self.send_replay(now, out);
    }

    fn send_lane(&mut self, lane: Lane, message: &mut Uplink, out: &mut Vec<Output>) {
        let size = |b: &LaneBatch| b.items.len();
        while let Some(batch) = self.sender.next_batch(&self.memory.ring, lane) {
            let have: usize = message.batches.iter().map(size).sum();
            if have + size(&batch) > limits::SAMPLES_PER_MESSAGE {
                out.push(Output::Send(Box::new(std::mem::take(message))));
            }
            message.batches.push(batch);
        }
    }

    /// Old STATUS goes beside the session, at its own pace.
    fn send_replay(&mut self, now: &Now, out: &mut Vec<Output>) {
        if self.session.is_none() || !self.pace.is_due(now.link) {
            return;
        }
        let Some(batch) = self.sender.next_replay(&self.memory.ring) else { return };
        let cap_bytes_s = self.update.desired.as_ref().map_or(0, |d| d.rate_bytes_s);
        self.pace.sent(now.link, batch.items.len() * STATUS_SAMPLE_BYTES, cap_bytes_s);
        let memory = &self.memory.ledger.session;
        out.push(Output::Replay(Box::new(StatusReplay {
            robot_id: self.config.robot_id.clone(),
            session_epoch: memory.session_epoch,
            session_secret: memory.secret.clone(),
            batch,
        })));
    }

    /// The server's word on a batch counts as on the session; what brought nothing is tried again, and then left to the
    /// session.
    fn replayed(&mut self, now: &Now, session_epoch: u64, replayed: Replayed) {
        if self.session.as_ref().is_none_or(|s| s.epoch != session_epoch) {
            return;
        }
        let before = self.memory.ring.lane(Lane::Status).acked;
        if let Replayed::Stored(ack) = &replayed {
            self.acked(ack);
        }
        self.sender.replayed(&self.memory.ring);
        if let Replayed::Stored(ack) = &replayed {
            self.expected(ack);
        }
        let goes_on = match &replayed {
            Replayed::Stored(_) if self.memory.ring.lane(Lane::Status).acked > before => {
                self.pace.went_well();
                true
            }
            Replayed::NotServed => false,
            Replayed::Stored(_) | Replayed::Failed(_) => self.pace.came_to_nothing(now.link),
        };
        if !goes_on {
            tracing::info!(robot_id = %self.config.robot_id, ?replayed, "old status goes on the session");
            self.sender.replay_on_link();
        }
    }

    fn heartbeat(&mut self, now: &Now) -> Option<Heartbeat> {
        let session = self.session.as_mut()?;
        session.hb += 1;
        self.sent.sent(session.hb, now.link);
        let mut reported = self.reported(now);
        self.listed_load.note(reported.hb, reported.load.as_ref());
        if self.desired.is_none() {
            // Grants are not on the ledger: until the server has said them again, what is not listed here proves
            // nothing.
            reported.applied_work = 0;
        }
        match self.session.as_mut().filter(|session| session.told_map != reported.map_version) {
            Some(session) => session.told_map.clone_from(&reported.map_version),
            None => reported.map_version.clear(),
        }
        reported.free_bytes = self.session.as_mut().and_then(|session| session.room_to_tell(reported.free_bytes));
        Some(Heartbeat { reported, sent_unix_us: now.wall.0 * 1000, clock: self.clock.take() })
    }
}
