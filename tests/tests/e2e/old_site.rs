//! A site at which a hundred thousand tasks are over, in files of SQLite and in a database of PostgreSQL: starts, takeovers, lists, lookups,
//! pruning and backups cost what is alive, or what is asked for. What counts is how many rows are read.
//!
//! Each old store is made once for this program and copied for each test. `MIDSHIFT_OLD_TASKS` says how many tasks instead.

use crate::harness::{channel, free_port, tasks, until};
use crate::room::LIMIT;
use anyhow::{Context, ensure};
use midshift_agent::clock::wall;
use midshift_backup::{Access, Places, back_up, restore, verify};
use midshift_cli::roles::Roles;
use midshift_core::rows::Table;
use midshift_core::site::{CORRIDOR, Site, text};
use midshift_core::task::TaskState;
use midshift_core::time::{Clock, Utc};
use midshift_dev::task_summary;
use midshift_dev::throwaway::Throwaway;
use midshift_process::clock::{at, clock};
use midshift_process::door;
use midshift_proto::fleet::v1::ExplainTaskRequest;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::task::v1::watch_tasks_response::Item;
use midshift_proto::task::v1::{
    FlatTask, GetTaskRequest, ListTasksRequest, SubmitTaskRequest, TaskFilter, WatchTasksRequest,
    submit_task_request::Body,
};
use midshift_server::keep_limits::KeepLimits;
use midshift_server::planning::Planning;
use midshift_server::storage::{Database, Storage};
use midshift_server::{Components, NaiveRules, Server};
use midshift_store::{Query, load};
use midshift_tests::counted::Counted;
use midshift_tests::old_site::{DAY_MS, OldSite, task_id};
use midshift_tests::old_tables;
use midshift_tests::postgres::PostgresServer;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::sync::OnceCell;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Tasks that are over, unless the environment says how many.
const ENDED: u64 = 100_000;
const VARIABLE: &str = "MIDSHIFT_OLD_TASKS";
/// Rows that one call, and what a server does beside it, may read; a list reads a hundred tasks at a time, each of them several rows.
const READ_BY_A_CALL: usize = 1_000;
/// Rows that a start or a takeover may read, and its first plans: of fifty robots, not of tasks.
const READ_BY_A_START: usize = 3_000;
/// Rows that PostgreSQL may look at for all of it: less than any table of tasks has.
const SCANNED: usize = 15_000;
/// The template in PostgreSQL.
const TEMPLATE: &str = "old_site";
const FILE: &str = "control.db";

#[derive(Clone, Copy, Debug)]
enum Engine {
    Sqlite,
    Postgres,
}

fn ended() -> anyhow::Result<u64> {
    match std::env::var(VARIABLE) {
        Ok(many) => many.parse().context(VARIABLE),
        Err(_) => Ok(ENDED),
    }
}

fn site() -> anyhow::Result<Arc<Site>> {
    Ok(Arc::new(text::parse(CORRIDOR)?))
}

/// An old site in an engine, to be used by one test.
struct Old {
    dir: TempDir,
    url: Option<String>,
    site: Arc<Site>,
}

impl Old {
    /// A copy of the one that is made at first use.
    async fn copy(engine: Engine) -> anyhow::Result<Self> {
        static FILES: OnceCell<PathBuf> = OnceCell::const_new();
        static TEMPLATE_MADE: OnceCell<()> = OnceCell::const_new();
        let dir = tempfile::tempdir()?;
        let url = match engine {
            Engine::Sqlite => {
                let made = FILES.get_or_try_init(made_in_files).await?;
                std::fs::create_dir(dir.path().join("data"))?;
                std::fs::copy(made.join(FILE), dir.path().join("data").join(FILE))?;
                None
            }
            Engine::Postgres => {
                TEMPLATE_MADE.get_or_try_init(made_in_postgresql).await?;
                let copy = || PostgresServer::shared().large_database_from(TEMPLATE);
                Some(tokio::task::block_in_place(copy))
            }
        };
        Ok(Self { dir, url, site: site()? })
    }
    fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }
    async fn open(&self) -> anyhow::Result<Storage> {
        open(&self.data(), self.url.clone(), &self.site).await
    }
    fn places(&self, data: &str, url: Option<&String>) -> anyhow::Result<Places> {
        let store = Database { store: url.cloned() }.postgres()?;
        Ok(Places { data: self.dir.path().join(data), ota_keys: None, store })
    }
}

impl Drop for Old {
    fn drop(&mut self) {
        if let Some(url) = &self.url {
            PostgresServer::shared().drop_database(url);
        }
    }
}

