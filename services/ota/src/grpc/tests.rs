//! The two services as callers meet them, over a real connection.

use crate::OtaService;
use crate::fixture::{SEEDS, files, first_root, release, service, targets};
use midshift_bundle::digest::Digest;
use midshift_bundle::encoded_target::EncodedTarget;
use midshift_core::identity::Caller;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::chunk_service_client::ChunkServiceClient;
use midshift_proto::refusal_of;
use tempfile::TempDir;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::service::{InterceptorLayer, Routes};
use tonic::transport::{Channel, Endpoint, Server};
use tonic::{Request, Status};

struct World {
    _dir: TempDir,
    bundles: BundleServiceClient<Channel>,
    chunks: ChunkServiceClient<Channel>,
    service: OtaService,
}

async fn served(dir: TempDir, service: OtaService) -> World {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    // As a port without login.
    let port = InterceptorLayer::new(|mut request: Request<()>| {
        request.extensions_mut().insert(Caller::local());
        Ok::<_, Status>(request)
    });
    let routes = service.add_chunks_to(service.add_bundles_to(Routes::default()));
    let server = Server::builder().layer(port).add_routes(routes);
    tokio::spawn(server.serve_with_incoming(TcpListenerStream::new(listener)));
    let channel = Endpoint::from_shared(format!("http://{address}")).expect("a uri").connect_lazy();
    let bundles = BundleServiceClient::new(channel.clone()).max_decoding_message_size(16 * 1024 * 1024);
    World { _dir: dir, bundles, chunks: ChunkServiceClient::new(channel), service }
}

async fn world() -> World {
    let dir = TempDir::new().expect("a folder");
    let service = service(&dir).await;
    served(dir, service).await
}

fn code(status: &Status) -> Option<Code> {
    refusal_of(status).code
}

fn fields(status: &Status) -> Vec<String> {
    refusal_of(status).violations.into_iter().map(|v| v.field).collect()
}

fn pieces(content: &[u8], from: usize, size: usize) -> Vec<v1::UploadTargetRequest> {
    let digest = Digest::of_content(content).to_string();
    let piece = |(i, data): (usize, &[u8])| v1::UploadTargetRequest {
        digest: digest.clone(),
        length: content.len() as u64,
        offset: (from + i * size) as u64,
        data: data.to_vec(),
    };
    content[from..].chunks(size).enumerate().map(piece).collect()
}

impl World {
    async fn upload(&mut self, pieces: Vec<v1::UploadTargetRequest>) -> Result<v1::UploadTargetResponse, Status> {
        self.bundles.upload_target(tokio_stream::iter(pieces)).await.map(tonic::Response::into_inner)
    }
    async fn state(&mut self, content: &[u8]) -> v1::GetUploadResponse {
        let request =
            v1::GetUploadRequest { digest: Digest::of_content(content).to_string(), length: content.len() as u64 };
        self.bundles.get_upload(request).await.expect("asked").into_inner()
    }
    async fn publish(
        &mut self,
        roots: Vec<Vec<u8>>,
        targets: Vec<u8>,
        expected: u64,
    ) -> Result<v1::PublishRepositoryResponse, Status> {
        let request = v1::PublishRepositoryRequest { roots, targets, expected_targets_version: expected };
        self.bundles.publish_repository(request).await.map(tonic::Response::into_inner)
    }
    async fn fetch(
        &mut self,
        content: &[u8],
        offset: u64,
        length: u64,
    ) -> Result<Vec<v1::FetchChunksResponse>, Status> {
        let request = v1::FetchChunksRequest { digest: Digest::of_content(content).to_string(), offset, length };
        let mut stream = self.chunks.fetch_chunks(request).await?.into_inner();
        let mut all = Vec::new();
        while let Some(chunk) = stream.message().await? {
            all.push(chunk);
        }
        Ok(all)
    }
}

