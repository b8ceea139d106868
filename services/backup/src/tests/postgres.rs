//! A backup of a server on PostgreSQL has its rows and its releases, and becomes one store again or nothing.

use super::{NOW, let_in, list_of_both, release, site, somebody_known};
use crate::part::POSTGRES;
use crate::postgres_server::PostgresServer;
use crate::staging::Staging;
use crate::{Access, Identity, Places, back_up, name_all, restore, verify};
use midshift_core::item::{Expect, Item, RowChange, Write};
use midshift_core::rows::{Index, Key, Table, Writer};
use midshift_ota::content::Room;
use midshift_ota::folder::{Owner, mark};
use midshift_ota::{OtaService, Parts};
use midshift_process::clock;
use midshift_store::{PostgresConfig, PostgresCopy, PostgresFrames, PostgresRestore, PostgresStore, Store, StoreId};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tempfile::TempDir;

fn database() -> PostgresConfig {
    PostgresConfig::new(PostgresServer::shared().database())
}

async fn open(config: &PostgresConfig) -> PostgresStore {
    PostgresStore::open(config, site(), clock::clock(1000)).await.expect("a store")
}

/// A server's database, in use, and its data directory.
struct Used {
    dir: TempDir,
    config: PostgresConfig,
    store: PostgresStore,
}

impl Used {
    /// With one row of this table.
    async fn new(table: Table, writer: Writer) -> Self {
        let (dir, config) = (tempfile::tempdir().expect("a folder"), database());
        let store = open(&config).await;
        PostgresFrames::open(&config, site(), clock::clock(1000), 1 << 20).await.expect("a log");
        let write = Write::Put { body: Arc::from("{}"), index: Index::default() };
        let change = RowChange { key: Key::new(table, "a"), expect: Expect::Absent, write, kind: "row.put" };
        let item = Item { rows: vec![change], ..Item::new(writer, "test") };
        store.commit(vec![item]).await.remove(0).expect("applied");
        Self { dir, config, store }
    }
    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }
    fn places(&self) -> Places {
        Places { data: self.at("data"), ota_keys: None, store: Some(self.config.clone()) }
    }
    /// Releases in its data directory that say whose they are. Where the keys are.
    async fn released(&self, owner: &StoreId) -> PathBuf {
        let keys = release(self.dir.path(), &self.at("data"), 1).await;
        mark(&self.at("data").join("ota"), owner).expect("written");
        keys
    }
    async fn backed_up(&self) -> PathBuf {
        back_up(&self.places(), &self.at("backup"), NOW).await.expect("a backup");
        self.at("backup")
    }
    fn left(&self) -> Vec<String> {
        let entries = fs::read_dir(self.dir.path()).expect("a folder");
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect()
    }
}

