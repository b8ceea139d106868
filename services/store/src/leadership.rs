//! Reads and writes the leader lease of a service in the store, by the rules of [`midshift_core::leadership`].
//!
//! Invariant: what was read counts from after the reading, since an answer may take long; what was claimed counts from before the claim.

use crate::{Applied, CommitError, Error, Store};
use midshift_core::leadership::{LeaderLease, LeaderRow, LeaseAction};
use midshift_core::limits;
use midshift_core::time::Clock;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

/// How often a process that reads looks whether its lease is due.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Reads the lease and claims it if no process leads; true: this process leads from now on. It may have stepped down, also before an error.
///
/// # Errors
/// If the row cannot be read, or nobody knows whether it was written.
pub async fn claim_if_free<R: LeaderRow>(
    lease: &mut LeaderLease<R>,
    store: &dyn Store,
    clock: &dyn Clock,
) -> Result<bool, Error> {
    if lease.next_action(clock.now().link) == LeaseAction::StepDown {
        lease.step_down();
    }
    let rows = store.get(vec![LeaderLease::<R>::key()]).await?;
    let now = clock.now().link;
    lease.read(rows.first(), now)?;
    match lease.next_action(now) {
        LeaseAction::StepDown => {
            lease.step_down();
            Ok(false)
        }
        LeaseAction::TakeOver => match store.commit(vec![lease.claim()]).await.pop() {
            Some(Ok(_)) => {
                lease.claimed(now);
                Ok(true)
            }
            Some(Err(CommitError::Conflict { .. })) => Ok(false),
            Some(Err(error)) => Err(Error::Unavailable(Arc::new(error))),
            None => unreachable!("one result an item"),
        },
        LeaseAction::Lead | LeaseAction::Renew | LeaseAction::StandBy => Ok(false),
    }
}

/// Renews the lease of a leader while it waits for a long reading, so that no other process takes over meanwhile. It does so for
/// [`limits::LEAD_READS_FOR`] at most.
pub async fn renew_while<R: LeaderRow, T>(
    lease: &mut LeaderLease<R>,
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
        if lease.next_action(now) == LeaseAction::Renew && now.since(begun) < limits::LEAD_READS_FOR {
            let claimed = store.commit(vec![lease.claim()]).await.pop();
            // Not written, or nobody knows: another claim finds that out, and without one the lease ends by itself.
            if matches!(claimed, Some(Ok(_))) {
                lease.claimed(now);
            }
        }
    }
}

/// Releases the lease of a leader, so that another process leads at once. None: this process did not lead; else whether the row says so.
pub async fn release_lease<R: LeaderRow>(lease: &mut LeaderLease<R>, store: &dyn Store) -> Option<bool> {
    let item = lease.release()?;
    let within = Duration::from_millis(limits::LEAD_LEFT_WITHIN.as_ms());
    let left = tokio::time::timeout(within, store.commit(vec![item])).await;
    lease.step_down();
    Some(left.is_ok_and(|results| results.iter().all(Result::is_ok)))
}

/// The outcome of items that were committed together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroupOutcome {
    /// All of them are in the store.
    Done,
    /// Others changed rows that they are about, so that some are not in the store: decide anew.
    Moved,
    /// Something else is the matter with some of them.
    Unknown,
}

/// Judges the results of items that were committed together.
pub fn group_outcome(results: &[Result<Applied, CommitError>]) -> GroupOutcome {
    let is_conflict = |error: &CommitError| matches!(error, CommitError::Conflict { .. });
    match results.iter().filter_map(|result| result.as_ref().err()).map(is_conflict).min() {
        None => GroupOutcome::Done,
        Some(true) => GroupOutcome::Moved,
        Some(false) => GroupOutcome::Unknown,
    }
}
