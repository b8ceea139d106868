//! The gRPC face of the audit: decode, call, encode.

use super::{AuditService, verify};
use midshift_core::identity::Actor;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_proto::access::caller;
use midshift_proto::identity::v1;
use midshift_proto::identity::v1::audit_service_server::AuditService as Face;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

/// Messages on their way to one reader.
const AHEAD: usize = 4;

fn status(refusal: &Refusal) -> Status {
    midshift_proto::status(refusal, None)
}

impl AuditService {
    fn permit(&self) -> Result<OwnedSemaphorePermit, Status> {
        let permit = self.readers.clone().try_acquire_owned();
        permit.map_err(|_| status(&Refusal::new(Kind::Exhausted, Code::Overloaded)))
    }
}

#[tonic::async_trait]
impl Face for AuditService {
    type ExportAuditStream = ReceiverStream<Result<v1::ExportAuditResponse, Status>>;
    type VerifyAuditStream = ReceiverStream<Result<v1::VerifyAuditResponse, Status>>;

    async fn list_audit(&self, r: Request<v1::ListAuditRequest>) -> Result<Response<v1::ListAuditResponse>, Status> {
        self.list(r.into_inner()).await.map(Response::new).map_err(|refusal| status(&refusal))
    }
    async fn export_audit(
        &self,
        request: Request<v1::ExportAuditRequest>,
    ) -> Result<Response<Self::ExportAuditStream>, Status> {
        let (sender, stream) = mpsc::channel(AHEAD);
        let (service, permit, by) = (self.clone(), self.permit()?, Actor::from(&caller(&request)));
        tokio::spawn(async move {
            let export = service.shutdown.run_until_cancelled(service.export(&by, &sender)).await;
            if let Some(Err(refusal)) = export {
                drop(sender.send(Err(status(&refusal))).await);
            } else if export.is_none() {
                drop(sender.send(Err(status(&Refusal::new(Kind::Unavailable, Code::ShuttingDown)))).await);
            }
            drop(permit);
        });
        Ok(Response::new(ReceiverStream::new(stream)))
    }
    async fn verify_audit(
        &self,
        r: Request<v1::VerifyAuditRequest>,
    ) -> Result<Response<Self::VerifyAuditStream>, Status> {
        let noted = verify::noted(r.get_ref()).map_err(|refusal| status(&refusal))?;
        let (sender, stream) = mpsc::channel(AHEAD);
        let (service, permit) = (self.clone(), self.permit()?);
        tokio::spawn(async move {
            let verdict = service.shutdown.run_until_cancelled(service.verify(noted, &sender)).await;
            if let Some(Err(refusal)) = verdict {
                drop(sender.send(Err(status(&refusal))).await);
            } else if verdict.is_none() {
                drop(sender.send(Err(status(&Refusal::new(Kind::Unavailable, Code::ShuttingDown)))).await);
            }
            drop(permit);
        });
        Ok(Response::new(ReceiverStream::new(stream)))
    }
}
