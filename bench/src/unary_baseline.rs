//! Raw limits of the transport: bare tonic services that take the same messages as midshift and do nothing with them.
//!
//! Invariant: nothing is checked, kept or counted beyond what the measurement asks for. Called by children only.

use midshift_proto::task::v1;
use midshift_proto::task::v1::task_service_server::{TaskService, TaskServiceServer};
use prost::Message;
use std::net::SocketAddr;
use std::path::Path;
use tokio::net::TcpListener;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Server;
use tonic::{Request, Response, Status, Streaming};

/// Answers every SubmitTask with the same message.
struct Unary(v1::SubmitTaskResponse);

/// Serves the bare unary call until `stop`; `answer` holds the encoded response.
pub async fn serve(answer: &Path, address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    let answer = v1::SubmitTaskResponse::decode(std::fs::read(answer)?.as_slice())?;
    let listener = TcpListener::bind(address).await?;
    Server::builder()
        .add_service(TaskServiceServer::new(Unary(answer)))
        .serve_with_incoming_shutdown(crate::listen::nodelay(listener), stop.cancelled_owned())
        .await?;
    Ok(())
}

fn not_here<T>() -> Result<Response<T>, Status> {
    Err(Status::unimplemented("only SubmitTask"))
}

#[tonic::async_trait]
impl TaskService for Unary {
    type WatchTasksStream = ReceiverStream<Result<v1::WatchTasksResponse, Status>>;

    async fn submit_task(&self, _: Request<v1::SubmitTaskRequest>) -> Result<Response<v1::SubmitTaskResponse>, Status> {
        Ok(Response::new(self.0.clone()))
    }
    async fn submit_tasks(
        &self,
        _: Request<Streaming<v1::SubmitTasksRequest>>,
    ) -> Result<Response<v1::SubmitTasksResponse>, Status> {
        not_here()
    }
    async fn get_task(&self, _: Request<v1::GetTaskRequest>) -> Result<Response<v1::GetTaskResponse>, Status> {
        not_here()
    }
    async fn list_tasks(&self, _: Request<v1::ListTasksRequest>) -> Result<Response<v1::ListTasksResponse>, Status> {
        not_here()
    }
    async fn cancel_task(&self, _: Request<v1::CancelTaskRequest>) -> Result<Response<v1::CancelTaskResponse>, Status> {
        not_here()
    }
    async fn resolve_task(
        &self,
        _: Request<v1::ResolveTaskRequest>,
    ) -> Result<Response<v1::ResolveTaskResponse>, Status> {
        not_here()
    }
    async fn update_task(&self, _: Request<v1::UpdateTaskRequest>) -> Result<Response<v1::UpdateTaskResponse>, Status> {
        not_here()
    }
    async fn hold_task(&self, _: Request<v1::HoldTaskRequest>) -> Result<Response<v1::HoldTaskResponse>, Status> {
        not_here()
    }
    async fn release_task(
        &self,
        _: Request<v1::ReleaseTaskRequest>,
    ) -> Result<Response<v1::ReleaseTaskResponse>, Status> {
        not_here()
    }
    async fn list_task_types(
        &self,
        _: Request<v1::ListTaskTypesRequest>,
    ) -> Result<Response<v1::ListTaskTypesResponse>, Status> {
        not_here()
    }
    async fn put_task_type(
        &self,
        _: Request<v1::PutTaskTypeRequest>,
    ) -> Result<Response<v1::PutTaskTypeResponse>, Status> {
        not_here()
    }
    async fn delete_task_type(
        &self,
        _: Request<v1::DeleteTaskTypeRequest>,
    ) -> Result<Response<v1::DeleteTaskTypeResponse>, Status> {
        not_here()
    }
    async fn put_task_type_rules(
        &self,
        _: Request<v1::PutTaskTypeRulesRequest>,
    ) -> Result<Response<v1::PutTaskTypeRulesResponse>, Status> {
        not_here()
    }
    async fn cancel_tasks(
        &self,
        _: Request<v1::CancelTasksRequest>,
    ) -> Result<Response<v1::CancelTasksResponse>, Status> {
        not_here()
    }
    async fn resolve_tasks(
        &self,
        _: Request<v1::ResolveTasksRequest>,
    ) -> Result<Response<v1::ResolveTasksResponse>, Status> {
        not_here()
    }
    async fn resume_held(&self, _: Request<v1::ResumeHeldRequest>) -> Result<Response<v1::ResumeHeldResponse>, Status> {
        not_here()
    }
    async fn watch_tasks(&self, _: Request<v1::WatchTasksRequest>) -> Result<Response<Self::WatchTasksStream>, Status> {
        not_here()
    }
}
