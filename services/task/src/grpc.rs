//! The gRPC face of task intake: decode, call, encode.

use crate::batch::{Batch, Broken};
use crate::{TaskService, rows};
use midshift_core::identity::Caller;
use midshift_core::ids::{RequestId, Subject, TaskId};
use midshift_core::limits;
use midshift_core::reason::{Kind, Refusal};
use midshift_core::rows::Table;
use midshift_core::task::Attempt;
use midshift_proto::DenialReporter;
use midshift_proto::access::caller;
use midshift_proto::task::v1::{self, task_service_server::TaskService as Face};
use midshift_proto::watches::{self, Reader};
use midshift_store::Query;
use tonic::metadata::MetadataMap;
use tonic::{Request, Response, Status, Streaming};

/// Where a caller may name its call, for errors; a request_id in the body goes before it.
const REQUEST_ID_HEADER: &str = "x-request-id";

/// What a call is called in an error: by its body, by its header, or by a number drawn here.
pub struct CallId(String);

impl CallId {
    fn of_request<T>(request: &Request<T>, own: &str) -> Self {
        let named = |text: &str| RequestId::parse(text).is_ok().then(|| text.to_owned());
        let header = |map: &MetadataMap| map.get(REQUEST_ID_HEADER).and_then(|v| named(v.to_str().ok()?));
        let id = named(own).or_else(|| header(request.metadata()));
        Self(id.unwrap_or_else(|| format!("{:016x}", rand::random::<u64>())))
    }
    /// A refusal as a status, counted; our own faults are logged under the id that the caller sees.
    pub fn status(&self, refusal: &Refusal) -> Status {
        crate::count(refusal);
        if refusal.kind() == Kind::Internal {
            tracing::error!(request_id = self.0, code = refusal.reason.code.as_str(), "a call failed by our own fault");
        }
        midshift_proto::status(refusal, Some(&self.0))
    }
    fn answer<T>(&self, result: Result<T, Refusal>) -> Result<Response<T>, Status> {
        result.map(Response::new).map_err(|refusal| self.status(&refusal))
    }
}

impl TaskService {
    async fn get(&self, r: v1::GetTaskRequest, by: &Caller) -> Result<v1::GetTaskResponse, Refusal> {
        let task_id = TaskId::parse(&r.task_id).map_err(|e| Refusal::field("task_id", e.to_string()))?;
        let store = self.store();
        let task = rows::read_for(store, &self.inner.parts.site, by, &task_id).await?;
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
    type WatchTasksStream = Reader<v1::WatchTasksResponse>;

    async fn submit_task(&self, r: Request<v1::SubmitTaskRequest>) -> Result<Response<v1::SubmitTaskResponse>, Status> {
        let id = CallId::of_request(&r, &r.get_ref().request_id);
        let (by, reporter) = (caller(&r), DenialReporter::from_request(&r));
        id.answer(self.submit(r.into_inner(), &by).await.inspect_err(|refusal| reporter.report(refusal)))
    }
    async fn submit_tasks(
        &self,
        r: Request<Streaming<v1::SubmitTasksRequest>>,
    ) -> Result<Response<v1::SubmitTasksResponse>, Status> {
        let (id, by, reporter) = (CallId::of_request(&r, ""), caller(&r), DenialReporter::from_request(&r));
        let results = Batch::new(self, &by, reporter).run(r.into_inner()).await.map_err(|broken| match broken {
            Broken::Stream(status) => status,
            Broken::Refused(refusal) => id.status(&refusal),
        })?;
        Ok(Response::new(v1::SubmitTasksResponse { results }))
    }
    async fn get_task(&self, r: Request<v1::GetTaskRequest>) -> Result<Response<v1::GetTaskResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, ""), caller(&r));
        id.answer(self.get(r.into_inner(), &by).await)
    }
    async fn list_tasks(&self, r: Request<v1::ListTasksRequest>) -> Result<Response<v1::ListTasksResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, ""), caller(&r));
        id.answer(self.list(r.into_inner(), &by).await)
    }
    async fn cancel_task(&self, r: Request<v1::CancelTaskRequest>) -> Result<Response<v1::CancelTaskResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.cancel(r.into_inner(), &by).await)
    }
    async fn resolve_task(
        &self,
        r: Request<v1::ResolveTaskRequest>,
    ) -> Result<Response<v1::ResolveTaskResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.resolve(r.into_inner(), &by).await)
    }
    async fn update_task(&self, r: Request<v1::UpdateTaskRequest>) -> Result<Response<v1::UpdateTaskResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.update(r.into_inner(), &by).await)
    }
    async fn hold_task(&self, r: Request<v1::HoldTaskRequest>) -> Result<Response<v1::HoldTaskResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.hold(r.into_inner(), &by).await)
    }
    async fn release_task(
        &self,
        r: Request<v1::ReleaseTaskRequest>,
    ) -> Result<Response<v1::ReleaseTaskResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.release(r.into_inner(), &by).await)
    }
    async fn cancel_tasks(
        &self,
        r: Request<v1::CancelTasksRequest>,
    ) -> Result<Response<v1::CancelTasksResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.cancel_many(r.into_inner(), &by).await)
    }
    async fn resolve_tasks(
        &self,
        r: Request<v1::ResolveTasksRequest>,
    ) -> Result<Response<v1::ResolveTasksResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.resolve_many(r.into_inner(), &by).await)
    }
    async fn resume_held(&self, r: Request<v1::ResumeHeldRequest>) -> Result<Response<v1::ResumeHeldResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, &r.get_ref().request_id), caller(&r));
        id.answer(self.resume(r.into_inner(), &by).await)
    }
    async fn list_task_types(
        &self,
        r: Request<v1::ListTaskTypesRequest>,
    ) -> Result<Response<v1::ListTaskTypesResponse>, Status> {
        let id = CallId::of_request(&r, "");
        id.answer(self.list_types().await)
    }
    async fn put_task_type(
        &self,
        r: Request<v1::PutTaskTypeRequest>,
    ) -> Result<Response<v1::PutTaskTypeResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, ""), caller(&r));
        id.answer(self.put_type(r.into_inner(), &by).await)
    }
    async fn delete_task_type(
        &self,
        r: Request<v1::DeleteTaskTypeRequest>,
    ) -> Result<Response<v1::DeleteTaskTypeResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, ""), caller(&r));
        id.answer(self.delete_type(r.into_inner(), &by).await)
    }
    async fn put_task_type_rules(
        &self,
        r: Request<v1::PutTaskTypeRulesRequest>,
    ) -> Result<Response<v1::PutTaskTypeRulesResponse>, Status> {
        let (id, by) = (CallId::of_request(&r, ""), caller(&r));
        id.answer(self.put_type_rules(r.into_inner(), &by).await)
    }
    async fn watch_tasks(&self, r: Request<v1::WatchTasksRequest>) -> Result<Response<Self::WatchTasksStream>, Status> {
        let (id, by) = (CallId::of_request(&r, ""), caller(&r));
        let (teller, reader) = watches::watch();
        let watcher = self.watcher(r.into_inner(), by, teller).map_err(|refusal| id.status(&refusal))?;
        tokio::spawn(watcher.run(id));
        Ok(Response::new(reader))
    }
}