#[tokio::test]
async fn a_release_is_brought_in_pieces_published_listed_and_fetched() {
    let mut world = world().await;
    let files = files("walk", "1.0.0");
    let content = &files[1].1;
    assert_eq!(world.state(content).await, v1::GetUploadResponse::default());
    let half = world.upload(pieces(content, 0, 4)[..2].to_vec()).await.expect("half of it");
    assert_eq!((half.durable_bytes, half.is_complete), (8, false));
    assert_eq!(world.state(content).await.durable_bytes, 8);
    let document = targets(None, &files, SEEDS.targets);
    let early = world.publish(vec![first_root()], document.clone(), 0).await.expect_err("too early");
    assert_eq!(code(&early), Some(Code::FilesMissing));
    assert!(early.message().contains("walk-1.0.0.manifest, walk-gait-1.0.0.component"), "{}", early.message());
    let whole = world.upload(pieces(content, 8, 3)).await.expect("the rest");
    assert_eq!((whole.durable_bytes, whole.is_complete), (16, true));
    assert!(world.state(content).await.is_complete);
    world.upload(pieces(&files[0].1, 0, 1000)).await.expect("the manifest");
    let unlisted = world.fetch(content, 0, 16).await.expect_err("no release lists it yet");
    assert_eq!(code(&unlisted), Some(Code::SoftwareNotFound));
    let told = world.publish(vec![first_root()], document.clone(), 0).await.expect("published");
    assert_eq!((told.root_version, told.targets_version), (1, 1));
    let late = world.publish(Vec::new(), targets(Some(&document), &[], SEEDS.targets), 0).await.expect_err("late");
    assert_eq!((late.code(), code(&late)), (tonic::Code::Aborted, Some(Code::ReleaseMoved)));
    let listed = world.bundles.list_bundles(v1::ListBundlesRequest::default()).await.expect("listed").into_inner();
    let bundle = &listed.bundles[0];
    assert_eq!((bundle.name.as_str(), bundle.version.as_str(), bundle.length), ("walk", "1.0.0", 16));
    assert_eq!(bundle.digest, Digest::of_content(&files[0].1).to_string());
    assert_eq!(
        (bundle.components[0].kind.as_str(), bundle.components[0].hardware.as_slice()),
        ("process", &["h1".to_owned()][..])
    );
    let fetched = world.fetch(content, 0, limits::CHUNK_RANGE_BYTES).await.expect("fetched");
    assert_eq!(fetched.iter().flat_map(|c| c.data.clone()).collect::<Vec<_>>(), *content);
    let request = v1::GetMetadataRequest { name: "1.targets.json".to_owned() };
    let found = world.bundles.get_metadata(request).await.expect("there").into_inner();
    assert_eq!(found.document, document);
    let request = v1::GetMetadataRequest { name: "2.targets.json".to_owned() };
    let absent = world.bundles.get_metadata(request).await.expect_err("not there");
    assert_eq!((absent.code(), code(&absent)), (tonic::Code::NotFound, Some(Code::SoftwareNotFound)));
}

#[tokio::test]
async fn chunks_are_small_summed_and_in_order() {
    let mut world = world().await;
    let content: Vec<u8> = (0..(3 * limits::CHUNK_BYTES + 77)).map(|i| (i % 251) as u8).collect();
    release(&world.service, &[("large.bin".to_owned(), content.clone())]).await;
    let (from, count) = (1000, 2 * limits::CHUNK_BYTES + 5);
    let chunks = world.fetch(&content, from as u64, count as u64).await.expect("fetched");
    let mut next = from;
    for chunk in &chunks {
        assert!(!chunk.data.is_empty() && chunk.data.len() <= limits::CHUNK_BYTES);
        assert!(chunk.offset == next as u64 && midshift_proto::chunk::is_whole(chunk));
        assert_eq!(chunk.data, content[next..next + chunk.data.len()]);
        next += chunk.data.len();
    }
    assert_eq!(next, from + count);
    let end = world.fetch(&content, content.len() as u64 - 7, limits::CHUNK_RANGE_BYTES).await.expect("the end");
    assert_eq!(end.iter().map(|c| c.data.len()).sum::<usize>(), 7, "cut at the end of the file");
}

