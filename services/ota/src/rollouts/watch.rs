//! A roll-out as it goes: now, and with each change, until it has ended.
//!
//! What is told changes with rows, with tasks that end on trial, with what robots say of their downloads, and with
//! time. Rows of this service wake a watcher; for the rest it looks again each second.
//!
//! Invariant: each look is answered from a projection that has come up to the head of the feed since it was asked for,
//! whether the process leads or not, and holds committed rows alone. So a client that goes on at another process is
//! told no older row than it was told before.

use super::encode;
use super::service::RolloutService;
use midshift_core::gates::TaskTally;
use midshift_core::identity::Caller;
use midshift_core::ids::RolloutId;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::{Board, objects, verdict};
use midshift_core::rows::Revision;
use midshift_core::time::Now;
use midshift_proto::ota::v1;
use midshift_proto::watches::Teller;
use std::collections::BTreeMap;
use std::ops::Bound;
use std::time::Duration;

/// Messages to one watcher come no faster.
const PACE: Duration = Duration::from_millis(500);
/// What no row of this service tells is looked at so often.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Robots in one message.
const ROBOTS_MAX: usize = 1_000;

/// Whether somebody watches the time that is left, too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Countdowns {
    /// It is told with each other change.
    WithChanges,
    /// It is told each second.
    Followed,
}

/// What may change of a robot: its row, the tasks that it ended on trial, and how much it has downloaded, permille.
type Shown = (Revision, TaskTally, u32);

/// Remembers what a watcher was sent last, and composes what it is sent next.
struct RolloutWatcher {
    countdowns: Countdowns,
    rollout: Option<v1::Rollout>,
    robots: BTreeMap<String, Shown>,
}

impl RolloutWatcher {
    /// What is new; none: nothing is, or the roll-out is gone. Says also whether it has ended.
    fn next(
        &mut self,
        view: &RolloutProjection,
        board: &Board,
        now: &Now,
        id: &RolloutId,
        by: &Caller,
    ) -> Result<(Option<v1::WatchRolloutResponse>, bool), Refusal> {
        let revised = view.rollouts.get(id.as_str()).filter(|revised| objects::sees(by, &revised.row));
        let reason = || Reason::from(Code::RolloutNotFound).with("rollout_id", id);
        let revised = revised.ok_or_else(|| Refusal::new(Kind::NotFound, reason()))?;
        let first = self.rollout.is_none();
        let (from, to) = (format!("{id}/"), format!("{id}0"));
        let mut robots = Vec::new();
        for (key, r) in view.robots.range::<str, _>((Bound::Included(&*from), Bound::Excluded(&*to))) {
            let shown: Shown = (
                r.revision,
                verdict::exposure_of(view, &revised.row, &r.row),
                encode::progress_permille(board, &r.row),
            );
            let known = self.robots.get(key.as_str()) == Some(&shown);
            if !known && robots.len() < ROBOTS_MAX {
                self.robots.insert(key.to_string(), shown);
                if !first || !r.row.step.is_over() {
                    robots.push(encode::robot(view, board, now, &revised.row, &r.row));
                }
            }
        }
        let rollout = encode::rollout(view, now, &revised.row);
        let is_new = !robots.is_empty() || !self.has_told(&rollout);
        if is_new {
            self.rollout = Some(rollout.clone());
        }
        let message = v1::WatchRolloutResponse { rollout: Some(rollout), robots };
        Ok((is_new.then_some(message), revised.row.phase.is_over()))
    }

    /// Whether a watcher knows this already. Time that passes is news only to one that follows it.
    fn has_told(&self, rollout: &v1::Rollout) -> bool {
        let Some(sent) = &self.rollout else { return false };
        if self.countdowns == Countdowns::Followed {
            return sent == rollout;
        }
        let begun = |rollout: &v1::Rollout| (rollout.soak_left.is_some(), rollout.exposure_left.is_some());
        let (soak_left, exposure_left) = (sent.soak_left, sent.exposure_left);
        // Tasks are told with the robots that ended them.
        let (trial, control) = (sent.trial, sent.control);
        let same = v1::Rollout { soak_left, exposure_left, trial, control, ..rollout.clone() };
        begun(sent) == begun(rollout) && *sent == same
    }
}

/// Watches until the roll-out has ended, the watcher goes, or the server stops.
pub async fn watch(
    service: RolloutService,
    id: RolloutId,
    countdowns: Countdowns,
    by: Caller,
    teller: &Teller<v1::WatchRolloutResponse>,
) {
    let mut watcher = RolloutWatcher { countdowns, rollout: None, robots: BTreeMap::new() };
    let mut changed = service.changed.clone();
    while teller.asked().await.is_ok() {
        changed.mark_unchanged();
        let (asked, by) = (id.clone(), by.clone());
        let looked = service
            .ask_about(vec![id.clone()], move |view, board, now| {
                let next = watcher.next(view, board, now, &asked, &by);
                (watcher, next)
            })
            .await;
        let next = looked.and_then(|(after, next)| next.map(|next| (after, next)));
        let (after, (message, is_over)) = match next {
            Ok(next) => next,
            Err(refusal) => {
                teller.end(midshift_proto::status(&refusal, None));
                return;
            }
        };
        watcher = after;
        if let Some(message) = message {
            teller.tell_message(message);
        }
        if is_over {
            return;
        }
        tokio::select! {
            () = teller.gone() => return,
            news = changed.changed() => if news.is_err() { return },
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
        tokio::time::sleep(PACE).await;
    }
}

#[cfg(test)]
mod tests;
