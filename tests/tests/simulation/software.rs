//! Release people of one run: throw-away keys and signed releases of behaviours, the same bytes in every run, and a folder for the server.
//!
//! Invariant: nothing is drawn and no wall clock is read, so that the same seed signs the same directives.

use anyhow::Context;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::{PublicKey, SecretKey};
use midshift_bundle::manifest::{Component, ComponentKind, FORMAT, Manifest};
use midshift_bundle::repository::{FileTarget, PEOPLE_LIFE_MS, RootDraft, Signers, sign_root, sign_targets};
use midshift_cli::samples::{NAME, SAMPLES};
use midshift_core::ids::{BundleId, SiteId};
use midshift_core::limits;
use midshift_core::time::{Clock, Utc};
use midshift_ota::content::{Content, DiskContent, FileRef, Room};
use midshift_ota::folder::Owner;
use midshift_ota::repository::{Act, OnlineKeys, Repository};
use midshift_ota::{OtaService, Parts};
use midshift_sim::behaviour::COMPONENT;
use midshift_sim::body::MODEL;
use midshift_sim::faults::FAULT_LOAD_LOST;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use tempfile::TempDir;

/// Releases beside [`SAMPLES`]: one more that is good.
const MORE: [(&str, &str); 1] = [("1.5.2", "speed_permille = 950\nenergy_permille = 950\n")];
/// Releases of which nothing bad is known.
pub const GOOD: [&str; 3] = ["1.5.0", "1.5.1", "1.5.2"];
/// Its program ends at its start.
pub const BAD_AT_START: &str = "1.6.0-bad-at-start";
/// Its program hangs on probation.
pub const HANGS: &str = "1.6.1-hangs";
/// It goes wrong under load.
pub const BAD_WITH_LOAD: &str = "1.6.2-bad-with-load";

/// All that a run needs of releases.
pub struct Software {
    dir: TempDir,
    /// What robots believe.
    pub trust: TrustAnchors,
    /// Content of each signed bundle, by its digest.
    pub signed: BTreeMap<Digest, BTreeSet<Digest>>,
    /// Bundles by version.
    bundles: BTreeMap<String, BundleId>,
}

fn key(seed: u8) -> SecretKey {
    SecretKey::of_seed([seed; 32])
}

fn manifest_of(version: &str, content: &[u8]) -> Manifest {
    let component = Component {
        hardware: BTreeSet::from([MODEL.to_owned()]),
        ..Component::new(COMPONENT, version, ComponentKind::Config, content)
    };
    Manifest {
        format: FORMAT,
        name: NAME.to_owned(),
        version: version.to_owned(),
        description: String::new(),
        hard_stop_codes: BTreeSet::from([FAULT_LOAD_LOST]),
        raises_floor: false,
        components: vec![component],
    }
}

impl Software {
    /// Signs and publishes everything at `now`.
    pub fn make(now: Utc, site: SiteId) -> anyhow::Result<Self> {
        let dir = tempfile::tempdir().context("making a folder for software")?;
        let keys = dir.path().join("keys");
        std::fs::create_dir_all(&keys)?;
        for (name, seed) in [("snapshot-1", 3), ("timestamp-1", 4), ("directive-1", 5)] {
            key(seed).write(&keys.join(format!("{name}.pem")))?;
        }
        let one = |seed: u8| Signers { keys: vec![key(seed).public()], threshold: 1 };
        let expires = now.plus_ms(PEOPLE_LIFE_MS);
        let draft =
            RootDraft { version: 1, expires, root: one(1), targets: one(2), snapshot: one(3), timestamp: one(4) };
        let root = sign_root(&draft, &[&key(1)])?;
        let releases = SAMPLES.iter().map(|s| (s.version, s.behaviour)).chain(MORE);
        let (mut signed, mut bundles, mut files) = (BTreeMap::new(), BTreeMap::new(), Vec::new());
        for (version, behaviour) in releases {
            let manifest = manifest_of(version, behaviour.as_bytes());
            let (bytes, content) = (manifest.to_bytes(), behaviour.as_bytes().to_vec());
            signed.insert(Digest::of_content(&bytes), BTreeSet::from([Digest::of_content(&content)]));
            bundles.insert(version.to_owned(), BundleId::parse(&Digest::of_content(&bytes).to_string())?);
            files.push((manifest.components[0].target(), content));
            files.push((manifest.target(), bytes));
        }
        let add: Vec<FileTarget> = files
            .iter()
            .map(|(name, bytes)| FileTarget {
                name: name.clone(),
                digest: Digest::of_content(bytes),
                length: bytes.len() as u64,
            })
            .collect();
        let targets = sign_targets(None, &add, &[], expires, &[&key(2)])?;
        let directive_keys = [key(5).public()].map(|key: PublicKey| (key.id(), key)).into();
        let trust = TrustAnchors { root: root.clone(), directive_keys, site };
        let this = Self { dir, trust, signed, bundles };
        let runtime = tokio::runtime::Builder::new_current_thread().build()?;
        runtime.block_on(this.publish(root, targets, files, now))?;
        Ok(this)
    }

    async fn publish(
        &self,
        root: Vec<u8>,
        targets: Vec<u8>,
        files: Vec<(String, Vec<u8>)>,
        now: Utc,
    ) -> anyhow::Result<()> {
        let content =
            DiskContent::open(&self.folder().join("content"), Room::with_quota(limits::SOFTWARE_BYTES_DEFAULT))?;
        for (_, bytes) in files {
            let file = FileRef { digest: Digest::of_content(&bytes), length: bytes.len() as u64 };
            content.append(file, 0, bytes.into()).await?;
            content.settle(file).await?;
        }
        let keys = OnlineKeys::read(&self.keys())?;
        let repository = Repository::open(&self.folder().join("metadata"), keys, Arc::new(content)).await?;
        let act = Act { by: "release".into(), at: now };
        repository.publish(vec![root], targets, 0, act).await?;
        Ok(())
    }
    fn keys(&self) -> PathBuf {
        self.dir.path().join("keys")
    }
    fn folder(&self) -> PathBuf {
        self.dir.path().join("server")
    }
    /// The service of a server that starts now.
    pub async fn open(&self, clock: Arc<dyn Clock>) -> anyhow::Result<OtaService> {
        let room = Room::with_quota(limits::SOFTWARE_BYTES_DEFAULT);
        Ok(OtaService::open(Parts { folder: self.folder(), keys: self.keys(), room, clock, owner: Owner::Nobody })
            .await?)
    }
    /// The bundle of a version.
    pub fn bundle(&self, version: &str) -> &BundleId {
        &self.bundles[version]
    }
}