#[tokio::test]
async fn every_violation_of_a_call_is_told() {
    let mut world = world().await;
    let status = world.bundles.get_upload(v1::GetUploadRequest::default()).await.expect_err("empty");
    assert_eq!(fields(&status), ["digest", "length"]);
    assert_eq!(fields(&world.upload(Vec::new()).await.expect_err("nothing")), ["digest", "length"]);
    let request = v1::FetchChunksRequest { digest: "ABC".to_owned(), offset: 0, length: limits::CHUNK_RANGE_BYTES + 1 };
    assert_eq!(fields(&world.chunks.fetch_chunks(request).await.expect_err("both")), ["digest", "length"]);
    let request = v1::ListBundlesRequest { page_size: 1001, page_token: "no token".to_owned() };
    assert_eq!(fields(&world.bundles.list_bundles(request).await.expect_err("both")), ["page_size", "page_token"]);
    let status = world.bundles.get_metadata(v1::GetMetadataRequest::default()).await.expect_err("empty");
    assert_eq!(fields(&status), ["name"]);
    let status = world.publish(vec![b"no root".to_vec()], b"no targets".to_vec(), 0).await.expect_err("none");
    assert_eq!(fields(&status), ["roots[0]"]);
    let status = world.publish(vec![first_root()], Vec::new(), 0).await.expect_err("no targets");
    assert_eq!(fields(&status), ["targets"]);
    release(&world.service, &files("walk", "1.0.0")).await;
    let status = world.fetch(&files("walk", "1.0.0")[1].1, 16, 1).await.expect_err("beyond");
    assert_eq!(fields(&status), ["offset"]);
}

#[tokio::test]
async fn pieces_that_are_too_large_or_in_the_wrong_place_are_refused() {
    let mut world = world().await;
    let content = vec![7; limits::UPLOAD_PIECE_BYTES + 1];
    let status = world.upload(pieces(&content, 0, content.len())).await.expect_err("one byte too many");
    assert_eq!(fields(&status), ["data"]);
    let whole = world.upload(pieces(&content, 0, limits::UPLOAD_PIECE_BYTES)).await.expect("two pieces");
    assert!(whole.is_complete);
    let mut hole = pieces(b"a file of two pieces", 0, 10);
    hole.remove(0);
    let status = world.upload(hole).await.expect_err("a hole");
    assert_eq!((status.code(), code(&status)), (tonic::Code::Aborted, Some(Code::UploadMoved)));
    assert_eq!(refusal_of(&status).metadata.get("durable_bytes").map(String::as_str), Some("0"));
    let mut giant = pieces(b"giant", 0, 5);
    giant[0].length = (8 << 30) + 1;
    let status = world.upload(giant).await.expect_err("too long");
    assert_eq!((status.code(), code(&status)), (tonic::Code::ResourceExhausted, Some(Code::UploadTooLarge)));
    let mut full = pieces(b"fills the disk", 0, 5);
    full[0].length = 8 << 30;
    let status = world.upload(full).await.expect_err("over the quota");
    assert_eq!((status.code(), code(&status)), (tonic::Code::ResourceExhausted, Some(Code::SoftwareFull)));
    let told = refusal_of(&status).metadata;
    let fact = |name: &str| told.get(name).map(|fact| fact.parse::<u64>().expect("a number"));
    let used = limits::UPLOAD_PIECE_BYTES as u64 + 1;
    let facts = [fact("used"), fact("free"), fact("quota"), fact("missing")];
    assert_eq!(facts, [Some(used), Some((1 << 30) - used), Some(1 << 30), Some(8 << 30)]);
    let room = world.bundles.list_bundles(v1::ListBundlesRequest::default()).await.expect("listed").into_inner().room;
    assert_eq!(room, Some(v1::SoftwareRoom { used_bytes: used, quota_bytes: 1 << 30, ..Default::default() }));
    let mut wrong = pieces(b"bytes", 0, 5);
    wrong[0].digest = Digest::of_content(b"other").to_string();
    assert_eq!(code(&world.upload(wrong).await.expect_err("wrong bytes")), Some(Code::UploadCorrupt));
}

