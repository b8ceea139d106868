//! Rows and samples: two files of SQLite, or two schemas of PostgreSQL.

use super::files::{blocking, must, write};
use super::part::{BackupFacts, Making, POSTGRES, Part, Places};
use anyhow::{Context, bail};
use async_trait::async_trait;
use midshift_store::{Database, PostgresCopy, PostgresRestore, StoreId};
use std::fs;
use std::path::{Path, PathBuf};

/// One of the two files of SQLite.
pub struct Rows(pub Database);

impl Rows {
    fn file(&self, folder: &Path) -> PathBuf {
        folder.join(self.0.file())
    }
}

#[async_trait]
impl Part for Rows {
    fn name(&self) -> &'static str {
        match self.0 {
            Database::Control => "control",
            Database::Telemetry => "telemetry",
        }
    }
    async fn copy(&self, from: &Places, folder: &Path, facts: &mut BackupFacts) -> anyhow::Result<bool> {
        if from.store.is_some() || !from.data.join(self.0.file()).is_file() {
            return Ok(false);
        }
        fs::create_dir_all(folder)?;
        self.0.copy(&from.data, &self.file(folder)).await?;
        if self.0 == Database::Control {
            facts.site_id = self.0.inspect(&self.file(folder)).await?.0.site_id;
        }
        Ok(true)
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        Ok(self.0.inspect(&self.file(folder)).await?.1)
    }
    async fn put_back(&self, folder: &Path, to: &mut Making) -> anyhow::Result<()> {
        let (from, to_file) = (self.file(folder), self.file(&to.places.data));
        blocking(move || fs::copy(from, to_file).context("copying")).await?;
        if self.0 == Database::Control {
            midshift_store::renew_identity(&to.places.data, &to.store_id).await?;
        }
        Ok(())
    }
}

/// Both schemas of a PostgreSQL database, of one moment.
pub struct Schemas;

/// What the copy of a database says of itself.
const COPIED: &str = "copied.json";

fn copied(folder: &Path) -> anyhow::Result<PostgresCopy> {
    serde_json::from_slice(&must(folder, COPIED)?).with_context(|| format!("{COPIED} is not readable"))
}

#[async_trait]
impl Part for Schemas {
    fn name(&self) -> &'static str {
        POSTGRES
    }
    async fn copy(&self, from: &Places, folder: &Path, facts: &mut BackupFacts) -> anyhow::Result<bool> {
        let Some(config) = &from.store else { return Ok(false) };
        fs::create_dir_all(folder)?;
        let Some(copy) = PostgresCopy::begin(config, folder).await? else {
            bail!("no server ever served from this database")
        };
        write(&folder.join(COPIED), &serde_json::to_vec_pretty(&copy)?)?;
        facts.bundles = copy.rows("bundle").unwrap_or(0);
        facts.store_id = Some(StoreId(copy.store_id.into()));
        facts.site_id = Some(copy.site_id);
        Ok(true)
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        let folder = folder.to_owned();
        blocking(move || Ok(copied(&folder)?.check(&folder))).await
    }
    async fn put_back(&self, folder: &Path, to: &mut Making) -> anyhow::Result<()> {
        let config = to.places.store.as_ref().context("no database is named")?;
        to.rows = Some(PostgresRestore::begin(config, folder, &copied(folder)?, &to.store_id).await?);
        Ok(())
    }
}
