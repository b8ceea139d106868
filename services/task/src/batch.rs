//! Batches: items are committed in slices, each item stands for itself, answers keep the order.
//!
//! Invariant: an item is checked after everything sent before it that it depends on was committed, wherever slices end.
//! A batch is read on while a slice is committed: many small frames that nobody reads end a connection of HTTP/2.

use crate::TaskService;
use crate::admit::{Admitted, Durable, Prepared, no_result};
use midshift_core::identity::Caller;
use midshift_core::limits;
use midshift_core::reason::{Reason, Refusal};
use midshift_proto::DenialReporter;
use midshift_proto::common::v1::FieldViolation;
use midshift_proto::convert::shown;
use midshift_proto::task::v1::{self, submit_task_request::Body, submit_task_result::Outcome};
use prost::Message;
use std::collections::BTreeSet;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::{Stream, StreamExt};
use tonic::Status;

/// Why a batch ends before its last item.
pub enum Broken {
    /// Its stream broke.
    Stream(Status),
    /// It breaks a rule of batches.
    Refused(Refusal),
}

/// A message that was read, with its share of the room for messages that wait.
type Waiting = (v1::SubmitTasksRequest, OwnedSemaphorePermit);

/// A batch under way.
pub struct Batch<'a> {
    service: &'a TaskService,
    by: &'a Caller,
    reporter: DenialReporter,
    slice: Vec<v1::SubmitTaskRequest>,
    /// Ids that items of the slice chose.
    chosen: BTreeSet<String>,
    results: Vec<v1::SubmitTaskResult>,
}

impl<'a> Batch<'a> {
    /// An empty one of this caller; what it may not is told there.
    pub fn new(service: &'a TaskService, by: &'a Caller, reporter: DenialReporter) -> Self {
        Self { service, by, reporter, slice: Vec::new(), chosen: BTreeSet::new(), results: Vec::new() }
    }

    /// Reads `stream` to its end and commits every item; one result an item.
    ///
    /// # Errors
    /// The first one, after what was sent before it is committed.
    pub async fn run(
        mut self,
        stream: impl Stream<Item = Result<v1::SubmitTasksRequest, Status>> + Unpin,
    ) -> Result<Vec<v1::SubmitTaskResult>, Broken> {
        let (queue, waiting) = mpsc::channel(limits::SUBMIT_ITEMS_MAX);
        let commits = async {
            let outcome = self.commit_each(waiting).await;
            self.flush().await;
            outcome
        };
        let (read, committed) = tokio::join!(read_ahead(stream, queue), commits);
        committed.map_err(Broken::Refused)?;
        read.map_err(Broken::Stream)?;
        Ok(self.results)
    }

    async fn commit_each(&mut self, mut waiting: mpsc::Receiver<Waiting>) -> Result<(), Refusal> {
        while let Some((message, room)) = waiting.recv().await {
            drop(room);
            self.take_item(message.item.unwrap_or_default()).await?;
        }
        Ok(())
    }

    /// Takes the next item; what came before is committed first if the slice is full or the item names it.
    async fn take_item(&mut self, request: v1::SubmitTaskRequest) -> Result<(), Refusal> {
        if self.results.len() + self.slice.len() >= limits::SUBMIT_ITEMS_MAX {
            return Err(Refusal::field("item", "at most 10000 a call; what came before was admitted"));
        }
        let depends = named_ids(&request).any(|id| !id.is_empty() && self.chosen.contains(id));
        if depends || self.slice.len() == limits::SUBMIT_SLICE {
            self.flush().await;
        }
        self.chosen.insert(chosen_id(&request).to_owned());
        self.slice.push(request);
        Ok(())
    }

