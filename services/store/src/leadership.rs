//! Taking part in who leads a service: the rules are [`midshift_core::leadership`], and this reads and writes its row.
//!
//! Invariant: what was read counts from after the reading, since an answer may take long; what was claimed counts from before the claim.

use crate::{Applied, CommitError, Error, Store};
use midshift_core::leadership::{LeaderRow, Seat, Stance};
use midshift_core::limits;
use midshift_core::time::Clock;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

/// How often a process that reads looks whether its lease is due.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Reads who leads, and takes over if nobody does; true: this process leads from now on. It may have stepped down, also before an error.
///
/// # Errors
/// If the row cannot be read, or nobody knows whether it was written.
pub async fn take_part<R: LeaderRow>(seat: &mut Seat<R>, store: &dyn Store, clock: &dyn Clock) -> Result<bool, Error> {
    if seat.stance(clock.now().link) == Stance::StepDown {
        seat.step_down();
    }
    let rows = store.get(vec![Seat::<R>::key()]).await?;
    let now = clock.now().link;
    seat.read(rows.first(), now)?;
    match seat.stance(now) {
        Stance::StepDown => {
            seat.step_down();
            Ok(false)
        }
        Stance::TakeOver => match store.commit(vec![seat.claim()]).await.pop() {
            Some(Ok(_)) => {
                seat.claimed(now);
                Ok(true)
            }
            Some(Err(CommitError::Conflict { .. })) => Ok(false),
            Some(Err(error)) => Err(Error::Unavailable(Arc::new(error))),
            None => unreachable!("one result an item"),
        },
        Stance::Lead | Stance::Renew | Stance::StandBy => Ok(false),
    }
}

/// Waits for a reading and says meanwhile that this process leads, if it does: a reading that takes long is no reason for another one to take
/// over. It says so for [`limits::LEAD_READS_FOR`] at most.
pub async fn renewed_while<R: LeaderRow, T>(
    seat: &mut Seat<R>,
    store: &dyn Store,
    clock: &dyn Clock,
    reading: impl Future<Output = T>,
) -> T {
    let mut reading = pin!(reading);
    let begun = clock.now().link;
    loop {
        tokio::select! {
            biased;
            read = &mut reading => return read,
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
        let now = clock.now().link;
        if seat.stance(now) == Stance::Renew && now.since(begun) < limits::LEAD_READS_FOR {
            let claimed = store.commit(vec![seat.claim()]).await.pop();
            // Not written, or nobody knows: another claim finds that out, and without one the lease ends by itself.
            if matches!(claimed, Some(Ok(_))) {
                seat.claimed(now);
            }
        }
    }
}

/// Lets another process lead at once, if this one does. None: there was nothing to leave; else whether the row says so.
pub async fn hand_over<R: LeaderRow>(seat: &mut Seat<R>, store: &dyn Store) -> Option<bool> {
    let item = seat.release()?;
    let within = Duration::from_millis(limits::LEAD_LEFT_WITHIN.as_ms());
    let left = tokio::time::timeout(within, store.commit(vec![item])).await;
    seat.step_down();
    Some(left.is_ok_and(|results| results.iter().all(Result::is_ok)))
}

/// What became of items that were committed together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Settled {
    /// All of them are in the store.
    Done,
    /// Others changed rows that they are about, so that some are not in the store: decide anew.
    Moved,
    /// Something else is the matter with some of them.
    Unknown,
}

/// What became of items with these results.
pub fn settled(results: &[Result<Applied, CommitError>]) -> Settled {
    let is_conflict = |error: &CommitError| matches!(error, CommitError::Conflict { .. });
    match results.iter().filter_map(|result| result.as_ref().err()).map(is_conflict).min() {
        None => Settled::Done,
        Some(true) => Settled::Moved,
        Some(false) => Settled::Unknown,
    }
}
