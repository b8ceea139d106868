//! Metadata and bytes over gRPC, from a server that the test plays, over pipes in memory on tokio's paused clock and
//! once over TCP.

use crate::release::{Bundle, Releases};
use async_trait::async_trait;
use hyper_util::rt::TokioIo;
use midshift_agent::bulk::{Bulk, IDLE, SILENCE};
use midshift_agent::dial::{self, Dial, TcpDial};
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::sets::{CHUNK_BYTES, FileRef, Sets};
use midshift_agent::update::io::{DownloadPlan, Remote, UpdateWorker, Worker};
use midshift_agent::update::remote::GrpcRemote;
use midshift_agent::update::{Done, Failure, Job};
use midshift_bundle::digest::Digest;
use midshift_proto::chunk;
use midshift_proto::ota::v1::bundle_service_server::{BundleService, BundleServiceServer};
use midshift_proto::ota::v1::chunk_service_server::{ChunkService, ChunkServiceServer};
use midshift_proto::ota::v1::{
    Encoding, FetchChunksRequest, FetchChunksResponse, GetEncodingRequest, GetEncodingResponse, GetMetadataRequest,
    GetMetadataResponse, GetUploadRequest, GetUploadResponse, ListBundlesRequest, ListBundlesResponse,
    PublishRepositoryRequest, PublishRepositoryResponse, UploadTargetRequest, UploadTargetResponse,
};
use std::io::ErrorKind;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use tokio::io::{AsyncRead, AsyncWrite, DuplexStream, ReadBuf};
use tokio::sync::{mpsc, watch};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tokio_util::sync::CancellationToken;
use tonic::transport::server::Router;
use tonic::transport::{Channel, Server, Uri};
use tonic::{Request, Response, Status, Streaming};

/// Bytes of a piece: no chunk ends where a piece ends.
const PIECE_BYTES: usize = 100_000;

/// What is wrong with the server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Wrong {
    #[default]
    Nothing,
    /// The second piece has another byte than its check says.
    Broken,
    /// The second piece comes before the first.
    Order,
    /// The first piece comes twice.
    Twice,
    /// The last piece is longer than was asked for.
    Longer,
    /// The third piece is empty.
    Empty,
    /// After three pieces the stream ends well.
    Early,
    /// After three pieces the stream ends with a status.
    Breaks,
    /// After three pieces nothing comes any more.
    Silent,
    /// Every call is refused.
    Refuses,
    /// It knows no encoded targets.
    Old,
}

/// A server with the releases of the bench.
#[derive(Clone)]
pub struct Shop {
    pub releases: Releases,
    wrong: Arc<Mutex<Wrong>>,
    /// What it says of ways, and what it was asked.
    encoding: Arc<Mutex<GetEncodingResponse>>,
    asked: Arc<Mutex<Vec<GetEncodingRequest>>>,
}

impl Shop {
    pub fn new() -> Self {
        Self { releases: Releases::new(), wrong: Arc::default(), encoding: Arc::default(), asked: Arc::default() }
    }
    fn is(&self, wrong: Wrong) -> bool {
        *self.wrong.lock().expect("not poisoned") == wrong
    }
    pub fn router(&self) -> Router {
        Server::builder()
            .add_service(BundleServiceServer::new(self.clone()))
            .add_service(ChunkServiceServer::new(self.clone()))
    }
    /// Pieces of a range as a server that is so wrong sends them.
    fn pieces(&self, mut pieces: Vec<FetchChunksResponse>) -> Vec<Result<FetchChunksResponse, Status>> {
        match *self.wrong.lock().expect("not poisoned") {
            Wrong::Nothing | Wrong::Refuses | Wrong::Old => {}
            Wrong::Broken => pieces[1].data[7] ^= 1,
            Wrong::Order => pieces.swap(0, 1),
            Wrong::Twice => pieces.insert(1, pieces[0].clone()),
            Wrong::Longer => {
                let last = pieces.pop().expect("has pieces");
                pieces.push(chunk::piece(last.offset, [last.data, vec![0]].concat()));
            }
            Wrong::Empty => pieces.insert(2, chunk::piece(pieces[2].offset, Vec::new())),
            Wrong::Early | Wrong::Breaks | Wrong::Silent => pieces.truncate(3),
        }
        let breaks = self.is(Wrong::Breaks).then(|| Err(Status::unavailable("the server goes down")));
        pieces.into_iter().map(Ok).chain(breaks).collect()
    }
}

