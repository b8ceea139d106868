//! A roll-out as it goes: now, and with each change, until it has ended.

use super::{RolloutService, encode};
use midshift_core::identity::Caller;
use midshift_core::ids::RolloutId;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::rollout::view::View;
use midshift_core::rollout::{Board, objects};
use midshift_core::rows::Revision;
use midshift_core::time::Now;
use midshift_proto::ota::v1;
use midshift_proto::watches::Teller;
use std::collections::BTreeMap;
use std::time::Duration;

/// Messages to one watcher come no faster.
const PACE: Duration = Duration::from_millis(500);
/// Robots in one message.
const ROBOTS_MAX: usize = 1_000;

/// What a watcher was told last, and what it is told next.
#[derive(Default)]
struct Told {
    rollout: Option<Revision>,
    robots: BTreeMap<String, Revision>,
}

impl Told {
    /// What is new; none: nothing is, or the roll-out is gone. Says also whether it has ended.
    fn next(
        &mut self,
        view: &View,
        board: &Board,
        now: &Now,
        id: &RolloutId,
        by: &Caller,
    ) -> Result<(Option<v1::WatchRolloutResponse>, bool), Refusal> {
        let rowed = view.rollouts.get(id.as_str()).filter(|rowed| objects::sees(by, &rowed.row));
        let reason = || Reason::from(Code::RolloutNotFound).with("rollout_id", id);
        let rowed = rowed.ok_or_else(|| Refusal::new(Kind::NotFound, reason()))?;
        let first = self.rollout.is_none();
        let (from, to) = (format!("{id}/"), format!("{id}0"));
        let mut robots = Vec::new();
        for (key, r) in view.robots.range(from..to) {
            let known = self.robots.get(key) == Some(&r.revision);
            if !known && robots.len() < ROBOTS_MAX {
                self.robots.insert(key.clone(), r.revision);
                if !first || !r.row.step.is_over() {
                    robots.push(encode::robot(view, board, now, &rowed.row, &r.row));
                }
            }
        }
        let is_new = self.rollout != Some(rowed.revision) || !robots.is_empty();
        self.rollout = Some(rowed.revision);
        let message = v1::WatchRolloutResponse { rollout: Some(encode::rollout(view, now, &rowed.row)), robots };
        Ok((is_new.then_some(message), rowed.row.phase.is_over()))
    }
}

/// Watches until the roll-out has ended, the watcher goes, or the server stops.
pub async fn watch(service: RolloutService, id: RolloutId, by: Caller, teller: &Teller<v1::WatchRolloutResponse>) {
    let mut told = Told::default();
    let mut changed = service.changed.clone();
    while teller.asked().await.is_ok() {
        changed.mark_unchanged();
        let (asked, by) = (id.clone(), by.clone());
        let looked = service
            .look(move |view, board, now| {
                let next = told.next(view, board, now, &asked, &by);
                (told, next)
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
        told = after;
        if let Some(message) = message {
            teller.tell_message(message);
        }
        if is_over {
            return;
        }
        tokio::select! {
            () = teller.gone() => return,
            news = changed.changed() => if news.is_err() { return },
        }
        tokio::time::sleep(PACE).await;
    }
}