async fn open(data: &Path, store: Option<String>, site: &Site) -> anyhow::Result<Storage> {
    let status_log_bytes = KeepLimits::default().status_log_bytes;
    Database { store }.open(data, site.site_id().clone(), clock(1000), status_log_bytes).await
}

/// The files of an old site. They stay until the next run, which makes them anew.
async fn made_in_files() -> anyhow::Result<PathBuf> {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("old-site");
    if dir.exists() {
        std::fs::remove_dir_all(&dir)?;
    }
    make(None, &dir).await?;
    Ok(dir)
}

async fn made_in_postgresql() -> anyhow::Result<()> {
    let server = PostgresServer::shared();
    let url = tokio::task::block_in_place(|| server.database_named(TEMPLATE));
    make(Some(url.clone()), Path::new("")).await?;
    // As the server itself does it at a site that grew for weeks.
    tokio::task::block_in_place(|| server.ask(&url, "VACUUM (ANALYZE)"));
    until_alone(server, &url).await
}

async fn make(store: Option<String>, data: &Path) -> anyhow::Result<()> {
    let (ended, engine) = (ended()?, if store.is_some() { "PostgreSQL" } else { "files" });
    let begun = tokio::time::Instant::now();
    old_tables::make(&OldSite::with_ended(ended, wall()), &Database { store }, data, site()?.site_id()).await?;
    say!("{ended} ended tasks in {engine} took {:?}", begun.elapsed());
    Ok(())
}

/// Waits until nobody else uses a database.
async fn until_alone(server: &PostgresServer, url: &str) -> anyhow::Result<()> {
    let others = "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()";
    let ask = || tokio::task::block_in_place(|| server.ask(url, others));
    until("nobody else uses the database", LIMIT, async || Ok((ask() == "0").then_some(()))).await
}

/// A whole server over a store whose reads are counted, without login.
struct Serving {
    address: SocketAddr,
    counted: Arc<Counted>,
    storage: Storage,
    stop: CancellationToken,
    serving: AbortOnDropHandle<anyhow::Result<()>>,
    _planning: Planning,
    /// Keys, with which roll-outs are planned too.
    _software: Throwaway,
}

impl Serving {
    async fn start(old: &Old) -> anyhow::Result<Self> {
        let storage = old.open().await?;
        let counted = Counted::over(storage.store());
        let (planning, stop) = (Planning::start()?, CancellationToken::new());
        let (software, ota) = Throwaway::make(clock(1000)).await?;
        let parts = Components {
            roles: Roles::default(),
            drain: Duration::ZERO,
            heard: storage.heard(),
            store: counted.clone(),
            frames: storage.frames(),
            site: old.site.clone(),
            site_text: CORRIDOR.to_owned(),
            clock: clock(1000),
            ota,
            identity: None,
            port: door::alone("business"),
            reader: None,
            sim: None,
            naive: NaiveRules::default(),
            stops: None,
            stop_port: None,
            keep: Default::default(),
            jumped_before: None,
            planning: planning.handle(),
            map: Default::default(),
        };
        let server = Server::new(parts, stop.clone()).await?;
        // No port that a site with a login had in this program.
        let address = free_port()?;
        let listener = TcpListener::bind(address).await?;
        let serving = AbortOnDropHandle::new(tokio::spawn(server.serve(listener)));
        Ok(Self { address, counted, storage, stop, serving, _planning: planning, _software: software })
    }

    /// Waits until a new task was planned: it waits for its turn, and why it has no robot is known.
    async fn plans(&self, id: &str) -> anyhow::Result<()> {
        let flat = FlatTask {
            task_type: "transport".to_owned(),
            from_waypoint: "A".to_owned(),
            to_waypoint: "B".to_owned(),
            timeout_seconds: Some(600),
            ..FlatTask::default()
        };
        let request =
            SubmitTaskRequest { task_id: id.to_owned(), body: Some(Body::Flat(flat)), ..SubmitTaskRequest::default() };
        tasks(self.address)?.submit_task(request).await?;
        until("it is planned", LIMIT, async || {
            let task = tasks(self.address)?.get_task(GetTaskRequest { task_id: id.to_owned() }).await?.into_inner();
            let request = ExplainTaskRequest { task_id: id.to_owned() };
            let explained = FleetServiceClient::new(channel(self.address)?).explain_task(request).await;
            let has_reason = explained.is_ok_and(|e| e.into_inner().explanation.is_some_and(|e| e.verdict.is_some()));
            let is_ready = task.task.is_some_and(|task| task.ready_time.is_some());
            Ok((is_ready && has_reason).then_some(()))
        })
        .await
    }

