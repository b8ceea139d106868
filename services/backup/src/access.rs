//! Who is let in again by rows that were restored: what was taken back after the backup is taken back again, or a person says what is to be.
//!
//! Invariant: rows that let somebody in become a store only with a list of revocations, or by a person's word. Both engines are put right before
//! their rows make a server of the rest.

use super::files::blocking;
use super::part::Making;
use anyhow::{Context, bail};
use midshift_core::identity::Revocation;
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Row, Writer};
use midshift_core::time::Utc;
use midshift_identity::RevocationList;
use midshift_identity::restored::{self, TABLES, Tokens};
use midshift_store::SqliteRestored;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

/// What is to become of tokens, where a person says it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Identity {
    /// Tokens and robots are as good as they were at the backup: those that were revoked since are let in again.
    AsBackedUp,
    /// All tokens end, and a new one that may do everything is printed. Robots stay as they were at the backup.
    ReIssue,
}

impl Identity {
    /// As it is typed.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::AsBackedUp => "as-backed-up",
            Self::ReIssue => "re-issue",
        }
    }
}

/// What a person says of who is let in.
#[derive(Clone, Debug, Default)]
pub struct Access {
    /// A list of what was taken back.
    pub revocations: Option<PathBuf>,
    /// What becomes of tokens.
    pub identity: Option<Identity>,
}

/// Who is let in no more after a restore, and the new token if one was asked for.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct AccessOutcome {
    /// Tokens that ended.
    pub tokens: usize,
    /// Keys of robots that were taken out.
    pub keys: usize,
    /// The new token; none: none was asked for.
    pub secret: Option<String>,
    /// Nobody can administer the site with a token of the backup.
    pub is_orphaned: bool,
}

impl fmt::Debug for AccessOutcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The secret is for whoever asked, and for no log.
        f.debug_struct("Settled").field("tokens", &self.tokens).field("keys", &self.keys).finish_non_exhaustive()
    }
}

const ASKED: &str = "the backup would let in again whoever was revoked since, so say how. \
    Best: --revocations FILE, the list revocations.jsonl of the lost server (in its folder identity, and a copy in the folder stop of its stop service, which \
    may be on another machine): what it names stays out. \
    Without it: --identity re-issue (all tokens end and a new one that may do everything is printed; robots that were revoked since come back: revoke them again), or \
    --identity as-backed-up (tokens and robots that were revoked since come back)";

impl Access {
    /// The list, which is read before anything is restored.
    ///
    /// # Errors
    /// It cannot be read, or the two contradict each other.
    pub fn list(&self) -> anyhow::Result<Vec<Revocation>> {
        let Some(path) = &self.revocations else { return Ok(Vec::new()) };
        if self.identity == Some(Identity::AsBackedUp) {
            bail!("--identity as-backed-up takes nothing back: leave it out, or leave --revocations out");
        }
        RevocationList::read(path).context("reading what was taken back")
    }

    /// Puts rows right that are about to be a store, of a folder that has no name yet or in a transaction that is open.
    ///
    /// # Errors
    /// A person must say something first; or rows cannot be read or written.
    pub async fn put_right(
        &self,
        list: &[Revocation],
        site_id: &str,
        making: &mut Making,
    ) -> anyhow::Result<AccessOutcome> {
        let site_id = SiteId::parse(site_id).context("reading whose the backup is")?;
        let data = making.places.data.clone();
        let settled = match &mut making.rows {
            Some(rows) => {
                let found = rows.rows(&site_id, &TABLES).await?;
                let (item, settled) = self.decide(&found, list, making.now)?.unwrap_or_else(nothing);
                rows.amend(&site_id, &item).await?;
                settled
            }
            None => {
                let mut rows = SqliteRestored::open(&data, site_id).await?;
                let found = rows.rows(&TABLES).await?;
                let (item, settled) = self.decide(&found, list, making.now)?.unwrap_or_else(nothing);
                rows.amend(&item).await?;
                settled
            }
        };
        if let Some(list) = self.revocations.clone() {
            blocking(move || copy_list(&list, &data.join(midshift_identity::FOLDER))).await?;
        }
        Ok(settled)
    }

    /// What is to be written; none: nobody is let in, so that there is nothing to ask.
    fn decide(&self, rows: &[Row], list: &[Revocation], now: Utc) -> anyhow::Result<Option<(Item, AccessOutcome)>> {
        if self.revocations.is_none() && self.identity.is_none() {
            if restored::lets_somebody_in(rows, now)? {
                bail!(ASKED);
            }
            return Ok(None);
        }
        if self.identity == Some(Identity::AsBackedUp) {
            return Ok(None);
        }
        let tokens = if self.identity == Some(Identity::ReIssue) { Tokens::Reissue } else { Tokens::Stay };
        let restored = restored::put_right(rows, list, tokens, now)?;
        let settled = AccessOutcome {
            tokens: restored.tokens,
            keys: restored.keys,
            secret: restored.secret,
            is_orphaned: !restored.is_administered,
        };
        Ok(Some((restored.item, settled)))
    }
}

fn nothing() -> (Item, AccessOutcome) {
    (Item::new(Writer::Identity, "midshift"), AccessOutcome::default())
}

/// The list goes on in the restored server: what it names, and these rows do not know, may be in a later backup.
fn copy_list(list: &Path, folder: &Path) -> anyhow::Result<()> {
    let lines = fs::read(list).with_context(|| format!("reading {}", list.display()))?;
    midshift_identity::make_folder(folder)
        .with_context(|| format!("keeping what was taken back: {} must be a folder", folder.display()))?;
    let to = folder.join(RevocationList::FILE);
    midshift_durable::replace_with(&to, &lines, midshift_durable::PRIVATE)
        .with_context(|| format!("writing {}", to.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn the_list_goes_on_also_where_the_backup_had_no_keys_and_never_where_no_folder_can_be() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        fs::write(at("list"), "{}\n").expect("written");
        copy_list(&at("list"), &at("identity")).expect("kept");
        let kept = at("identity").join(RevocationList::FILE);
        let mode = |path: &Path| fs::metadata(path).expect("there").permissions().mode() & 0o777;
        assert_eq!((mode(&at("identity")), mode(&kept)), (0o700, 0o600));
        assert_eq!(fs::read_to_string(kept).expect("read"), "{}\n");
        let error = copy_list(&at("list"), &at("list")).expect_err("a file is there");
        assert!(format!("{error:#}").contains("must be a folder"), "{error:#}");
    }
}