type Answer<T> = Result<Response<T>, Status>;

#[async_trait]
impl BundleService for Shop {
    async fn get_metadata(&self, request: Request<GetMetadataRequest>) -> Answer<GetMetadataResponse> {
        if self.is(Wrong::Refuses) {
            return Err(Status::unavailable("the server is going down"));
        }
        let document = self.releases.metadata(&request.into_inner().name).await?;
        let document = document.ok_or_else(|| Status::not_found("no such document"))?;
        Ok(Response::new(GetMetadataResponse { document }))
    }
    async fn get_upload(&self, _: Request<GetUploadRequest>) -> Answer<GetUploadResponse> {
        Err(Status::unimplemented("robots do not upload"))
    }
    async fn upload_target(&self, _: Request<Streaming<UploadTargetRequest>>) -> Answer<UploadTargetResponse> {
        Err(Status::unimplemented("robots do not upload"))
    }
    async fn publish_repository(&self, _: Request<PublishRepositoryRequest>) -> Answer<PublishRepositoryResponse> {
        Err(Status::unimplemented("robots do not publish"))
    }
    async fn list_bundles(&self, _: Request<ListBundlesRequest>) -> Answer<ListBundlesResponse> {
        Err(Status::unimplemented("robots do not list"))
    }
}

#[async_trait]
impl ChunkService for Shop {
    type FetchChunksStream = Pin<Box<dyn tokio_stream::Stream<Item = Result<FetchChunksResponse, Status>> + Send>>;

    async fn get_encoding(&self, request: Request<GetEncodingRequest>) -> Answer<GetEncodingResponse> {
        match *self.wrong.lock().expect("not poisoned") {
            Wrong::Refuses => Err(Status::permission_denied("not for you")),
            Wrong::Old => Err(Status::unimplemented("a server from before")),
            _ => {
                self.asked.lock().expect("not poisoned").push(request.into_inner());
                Ok(Response::new(self.encoding.lock().expect("not poisoned").clone()))
            }
        }
    }

    async fn fetch_chunks(&self, request: Request<FetchChunksRequest>) -> Answer<Self::FetchChunksStream> {
        if self.is(Wrong::Refuses) {
            return Err(Status::permission_denied("not for you"));
        }
        let asked = request.into_inner();
        let digest: Digest = asked.digest.parse().map_err(|_| Status::invalid_argument("no digest"))?;
        let range = asked.offset..asked.offset + asked.length;
        let mut content = self.releases.range(&digest, range).await?;
        let mut bytes = Vec::new();
        while let Some(some) = content.next().await {
            bytes.extend(some?);
        }
        let starts = (asked.offset..).step_by(PIECE_BYTES);
        let pieces = bytes.chunks(PIECE_BYTES).zip(starts).map(|(data, at)| chunk::piece(at, data.to_vec()));
        let pieces = tokio_stream::iter(self.pieces(pieces.collect()));
        let is_silent = self.is(Wrong::Silent);
        Ok(Response::new(if is_silent { Box::pin(pieces.chain(tokio_stream::pending())) } else { Box::pin(pieces) }))
    }
}

/// A robot's end of a pipe, counted while it is open.
struct End {
    pipe: DuplexStream,
    open: watch::Sender<usize>,
}

impl Drop for End {
    fn drop(&mut self) {
        self.open.send_modify(|open| *open -= 1);
    }
}

impl AsyncRead for End {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.pipe).poll_read(cx, buf)
    }
}

impl AsyncWrite for End {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.pipe).poll_write(cx, buf)
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.pipe).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.pipe).poll_shutdown(cx)
    }
}

