//! The site's authority and the server's own key.

use super::files::{blocking, copy, entries};
use super::part::{BackupFacts, Making, Part, Places};
use anyhow::ensure;
use async_trait::async_trait;
use midshift_identity::{FOLDER, RevocationList};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Keys and certificates of the server. Whoever has the backup can be the site.
pub struct Identity;

/// Without this one nobody can sign for the robots and people that trust the site.
const AUTHORITY: &str = "authority.pem";

#[async_trait]
impl Part for Identity {
    fn name(&self) -> &'static str {
        FOLDER
    }
    async fn copy(&self, from: &Places, folder: &Path, _facts: &mut BackupFacts) -> anyhow::Result<bool> {
        let (from, folder) = (from.data.join(FOLDER), folder.to_owned());
        blocking(move || {
            if !from.is_dir() {
                return Ok(false);
            }
            carry(&from, &folder).map(|()| true)
        })
        .await
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        let authority = folder.join(AUTHORITY);
        blocking(move || {
            let text = fs::read_to_string(&authority).unwrap_or_default();
            let is_whole = ["PRIVATE KEY-----\n", "-----END CERTIFICATE-----\n"].iter().all(|part| text.contains(part));
            Ok(if is_whole { Vec::new() } else { vec![format!("{} has no key and certificate", authority.display())] })
        })
        .await
    }
    async fn put_back(&self, folder: &Path, to: &mut Making) -> anyhow::Result<()> {
        let (from, to) = (folder.to_owned(), to.places.data.join(FOLDER));
        blocking(move || carry(&from, &to)).await
    }
}

/// Files that are written, not those that are being; and not the list of what was taken back: one that is as old as the rows takes nothing back in them.
fn carry(from: &Path, to: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(to)?;
    fs::set_permissions(to, fs::Permissions::from_mode(0o700))?;
    let mut some = false;
    for path in entries(from)? {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if !name.starts_with('.') && name != RevocationList::FILE {
            copy(&path, &to.join(name))?;
            some = true;
        }
    }
    ensure!(some, "{} is empty", from.display());
    Ok(())
}
