//! Largest legal messages over a real port, what is larger, and as many batches at once as one connection takes.

use crate::harness::Server;
use anyhow::Context;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_proto::refusal_of;
use midshift_proto::task::v1::submit_task_request::Body;
use midshift_proto::task::v1::{Action, FlatTask, Step, SubmitTaskRequest, SubmitTasksRequest, TaskSpec, step};
use prost_types::{ListValue, Struct, Value, value::Kind};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tonic::codec::CompressionEncoding;

/// Parameters of about so many bytes as JSON, in the form that is largest on the wire: a list of numbers.
fn params(bytes: usize) -> Struct {
    let zero = || Value { kind: Some(Kind::NumberValue(0.0)) };
    // `{"n":[0,0]}`: two bytes a number.
    let values = (0..(bytes - 8) / 2).map(|_| zero()).collect();
    let list = Value { kind: Some(Kind::ListValue(ListValue { values })) };
    Struct { fields: [("n".to_owned(), list)].into() }
}

/// The reason of a RESOURCE_EXHAUSTED.
fn exhausted(status: &Status) -> Option<Code> {
    assert_eq!(status.code(), tonic::Code::ResourceExhausted, "{status}");
    refusal_of(status).code
}

fn step(kind: step::Kind) -> Step {
    Step { kind: Some(kind), ..Default::default() }
}

fn largest(params_bytes: usize) -> SubmitTaskRequest {
    let each = params(params_bytes);
    let action = |n: usize| {
        let name = format!("scan-{n:0>59}");
        step(step::Kind::Action(Action { name, params: (n < 4).then(|| each.clone()) }))
    };
    let label = |n: usize| (format!("k{n:0>62}"), "v".repeat(63));
    let spec = TaskSpec {
        r#type: "transport".to_owned(),
        timeout: Some(prost_types::Duration { seconds: 600, nanos: 0 }),
        steps: (0..limits::STEPS_MAX).map(action).collect(),
        labels: (0..limits::LABELS_MAX).map(label).collect(),
        ..Default::default()
    };
    SubmitTaskRequest { request_id: "largest".into(), body: Some(Body::Spec(spec)), ..Default::default() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_largest_legal_task_is_taken_and_a_larger_message_hears_why_it_is_not() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let server = Server::start(dir.path()).await?;
    let mut tasks = server.tasks()?;
    let task = tasks.submit_task(largest(limits::PARAMS_BYTES_MAX)).await?.into_inner().task;
    assert_eq!(task.context("a task")?.spec.map(|spec| spec.steps.len()), Some(limits::STEPS_MAX));
    let told = tasks.submit_task(largest(20 * limits::PARAMS_BYTES_MAX)).await.expect_err("too large");
    assert_eq!(exhausted(&told), Some(Code::MessageTooLarge));
    let items = tokio_stream::iter([SubmitTasksRequest { item: Some(largest(20 * limits::PARAMS_BYTES_MAX)) }]);
    let told = tasks.submit_tasks(items).await.expect_err("too large");
    assert_eq!(exhausted(&told), Some(Code::MessageTooLarge));
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_in_gzip_is_taken_and_one_that_grows_too_large_hears_why_it_is_not() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let server = Server::start(dir.path()).await?;
    let mut tasks = server.tasks()?.send_compressed(CompressionEncoding::Gzip);
    let task = tasks.submit_task(largest(limits::PARAMS_BYTES_MAX)).await?.into_inner().task;
    assert_eq!(task.context("a task")?.spec.map(|spec| spec.steps.len()), Some(limits::STEPS_MAX));
    let told = tasks.submit_task(largest(20 * limits::PARAMS_BYTES_MAX)).await.expect_err("too large");
    assert_eq!(exhausted(&told), Some(Code::MessageTooLarge));
    assert!(told.message().contains("once it is decompressed"), "{told}");
    Ok(())
}

fn small(request_id: String) -> SubmitTasksRequest {
    let flat = FlatTask {
        task_type: "transport".into(),
        to_waypoint: "B03".into(),
        timeout_seconds: Some(600),
        ..Default::default()
    };
    let item = SubmitTaskRequest { request_id, body: Some(Body::Flat(flat)), ..Default::default() };
    SubmitTasksRequest { item: Some(item) }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn as_many_batches_at_once_as_one_connection_takes_are_admitted_and_one_more_is_refused() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let server = Server::start(dir.path()).await?;
    let tasks = server.tasks()?;
    let mut batches = JoinSet::new();
    let mut open = Vec::new();
    for batch in 0..limits::BATCHES_PER_CONNECTION_MAX {
        // One message at a time, so that each goes in a frame of its own.
        let (items, stream) = mpsc::channel(1);
        let mut tasks = tasks.clone();
        batches.spawn(async move { tasks.submit_tasks(ReceiverStream::new(stream)).await });
        items.send(small(format!("{batch}-0"))).await?;
        open.push(items);
    }
    let mut all = JoinSet::new();
    for (batch, items) in open.into_iter().enumerate() {
        all.spawn(async move {
            for n in 1..limits::SUBMIT_ITEMS_MAX - 1 {
                items.send(small(format!("{batch}-{n}"))).await?;
            }
            anyhow::Ok((batch, items))
        });
    }
    let mut open = Vec::new();
    while let Some(sent) = all.join_next().await {
        open.push(sent??);
    }
    // All of them still wait for their last item.
    let more = tokio_stream::iter([small("more".into())]);
    let told = tasks.clone().submit_tasks(more).await.expect_err("one too many");
    assert_eq!(exhausted(&told), Some(Code::TooManyRequests));
    for (batch, items) in open {
        items.send(small(format!("{batch}-last"))).await?;
    }
    while let Some(answer) = batches.join_next().await {
        assert_eq!(answer??.into_inner().results.len(), limits::SUBMIT_ITEMS_MAX);
    }
    Ok(())
}
