//! The gRPC face of releases: decode, call, encode. That of bytes is in `downloads`.

use crate::content::{Completeness, FileRef};
use crate::pages;
use crate::refusal::{self, answer, status};
use crate::repository::Act;
use crate::service::OtaService;
use bytes::Bytes;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::COMPONENT_BYTES_MAX;
use midshift_core::identity::Caller;
use midshift_core::limits;
use midshift_core::reason::{Refusal, Violations};
use midshift_proto::access::caller;
use midshift_proto::convert::shown;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::bundle_service_server::BundleService as BundleFace;
use tonic::{Request, Response, Status, Streaming};

/// Which file a request means, and everything that is wrong with that.
fn wanted(digest: &str, length: u64) -> Result<FileRef, Refusal> {
    let mut bad = Violations::default();
    let digest = bad.accept("digest", digest.parse::<Digest>());
    if length == 0 {
        bad.add("length", format!("is required, 1..{COMPONENT_BYTES_MAX}"));
    }
    bad.finish()?;
    if length > COMPONENT_BYTES_MAX {
        return Err(refusal::too_large(length));
    }
    let digest = digest.ok_or_else(|| Refusal::field("digest", "is required"))?;
    Ok(FileRef { digest, length })
}

impl OtaService {
    async fn upload_state(&self, r: v1::GetUploadRequest) -> Result<v1::GetUploadResponse, Refusal> {
        let opened = self.opened()?;
        let file = wanted(&r.digest, r.length)?;
        let held = opened.content.settle(file).await?;
        Ok(v1::GetUploadResponse { durable_bytes: durable(held, file), is_complete: held == Completeness::Whole })
    }

    /// Takes one piece; the file is what the first one named.
    async fn piece(&self, file: FileRef, message: v1::UploadTargetRequest) -> Result<(), Refusal> {
        if message.data.len() > limits::UPLOAD_PIECE_BYTES {
            let most = limits::UPLOAD_PIECE_BYTES;
            return Err(Refusal::field("data", format!("has {} bytes, at most {most}", message.data.len())));
        }
        if message.data.is_empty() {
            return Ok(());
        }
        let (opened, data) = (self.opened()?, Bytes::from(message.data));
        Ok(opened.content.append(file, message.offset, data).await?)
    }

    async fn uploaded(&self, file: FileRef) -> Result<v1::UploadTargetResponse, Refusal> {
        let held = self.opened()?.content.settle(file).await?;
        Ok(v1::UploadTargetResponse { durable_bytes: durable(held, file), is_complete: held == Completeness::Whole })
    }

    async fn publish(
        &self,
        r: v1::PublishRepositoryRequest,
        by: &Caller,
    ) -> Result<v1::PublishRepositoryResponse, Refusal> {
        let opened = self.opened()?;
        let act = Act { by: by.into(), at: opened.now() };
        let newest = opened.repository.publish(r.roots, r.targets, r.expected_targets_version, act).await?;
        let (root_version, targets_version) = (newest.root.edition.version, newest.targets.edition.version);
        tracing::info!(root_version, targets_version, bundles = newest.releases.len(), "a release was published");
        Ok(v1::PublishRepositoryResponse { root_version, targets_version })
    }

    async fn list(&self, r: &v1::ListBundlesRequest) -> Result<v1::ListBundlesResponse, Refusal> {
        let opened = self.opened()?;
        opened.repository.documents().look_if_possible().await;
        let newest = opened.repository.newest();
        let releases = newest.as_ref().map(|newest| newest.releases.as_slice()).unwrap_or_default();
        let encoded_bytes = newest.as_ref().map_or(0, |newest| newest.encoded_bytes());
        let room = pages::room(opened.content.fill(), encoded_bytes, opened.collector.newest());
        let page = pages::page(releases, room, r).map_err(|bad| Refusal::invalid(bad.0))?;
        let keyless = opened.repository.directive_key().err().map(|keyless| shown(&keyless.reason()));
        Ok(v1::ListBundlesResponse { keyless, ..page })
    }
}

fn durable(held: Completeness, file: FileRef) -> u64 {
    match held {
        Completeness::Whole => file.length,
        Completeness::Part(bytes) => bytes,
    }
}

#[tonic::async_trait]
impl BundleFace for OtaService {
    async fn get_upload(&self, r: Request<v1::GetUploadRequest>) -> Result<Response<v1::GetUploadResponse>, Status> {
        answer(self.upload_state(r.into_inner()).await)
    }
    async fn upload_target(
        &self,
        r: Request<Streaming<v1::UploadTargetRequest>>,
    ) -> Result<Response<v1::UploadTargetResponse>, Status> {
        let mut stream = r.into_inner();
        self.opened().map_err(|refusal| status(&refusal))?;
        let first = stream.message().await?.unwrap_or_default();
        let file = wanted(&first.digest, first.length).map_err(|refusal| status(&refusal))?;
        let mut next = Some(first);
        while let Some(message) = next {
            self.piece(file, message).await.map_err(|refusal| status(&refusal))?;
            next = stream.message().await?;
        }
        answer(self.uploaded(file).await)
    }
    async fn publish_repository(
        &self,
        r: Request<v1::PublishRepositoryRequest>,
    ) -> Result<Response<v1::PublishRepositoryResponse>, Status> {
        let by = caller(&r);
        answer(self.publish(r.into_inner(), &by).await)
    }
    async fn get_metadata(
        &self,
        r: Request<v1::GetMetadataRequest>,
    ) -> Result<Response<v1::GetMetadataResponse>, Status> {
        answer(self.downloads().metadata(r.into_inner()).await)
    }
    async fn list_bundles(
        &self,
        r: Request<v1::ListBundlesRequest>,
    ) -> Result<Response<v1::ListBundlesResponse>, Status> {
        answer(self.list(&r.into_inner()).await)
    }
}

#[cfg(test)]
mod tests;
