//! How far robots are with one stop, for whoever engaged it: the whole, then what changed.
//!
//! Invariant: what is told of a robot is what [`confirmation`] makes of its own newest word; nothing is confirmed by time. Leaving early takes nothing back.

use crate::changes::was_reset;
use crate::inner::Inner;
use crate::threads::lock;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::nearest::nearest;
use midshift_core::reason::Refusal;
use midshift_core::robot::StopLevel;
use midshift_core::stop::roster::{Confirmation, confirmation, is_elsewhere};
use midshift_core::stop::{Scope, Stop};
use midshift_core::time::{LinkTime, Now, Utc};
use midshift_proto::convert::WireEnum;
use midshift_proto::stop::v1;
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tonic::Status;

/// Silence becomes visible at most this late.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// UTC of the wall at a moment of the link clock before or after now, as people read it.
pub fn wall_at(now: &Now, at: LinkTime) -> Utc {
    Utc(now.wall.0 + at.0.cast_signed() - now.link.0.cast_signed())
}

/// Adds one robot.
pub fn count(counts: &mut v1::Counts, confirmation: Confirmation) {
    *match confirmation {
        Confirmation::Requested => &mut counts.requested,
        Confirmation::Acked => &mut counts.acked,
        Confirmation::Outside => &mut counts.outside,
        Confirmation::StandstillConfirmed => &mut counts.standstill_confirmed,
        Confirmation::Unreachable { .. } => &mut counts.unreachable,
    } += 1;
}

/// How one robot is with the stop.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Found {
    confirmation: Confirmation,
    /// By its newest report; none: it was never heard.
    obeys: Option<StopLevel>,
    is_elsewhere: bool,
}

fn encode(robot_id: &RobotId, found: &Found, now: &Now) -> v1::RobotStop {
    use v1::Confirmation as W;
    let (word, since, by) = match found.confirmation {
        Confirmation::Requested => (W::Requested, None, None),
        Confirmation::Acked => (W::Acked, None, None),
        Confirmation::Outside => (W::Outside, None, None),
        Confirmation::StandstillConfirmed => (W::StandstillConfirmed, None, None),
        Confirmation::Unreachable { since, self_stop_by } => (W::Unreachable, since, self_stop_by),
    };
    v1::RobotStop {
        robot_id: robot_id.to_string(),
        confirmation: word.into(),
        unreachable_since_unix_ms: since.map_or(0, |at| wall_at(now, at).0),
        self_stop_by_unix_ms: by.map_or(0, |at| wall_at(now, at).0),
        obeys: found.obeys.map_or(0, WireEnum::to_wire),
        elsewhere: found.is_elsewhere,
    }
}

/// What a look at all robots found.
struct Seen {
    news: Vec<v1::RobotStop>,
    counts: v1::Counts,
    /// Nothing more is to come by itself.
    is_over: bool,
}

struct Watching<'a> {
    inner: &'a Inner,
    stop: Stop,
    told: BTreeMap<RobotId, Found>,
}

