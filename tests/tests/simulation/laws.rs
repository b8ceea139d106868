//! When permission ends, counted by a clock that neither server nor robot has.
//!
//! A permission is anchored to a heartbeat that was sent before the row that gives it was committed. So whoever uses it later
//! after that commit than it is valid, with 2 % for both clocks, uses it late, whatever the machines' clocks say.

use midshift_core::authority::Authority;
use midshift_core::ids::{AttemptId, RobotId};
use std::collections::BTreeMap;

/// From a robot's decision to its place on the disk, microseconds.
const WRITE_US: u64 = 60_000;

fn judge(given: Option<&(Authority, u64)>, session_epoch: u64, us: u64) -> Option<String> {
    let Some((authority, at_us)) = given else { return Some("nobody gave it".to_owned()) };
    if authority.session_epoch != session_epoch {
        return Some(format!("given in session {}, used in {session_epoch}", authority.session_epoch));
    }
    let age_us = us.saturating_sub(*at_us);
    let late = age_us > authority.valid_ms * 1_020 + WRITE_US;
    late.then(|| format!("{} ms after it was given, valid are {}", age_us / 1000, authority.valid_ms))
}

/// Offers by attempt, with the moment of their newest commit.
#[derive(Default)]
pub struct Offers(BTreeMap<AttemptId, (Authority, u64)>);

impl Offers {
    /// An offer was committed.
    pub fn give(&mut self, attempt: &AttemptId, authority: Authority, us: u64) {
        if self.0.get(attempt).is_none_or(|(old, _)| *old != authority) {
            self.0.insert(attempt.clone(), (authority, us));
        }
    }
    /// What is wrong with taking it now.
    pub fn judge(&self, attempt: &AttemptId, session_epoch: u64, us: u64) -> Option<String> {
        judge(self.0.get(attempt), session_epoch, us)
    }
}

/// Grants of places by robot and number, with the moment of their newest commit.
#[derive(Default)]
pub struct Grants(BTreeMap<(RobotId, u64), (Authority, u64)>);

impl Grants {
    /// A grant was committed.
    pub fn give(&mut self, robot_id: &RobotId, grant_id: u64, authority: Authority, us: u64) {
        let key = (robot_id.clone(), grant_id);
        if self.0.get(&key).is_none_or(|(old, _)| *old != authority) {
            self.0.insert(key, (authority, us));
        }
    }
    /// What is wrong with entering on it now.
    pub fn judge(&self, robot_id: &RobotId, grant_id: u64, session_epoch: u64, us: u64) -> Option<String> {
        judge(self.0.get(&(robot_id.clone(), grant_id)), session_epoch, us)
    }
}