/// Pipes instead of a network.
struct Pipes {
    ends: mpsc::Sender<std::io::Result<DuplexStream>>,
    open: watch::Sender<usize>,
    dialed: watch::Sender<usize>,
}

#[async_trait]
impl Dial for Pipes {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        let (ends, open, dialed) = (self.ends.clone(), self.open.clone(), self.dialed.clone());
        let connect = tower::service_fn(move |_: Uri| {
            let (ends, open, dialed) = (ends.clone(), open.clone(), dialed.clone());
            async move {
                let (pipe, far) = tokio::io::duplex(16 * 1024);
                ends.send(Ok(far)).await.map_err(std::io::Error::other)?;
                dialed.send_modify(|dialed| *dialed += 1);
                open.send_modify(|open| *open += 1);
                Ok::<_, std::io::Error>(TokioIo::new(End { pipe, open }))
            }
        });
        let endpoint = dial::bulk_endpoint("http://server")?;
        endpoint.connect_with_connector(connect).await.map_err(|e| dial::Error(e.into()))
    }
}

/// A robot and the server of its releases.
struct Bench {
    releases: Releases,
    shop: Shop,
    remote: Arc<GrpcRemote>,
    open: watch::Receiver<usize>,
    dialed: watch::Receiver<usize>,
}

impl Bench {
    fn new() -> Self {
        let shop = Shop::new();
        let (ends, incoming) = mpsc::channel(4);
        tokio::spawn(shop.router().serve_with_incoming(ReceiverStream::new(incoming)));
        let ((open, is_open), (dialed, was_dialed)) = (watch::channel(0), watch::channel(0));
        let remote = Arc::new(GrpcRemote::new(Bulk::new(Arc::new(Pipes { ends, open, dialed }))));
        Self { releases: shop.releases.clone(), shop, remote, open: is_open, dialed: was_dialed }
    }
    fn server_is(&self, wrong: Wrong) {
        *self.shop.wrong.lock().expect("not poisoned") = wrong;
    }
    /// What the robot makes of an answer about ways.
    async fn plan_download(&self, answer: GetEncodingResponse) -> DownloadPlan {
        *self.shop.encoding.lock().expect("not poisoned") = answer;
        let wanted = FileRef { digest: Digest::of_content(b"new"), length: 1_000 };
        self.remote.plan_download(&wanted, &[Digest::of_content(b"old")]).await.expect("answers")
    }
    fn connections(&self) -> (usize, usize) {
        (*self.open.borrow(), *self.dialed.borrow())
    }
    /// All of a file, or the bytes up to an error and its kind.
    async fn read(&self, wanted: FileRef) -> (Vec<u8>, Option<ErrorKind>) {
        let mut bytes = Vec::new();
        let mut pieces = match self.remote.range(&wanted.digest, 0..wanted.length).await {
            Ok(pieces) => pieces,
            Err(error) => return (bytes, Some(error.kind())),
        };
        while let Some(piece) = pieces.next().await {
            match piece {
                Ok(piece) => bytes.extend(piece),
                Err(error) => {
                    assert!(pieces.next().await.is_none(), "after an error nothing comes");
                    return (bytes, Some(error.kind()));
                }
            }
        }
        (bytes, None)
    }
}

fn program(bundle: &Bundle) -> FileRef {
    let component = &bundle.manifest.components[0];
    FileRef { digest: component.digest, length: component.length }
}

async fn work(worker: &mut UpdateWorker, job: Job) -> Done {
    worker.work(job, CancellationToken::new()).await
}

#[tokio::test(start_paused = true)]
async fn a_release_comes_over_the_wire_whole() {
    let bench = Bench::new();
    let bundle = bench.releases.release("1.0.0");
    let mut sets = MemorySets::new();
    let mut worker = UpdateWorker::new(Box::new(sets.clone()), bench.remote.clone());
    let manifest = FileRef { digest: bundle.digest, length: bundle.length };
    let Done::Manifest { manifest: read, bytes } = work(&mut worker, Job::Manifest { wanted: manifest }).await else {
        panic!("no manifest")
    };
    assert_eq!((*read, Digest::of_content(&bytes)), (bundle.manifest.clone(), bundle.digest));
    let wanted = program(&bundle);
    assert!(matches!(work(&mut worker, Job::Fetch { wanted, bases: Vec::new(), rate_bytes_s: 0 }).await, Done::Ok));
    assert_eq!(sets.read(&wanted.digest, wanted.length).expect("is there").len() as u64, wanted.length);
    assert_eq!(bench.connections(), (1, 1), "one connection for all of it");
}

