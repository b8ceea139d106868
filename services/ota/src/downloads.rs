//! Where bytes and documents are handed out, over gRPC to robots and over HTTP to others: from the folder of this process, or of others.
//!
//! Invariant: nothing is written or signed here, and only what the newest signed release lists is handed out. Shorter ways to files are listed like
//! the files: they are made by whoever signs. Bytes are for machines that are enrolled: a genuine certificate alone is none of a robot.

use crate::content::{Content, FileRef};
use crate::integrity::Integrity;
use crate::refusal::{answer, status};
use crate::repository::Documents;
use midshift_bundle::digest::Digest;
use midshift_core::identity::{Caller, Principal, RobotIdentity};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_proto::access::caller;
use midshift_proto::chunk;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::bundle_service_server::{BundleService as BundleFace, BundleServiceServer};
use midshift_proto::ota::v1::chunk_service_server::{ChunkService as ChunkFace, ChunkServiceServer};
use midshift_store::{Store, load};
use std::collections::BTreeSet;
use std::pin::Pin;
use std::sync::Arc;
use tokio_stream::{Stream, StreamExt};
use tokio_util::io::ReaderStream;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;
use tonic::{Request, Response, Status, Streaming};

/// Longest message of the service: all documents of a publication.
const MESSAGE_BYTES: usize = 2 * midshift_bundle::trust::METADATA_BYTES_MAX as usize;

/// What is handed out.
pub struct Shown {
    pub(crate) content: Arc<dyn Content>,
    pub(crate) documents: Documents,
    integrity: Integrity,
}

/// What may be downloaded, and by whom. Cheap to clone. One of a server without keys says so to everybody.
#[derive(Clone, Default)]
pub struct Downloads {
    shown: Option<Arc<Shown>>,
    /// Rows that say which machines are robots. None: nobody is held against any.
    rows: Option<Arc<dyn Store>>,
}

impl Shown {
    /// Whether the newest signed release lists it.
    fn lists(&self, digest: Digest) -> bool {
        self.documents.newest().is_some_and(|newest| newest.lists(digest))
    }
}

impl Downloads {
    pub(crate) fn new(content: Arc<dyn Content>, documents: Documents) -> Self {
        Self { shown: Some(Arc::new(Shown { content, documents, integrity: Integrity::default() })), rows: None }
    }

    /// The same, which gives bytes to those machines alone that these rows know.
    pub(crate) fn with_rows(self, rows: Option<Arc<dyn Store>>) -> Self {
        Self { rows, ..self }
    }

    /// Refuses a machine that shows a certificate of the site and is not enrolled as the robot that it names. Whoever shows none is the port's to judge.
    pub(crate) async fn must_be_enrolled(&self, by: &Caller) -> Result<(), Refusal> {
        let (Some(rows), Principal::Robot(robot_id), Some(key)) = (&self.rows, by.principal(), by.key()) else {
            return Ok(());
        };
        let found = load::<RobotIdentity>(rows.as_ref(), robot_id.as_str()).await;
        let unavailable = |error: midshift_store::Error| {
            Refusal::new(Kind::Unavailable, Reason::new(Code::StoreUnavailable, error.to_string()))
        };
        if found.map_err(unavailable)?.is_some_and(|(robot, _)| robot.has_key(key)) {
            return Ok(());
        }
        Err(Refusal::new(Kind::Denied, Reason::from(Code::RobotNotEnrolled).with("robot_id", robot_id)))
    }

    /// Signed files that were found damaged and that nobody was told of.
    pub(crate) fn damaged(&self) -> BTreeSet<Digest> {
        self.shown.as_ref().map(|shown| shown.integrity.unreported()).unwrap_or_default()
    }

    /// Marks damaged files as reported to people.
    pub(crate) fn mark_damaged_reported(&self, files: &BTreeSet<Digest>) {
        if let Some(shown) = &self.shown {
            shown.integrity.mark_reported(files);
        }
    }

    pub(crate) fn shown(&self) -> Result<&Shown, Refusal> {
        self.shown.as_deref().ok_or_else(|| Refusal::new(Kind::Precondition, Code::NoOnlineKeys))
    }

    /// A document by its name.
    pub(crate) async fn metadata(&self, r: v1::GetMetadataRequest) -> Result<v1::GetMetadataResponse, Refusal> {
        let shown = self.shown()?;
        if r.name.is_empty() {
            return Err(Refusal::field("name", "is required, e.g. timestamp.json"));
        }
        let found = shown.documents.document(&r.name).await?;
        let reason = || Reason::from(Code::SoftwareNotFound).with("name", r.name.chars().take(100).collect::<String>());
        let document = found.ok_or_else(|| Refusal::new(Kind::NotFound, reason()))?;
        Ok(v1::GetMetadataResponse { document })
    }

    /// Which file is meant and how long it is, if a signed release lists it and it is here whole.
    pub(crate) async fn listed(&self, digest: Digest) -> Result<FileRef, Refusal> {
        let shown = self.shown()?;
        let not_found = || Refusal::new(Kind::NotFound, Code::SoftwareNotFound);
        if !shown.lists(digest) {
            // Another process may have published it a moment ago.
            shown.documents.look_if_possible().await;
            if !shown.lists(digest) {
                return Err(not_found());
            }
        }
        let length = shown.content.length(digest).await?.ok_or_else(not_found)?;
        if !shown.integrity.holds(shown.content.as_ref(), digest).await? {
            return Err(not_found());
        }
        Ok(FileRef { digest, length })
    }

