//! Release people of one measurement: throw-away keys, the sample releases signed with them, and the push to a server.

use crate::child::Child;
use anyhow::Context;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::digest::Digest;
use midshift_bundle::folder::Folder;
use midshift_bundle::keys::{PublicKey, SecretKey};
use midshift_bundle::repository::listed;
use midshift_cli::samples::{self, NAME, SAMPLES, Signer};
use midshift_core::ids::{BundleId, SiteId};
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use std::path::{Path, PathBuf};

/// Keys and signed releases in a folder that its maker takes away.
pub struct People {
    repository: PathBuf,
    /// Also the online keys of the server.
    pub keys: PathBuf,
    /// Bundles, as the samples stand.
    bundles: Vec<BundleId>,
}

/// How people call sample number `at`.
pub fn label(at: usize) -> String {
    format!("{NAME}-{}", SAMPLES[at].version)
}

impl People {
    /// Draws keys and signs the samples: settings only, which is all that simulated robots read.
    pub fn make(dir: &Path) -> anyhow::Result<Self> {
        let made = samples::make(&dir.join("samples"), None, Signer::Throwaway, midshift_agent::clock::wall())?;
        let id = |bytes: &[u8]| BundleId::parse(&Digest::of_content(bytes).to_string());
        let bundles = made.bundles.iter().map(|(_, manifest)| id(&manifest.to_bytes())).collect::<Result<_, _>>()?;
        Ok(Self { repository: made.repository, keys: made.keys.context("throw-away keys")?, bundles })
    }
    /// Sample number `at`.
    pub fn bundle(&self, at: usize) -> &BundleId {
        &self.bundles[at]
    }
    /// The key that the server signs directives with.
    pub fn directive_key(&self) -> anyhow::Result<PublicKey> {
        Ok(SecretKey::read(&self.keys.join("directive-1.pem"))?.public())
    }
    /// What robots of a site believe.
    pub fn trust(&self, site: SiteId) -> anyhow::Result<TrustAnchors> {
        let root = Folder::open(&self.repository)?.document("1.root.json")?.context("a repository without a root")?;
        let key = self.directive_key()?;
        Ok(TrustAnchors { root, directive_keys: [(key.id(), key)].into(), site })
    }
    /// Brings all of it to a server that has nothing.
    pub async fn push(&self, server: &Child) -> anyhow::Result<()> {
        let folder = Folder::open(&self.repository)?;
        let checked = folder.check()?;
        let document = |name: String| anyhow::Ok(folder.document(&name)?.with_context(|| format!("no {name}"))?);
        let targets = document(format!("{}.targets.json", checked.targets_version.context("nothing is signed")?))?;
        let mut client = BundleServiceClient::new(server.channel().await?);
        for file in listed(&targets)? {
            let data = std::fs::read(folder.file(&file.name, file.digest))?;
            let (digest, length) = (file.digest.to_string(), file.length);
            let piece = v1::UploadTargetRequest { digest, length, offset: 0, data };
            client.upload_target(tokio_stream::once(piece)).await?;
        }
        let roots = (1..=checked.root_version).map(|version| document(format!("{version}.root.json")));
        let roots = roots.collect::<anyhow::Result<_>>()?;
        let request = v1::PublishRepositoryRequest { roots, targets, expected_targets_version: 0 };
        client.publish_repository(request).await?;
        Ok(())
    }
}
