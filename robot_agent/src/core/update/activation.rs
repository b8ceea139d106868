//! Whether the robot may change its software now: held by the drain, without work, load, stop or passage, and with a
//! grant that lives.
//!
//! Invariant: a switch that waits for the disk is taken back once something came between.

use crate::core::state::AgentCore;
use crate::storage::Update;
use crate::update::Job;
use midshift_core::ids::{DrainId, PlaceId, SetId};
use midshift_core::limits;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{HardwareStop, Lane, Mode};
use midshift_core::robot_events::RobotEvent;
use midshift_core::time::{LinkDuration, Now};
use midshift_core::update::{UpdateEvent, UpdateState};

/// A grant that did not come is asked for again after this.
const ASK_AGAIN: LinkDuration = LinkDuration(10_000);

impl AgentCore {
    /// Whether the robot may change its software forward now: without work, load, stop or passage, in this drain,
    /// charged and cool.
    pub(super) fn may_activate(&self, now: &Now, drain_id: &DrainId) -> Result<(), Reason> {
        let no = |what: &str| Err(Reason::from(Code::ActivationBlocked).with("by", what));
        let state = self.body.state(now.site);
        let launched = self.update.config.as_ref().is_some_and(|c| c.is_launched);
        match () {
            () if !self.is_held_by(drain_id) => no("drain"),
            () if self.config.bugs.activates_anyway() => Ok(()),
            () if self.work.is_some() => no("attempt"),
            () if self.body.load().is_some() => no("load"),
            () if self.is_in_passage() => no("passage"),
            () if self.hardware_stop != HardwareStop::None || self.is_stopped() => no("stop"),
            () if self.mode != Mode::Automatic => no("mode"),
            () if !self.body.standstill(now.site) => no("motion"),
            () if state.battery_permille < limits::ACTIVATE_BATTERY_PERMILLE => no("battery"),
            () if state.hottest_joint_decidegrees > limits::ACTIVATE_JOINT_DECIDEGREES => no("temperature"),
            () if !launched => no("no launcher"),
            () => Ok(()),
        }
    }

    /// Whether this drain holds the robot.
    fn is_held_by(&self, drain_id: &DrainId) -> bool {
        let held = self.memory.ledger.maintenance.as_ref();
        held == Some(drain_id) || (self.config.bugs.any_drain_will_do() && held.is_some())
    }

    /// Whether the software changes, or is not yet believed: no work is taken.
    pub(crate) fn changes_software(&self) -> bool {
        let state = self.memory.ledger.software.update.as_ref().map(|u| u.state);
        matches!(state, Some(UpdateState::Switching | UpdateState::Probation | UpdateState::RollingBack))
    }

    /// It holds a place beside the one it stands on.
    fn is_in_passage(&self) -> bool {
        // Not the waypoint that it passed last: it may have left it since.
        let here = self.body.stands_on();
        let standing = |place: &PlaceId| here.iter().any(|w| w.as_str() == place.as_str());
        let row = &self.memory.ledger.places;
        row.inside.keys().chain(row.committed.keys()).any(|place| !standing(place))
    }

    /// Whether what let the switch begin holds still: its grant lives, and nothing came between.
    pub(super) fn may_switch(&self, now: &Now, update: &Update) -> Result<(), Reason> {
        let blocked = |what: &str| Reason::from(Code::ActivationBlocked).with("by", what);
        self.may_activate(now, update.drain_id.as_ref().ok_or_else(|| blocked("drain"))?)?;
        let lives = self.update.granted_until.is_some_and(|until| now.link <= until);
        if lives || self.config.bugs.authority_from_receipt() { Ok(()) } else { Err(blocked("grant")) }
    }

    /// A switch that waits for the disk is not made once something came between.
    pub(super) fn take_switch_back(&mut self, now: &Now) {
        let update = self.memory.ledger.software.update.as_ref().filter(|u| u.state == UpdateState::Switching);
        let waits = matches!(self.update.next, Some((Job::Write(_), _)));
        if waits && update.is_some_and(|update| self.may_switch(now, update).is_err()) {
            self.update.next = None;
        }
    }

    pub(super) fn note_blocked(&mut self, reason: Reason) {
        let Some(update) = self.memory.ledger.software.update.clone() else { return };
        if update.reason.as_ref() != Some(&reason) {
            self.put_update(Update { reason: Some(reason), ..update });
        }
    }

    pub(super) fn ask_for_grant(&mut self, now: &Now, update: &Update) {
        let Some(drain_id) = self.drain_to_activate_in().cloned() else { return };
        let again = |(id, at): &(DrainId, _)| *id == drain_id && now.link.since(*at) < ASK_AGAIN;
        if self.update.asked.as_ref().is_some_and(again) {
            self.wake_at(now.link + ASK_AGAIN);
            return;
        }
        let Some(set) = update.set_name().and_then(|name| SetId::parse(&name).ok()) else { return };
        self.update.asked = Some((drain_id.clone(), now.link));
        self.emit(Lane::Event, RobotEvent::Update(UpdateEvent::Ready { drain_id, set }));
    }
}
