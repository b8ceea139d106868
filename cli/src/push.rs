//! `midshift bundle push`: a repository of release people to the server.
//!
//! Invariant: nothing is pushed over what somebody else published: what the server has must be in the folder, byte for byte. Files go
//! before the document that lists them.

use super::client::{Call, Exit, unary};
use super::out::Out;
use crate::endpoint::Line;
use indicatif::{ProgressBar, ProgressStyle};
use midshift_bundle::folder::{Checked, Folder};
use midshift_bundle::freshness::{newest_targets, stamp};
use midshift_bundle::repository::{self as documents, FileTarget, check_targets, listed};
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use std::fs::File;
use std::io::{self, IsTerminal, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::time::Instant;
use tonic::Code;

/// Bytes of one message.
const PIECE_BYTES: usize = 256 * 1024;
/// One call brings as much as fits into this, so that slow lines stay far below the server's limit for a call.
const CALL_FOR: Duration = Duration::from_secs(5);

type Client = BundleServiceClient<Line>;

impl From<documents::Error> for Exit {
    fn from(error: documents::Error) -> Self {
        Self::new(1, error.to_string())
    }
}

/// Brings what is missing, file by file, then publishes.
pub async fn run(path: &Path, call: &Call, out: &Out) -> Result<(), Exit> {
    let folder = Folder::open(path)?;
    let checked = folder.check().map_err(Exit::of_finding)?;
    let Some(newest) = checked.targets_version else {
        let next = format!("midshift bundle sign BUNDLE --repository {} --key targets-1.pem", path.display());
        return Err(Exit::usage(format!("nothing is signed in {}\n  try: {next}", path.display())));
    };
    let mut compared = Compared { client: call.bundles().await?, folder };
    let roots = compared.common_roots().await?;
    let targets = compared.common_targets(newest).await?;
    let Compared { client, folder } = compared;
    let mut push = Push { client, folder, checked };
    let mut told = v1::PublishRepositoryResponse { root_version: roots, targets_version: targets };
    // The first publication may begin anywhere; after it no version is left out.
    let versions = if targets == 0 { newest..=newest } else { targets + 1..=newest };
    for version in versions {
        told = push.publish(&told, version, newest).await?;
    }
    let words = if told.targets_version == targets { "the server has it already" } else { "published" };
    out.one(&told, &told.targets_version.to_string(), || {
        format!("root {}, targets {}: {words}", told.root_version, told.targets_version)
    })?;
    if told.root_version < push.checked.root_version {
        out.inform("the newest root goes with the next targets document: sign one");
    }
    out.next("midshift bundle ls");
    Ok(())
}

/// Holds a repository against that of a server: all that the server shows must be in it, or what is signed next would fork its versions.
pub async fn has_all_of_server(folder: Folder, call: &Call) -> Result<(), Exit> {
    let newest = folder.targets_version()?.unwrap_or_default();
    let mut compared = Compared { client: call.bundles().await?, folder };
    compared.common_roots().await?;
    compared.common_targets(newest).await.map(drop)
}

/// As [`has_all_of_server`], against another copy of the repository.
pub fn has_all_of_copy(folder: &Folder, copy: &Folder) -> Result<(), Exit> {
    let newest = folder.targets_version()?.unwrap_or_default();
    let Some(theirs) = copy.targets_version()? else { return Ok(()) };
    let name = format!("{theirs}.targets.json");
    if theirs > newest {
        return Err(behind("the other repository", theirs, newest));
    }
    if folder.document(&name)? != copy.document(&name)? {
        return Err(diverged("the other repository", &name));
    }
    Ok(())
}

/// A repository beside that of a server.
struct Compared {
    client: Client,
    folder: Folder,
}

impl Compared {
    /// A document of the server; none: it has none.
    async fn theirs(&mut self, name: &str) -> Result<Option<Vec<u8>>, Exit> {
        let request = v1::GetMetadataRequest { name: name.to_owned() };
        match self.client.get_metadata(unary(request)).await {
            Ok(answer) => Ok(Some(answer.into_inner().document)),
            Err(status) if status.code() == Code::NotFound => Ok(None),
            Err(status) => Err(status.into()),
        }
    }

    /// Version of the server's newest root, once every root that it has is known to be ours; 0: none.
    async fn common_roots(&mut self) -> Result<u64, Exit> {
        for version in 1.. {
            let name = format!("{version}.root.json");
            let Some(theirs) = self.theirs(&name).await? else { return Ok(version - 1) };
            if self.folder.document(&name)?.as_ref() != Some(&theirs) {
                return Err(diverged("the server", &name));
            }
        }
        Ok(0)
    }

    /// Version of the server's newest targets document, once it is known to be ours; 0: none.
    async fn common_targets(&mut self, newest: u64) -> Result<u64, Exit> {
        let Some(timestamp) = self.theirs("timestamp.json").await? else { return Ok(0) };
        let name = format!("{}.snapshot.json", stamp(&timestamp)?.snapshot_version);
        let snapshot = self.theirs(&name).await?.ok_or_else(|| Exit::new(1, format!("the server lost its {name}")))?;
        let version = newest_targets(&snapshot)?;
        let name = format!("{version}.targets.json");
        let theirs = self.theirs(&name).await?;
        if version > newest {
            return Err(behind("the server", version, newest));
        }
        if self.folder.document(&name)? != theirs {
            return Err(diverged("the server", &name));
        }
        Ok(version)
    }
}

struct Push {
    client: Client,
    folder: Folder,
    checked: Checked,
}

impl Push {
    fn ours(&self, name: &str) -> Result<Vec<u8>, Exit> {
        self.folder.document(name)?.ok_or_else(|| Exit::new(1, format!("the repository has no {name}")))
    }

    /// Brings the files of one targets document, then makes it the newest.
    async fn publish(
        &mut self,
        before: &v1::PublishRepositoryResponse,
        version: u64,
        newest: u64,
    ) -> Result<v1::PublishRepositoryResponse, Exit> {
        let targets = self.ours(&format!("{version}.targets.json"))?;
        let known = match before.targets_version {
            0 => Vec::new(),
            known => listed(&self.ours(&format!("{known}.targets.json"))?)?,
        };
        let files = listed(&targets)?;
        self.bring(files.iter().filter(|file| !known.contains(file)).collect()).await?;
        // New roots come as late as they can: an older document may be signed by keys that they no longer name.
        let wants_roots = version == newest
            || before.root_version == 0
            || check_targets(&self.ours(&format!("{}.root.json", before.root_version))?, &targets).is_err();
        let last = if wants_roots { self.checked.root_version } else { before.root_version };
        let roots = (before.root_version + 1..=last).map(|v| self.ours(&format!("{v}.root.json")));
        let roots = roots.collect::<Result<Vec<_>, _>>()?;
        let expected_targets_version = before.targets_version;
        let request = v1::PublishRepositoryRequest { roots, targets, expected_targets_version };
        Ok(self.client.publish_repository(unary(request)).await?.into_inner())
    }

    async fn bring(&mut self, files: Vec<&FileTarget>) -> Result<(), Exit> {
        let total = files.iter().map(|file| file.length).sum();
        let bar = if io::stderr().is_terminal() { ProgressBar::new(total) } else { ProgressBar::hidden() };
        let template = "{bar:40} {binary_bytes}/{binary_total_bytes} {binary_bytes_per_sec} {wide_msg}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        let mut done = 0;
        for file in files {
            bar.set_message(file.name.clone());
            self.bring_one(file, done, &bar).await?;
            done += file.length;
        }
        bar.finish_and_clear();
        Ok(())
    }

    /// One file, from where the server has it, in as many calls as it takes.
    async fn bring_one(&mut self, file: &FileTarget, done: u64, bar: &ProgressBar) -> Result<(), Exit> {
        let path = self.folder.file(&file.name, file.digest);
        let request = v1::GetUploadRequest { digest: file.digest.to_string(), length: file.length };
        let state = self.client.get_upload(unary(request)).await?.into_inner();
        let (mut durable, mut is_complete) = (state.durable_bytes, state.is_complete);
        while !is_complete {
            bar.set_position(done + durable);
            let pieces = Pieces::open(&path, file, durable, bar).map_err(anyhow::Error::from)?;
            let failure = pieces.failure.clone();
            let answer = self.client.upload_target(tokio_stream::iter(pieces)).await?.into_inner();
            if let Some(error) = failure.get() {
                return Err(Exit::new(1, format!("reading {}: {error}", path.display())));
            }
            if answer.durable_bytes <= durable {
                return Err(Exit::new(1, format!("{} does not get on at byte {durable}", file.name)));
            }
            (durable, is_complete) = (answer.durable_bytes, answer.is_complete);
        }
        bar.set_position(done + file.length);
        Ok(())
    }
}

const TAKE_THEIRS: &str = "take the repository of whoever pushed last, sign into that one and push it";

/// Somebody signed on top of what is here.
fn behind(who: &str, theirs: u64, ours: u64) -> Exit {
    let text = format!("{who} has targets {theirs} and this repository targets {ours}: somebody else signed meanwhile");
    Exit::new(9, text).or_try(TAKE_THEIRS)
}

fn diverged(who: &str, name: &str) -> Exit {
    let text =
        format!("{who} has another {name} than this repository: somebody else published, or it is another project");
    Exit::new(9, text).or_try(TAKE_THEIRS)
}

/// Messages of one call: they end with the file or when the call has lasted long enough.
struct Pieces {
    file: File,
    digest: String,
    length: u64,
    offset: u64,
    begun: Instant,
    bar: ProgressBar,
    failure: Arc<OnceLock<io::Error>>,
}

impl Pieces {
    fn open(path: &Path, target: &FileTarget, offset: u64, bar: &ProgressBar) -> io::Result<Self> {
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(offset))?;
        let (digest, length) = (target.digest.to_string(), target.length);
        let (begun, failure) = (Instant::now(), Arc::default());
        Ok(Self { file, digest, length, offset, begun, bar: bar.clone(), failure })
    }
}

impl Iterator for Pieces {
    type Item = v1::UploadTargetRequest;

    fn next(&mut self) -> Option<Self::Item> {
        let missing = self.length.saturating_sub(self.offset);
        if missing == 0 || self.begun.elapsed() >= CALL_FOR {
            return None;
        }
        let mut data = Vec::new();
        let most = missing.min(PIECE_BYTES as u64);
        if let Err(error) = (&mut self.file).take(most).read_to_end(&mut data) {
            // Nothing else sets it.
            let _ = self.failure.set(error);
            return None;
        }
        if data.is_empty() {
            return None;
        }
        let piece =
            v1::UploadTargetRequest { digest: self.digest.clone(), length: self.length, offset: self.offset, data };
        self.offset += piece.data.len() as u64;
        self.bar.inc(piece.data.len() as u64);
        Some(piece)
    }
}
