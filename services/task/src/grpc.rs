//! The gRPC face of task intake: decode, call, encode.

use crate::admit::SLICE;
use crate::{TaskService, rows};
use midshift_core::ids::{Subject, TaskId};
use midshift_core::limits;
use midshift_core::reason::Refusal;
use midshift_core::rows::Table;
use midshift_core::task::Attempt;
use midshift_proto::task::v1::{self, task_service_server::TaskService as Face};
use midshift_store::Query;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

/// Messages on their way to one watcher.
const WATCH_MAX: usize = 64;
/// Until login exists nobody is known by name.
const ACTOR: &str = "anonymous";

fn answer<T>(result: Result<T, Refusal>) -> Result<Response<T>, Status> {
    result.map(Response::new).map_err(|refusal| {
        metrics::counter!("midshift_task_refused_total", "code" => refusal.reason.code.as_str()).increment(1);
        midshift_proto::status(&refusal, None)
    })
}

impl TaskService {
    async fn get(&self, r: v1::GetTaskRequest) -> Result<v1::GetTaskResponse, Refusal> {
        let task_id = TaskId::parse(&r.task_id).map_err(|e| Refusal::field("task_id", e.to_string()))?;
        let store = self.inner.parts.store.as_ref();
        let task = rows::read(store, &task_id).await?;
        let query = Query {
            limit: limits::PAGE_MAX,
            ..Query::all(Table::Attempt).of_parent(Subject::Task(task_id).to_string())
        };
        let attempts = store.list(query).await.map_err(rows::unavailable)?;
        let attempts: Result<Vec<Attempt>, _> = attempts.iter().map(|row| row.decode()).collect();
        let attempts = attempts.map_err(rows::unavailable)?.iter().map(Into::into).collect();
        Ok(v1::GetTaskResponse { task: Some(task.encode()), attempts })
    }
}

#[tonic::async_trait]
impl Face for TaskService {
    type WatchTasksStream = ReceiverStream<Result<v1::WatchTasksResponse, Status>>;

    async fn submit_task(&self, r: Request<v1::SubmitTaskRequest>) -> Result<Response<v1::SubmitTaskResponse>, Status> {
        let task = self.submit(r.into_inner(), ACTOR).await;
        answer(task.map(|task| v1::SubmitTaskResponse { task: Some(task) }))
    }
    async fn submit_tasks(
        &self,
        r: Request<Streaming<v1::SubmitTasksRequest>>,
    ) -> Result<Response<v1::SubmitTasksResponse>, Status> {
        let mut stream = r.into_inner();
        let (mut results, mut slice) = (Vec::new(), Vec::new());
        while let Some(message) = stream.message().await? {
            if results.len() + slice.len() >= limits::SUBMIT_ITEMS_MAX {
                return answer(Err(Refusal::field("item", "at most 10000 a call; what came before was admitted")));
            }
            slice.push(message.item.unwrap_or_default());
            if slice.len() == SLICE {
                results.extend(self.submit_slice(std::mem::take(&mut slice), ACTOR).await);
            }
        }
        results.extend(self.submit_slice(slice, ACTOR).await);
        answer(Ok(v1::SubmitTasksResponse { results }))
    }
    async fn get_task(&self, r: Request<v1::GetTaskRequest>) -> Result<Response<v1::GetTaskResponse>, Status> {
        answer(self.get(r.into_inner()).await)
    }
    async fn list_tasks(&self, r: Request<v1::ListTasksRequest>) -> Result<Response<v1::ListTasksResponse>, Status> {
        answer(self.list(r.into_inner()).await)
    }
    async fn cancel_task(&self, r: Request<v1::CancelTaskRequest>) -> Result<Response<v1::CancelTaskResponse>, Status> {
        answer(self.cancel(r.into_inner()).await)
    }
    async fn resolve_task(
        &self,
        r: Request<v1::ResolveTaskRequest>,
    ) -> Result<Response<v1::ResolveTaskResponse>, Status> {
        answer(self.resolve(r.into_inner()).await)
    }
    async fn resume_held(&self, r: Request<v1::ResumeHeldRequest>) -> Result<Response<v1::ResumeHeldResponse>, Status> {
        answer(self.resume(r.into_inner()).await)
    }
    async fn watch_tasks(&self, r: Request<v1::WatchTasksRequest>) -> Result<Response<Self::WatchTasksStream>, Status> {
        let (sender, stream) = mpsc::channel(WATCH_MAX);
        match self.watcher(r.into_inner(), sender) {
            Ok((watcher, from_now)) => {
                tokio::spawn(watcher.run(from_now));
                Ok(Response::new(ReceiverStream::new(stream)))
            }
            Err(refusal) => Err(midshift_proto::status(&refusal, None)),
        }
    }
}
