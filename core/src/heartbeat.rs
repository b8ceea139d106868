//! The newest heartbeat of a robot, as a server knows it and as it shares it with other processes.

use crate::ids::{AreaId, RobotId};
use crate::robot::Lane;
use crate::rows::written;
use crate::session::LaneMark;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The newest heartbeat of a robot with what the server knows about it: the volatile face, never a row.
#[derive(Clone, Debug, PartialEq)]
pub struct NewestHeartbeat {
    /// The robot that sent it.
    pub robot_id: RobotId,
    /// What it said.
    pub report: crate::robot::ReportedState,
    /// When the server had processed it.
    pub processed_at: crate::time::LinkTime,
    /// The same moment on the site clock.
    pub processed_site: crate::time::SiteTime,
    /// UTC of the wall at receipt.
    pub received_unix_ms: i64,
    /// When its progress number last changed, site clock.
    pub progress_at: crate::time::SiteTime,
    /// How far its clock is off. None: not measured yet.
    pub clock: Option<ClockOffset>,
}

/// How far the clock of a robot is off, as its gateway measured it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockOffset {
    /// Robot clock minus server clock, milliseconds.
    pub clock_offset_ms: i64,
    /// Largest error of that, milliseconds.
    pub clock_error_ms: u64,
}

impl NewestHeartbeat {
    /// The area in which the robot is: that of the waypoint it was at last. None: not known.
    pub fn area<'s>(&self, site: &'s crate::site::Site) -> Option<&'s AreaId> {
        site.area_at(self.report.vitals.waypoint.as_ref())
    }
}

/// A heartbeat as its gateway shares it with other processes: without readings of clocks of one process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SharedHeartbeat {
    /// What the robot said.
    pub report: crate::robot::ReportedState,
    /// UTC of the gateway's wall at receipt, milliseconds.
    pub received_unix_ms: i64,
    /// As [`NewestHeartbeat::clock`].
    pub clock: Option<ClockOffset>,
}

impl SharedHeartbeat {
    /// As text, for [`SharedHeartbeat::parse`].
    pub fn text(&self) -> Arc<str> {
        written(self)
    }
    /// From [`SharedHeartbeat::text`].
    ///
    /// # Errors
    /// If it is not such a text.
    pub fn parse(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }
    /// As this process knows it from `now` on, where it knew `before` of the robot; none if that is not older.
    pub fn into_newest(
        self,
        robot_id: &RobotId,
        before: Option<&NewestHeartbeat>,
        now: crate::time::Now,
    ) -> Option<NewestHeartbeat> {
        let order = |report: &crate::robot::ReportedState| (report.session_epoch, report.hb);
        if before.is_some_and(|before| order(&before.report) >= order(&self.report)) {
            return None;
        }
        let progressed = before.is_none_or(|before| before.report.progress() != self.report.progress());
        let progress_at = before.filter(|_| !progressed).map_or(now.site, |before| before.progress_at);
        let Self { report, received_unix_ms, clock } = self;
        let (robot_id, processed_at, processed_site) = (robot_id.clone(), now.link, now.site);
        Some(NewestHeartbeat { robot_id, report, processed_at, processed_site, received_unix_ms, progress_at, clock })
    }
}

impl From<&NewestHeartbeat> for SharedHeartbeat {
    fn from(live: &NewestHeartbeat) -> Self {
        Self { report: live.report.clone(), received_unix_ms: live.received_unix_ms, clock: live.clock }
    }
}

impl NewestHeartbeat {
    /// Everything that the robot had written down when it sent this is stored, if its ring stands at `mark`.
    pub fn is_consumed(&self, mark: Option<&LaneMark>) -> bool {
        let done = |lane: Lane, have: u64| self.report.produced.get(&lane).is_none_or(|p| *p <= have);
        done(Lane::Event, mark.map_or(0, |m| m.event)) && done(Lane::Critical, mark.map_or(0, |m| m.critical))
    }
}
