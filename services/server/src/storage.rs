//! Where a server keeps its rows and samples: files of its own, or a PostgreSQL database.

use anyhow::{Context, bail};
use midshift_core::Boxed;
use midshift_core::ids::SiteId;
use midshift_core::time::Clock;
use midshift_store::{
    FrameLog, HeartbeatLog, Migrated, PostgresConfig, PostgresFrames, PostgresHeartbeats, PostgresStore, Road,
    SqliteFrames, SqliteStore, Store,
};
use std::path::Path;
use std::sync::Arc;

/// Which database.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Database {
    /// A PostgreSQL database (15 or newer) for rows and samples, postgres://USER:PASSWORD@HOST/DATABASE, instead of SQLite in --data. On another machine
    /// than this one the address ends in ?sslmode=verify-full&sslrootcert=FILE, and &sslcert=FILE&sslkey=FILE where the database asks for a
    /// certificate; ?sslmode=disable says that the network in between is trusted with everything.
    #[arg(long, value_name = "URL", env = "MIDSHIFT_STORE", hide_env_values = true)]
    pub store: Option<String>,
}

impl Database {
    /// The address if it is one of PostgreSQL; the password is never shown.
    ///
    /// # Errors
    /// If it is an address of something else, or nobody would have to prove there that it is the database.
    pub fn postgres(&self) -> anyhow::Result<Option<PostgresConfig>> {
        match &self.store {
            None => Ok(None),
            Some(url) if url.starts_with("postgres://") || url.starts_with("postgresql://") => {
                let config = PostgresConfig::new(url);
                proven(&config)?;
                Ok(Some(config))
            }
            Some(_) => bail!("--store is not an address of PostgreSQL; try postgres://USER:PASSWORD@HOST/DATABASE"),
        }
    }

    /// Brings the database, or the files in `data`, up to this version's schema.
    pub fn migrate<'a>(&'a self, data: &'a Path) -> Boxed<'a, anyhow::Result<Vec<Migrated>>> {
        Box::pin(async move {
            match self.postgres()? {
                Some(config) => Ok(midshift_store::migrate_postgres(&config).await?),
                None => Ok(midshift_store::migrate(data).await?),
            }
        })
    }

    /// Opens what is kept of `site_id`: of samples at most `status_log_bytes`.
    pub fn open<'a>(
        &'a self,
        data: &'a Path,
        site_id: SiteId,
        clock: Arc<dyn Clock>,
        status_log_bytes: u64,
    ) -> Boxed<'a, anyhow::Result<Storage>> {
        Box::pin(async move {
            match self.postgres()? {
                Some(config) => {
                    let store = PostgresStore::open(&config, site_id.clone(), clock.clone()).await;
                    let store = store.context("opening the store in PostgreSQL")?;
                    let frames = PostgresFrames::open(&config, site_id.clone(), clock, status_log_bytes).await;
                    let frames = frames.context("opening the samples in PostgreSQL")?;
                    let heard = PostgresHeartbeats::open(&config, site_id)
                        .await
                        .context("opening the heartbeats in PostgreSQL")?;
                    Ok(Storage::Postgres(Arc::new(store), Arc::new(frames), Arc::new(heard)))
                }
                None => {
                    let store = SqliteStore::open(data, site_id.clone(), clock.clone()).await?;
                    let frames = SqliteFrames::open(data, site_id, clock, status_log_bytes).await?;
                    Ok(Storage::Sqlite(Arc::new(store), Arc::new(frames)))
                }
            }
        })
    }
}

/// Refuses a way on which anybody could pass for the database.
fn proven(config: &PostgresConfig) -> anyhow::Result<()> {
    match config.road()? {
        Road::Local | Road::Proven => {}
        Road::Plain => tracing::warn!(
            "sslmode=disable: whoever is on the network between here and PostgreSQL reads and changes every row, and so commands the fleet"
        ),
        Road::Unproven => bail!(
            "--store names a database on another machine and does not say how it proves itself: add ?sslmode=verify-full&sslrootcert=FILE, the certificate that its own is signed by; on a network of its own that nobody else reaches ?sslmode=disable goes without"
        ),
    }
    Ok(())
}

/// What is open.
pub enum Storage {
    /// Two files in the data directory.
    Sqlite(Arc<SqliteStore>, Arc<SqliteFrames>),
    /// Two schemas of a database.
    Postgres(Arc<PostgresStore>, Arc<PostgresFrames>, Arc<PostgresHeartbeats>),
}

impl Storage {
    /// The rows.
    pub fn store(&self) -> Arc<dyn Store> {
        match self {
            Self::Sqlite(store, _) => store.clone(),
            Self::Postgres(store, ..) => store.clone(),
        }
    }

    /// The samples.
    pub fn frames(&self) -> Arc<dyn FrameLog> {
        match self {
            Self::Sqlite(_, frames) => frames.clone(),
            Self::Postgres(_, frames, _) => frames.clone(),
        }
    }

    /// Where several processes share newest heartbeats; none where only one may open it.
    pub fn heard(&self) -> Option<Arc<dyn HeartbeatLog>> {
        match self {
            Self::Sqlite(..) => None,
            Self::Postgres(_, _, heard) => Some(heard.clone()),
        }
    }

    /// For the log.
    pub const fn engine(&self) -> &'static str {
        match self {
            Self::Sqlite(..) => "sqlite",
            Self::Postgres(..) => "postgresql",
        }
    }

    /// Finishes what is queued and closes everything.
    pub fn close(&self) -> Boxed<'_, ()> {
        Box::pin(async move {
            match self {
                Self::Sqlite(store, frames) => {
                    store.close().await;
                    frames.close().await;
                }
                Self::Postgres(store, frames, heard) => {
                    heard.close().await;
                    store.close().await;
                    frames.close().await;
                }
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::Database;
    use midshift_core::ids::{RobotId, SiteId};
    use midshift_process::clock::clock;
    use midshift_store::Frame;

    #[tokio::test]
    async fn samples_over_the_bytes_that_are_kept_go_at_the_next_turn() {
        let dir = tempfile::tempdir().expect("a folder");
        let site = SiteId::parse("north").expect("an id");
        let frame = |seq| Frame {
            robot_id: RobotId::parse("r1").expect("an id"),
            ring: "ring".into(),
            first_seq: seq,
            last_seq: seq,
            bytes: vec![1; 100].into(),
        };
        for (bytes, went) in [(1 << 20, false), (1, true)] {
            let storage = Database::default().open(dir.path(), site.clone(), clock(1000), bytes).await.expect("open");
            storage.frames().append(vec![frame(bytes), frame(bytes + 1)]).await.expect("kept");
            assert_eq!(storage.frames().prune().await.expect("pruned") > 0, went, "{bytes} bytes are kept");
            storage.close().await;
        }
    }

    #[test]
    fn a_database_elsewhere_that_proves_nothing_is_refused_and_told_what_to_add() {
        let said = |store: &str| Database { store: Some(store.to_owned()) }.postgres().map(|_| ());
        let refused = said("postgres://midshift:secret@db.local/midshift").expect_err("it is refused").to_string();
        assert!(refused.contains("sslmode=verify-full") && !refused.contains("secret"), "{refused}");
        assert!(said("postgres://midshift@db.local/midshift?sslmode=require").is_err());
        for taken in [
            "localhost/midshift",
            "db/midshift?sslmode=verify-full&sslrootcert=/root.crt",
            "db/midshift?sslmode=disable",
        ] {
            said(&format!("postgres://midshift@{taken}")).expect(taken);
        }
    }
}
