//! `midshift task cancel|resolve --all`: pages of requests until nobody is meant any more.

use super::target::TaskSelection;
use crate::client::{Change, Exit, unary};
use crate::out::Out;
use midshift_proto::task::v1;
use std::collections::BTreeMap;
use tonic::Status;

/// Ends every task that is meant.
pub async fn cancel(which: &TaskSelection, reason: &str, force: bool, change: &Change, out: &Out) -> Result<(), Exit> {
    let mut client = which.call.task().await?;
    let filter = which.meant.filter()?;
    let request = v1::CancelTasksRequest {
        all: is_everything(&filter),
        filter: Some(filter),
        request_id: change.request_id.clone(),
        reason: reason.to_owned(),
        force,
        validate_only: change.dry_run,
        page_token: String::new(),
    };
    let ask = async |page_token| {
        let request = v1::CancelTasksRequest { page_token, ..request.clone() };
        Ok(client.cancel_tasks(unary(request)).await?.into_inner().outcome)
    };
    Sum::of_pages(ask).await?.print("cancel", change, out)
}

/// Answers every task that is meant.
pub async fn resolve(
    which: &TaskSelection,
    resolution: v1::Resolution,
    reason: &str,
    change: &Change,
    out: &Out,
) -> Result<(), Exit> {
    let mut client = which.call.task().await?;
    let filter = which.meant.filter()?;
    let request = v1::ResolveTasksRequest {
        all: is_everything(&filter),
        filter: Some(filter),
        request_id: change.request_id.clone(),
        resolution: resolution as i32,
        reason: reason.to_owned(),
        validate_only: change.dry_run,
        page_token: String::new(),
    };
    let ask = async |page_token| {
        let request = v1::ResolveTasksRequest { page_token, ..request.clone() };
        Ok(client.resolve_tasks(unary(request)).await?.into_inner().outcome)
    };
    Sum::of_pages(ask).await?.print("resolve", change, out)
}

/// Whether no flag says which tasks are meant. Else `all` is not set: a server that does not know the flag refuses the request.
fn is_everything(filter: &v1::TaskFilter) -> bool {
    *filter == v1::TaskFilter::default()
}

/// Outcomes of all pages together.
struct Sum {
    outcome: v1::BulkOutcome,
}

impl Sum {
    /// Asks for page after page until nobody is meant any more.
    async fn of_pages(
        mut ask: impl AsyncFnMut(String) -> Result<Option<v1::BulkOutcome>, Status>,
    ) -> Result<Self, Status> {
        let mut sum = v1::BulkOutcome::default();
        loop {
            let page = ask(std::mem::take(&mut sum.next_page_token)).await?.unwrap_or_default();
            (sum.matched, sum.asked) = (sum.matched + page.matched, sum.asked + page.asked);
            (sum.pending, sum.next_page_token) = (page.pending, page.next_page_token);
            for (code, tasks) in page.refused {
                *sum.refused.entry(code).or_default() += tasks;
            }
            if sum.next_page_token.is_empty() {
                return Ok(Self { outcome: sum });
            }
        }
    }
    fn print(self, verb: &str, change: &Change, out: &Out) -> Result<(), Exit> {
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