/// Where a restore goes.
fn restored(used: &Used, config: &PostgresConfig) -> Places {
    Places { data: used.at("restored"), ota_keys: None, store: Some(config.clone()) }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rows_of_postgresql_and_their_releases_become_one_store_of_its_own() {
    let used = Used::new(Table::Bundle, Writer::Ota).await;
    let keys = used.released(used.store.id()).await;
    let backup = used.backed_up().await;
    let summary = verify(&backup).await.expect("it is good");
    let names: Vec<&str> = summary.parts.iter().map(|(name, ..)| name.as_str()).collect();
    assert_eq!((summary.site_id.as_str(), summary.begun, names), ("north", NOW, vec![POSTGRES, "ota"]));
    let config = database();
    let to = restored(&used, &config);
    restore(&backup, &to, &Access::default(), NOW).await.expect("restored");
    let store = open(&config).await;
    assert_ne!(store.id(), used.store.id());
    assert_eq!(store.snapshot(&[Table::Bundle]).await.expect("rows").rows.len(), 1);
    let owned = |folder: &Path| Parts {
        folder: folder.join("ota"),
        keys: keys.clone(),
        room: Room::with_quota(1 << 30),
        clock: clock::clock(1000),
        owner: Owner::Shared { store_id: store.id().clone(), known_bundles: 1 },
    };
    OtaService::open(owned(&to.data)).await.expect("its own");
    let error = OtaService::open(owned(&used.at("data"))).await.err().expect("the lost server's").to_string();
    assert!(error.contains("belongs to store"), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rows_of_postgresql_let_nobody_in_again_who_was_revoked_since_but_by_a_persons_word() {
    let used = Used::new(Table::Attempt, Writer::Fleet).await;
    used.store.commit(vec![somebody_known()]).await.remove(0).expect("applied");
    let backup = used.backed_up().await;
    let to = |name: &str, config: &PostgresConfig| Places {
        data: used.at(name),
        ota_keys: None,
        store: Some(config.clone()),
    };
    let config = database();
    let error = restore(&backup, &to("asked", &config), &Access::default(), NOW).await.expect_err("a person must say");
    assert!(format!("{error:#}").contains("--revocations FILE"), "{error:#}");
    assert!(!used.at("asked").exists());
    let list = list_of_both(used.dir.path());
    let (_, settled) = restore(&backup, &to("merged", &config), &list, NOW).await.expect("nothing was left");
    assert_eq!((settled.tokens, settled.keys), (1, 1));
    assert_eq!(let_in(&open(&config).await).await, (false, false));
    let config = database();
    let access = Access { revocations: None, identity: Some(Identity::ReIssue) };
    let (_, settled) = restore(&backup, &to("issued", &config), &access, NOW).await.expect("restored");
    assert!(settled.secret.is_some());
    assert_eq!(let_in(&open(&config).await).await, (false, true));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_of_one_engine_does_not_become_the_other() {
    let used = Used::new(Table::Attempt, Writer::Fleet).await;
    let backup = used.backed_up().await;
    let files = Places { store: None, ..restored(&used, &used.config) };
    let error = restore(&backup, &files, &Access::default(), NOW).await.expect_err("no database").to_string();
    assert!(error.contains("rows of PostgreSQL") && error.contains("SQLite") && error.contains("--store"), "{error}");
    let sqlite = Places { data: used.at("sqlite"), ota_keys: None, store: None };
    drop(midshift_store::SqliteStore::open(&sqlite.data, site(), clock::clock(1000)).await.expect("a store"));
    back_up(&sqlite, &used.at("of-sqlite"), NOW).await.expect("a backup");
    let error = restore(&used.at("of-sqlite"), &restored(&used, &database()), &Access::default(), NOW)
        .await
        .expect_err("a database");
    let error = error.to_string();
    assert!(error.contains("rows of SQLite") && error.contains("PostgreSQL") && error.contains("--store"), "{error}");
    assert!(!used.at("restored").exists());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_folder_of_another_store_or_without_the_releases_that_rows_know_is_not_copied() {
    let used = Used::new(Table::Bundle, Writer::Ota).await;
    fs::create_dir_all(used.at("data").join("ota")).expect("a volume that is not mounted");
    let error = back_up(&used.places(), &used.at("backup"), NOW).await.expect_err("nothing is there");
    assert!(format!("{error:#}").contains("the store knows 1 bundles"), "{error:#}");
    used.released(&StoreId::fresh()).await;
    let error = back_up(&used.places(), &used.at("backup"), NOW).await.expect_err("another's");
    assert!(format!("{error:#}").contains("belongs to store"), "{error:#}");
    assert!(!used.at("backup").exists());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn spoiled_rows_are_each_named_and_nothing_is_restored_of_them() {
    let used = Used::new(Table::Attempt, Writer::Fleet).await;
    let backup = used.backed_up().await;
    let [cut, flipped] =
        ["control/attempt.copy", "control/store_head.copy"].map(|file| backup.join(POSTGRES).join(file));
    let wholes = [&cut, &flipped].map(|file| fs::read(file).expect("a file"));
    fs::write(&cut, &wholes[0][..30]).expect("written");
    let mut other = wholes[1].clone();
    other[20] ^= 1;
    fs::write(&flipped, other).expect("written");
    let error = verify(&backup).await.expect_err("it is not good").to_string();
    let told = [
        "postgresql/control/attempt.copy is not what was copied",
        "postgresql/control/store_head.copy is not what was copied",
        "postgresql: control.attempt: row 1",
        "postgresql: control.store_head: row 1 has 2 columns, not 3",
    ];
    assert!(told.iter().all(|told| error.contains(told)), "{error}");
    let config = database();
    let to = restored(&used, &config);
    restore(&backup, &to, &Access::default(), NOW).await.expect_err("it is not good");
    assert!(!to.data.exists());
    fs::write(&cut, &wholes[0]).expect("written");
    fs::write(&flipped, &wholes[1]).expect("written");
    restore(&backup, &to, &Access::default(), NOW).await.expect("nothing was left");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn into_a_database_with_rows_nothing_is_restored() {
    let used = Used::new(Table::Attempt, Writer::Fleet).await;
    let backup = used.backed_up().await;
    let error =
        restore(&backup, &restored(&used, &used.config), &Access::default(), NOW).await.expect_err("it has rows");
    assert!(format!("{error:#}").contains("goes into an empty one only"), "{error:#}");
    let mut left = used.left();
    left.sort();
    assert_eq!(left, ["backup"], "nothing half is left");
    let nowhere = Places { store: Some(database()), ..used.places() };
    let error = back_up(&nowhere, &used.at("of-nothing"), NOW).await.expect_err("there is nothing");
    assert!(format!("{error:#}").contains("no server ever served from this database"), "{error:#}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn when_nobody_knows_whether_the_rows_came_folders_stay_and_people_are_told() {
    let used = Used::new(Table::Attempt, Writer::Fleet).await;
    let copy = PostgresCopy::begin(&used.config, used.dir.path()).await.expect("read").expect("a copy");
    let server = PostgresServer::shared();
    let config = PostgresConfig::new(server.database_named("silent"));
    let rows = PostgresRestore::begin(&config, used.dir.path(), &copy, &StoreId::fresh()).await.expect("rows");
    server.emptied("silent");
    let place = Staging::new(&used.at("restored")).expect("a folder");
    let error = name_all([(place, used.at("restored"))].into_iter(), Some(rows)).await.expect_err("it is gone");
    let told = format!("{error:#}");
    assert!(told.contains("has not said whether it took the rows") && told.contains("restore again"), "{told}");
    assert!(used.at("restored").is_dir());
}