#[tokio::test]
async fn it_comes_over_tcp_too() {
    let shop = Shop::new();
    let bundle = shop.releases.release("1.0.0");
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("binds");
    let uri = format!("http://{}", listener.local_addr().expect("bound"));
    tokio::spawn(shop.router().serve_with_incoming(TcpListenerStream::new(listener)));
    let remote = GrpcRemote::new(Bulk::new(Arc::new(TcpDial::bulk(&uri, None).expect("an address"))));
    let root = remote.metadata("1.root.json").await.expect("answers");
    assert_eq!(root, Some(shop.releases.config().root));
    let wanted = program(&bundle);
    let mut pieces = remote.range(&wanted.digest, 0..wanted.length).await.expect("answers");
    let mut bytes = Vec::new();
    while let Some(piece) = pieces.next().await {
        bytes.extend(piece.expect("a piece"));
    }
    assert_eq!(Digest::of_content(&bytes), wanted.digest);
}

#[tokio::test(start_paused = true)]
async fn what_is_not_there_is_told_from_a_server_that_does_not_answer() {
    let bench = Bench::new();
    let bundle = bench.releases.release("1.0.0");
    assert_eq!(bench.remote.metadata("7.root.json").await.expect("answers"), None);
    let nothing = FileRef { digest: Digest::of_content(b"of nobody"), length: 10 };
    assert_eq!(bench.read(nothing).await, (vec![], Some(ErrorKind::NotFound)));
    bench.server_is(Wrong::Refuses);
    assert!(bench.remote.metadata("7.root.json").await.is_err());
    assert_eq!(bench.read(program(&bundle)).await, (vec![], Some(ErrorKind::Other)));
}

#[tokio::test(start_paused = true)]
async fn bytes_that_do_not_come_as_they_should_are_not_handed_on() {
    let bench = Bench::new();
    let wanted = program(&bench.releases.release("1.0.0"));
    let (whole, error) = bench.read(wanted).await;
    assert_eq!((Digest::of_content(&whole), error), (wanted.digest, None));
    let last_full = whole.len() / PIECE_BYTES * PIECE_BYTES;
    let cases = [
        (Wrong::Broken, PIECE_BYTES, ErrorKind::InvalidData),
        (Wrong::Order, 0, ErrorKind::InvalidData),
        (Wrong::Twice, PIECE_BYTES, ErrorKind::InvalidData),
        (Wrong::Longer, last_full, ErrorKind::InvalidData),
        (Wrong::Empty, 2 * PIECE_BYTES, ErrorKind::InvalidData),
        (Wrong::Early, 3 * PIECE_BYTES, ErrorKind::UnexpectedEof),
        (Wrong::Breaks, 3 * PIECE_BYTES, ErrorKind::Other),
        (Wrong::Silent, 3 * PIECE_BYTES, ErrorKind::TimedOut),
    ];
    for (wrong, good, kind) in cases {
        bench.server_is(wrong);
        let (bytes, error) = bench.read(wanted).await;
        assert_eq!((bytes.len(), error), (good, Some(kind)), "{wrong:?}");
        assert!(whole.starts_with(&bytes), "{wrong:?}");
    }
    bench.server_is(Wrong::Nothing);
    assert_eq!(bench.read(wanted).await, (whole, None), "and a good server is believed again");
}

