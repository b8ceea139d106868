//! Releases to measure with: one file of noise a bundle, signed with throw-away keys, and brought to a server.
//!
//! Called by [`super::line`], [`super::resume`] and, for downloads beside a stop, [`crate::stop`].

use crate::child::Child;
use anyhow::{Context, bail, ensure};
use midshift_agent::sets::FileRef;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::build;
use midshift_bundle::folder::{Folder, Signed};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{FileTarget, Profile, listed};
use midshift_core::site::{DEMO, text};
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::{GetUploadRequest, PublishRepositoryRequest, UploadTargetRequest};
use midshift_sim::body::MODEL;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::fs::{self, File};
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use tonic::transport::Channel;

/// Bytes of one message of an upload.
const PIECE_BYTES: u64 = 256 * 1024;
/// Messages of one call, which must stay far below the server's limit for its time.
const PIECES_A_CALL: usize = 400;
/// Name of every bundle.
const NAME: &str = "load";

/// A repository with its keys.
pub struct Releases {
    dir: PathBuf,
    folder: Folder,
    targets_version: u64,
}

/// One bundle of it.
#[derive(Clone, Debug)]
pub struct Release {
    /// As roll-outs name it.
    pub bundle: String,
    /// Its one file.
    pub file: FileRef,
}

/// Writes bytes that no compression makes shorter.
pub fn noise(path: &Path, bytes: u64, seed: u64) -> anyhow::Result<()> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut out = BufWriter::new(File::create(path).with_context(|| format!("making {}", path.display()))?);
    let mut piece = vec![0; 1 << 20];
    let mut left = bytes;
    while left > 0 {
        let length = left.min(piece.len() as u64);
        let piece = &mut piece[..usize::try_from(length)?];
        rng.fill_bytes(piece);
        out.write_all(piece)?;
        left -= length;
    }
    Ok(out.flush()?)
}

impl Releases {
    /// Keys and a repository in a new folder.
    pub fn make(dir: &Path) -> anyhow::Result<Self> {
        let now = midshift_agent::clock::wall();
        fs::create_dir_all(dir)?;
        let folder = Folder::create(&dir.join("repository"), &dir.join("keys"), Profile::Solo, now)?;
        Ok(Self { dir: dir.to_owned(), folder, targets_version: 0 })
    }
    /// All keys.
    pub fn keys(&self) -> PathBuf {
        self.dir.join("keys")
    }
    /// What robots of the demo site believe of it.
    pub fn trust(&self) -> anyhow::Result<TrustAnchors> {
        let root = self.folder.document("1.root.json")?.context("the repository has no root")?;
        let key = SecretKey::read(&self.keys().join("directive-1.pem"))?.public();
        Ok(TrustAnchors { root, directive_keys: [(key.id(), key)].into(), site: text::parse(DEMO)?.site_id().clone() })
    }
    /// Builds and signs a bundle whose one file is so many bytes of noise. `number` is its version and decides the bytes.
    pub fn add(&mut self, number: u64, bytes: u64) -> anyhow::Result<Release> {
        let (draft, built) = (self.dir.join("draft"), self.dir.join("built"));
        fs::create_dir_all(&draft)?;
        noise(&draft.join("weights"), bytes, number)?;
        let version = format!("1.{number}.0");
        let text = format!(
            "name = \"{NAME}\"\nversion = \"{version}\"\n[[component]]\nname = \"weights\"\nversion = \"{version}\"\n\
             kind = \"weights\"\nfile = \"weights\"\nhardware = [\"{MODEL}\"]\nneeds = \"restart\"\n"
        );
        fs::write(draft.join(build::DRAFT_FILE), text)?;
        let manifest = build::build(&draft, &built, &mut |_| {})?;
        let key = SecretKey::read(&self.keys().join("targets-1.pem"))?;
        let (_, signed) = self.folder.add(&built, &[&key], midshift_agent::clock::wall())?;
        match signed {
            Signed::Published(version) => self.targets_version = version,
            Signed::Pending => bail!("one key was not enough to sign"),
        }
        fs::remove_dir_all(&draft)?;
        fs::remove_dir_all(&built)?;
        let component = manifest.components.first().context("a bundle without a component")?;
        let file = FileRef { digest: component.digest, length: component.length };
        Ok(Release { bundle: format!("{NAME}-{version}"), file })
    }
    /// Brings all of it to a server that has nothing.
    pub async fn push(&self, server: &Child) -> anyhow::Result<()> {
        let mut client = BundleServiceClient::new(server.channel().await?);
        let document = |name: &str| self.folder.document(name)?.with_context(|| format!("no {name}"));
        let targets = document(&format!("{}.targets.json", self.targets_version))?;
        for file in listed(&targets)? {
            self.bring(&mut client, &file).await?;
        }
        let roots = vec![document("1.root.json")?];
        client.publish_repository(PublishRepositoryRequest { roots, targets, expected_targets_version: 0 }).await?;
        Ok(())
    }
    async fn bring(&self, client: &mut BundleServiceClient<Channel>, file: &FileTarget) -> anyhow::Result<()> {
        let digest = file.digest.to_string();
        let state = client.get_upload(GetUploadRequest { digest: digest.clone(), length: file.length }).await?;
        let (mut durable, mut is_complete) = (state.get_ref().durable_bytes, state.get_ref().is_complete);
        while !is_complete {
            let mut content = File::open(self.folder.file(&file.name, file.digest))?;
            content.seek(SeekFrom::Start(durable))?;
            let starts = (durable..file.length).step_by(usize::try_from(PIECE_BYTES)?).take(PIECES_A_CALL);
            let mut pieces = Vec::new();
            for offset in starts {
                let mut data = Vec::new();
                (&mut content).take(PIECE_BYTES).read_to_end(&mut data)?;
                pieces.push(UploadTargetRequest { digest: digest.clone(), length: file.length, offset, data });
            }
            let answer = client.upload_target(tokio_stream::iter(pieces)).await?.into_inner();
            ensure!(answer.durable_bytes > durable || answer.is_complete, "{} does not get on", file.name);
            (durable, is_complete) = (answer.durable_bytes, answer.is_complete);
        }
        Ok(())
    }
}