    async fn flush(&mut self) {
        self.chosen.clear();
        let slice = std::mem::take(&mut self.slice);
        let ids: Vec<String> = slice.iter().map(|r| r.request_id.clone()).collect();
        let mut prepared = Vec::with_capacity(slice.len());
        for request in slice {
            prepared.push(self.prepare(request).await);
            // The reader of this batch runs between two items, even where no read of the store waits.
            tokio::task::consume_budget().await;
        }
        let items = prepared.iter().filter_map(|p| match p {
            Ok(Prepared::New(admission)) => Some(admission.item.clone()),
            _ => None,
        });
        let items: Vec<_> = items.collect();
        let committed = if items.is_empty() { Vec::new() } else { self.service.commit(items).await };
        let mut committed = committed.into_iter();
        for (request_id, prepared) in ids.into_iter().zip(prepared) {
            let outcome = match prepared {
                Err(refusal) => Err(refusal),
                Ok(Prepared::Known(task_id)) => Ok(Durable::Known(task_id)),
                Ok(Prepared::New(admission)) => match committed.next() {
                    None => Err(no_result()),
                    Some(result) => match self.service.settle(*admission, result, self.by).await {
                        Ok(Admitted::Durable(durable)) => Ok(durable),
                        Ok(Admitted::Again(next)) => self.service.admit(*next, self.by).await,
                        Err(refusal) => Err(refusal),
                    },
                },
            };
            let outcome = outcome.inspect_err(|refusal| self.reporter.report(refusal));
            let notes = match &outcome {
                // The task is durable, whether or not the rows of its robot can be read now.
                Ok(Durable::New(intake)) => self.service.notes(&intake.spec.robot_id).await.unwrap_or_default(),
                Ok(Durable::Known(_)) | Err(_) => Vec::new(),
            };
            self.results.push(result_of(request_id, outcome, &notes));
        }
    }

    async fn prepare(&self, request: v1::SubmitTaskRequest) -> Result<Prepared, Refusal> {
        if request.request_id.is_empty() {
            return Err(Refusal::field("request_id", "is required in a batch, so that it can be sent again"));
        }
        if request.validate_only {
            return Err(Refusal::field("validate_only", "is not for a batch"));
        }
        self.service.prepare(request, self.by).await
    }
}

/// Reads messages until the stream ends or breaks, at most [`limits::SUBMIT_AHEAD_BYTES`] ahead of what is committed.
async fn read_ahead(
    mut stream: impl Stream<Item = Result<v1::SubmitTasksRequest, Status>> + Unpin,
    queue: mpsc::Sender<Waiting>,
) -> Result<(), Status> {
    let room = Arc::new(Semaphore::new(limits::SUBMIT_AHEAD_BYTES as usize));
    loop {
        let message = tokio::select! {
            message = stream.next() => message.transpose()?,
            // The batch was refused: nobody waits for what its sender may still say.
            () = queue.closed() => break,
        };
        let Some(message) = message else { break };
        let bytes = u32::try_from(message.encoded_len()).unwrap_or(u32::MAX).min(limits::SUBMIT_AHEAD_BYTES);
        let Ok(permit) = room.clone().acquire_many_owned(bytes).await else { break };
        if queue.send((message, permit)).await.is_err() {
            break;
        }
    }
    Ok(())
}

/// The id a request asks for; empty: none.
/// Ids of tasks that a request names: they are to be there before it.
fn named_ids(request: &v1::SubmitTaskRequest) -> impl Iterator<Item = &String> {
    let (depends_on, same_robot_as) = match &request.body {
        Some(Body::Spec(spec)) => (spec.depends_on.as_slice(), Some(&spec.same_robot_as)),
        Some(Body::Flat(flat)) => (&[][..], Some(&flat.same_robot_as)),
        Some(Body::Nested(nested)) => (&[][..], Some(&nested.same_robot_as)),
        Some(Body::Typed(typed)) => (typed.depends_on.as_slice(), Some(&typed.same_robot_as)),
        None => (&[][..], None),
    };
    depends_on.iter().chain(same_robot_as)
}

fn chosen_id(request: &v1::SubmitTaskRequest) -> &str {
    match &request.body {
        _ if !request.task_id.is_empty() => &request.task_id,
        Some(Body::Flat(flat)) => &flat.task_id,
        Some(Body::Nested(nested)) => &nested.task_id,
        Some(Body::Typed(typed)) => &typed.task_id,
        Some(Body::Spec(_)) | None => "",
    }
}

fn result_of(request_id: String, outcome: Result<Durable, Refusal>, notes: &[Reason]) -> v1::SubmitTaskResult {
    let outcome = match outcome {
        Ok(durable) => Outcome::TaskId(durable.task_id().to_string()),
        Err(refusal) => {
            crate::count(&refusal);
            let violations = refusal.violations.into_iter();
            Outcome::Refusal(v1::SubmitTaskRefusal {
                reason: Some(shown(&refusal.reason)),
                violations: violations.map(|v| FieldViolation { field: v.field, description: v.description }).collect(),
            })
        }
    };
    v1::SubmitTaskResult { request_id, outcome: Some(outcome), notes: notes.iter().map(shown).collect() }
}
