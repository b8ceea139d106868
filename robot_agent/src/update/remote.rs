//! The server's repository over gRPC, on the bulk connection: metadata and bytes never stand before a heartbeat.
//!
//! Invariant: a piece is handed on only if it follows the one before and arrived as it was sent. Called by
//! [`super::io`].

use super::io::{DownloadPlan, Pieces, Remote};
use crate::sets::FileRef;
use crate::transport::bulk::{Bulk, Lease, SILENCE, silent};
use async_trait::async_trait;
use midshift_bundle::digest::Digest;
use midshift_bundle::trust::METADATA_BYTES_MAX;
use midshift_core::limits;
use midshift_proto::chunk;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::chunk_service_client::ChunkServiceClient;
use midshift_proto::ota::v1::{
    Encoding, FetchChunksRequest, FetchChunksResponse, GetEncodingRequest, GetEncodingResponse, GetMetadataRequest,
};
use std::io;
use std::ops::Range;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use tokio::time::Sleep;
use tokio_stream::Stream;
use tonic::{Code, Streaming};

/// What gRPC puts around a document, bytes.
const AROUND_BYTES: usize = 1024;

/// The repository of a server.
#[derive(Debug)]
pub struct GrpcRemote {
    bulk: Bulk,
}

impl GrpcRemote {
    /// Over this connection; it is not made before the first question.
    pub fn new(bulk: Bulk) -> Self {
        Self { bulk }
    }
}

#[async_trait]
impl Remote for GrpcRemote {
    async fn metadata(&self, name: &str) -> io::Result<Option<Vec<u8>>> {
        let lease = self.bulk.lease().await?;
        let most = METADATA_BYTES_MAX as usize + AROUND_BYTES;
        let mut client = BundleServiceClient::new(lease.channel.clone()).max_decoding_message_size(most);
        let request = GetMetadataRequest { name: name.to_owned() };
        match tokio::time::timeout(SILENCE, client.get_metadata(request)).await {
            Ok(Ok(answer)) => Ok(Some(answer.into_inner().document)),
            Ok(Err(status)) if status.code() == Code::NotFound => Ok(None),
            Ok(Err(status)) => Err(lease.refused(&status)),
            Err(_) => {
                lease.spoil();
                Err(silent())
            }
        }
    }

    async fn plan_download(&self, wanted: &FileRef, bases: &[Digest]) -> io::Result<DownloadPlan> {
        let lease = self.bulk.lease().await?;
        let base_digests = bases.iter().take(limits::ENCODING_BASES_MAX).map(Digest::to_string).collect();
        let request = GetEncodingRequest { digest: wanted.digest.to_string(), base_digests };
        let mut client = ChunkServiceClient::new(lease.channel.clone());
        match tokio::time::timeout(SILENCE, client.get_encoding(request)).await {
            Ok(Ok(answer)) => Ok(download_plan(&answer.into_inner())),
            // A server from before, or one that cannot: the file says itself whether it is there.
            Ok(Err(status)) if matches!(status.code(), Code::Unimplemented | Code::NotFound) => {
                Ok(DownloadPlan::AsItIs)
            }
            Ok(Err(status)) => Err(lease.refused(&status)),
            Err(_) => {
                lease.spoil();
                Err(silent())
            }
        }
    }

    async fn range(&self, digest: &Digest, range: Range<u64>) -> io::Result<Pieces> {
        let lease = self.bulk.lease().await?;
        let length = range.end.saturating_sub(range.start);
        let request = FetchChunksRequest { digest: digest.to_string(), offset: range.start, length };
        let mut client = ChunkServiceClient::new(lease.channel.clone());
        match tokio::time::timeout(SILENCE, client.fetch_chunks(request)).await {
            Ok(Ok(answers)) => Ok(Box::pin(Chunks {
                answers: answers.into_inner(),
                at: range.start,
                end: range.end,
                silence: None,
                lease: Some(lease),
            })),
            Ok(Err(status)) => Err(lease.refused(&status)),
            Err(_) => {
                lease.spoil();
                Err(silent())
            }
        }
    }
}

/// What an answer says; one that makes no sense is none.
fn download_plan(answer: &GetEncodingResponse) -> DownloadPlan {
    let encoded = |digest: Digest| FileRef { digest, length: answer.encoded_length };
    let base = match answer.encoding() {
        Encoding::Zstd => Ok(None),
        Encoding::ZstdPatch => answer.base_digest.parse().map(Some),
        Encoding::Identity | Encoding::Unspecified => return DownloadPlan::AsItIs,
    };
    match (base, answer.encoded_digest.parse().map(encoded)) {
        (Ok(base), Ok(encoded)) => DownloadPlan::Shorter { base, encoded },
        _ => DownloadPlan::AsItIs,
    }
}

/// Pieces of one range as they come.
struct Chunks {
    answers: Streaming<FetchChunksResponse>,
    /// Where the next one begins.
    at: u64,
    end: u64,
    /// Since the last one, while it is waited for: a reader that takes its time is not the server's silence.
    silence: Option<Pin<Box<Sleep>>>,
    /// None: it is over.
    lease: Option<Lease>,
}

impl Stream for Chunks {
    type Item = io::Result<Vec<u8>>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        let Some(lease) = &this.lease else { return Poll::Ready(None) };
        let answer = match Pin::new(&mut this.answers).poll_next(cx) {
            Poll::Ready(answer) => answer.map(|answer| answer.map_err(|status| lease.refused(&status))),
            Poll::Pending => {
                ready!(this.silence.get_or_insert_with(|| Box::pin(tokio::time::sleep(SILENCE))).as_mut().poll(cx));
                Some(Err(silent()))
            }
        };
        this.silence = None;
        let piece = match answer {
            Some(answer) => Some(answer.and_then(|piece| this.judge(piece))),
            None if this.at == this.end => None,
            None => Some(Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the bytes ended early"))),
        };
        if let (Some(Err(_)), Some(lease)) = (&piece, &this.lease) {
            lease.spoil();
        }
        if !matches!(piece, Some(Ok(_))) {
            this.lease = None;
        }
        Poll::Ready(piece)
    }
}

impl Chunks {
    /// The bytes of a piece, if it is the next one and whole.
    fn judge(&mut self, piece: FetchChunksResponse) -> io::Result<Vec<u8>> {
        let wrong = |what: &str| Err(io::Error::new(io::ErrorKind::InvalidData, what));
        if piece.offset != self.at || piece.data.is_empty() {
            return wrong("a piece does not follow the one before");
        }
        if piece.data.len() as u64 > self.end - self.at {
            return wrong("more bytes than were asked for");
        }
        if !chunk::is_whole(&piece) {
            return wrong("a piece was broken on its way");
        }
        self.at += piece.data.len() as u64;
        Ok(piece.data)
    }
}