    async fn end(self) -> anyhow::Result<()> {
        self.stop.cancel();
        self.serving.await??;
        self.storage.close().await;
        Ok(())
    }

    /// A page of ten; what was read for it.
    async fn list(&self, filter: TaskFilter) -> anyhow::Result<(Vec<String>, usize)> {
        self.counted.take_count();
        let request = ListTasksRequest { filter: Some(filter), page_size: 10, page_token: String::new() };
        let page = tasks(self.address)?.list_tasks(request).await?.into_inner();
        Ok((page.tasks.into_iter().map(|task| task.task_id).collect(), self.counted.take_count()))
    }
}

/// What looks at a store without changing it: each call reads about as much as it hands out. Of three counts the least: what the server
/// reads beside the calls, when its lease or its housekeeping is due, is counted with them.
async fn is_looked_up_by_index(serving: &Serving) -> anyhow::Result<()> {
    let mut read = look_up(serving).await?;
    for _ in 0..2 {
        let again = look_up(serving).await?;
        read.iter_mut().zip(again).for_each(|(read, again)| read.1 = read.1.min(again.1));
    }
    say!("rows read: {read:?}");
    ensure!(read.iter().all(|(_, rows)| *rows <= READ_BY_A_CALL), "rows read: {read:?}");
    Ok(())
}