#[tokio::test(start_paused = true)]
async fn a_download_goes_on_from_what_is_durable() {
    let bench = Bench::new();
    let wanted = program(&bench.releases.release("1.0.0"));
    let mut sets = MemorySets::new();
    let mut worker = UpdateWorker::new(Box::new(sets.clone()), bench.remote.clone());
    for wrong in [Wrong::Breaks, Wrong::Broken] {
        bench.server_is(wrong);
        let done = work(&mut worker, Job::Fetch { wanted, bases: Vec::new(), rate_bytes_s: 0 }).await;
        assert!(matches!(done, Done::Failed(Failure::Later(_))), "{wrong:?}: {done:?}");
        sets.sync(&wanted).expect("syncs");
        assert_eq!(sets.missing(&wanted).expect("tells"), std::slice::from_ref(&(CHUNK_BYTES..wanted.length)));
    }
    bench.server_is(Wrong::Nothing);
    let before = bench.releases.served();
    assert!(matches!(work(&mut worker, Job::Fetch { wanted, bases: Vec::new(), rate_bytes_s: 0 }).await, Done::Ok));
    assert_eq!(bench.releases.served() - before, wanted.length - CHUNK_BYTES, "what was there did not come again");
    assert!(sets.read(&wanted.digest, wanted.length).is_ok());
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_nobody_uses_is_closed_and_one_in_use_is_not() {
    let mut bench = Bench::new();
    let wanted = program(&bench.releases.release("1.0.0"));
    assert_eq!(bench.connections(), (0, 0), "none before the first question");
    bench.remote.metadata("timestamp.json").await.expect("answers");
    tokio::time::advance(IDLE / 2).await;
    bench.remote.metadata("timestamp.json").await.expect("answers");
    assert_eq!(bench.connections(), (1, 1));
    // A reader may be slow: its rate is kept by not reading.
    let mut pieces = bench.remote.range(&wanted.digest, 0..wanted.length).await.expect("answers");
    let mut length = 0;
    while let Some(piece) = pieces.next().await {
        length += piece.expect("a piece").len() as u64;
        tokio::time::sleep(2 * SILENCE).await;
        assert_eq!(bench.connections(), (1, 1));
    }
    assert_eq!(length, wanted.length);
    drop(pieces);
    bench.open.wait_for(|open| *open == 0).await.expect("is closed");
    bench.remote.metadata("timestamp.json").await.expect("answers");
    assert_eq!(bench.connections(), (1, 2));
}

#[tokio::test(start_paused = true)]
async fn a_shorter_way_is_asked_for_with_what_is_there_and_an_answer_without_sense_is_none() {
    let bench = Bench::new();
    let [old, way] = [b"old", b"way"].map(|content| Digest::of_content(content));
    let answer = GetEncodingResponse {
        encoding: Encoding::ZstdPatch.into(),
        base_digest: old.to_string(),
        encoded_digest: way.to_string(),
        encoded_length: 7,
    };
    let encoded = FileRef { digest: way, length: 7 };
    assert_eq!(bench.plan_download(answer.clone()).await, DownloadPlan::Shorter { base: Some(old), encoded });
    let zstd = GetEncodingResponse { encoding: Encoding::Zstd.into(), ..answer.clone() };
    assert_eq!(bench.plan_download(zstd).await, DownloadPlan::Shorter { base: None, encoded });
    let senseless = [
        GetEncodingResponse::default(),
        GetEncodingResponse { encoding: 77, ..answer.clone() },
        GetEncodingResponse { encoding: Encoding::Identity.into(), ..answer.clone() },
        GetEncodingResponse { base_digest: String::new(), ..answer.clone() },
        GetEncodingResponse { encoded_digest: "x".to_owned(), ..answer.clone() },
    ];
    for answer in senseless {
        assert_eq!(bench.plan_download(answer.clone()).await, DownloadPlan::AsItIs, "{answer:?}");
    }
    let asked = bench.shop.asked.lock().expect("not poisoned")[0].clone();
    let expected =
        GetEncodingRequest { digest: Digest::of_content(b"new").to_string(), base_digests: vec![old.to_string()] };
    assert_eq!(asked, expected);
    bench.server_is(Wrong::Old);
    assert_eq!(bench.plan_download(answer).await, DownloadPlan::AsItIs);
    bench.server_is(Wrong::Refuses);
    assert!(bench.remote.plan_download(&encoded, &[]).await.is_err());
}