impl Watching<'_> {
    /// # Errors
    /// The stop was reset.
    fn look_at_robots(&mut self, now: &Now) -> Result<Seen, Refusal> {
        let stop_id = &self.stop.stop_id;
        let engaged_stops = lock(&self.inner.engaged_stops);
        let since = engaged_stops.effective().find(|(stop, _)| stop.stop_id == *stop_id).map(|(_, since)| since);
        drop(engaged_stops);
        let since = since.ok_or_else(|| was_reset(stop_id))?;
        let robots = self.inner.robots.all();
        let mut seen = Seen { news: Vec::new(), counts: v1::Counts::default(), is_over: true };
        let mut found = BTreeMap::new();
        for robot in &robots {
            let state = robot.state();
            let heard = state.heard.as_ref();
            let one = Found {
                confirmation: confirmation(&self.stop, since, &robot.robot_id, heard, now.link),
                obeys: heard.map(|h| h.level),
                is_elsewhere: is_elsewhere(&self.stop, since, &robot.robot_id, heard, now.link),
            };
            found.insert(robot.robot_id.clone(), one);
        }
        if let Scope::Robot(robot_id) = &self.stop.scope {
            // One that nobody knows of: nobody knows either whether it stands.
            let confirmation = confirmation(&self.stop, since, robot_id, None, now.link);
            let unknown = Found { confirmation, obeys: None, is_elsewhere: false };
            found.entry(robot_id.clone()).or_insert(unknown);
        }
        for (robot_id, one) in &found {
            count(&mut seen.counts, one.confirmation);
            let is_over = || one.confirmation.is_settled(&self.stop) || self.has_stood_by_itself(one.confirmation, now);
            seen.is_over &= !may_mean(&self.stop, robot_id) || one.is_elsewhere || is_over();
            if self.told.get(robot_id) != Some(one) {
                seen.news.push(encode(robot_id, one, now));
            }
        }
        self.told = found;
        Ok(seen)
    }

    /// What is said in the first message only.
    fn begins(&self, stop: v1::Stop) -> v1::EngageResponse {
        let site_id = self.inner.site_id.as_ref().map(ToString::to_string).unwrap_or_default();
        let mut first = v1::EngageResponse { stop: Some(stop), site_id, ..v1::EngageResponse::default() };
        if let Scope::Robot(robot_id) = &self.stop.scope {
            let known = self.inner.robots.all();
            first.robot_unknown = known.iter().all(|robot| robot.robot_id != *robot_id);
            if first.robot_unknown {
                let names = known.iter().map(|robot| robot.robot_id.as_str());
                first.nearest_robot_ids = nearest(robot_id.as_str(), names).map(str::to_owned).collect();
            }
        }
        first
    }

    /// A robot that is not heard stands by its own silence by now. One that was never heard was answered by nobody since this process began.
    fn has_stood_by_itself(&self, confirmation: Confirmation, now: &Now) -> bool {
        match confirmation {
            Confirmation::Unreachable { self_stop_by: Some(by), .. } => now.link >= by,
            Confirmation::Unreachable { self_stop_by: None, .. } => {
                now.link.since(self.inner.started) >= limits::SILENCE_STAND
            }
            _ => false,
        }
    }
}

/// A robot may lie inside of this stop as far as anybody else knows, so that its word is waited for. Where one is that is not heard, nobody knows but itself
/// ([`is_elsewhere`]).
fn may_mean(stop: &Stop, robot_id: &RobotId) -> bool {
    !matches!(&stop.scope, Scope::Robot(id) if id != robot_id)
}

/// Tells of a stop until nothing more is to come, or the reader leaves. `may_stay`: there is room for one more reader; else it is told once.
pub async fn tell_of_stop(
    inner: &Inner,
    stop: Stop,
    mut durable: bool,
    version: u64,
    may_stay: bool,
    sender: mpsc::Sender<Result<v1::EngageResponse, Status>>,
) {
    let mut changed: watch::Receiver<u64> = inner.changed.subscribe();
    let begun = inner.clock.now().link;
    let mut watching = Watching { inner, stop, told: BTreeMap::new() };
    let mut first = Some(v1::Stop::from(&watching.stop));
    loop {
        changed.mark_unchanged();
        let now = inner.clock.now();
        let seen = match watching.look_at_robots(&now) {
            Ok(seen) => seen,
            Err(refusal) => {
                let _ = sender.send(Err(midshift_proto::status(&refusal, None))).await;
                return;
            }
        };
        let was_durable = durable;
        durable |= inner.disk.holds(version);
        if first.is_some() || !seen.news.is_empty() || durable != was_durable {
            let (robots, counts) = (seen.news, Some(seen.counts));
            let begins = first.take().map(|stop| watching.begins(stop)).unwrap_or_default();
            if sender.send(Ok(v1::EngageResponse { robots, counts, durable, ..begins })).await.is_err() {
                return;
            }
        }
        if seen.is_over || !may_stay || now.link.since(begun) >= limits::STOP_CONFIRM_FOR {
            return;
        }
        tokio::time::sleep(Duration::from_millis(limits::STOP_CONFIRM_EVERY.as_ms())).await;
        tokio::select! {
            () = sender.closed() => return,
            _ = changed.changed() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}
