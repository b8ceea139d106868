//! Online keys.

use super::files::{blocking, copy, entries};
use super::part::{BackupFacts, KEYS, Making, Part, Places};
use anyhow::ensure;
use async_trait::async_trait;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Keys that the server signs with by itself. Whoever has the backup has them.
pub struct OnlineKeys;

const ROLES: [&str; 3] = ["snapshot-", "timestamp-", "directive-"];

#[async_trait]
impl Part for OnlineKeys {
    fn name(&self) -> &'static str {
        KEYS
    }
    async fn copy(&self, from: &Places, folder: &Path, _facts: &mut BackupFacts) -> anyhow::Result<bool> {
        let Some(keys) = from.ota_keys.clone() else { return Ok(false) };
        let folder = folder.to_owned();
        blocking(move || {
            fs::create_dir_all(&folder)?;
            let mut some = false;
            for path in entries(&keys)? {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                if name.ends_with(".pem") && ROLES.iter().any(|role| name.starts_with(role)) {
                    copy(&path, &folder.join(name))?;
                    some = true;
                }
            }
            ensure!(some, "{} has no key of a server", keys.display());
            Ok(true)
        })
        .await
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        let keys = folder.to_owned();
        let read = blocking(move || Ok(midshift_ota::repository::OnlineKeys::read(&keys).err())).await?;
        Ok(read.iter().map(ToString::to_string).collect())
    }
    async fn put_back(&self, folder: &Path, to: &mut Making) -> anyhow::Result<()> {
        let (from, to) = (folder.to_owned(), to.places.ota_keys.clone().unwrap_or_else(|| to.places.data.join(KEYS)));
        blocking(move || {
            fs::create_dir_all(&to)?;
            fs::set_permissions(&to, fs::Permissions::from_mode(0o700))?;
            for path in entries(&from)? {
                copy(&path, &to.join(path.file_name().unwrap_or_default()))?;
            }
            Ok(())
        })
        .await
    }
}
