//! Release people for `dev` who vanish with it: keys and a repository in a temporary folder, so that a bundle can be signed and pushed at once.
//!
//! Invariant: nothing here is used by `serve`; a key of a real release never comes here.

use anyhow::Context;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::folder::Folder;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::Profile;
use midshift_core::Boxed;
use midshift_core::ids::SiteId;
use midshift_core::limits;
use midshift_core::time::Clock;
use midshift_ota::content::Room;
use midshift_ota::folder::Owner;
use midshift_ota::{OtaService, Parts};
use std::path::PathBuf;
use std::sync::Arc;
use tempfile::TempDir;

/// The folder, taken away when it is dropped.
pub struct Throwaway {
    dir: TempDir,
}

impl Throwaway {
    /// Makes keys and the first root, and the service that has the online keys.
    pub fn make(clock: Arc<dyn Clock>) -> Boxed<'static, anyhow::Result<(Self, OtaService)>> {
        Box::pin(async move {
            let this = Self { dir: tempfile::tempdir().context("making a folder for software")? };
            Folder::create(&this.repository(), &this.keys(), Profile::Solo, clock.now().wall)?;
            // No databases lie beside it that would need the rest of the disk.
            let room = Room::with_quota(limits::SOFTWARE_BYTES_DEFAULT);
            let parts =
                Parts { folder: this.dir.path().join("server"), keys: this.keys(), room, clock, owner: Owner::Nobody };
            let service = OtaService::open(parts).await.context("opening software of robots")?;
            Ok((this, service))
        })
    }
    /// Where bundles are signed into and pushed from.
    pub fn repository(&self) -> PathBuf {
        self.dir.path().join("repository")
    }
    /// What robots of `site` believe of it.
    pub fn trust(&self, site: SiteId) -> anyhow::Result<TrustAnchors> {
        let root = Folder::open(&self.repository())?.document("1.root.json")?.context("the repository has no root")?;
        let key = SecretKey::read(&self.keys().join("directive-1.pem"))?.public();
        Ok(TrustAnchors { root, directive_keys: [(key.id(), key)].into(), site })
    }
    /// All its keys.
    pub fn keys(&self) -> PathBuf {
        self.dir.path().join("keys")
    }
}