    async fn encoding(&self, r: v1::GetEncodingRequest, by: &Caller) -> Result<v1::GetEncodingResponse, Refusal> {
        self.must_be_enrolled(by).await?;
        let shown = self.shown()?;
        let mut bad = Violations::default();
        let digest = bad.accept("digest", r.digest.parse::<Digest>());
        if r.base_digests.len() > limits::ENCODING_BASES_MAX {
            bad.add("base_digests", format!("at most {}", limits::ENCODING_BASES_MAX));
        }
        let bases = r.base_digests.iter().take(limits::ENCODING_BASES_MAX);
        let bases: Vec<Digest> = bases.filter_map(|base| bad.accept("base_digests", base.parse())).collect();
        bad.finish()?;
        let digest = digest.ok_or_else(|| Refusal::field("digest", "is required"))?;
        let file = self.listed(digest).await?;
        let mut answer = v1::GetEncodingResponse { encoding: v1::Encoding::Identity.into(), ..Default::default() };
        if let Some(newest) = shown.documents.newest()
            && let Some((from, shorter)) = newest.find_encoded(file.digest, &bases)
        {
            let kind = if from.is_some() { v1::Encoding::ZstdPatch } else { v1::Encoding::Zstd };
            answer.encoding = kind.into();
            answer.base_digest = from.map(String::from).unwrap_or_default();
            answer.encoded_digest = shorter.digest.to_string();
            answer.encoded_length = shorter.length;
        }
        Ok(answer)
    }

    async fn fetch(&self, r: v1::FetchChunksRequest, by: &Caller) -> Result<Chunks, Refusal> {
        self.must_be_enrolled(by).await?;
        let shown = self.shown()?;
        let mut bad = Violations::default();
        let digest = bad.accept("digest", r.digest.parse::<Digest>());
        if !(1..=limits::CHUNK_RANGE_BYTES).contains(&r.length) {
            bad.add("length", format!("is required, 1..{}", limits::CHUNK_RANGE_BYTES));
        }
        bad.finish()?;
        let digest = digest.ok_or_else(|| Refusal::field("digest", "is required"))?;
        let length = self.listed(digest).await?.length;
        if r.offset >= length {
            return Err(Refusal::field("offset", format!("the file has {length} bytes")));
        }
        let range = r.offset..(r.offset + r.length).min(length);
        let reader = shown.content.read(digest, range).await?;
        let reader = reader.ok_or_else(|| Refusal::new(Kind::NotFound, Code::SoftwareNotFound))?;
        let mut offset = r.offset;
        let stream = ReaderStream::with_capacity(reader, limits::CHUNK_BYTES).map(move |piece| {
            let piece = piece.map_err(|error| {
                tracing::error!(%error, %digest, "a signed file cannot be read");
                status(&Refusal::new(Kind::Internal, Code::Internal))
            })?;
            let chunk = chunk::piece(offset, piece.to_vec());
            offset += piece.len() as u64;
            Ok(chunk)
        });
        Ok(Box::pin(stream))
    }
}

/// What robots ask a gateway for of releases; all else is for the processes that keep them.
#[tonic::async_trait]
impl BundleFace for Downloads {
    async fn get_metadata(
        &self,
        r: Request<v1::GetMetadataRequest>,
    ) -> Result<Response<v1::GetMetadataResponse>, Status> {
        answer(self.metadata(r.into_inner()).await)
    }
    async fn get_upload(&self, _: Request<v1::GetUploadRequest>) -> Result<Response<v1::GetUploadResponse>, Status> {
        elsewhere()
    }
    async fn upload_target(
        &self,
        _: Request<Streaming<v1::UploadTargetRequest>>,
    ) -> Result<Response<v1::UploadTargetResponse>, Status> {
        elsewhere()
    }
    async fn publish_repository(
        &self,
        _: Request<v1::PublishRepositoryRequest>,
    ) -> Result<Response<v1::PublishRepositoryResponse>, Status> {
        elsewhere()
    }
    async fn list_bundles(
        &self,
        _: Request<v1::ListBundlesRequest>,
    ) -> Result<Response<v1::ListBundlesResponse>, Status> {
        elsewhere()
    }
}

fn elsewhere<T>() -> Result<Response<T>, Status> {
    answer(Err(Refusal::new(Kind::Precondition, Code::ServedElsewhere)))
}

/// Pieces of a range on their way to a robot.
type Chunks = Pin<Box<dyn Stream<Item = Result<v1::FetchChunksResponse, Status>> + Send>>;

#[tonic::async_trait]
impl ChunkFace for Downloads {
    type FetchChunksStream = Chunks;

    async fn get_encoding(
        &self,
        r: Request<v1::GetEncodingRequest>,
    ) -> Result<Response<v1::GetEncodingResponse>, Status> {
        let by = caller(&r);
        answer(self.encoding(r.into_inner(), &by).await)
    }

    async fn fetch_chunks(&self, r: Request<v1::FetchChunksRequest>) -> Result<Response<Chunks>, Status> {
        let by = caller(&r);
        answer(self.fetch(r.into_inner(), &by).await)
    }
}

/// With the face of releases.
pub fn add_bundles(face: impl BundleFace, routes: Routes) -> Routes {
    let face = BundleServiceServer::new(face).accept_compressed(CompressionEncoding::Gzip);
    routes.add_service(face.max_decoding_message_size(MESSAGE_BYTES))
}

/// With the face of bytes.
pub fn add_chunks(downloads: Downloads, routes: Routes) -> Routes {
    let face = ChunkServiceServer::new(downloads).accept_compressed(CompressionEncoding::Gzip);
    routes.add_service(face.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
}

#[cfg(test)]
mod tests;
