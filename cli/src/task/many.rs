//! `midshift task cancel|resolve --all`: pages of requests until nobody is meant any more.

use super::Which;
use crate::client::{Change, Exit, unary};
use crate::out::Out;
use midshift_proto::task::v1;
use std::collections::BTreeMap;

/// Ends every task that is meant.
pub async fn cancel(which: &Which, reason: &str, force: bool, change: &Change, out: &Out) -> Result<(), Exit> {
    let filter = which.meant.filter()?;
    let mut client = which.call.task().await?;
    let mut sum = Sum::default();
    loop {
        let request = v1::CancelTasksRequest {
            filter: Some(filter.clone()),
            request_id: change.request_id.clone(),
            reason: reason.to_owned(),
            force,
            validate_only: change.dry_run,
            page_token: sum.outcome.next_page_token.clone(),
        };
        let outcome = client.cancel_tasks(unary(request)).await?.into_inner().outcome.unwrap_or_default();
        if sum.add(outcome) {
            return sum.tell("cancel", change, out);
        }
    }
}

/// Answers every task that is meant.
pub async fn resolve(
    which: &Which,
    resolution: v1::Resolution,
    reason: &str,
    change: &Change,
    out: &Out,
) -> Result<(), Exit> {
    let filter = which.meant.filter()?;
    let mut client = which.call.task().await?;
    let mut sum = Sum::default();
    loop {
        let request = v1::ResolveTasksRequest {
            filter: Some(filter.clone()),
            request_id: change.request_id.clone(),
            resolution: resolution as i32,
            reason: reason.to_owned(),
            validate_only: change.dry_run,
            page_token: sum.outcome.next_page_token.clone(),
        };
        let outcome = client.resolve_tasks(unary(request)).await?.into_inner().outcome.unwrap_or_default();
        if sum.add(outcome) {
            return sum.tell("resolve", change, out);
        }
    }
}

/// Outcomes of all pages together.
#[derive(Default)]
struct Sum {
    outcome: v1::BulkOutcome,
}

impl Sum {
    /// Adds a page; true: it was the last.
    fn add(&mut self, page: v1::BulkOutcome) -> bool {
        self.outcome.matched += page.matched;
        self.outcome.asked += page.asked;
        self.outcome.pending = page.pending;
        self.outcome.next_page_token = page.next_page_token;
        for (code, tasks) in page.refused {
            *self.outcome.refused.entry(code).or_default() += tasks;
        }
        self.outcome.next_page_token.is_empty()
    }
    fn tell(self, verb: &str, change: &Change, out: &Out) -> Result<(), Exit> {
        let Self { outcome } = self;
        let refused: BTreeMap<&String, &u32> = outcome.refused.iter().collect();
        let why = refused.iter().map(|(code, tasks)| format!(", {tasks} refused with {code}")).collect::<String>();
        let would = if change.dry_run { " would be" } else { "" };
        out.one(&outcome, "", || {
            format!("{} tasks meant, {}{would} asked to {verb}{why}", outcome.matched, outcome.asked)
        })?;
        if outcome.pending {
            out.next("the requests are durable and wait for fleet; midshift task ls");
        }
        if outcome.refused.is_empty() {
            Ok(())
        } else {
            Err(Exit::new(9, format!("not every task was asked to {verb}")))
        }
    }
}