#[tokio::test]
async fn bundles_are_listed_in_pages_that_lose_none() {
    let mut world = world().await;
    let versions = ["1.2.0", "1.10.0", "1.10.0-rc.1", "2.0.0", "0.9.0"];
    let all: Vec<_> = versions.iter().flat_map(|v| files("walk", v)).chain(files("arm", "3.0.0")).collect();
    release(&world.service, &all).await;
    let mut seen = Vec::new();
    let mut page_token = String::new();
    loop {
        let request = v1::ListBundlesRequest { page_size: 2, page_token };
        let page = world.bundles.list_bundles(request).await.expect("a page").into_inner();
        assert!(page.bundles.len() <= 2);
        seen.extend(page.bundles.into_iter().map(|b| format!("{} {}", b.name, b.version)));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    assert_eq!(seen, ["arm 3.0.0", "walk 0.9.0", "walk 1.2.0", "walk 1.10.0", "walk 1.10.0-rc.1", "walk 2.0.0"]);
}

#[tokio::test]
async fn a_server_without_keys_says_what_to_do() {
    let mut world = served(TempDir::new().expect("a folder"), OtaService::without_keys()).await;
    let all = [
        world.upload(pieces(b"x", 0, 1)).await.expect_err("no keys"),
        world.publish(Vec::new(), Vec::new(), 0).await.expect_err("no keys"),
        world.fetch(b"x", 0, 1).await.expect_err("no keys"),
        world.bundles.list_bundles(v1::ListBundlesRequest::default()).await.expect_err("no keys"),
    ];
    for status in all {
        assert_eq!((status.code(), code(&status)), (tonic::Code::FailedPrecondition, Some(Code::NoOnlineKeys)));
        assert!(status.message().contains("--ota-keys"), "{}", status.message());
    }
}

#[tokio::test]
async fn a_robot_is_told_of_the_patch_that_is_listed_for_it_and_another_of_the_whole_and_nothing_else_is_made() {
    let mut world = world().await;
    let [old, new, other] = [b"old".as_slice(), b"new", b"other"].map(Digest::of_content);
    let named = |from| EncodedTarget { to: new, from }.target();
    let patch = b"what the old one lacks".to_vec();
    let listed = [
        ("gait-1.component".to_owned(), b"old".to_vec()),
        ("gait-2.component".to_owned(), b"new".to_vec()),
        (named(Some(old)), patch.clone()),
        (named(None), b"shorter".to_vec()),
    ];
    release(&world.service, &listed).await;
    let mut way = async |digest: Digest, bases: &[Digest]| {
        let base_digests = bases.iter().map(Digest::to_string).collect();
        let request = v1::GetEncodingRequest { digest: digest.to_string(), base_digests };
        world.chunks.get_encoding(request).await.expect("told").into_inner()
    };
    let told = way(new, &[other, old]).await;
    assert_eq!(told.encoding(), v1::Encoding::ZstdPatch);
    assert_eq!((told.base_digest, told.encoded_length), (old.to_string(), patch.len() as u64));
    let whole = way(new, &[other]).await;
    assert_eq!((whole.encoding(), whole.base_digest.as_str()), (v1::Encoding::Zstd, ""));
    let none = way(old, &[new]).await;
    assert_eq!(none.encoding(), v1::Encoding::Identity, "nobody makes one");
    let request = v1::FetchChunksRequest { digest: told.encoded_digest, offset: 0, length: told.encoded_length };
    let mut stream = world.chunks.fetch_chunks(request).await.expect("a range").into_inner();
    let mut bytes = Vec::new();
    while let Some(chunk) = stream.message().await.expect("a piece") {
        bytes.extend(chunk.data);
    }
    assert_eq!(bytes, patch);
}

#[tokio::test]
async fn only_a_listed_file_has_ways_and_every_wrong_digest_is_told() {
    let mut world = world().await;
    release(&world.service, &files("walk", "1.0.0")).await;
    let mut ask = async |digest: String, base_digests: Vec<String>| {
        world.chunks.get_encoding(v1::GetEncodingRequest { digest, base_digests }).await.expect_err("refused")
    };
    let unlisted = ask(Digest::of_content(b"of nobody").to_string(), Vec::new()).await;
    assert_eq!(code(&unlisted), Some(Code::SoftwareNotFound));
    let wrong = ask("x".to_owned(), vec!["y".to_owned()]).await;
    assert_eq!(fields(&wrong), ["digest", "base_digests"]);
    let many = ask(Digest::of_content(b"of nobody").to_string(), vec![Digest::of_content(b"x").to_string(); 9]).await;
    assert_eq!(fields(&many), ["base_digests"]);
}