/// Calls and how many rows were read for each.
async fn look_up(serving: &Serving) -> anyhow::Result<[(&'static str, usize); 6]> {
    let ended = ended()?;
    let newest: Vec<String> = (0..10).map(|back| task_id(ended - back).to_string()).collect();
    let by_robot = TaskFilter { robot_ids: vec!["old-r1".to_owned()], ..TaskFilter::default() };
    let by_prefix = TaskFilter { task_id_prefix: "old-1999".to_owned(), ..TaskFilter::default() };
    let named = TaskFilter { task_ids: vec![task_id(1).to_string()], ..TaskFilter::default() };
    let all = serving.list(TaskFilter::default()).await?;
    // The one that is alive was submitted last.
    ensure!(all.0[1..] == newest[..9], "{:?}", all.0);
    let of_robot = serving.list(by_robot).await?;
    ensure!(of_robot.0.len() == 10, "{:?}", of_robot.0);
    let prefixed = serving.list(by_prefix).await?;
    ensure!(prefixed.0.len() == 10 && prefixed.0.iter().all(|id| id.starts_with("old-1999")), "{:?}", prefixed.0);
    let one = serving.list(named.clone()).await?;
    ensure!(one.0 == [task_id(1).to_string()], "{:?}", one.0);
    serving.counted.take_count();
    let request = WatchTasksRequest { filter: None, cursor: String::new() };
    let mut watch = tasks(serving.address)?.watch_tasks(request).await?.into_inner();
    let mut existing = 0;
    while let Some(told) = watch.message().await? {
        match told.item {
            Some(Item::Existing(_)) => existing += 1,
            _ => break,
        }
    }
    ensure!(existing == 1, "a watch begins with what is alive, not with {existing}");
    let watched = serving.counted.take_count();
    let before = task_summary::newest_number(&*serving.counted).await?;
    let of_others = task_summary::read_once(serving.counted.clone(), "dev-", before).await?.of_others();
    ensure!(of_others == 1, "a run's client knows of what is alive, not of {of_others}");
    let tallied = serving.counted.take_count();
    Ok([
        ("all", all.1),
        ("a robot's", of_robot.1),
        ("a prefix", prefixed.1),
        ("one", one.1),
        ("watch", watched),
        ("tally", tallied),
    ])
}

async fn starts_and_answers(engine: Engine) -> anyhow::Result<()> {
    let old = Old::copy(engine).await?;
    let serving = Serving::start(&old).await?;
    serving.plans("new-1").await?;
    let read = serving.counted.take_count();
    say!("{engine:?}: a start and a first plan read {read} rows");
    ensure!(read <= READ_BY_A_START, "a start and a first plan read {read} rows");
    is_looked_up_by_index(&serving).await?;
    serving.end().await?;
    if let Some(url) = &old.url {
        let server = PostgresServer::shared();
        let sql = "SELECT sum(seq_tup_read + coalesce(idx_tup_fetch, 0)) FROM pg_stat_user_tables";
        // A process tells what it has looked at as it ends.
        until_alone(server, url).await?;
        let scanned: usize = tokio::task::block_in_place(|| server.ask(url, sql)).parse()?;
        say!("PostgreSQL looked at {scanned} rows");
        ensure!(scanned > 0 && scanned <= SCANNED, "PostgreSQL looked at {scanned} rows");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_old_store_of_sqlite_is_started_on_and_looked_up_by_reading_a_few_rows() -> anyhow::Result<()> {
    starts_and_answers(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_old_store_of_postgresql_is_started_on_and_looked_up_by_reading_a_few_rows() -> anyhow::Result<()> {
    starts_and_answers(Engine::Postgres).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_takes_an_old_site_of_postgresql_over_reads_a_few_rows() -> anyhow::Result<()> {
    let old = Old::copy(Engine::Postgres).await?;
    let leads = Serving::start(&old).await?;
    leads.plans("new-1").await?;
    let standby = Serving::start(&old).await?;
    // Killed, not ended: it leaves its row as it is.
    drop(leads.serving);
    drop(leads._planning);
    leads.storage.close().await;
    standby.plans("new-2").await?;
    let read = standby.counted.take_count();
    say!("a takeover reads {read} rows");
    ensure!(read <= READ_BY_A_START, "a takeover reads {read} rows");
    standby.end().await
}

/// What is over for too long goes, and what goes is all that is read.
async fn is_pruned(engine: Engine) -> anyhow::Result<()> {
    let old = Old::copy(engine).await?;
    let storage = old.open().await?;
    let counted = Counted::over(storage.store());
    let early: Arc<dyn Clock> = clock(1000);
    midshift_fleet::prune(&*counted, &*early).await?;
    let read = counted.take_count();
    ensure!(read <= READ_BY_A_START, "{read} rows are read where nothing is due");
    // Two days on, those of the first day are older than a month.
    let later = at(Utc(wall().0 + 2 * DAY_MS), 1000);
    let gone = midshift_fleet::prune(&*counted, &*later).await?;
    let read = counted.take_count();
    let due = ended()? / 29;
    say!("{engine:?}: {gone} rows went and {read} were read, of {due} tasks");
    ensure!((due / 2..due * 6).contains(&gone), "{gone} rows went, of {due} tasks");
    ensure!(read as u64 <= 6 * due + READ_BY_A_START as u64, "{read} rows were read for {gone} that went");
    let first = load::<TaskState>(&*counted, task_id(1).as_str()).await?;
    let last = load::<TaskState>(&*counted, task_id(ended()?).as_str()).await?;
    ensure!(first.is_none() && last.is_some(), "the oldest go");
    storage.close().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pruning_an_old_store_of_sqlite_reads_what_goes() -> anyhow::Result<()> {
    is_pruned(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pruning_an_old_store_of_postgresql_reads_what_goes() -> anyhow::Result<()> {
    is_pruned(Engine::Postgres).await
}

/// A backup of it is whole, and what is restored begins and ends with the same tasks.
async fn is_backed_up(engine: Engine) -> anyhow::Result<()> {
    let old = Old::copy(engine).await?;
    // A server has used it once: its samples are files too.
    old.open().await?.close().await;
    // Rows of releases whose files are nowhere: of those no backup is made, as another test shows.
    if let Some(url) = &old.url {
        tokio::task::block_in_place(|| PostgresServer::shared().ask(url, "DELETE FROM control.bundle"));
    }
    let backup = old.dir.path().join("backup");
    back_up(&old.places("data", old.url.as_ref())?, &backup, wall()).await?;
    verify(&backup).await?;
    let url = old.url.as_ref().map(|_| tokio::task::block_in_place(|| PostgresServer::shared().database()));
    restore(&backup, &old.places("restored", url.as_ref())?, &Access::default(), wall()).await?;
    let storage = open(&old.dir.path().join("restored"), url.clone(), &old.site).await?;
    let store = storage.store();
    for newest_first in [false, true] {
        let query = Query { newest_first, limit: 1, ..Query::all(Table::TaskState) };
        let ends = store.list(query).await?;
        let wanted = if newest_first { ended()? } else { 1 };
        ensure!(ends.len() == 1 && *ends[0].key.id == *task_id(wanted).as_str(), "{ends:?}");
    }
    storage.close().await;
    if let Some(url) = url {
        let server = PostgresServer::shared();
        tokio::task::block_in_place(|| server.drop_database(&url));
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_old_store_of_sqlite_is_backed_up_and_restored_whole() -> anyhow::Result<()> {
    is_backed_up(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_old_store_of_postgresql_is_backed_up_and_restored_whole() -> anyhow::Result<()> {
    is_backed_up(Engine::Postgres).await
}
