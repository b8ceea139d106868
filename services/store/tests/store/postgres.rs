//! Several processes on one PostgreSQL database: order, guards, migrations, wakes.

use crate::server::PostgresServer;
use crate::support::{
    at, clock, database, item, number, one, postgres_at, put, say, site, stranger, until_a_writer_waits,
};
use midshift_core::ids::SiteId;
use midshift_core::item::Expect;
use midshift_core::rows::{Key, Log, Revision, Seq, Table, Writer};
use midshift_store::{
    CommitError, OpenError, PostgresConfig, PostgresFrames, PostgresStore, Store, Wakes, migrate_postgres,
};
use sqlx::postgres::PgListener;
use sqlx::{AssertSqlSafe, Row};
use std::path::Path;
use std::sync::Arc;

const LOCK_HEAD: &str = "BEGIN; SELECT seq FROM store_head WHERE site_id = 'north' FOR UPDATE";

/// An entry that another process writes, numbered by itself.
fn entry(seq: i64) -> String {
    format!(
        "INSERT INTO fleet_event (site_id, seq, subject, revision, kind, actor, at_unix_ms) \
         VALUES ('north', {seq}, 's', 0, 'event', 'other', 0)"
    )
}

fn move_head(seq: i64) -> String {
    format!("UPDATE store_head SET seq = {seq} WHERE site_id = 'north'")
}

async fn race(config: &PostgresConfig) {
    const EACH: u64 = 40;
    let stores = [Arc::new(postgres_at(config).await), Arc::new(postgres_at(config).await)];
    assert_eq!(stores[0].id(), stores[1].id());
    let start = stores[0].snapshot(&[]).await.unwrap().seq;
    let mut tasks = tokio::task::JoinSet::new();
    for (process, store) in stores.iter().enumerate() {
        let store = store.clone();
        tasks.spawn(async move {
            for n in 0..EACH {
                loop {
                    let shared = store.get(vec![Key::new(Table::ServiceClock, "shared")]).await.unwrap();
                    let expect = shared.first().map_or(Expect::Absent, |row| Expect::At(row.revision));
                    let own = put(Table::Attempt, &format!("{process}/{n}"), Expect::Absent, "{}");
                    match one(&*store, Writer::Fleet, vec![own, put(Table::ServiceClock, "shared", expect, "{}")]).await
                    {
                        Ok(_) => break,
                        Err(CommitError::Conflict { key, .. }) => assert_eq!(key.table, Table::ServiceClock),
                        Err(other) => panic!("{other}: {other:?}"),
                    }
                }
            }
        });
    }
    tasks.join_all().await;
    let shared = stores[1].get(vec![Key::new(Table::ServiceClock, "shared")]).await.unwrap();
    assert_eq!(shared[0].revision, Revision(2 * EACH), "each item was applied once");
    let page = stores[1].feed(start, &[Log::Fleet], 5_000).await.unwrap();
    let numbers: Vec<u64> = page.entries.iter().map(|e| e.seq.0).collect();
    assert_eq!(numbers, (start.0 + 1..=start.0 + 4 * EACH).collect::<Vec<_>>());
    let revisions = page.entries.iter().filter(|e| e.table == Some(Table::ServiceClock)).map(|e| e.revision.0);
    assert!(revisions.eq(1..=2 * EACH), "in the order in which they were applied");
}

#[tokio::test]
async fn two_processes_that_race_on_one_row_apply_each_item_once() {
    race(&database().await).await;
}

#[tokio::test]
async fn a_database_that_is_serializable_undoes_transactions_and_they_are_tried_again() {
    let config = database().await;
    let mut other = stranger(&config).await;
    let name: String = sqlx::query_scalar("SELECT current_database()").fetch_one(&mut other).await.unwrap();
    say(&mut other, &format!("ALTER DATABASE {name} SET default_transaction_isolation = 'serializable'")).await;
    let store = postgres_at(&config).await;
    let head = store.snapshot(&[]).await.unwrap().seq.0.cast_signed();
    say(&mut other, LOCK_HEAD).await;
    let waiting =
        tokio::spawn(
            async move { one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await },
        );
    until_a_writer_waits(&mut other).await;
    say(&mut other, &format!("{}; {}; COMMIT", entry(head + 1), move_head(head + 1))).await;
    assert_eq!(waiting.await.unwrap().unwrap().seq, Seq(head.cast_unsigned() + 2));
    let undone = format!("{name}: ERROR:  could not serialize access");
    assert!(PostgresServer::shared().log().contains(&undone), "the fault happened");
    race(&config).await;
}

#[tokio::test]
async fn numbers_are_given_in_the_order_of_commits_while_another_process_holds_its_transaction_open() {
    let config = database().await;
    let store = Arc::new(postgres_at(&config).await);
    let mut other = stranger(&config).await;
    let head = store.snapshot(&[]).await.unwrap().seq;
    let taken = head.0.cast_signed() + 1;
    say(&mut other, &format!("{LOCK_HEAD}; {}; {}", entry(taken), move_head(taken))).await;
    let writer = store.clone();
    let waiting = tokio::spawn(async move {
        one(&*writer, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await
    });
    until_a_writer_waits(&mut stranger(&config).await).await;
    let page = store.feed(head, &[Log::Fleet], 10).await.unwrap();
    assert_eq!((page.entries.len(), page.next), (0, head), "readers stay before what is under way");
    say(&mut other, "COMMIT").await;
    let applied = waiting.await.unwrap().unwrap();
    let page = store.feed(page.next, &[Log::Fleet], 10).await.unwrap();
    let numbers: Vec<Seq> = page.entries.iter().map(|e| e.seq).collect();
    assert_eq!(numbers, [Seq(taken.cast_unsigned()), applied.seq], "nothing is passed over");
}

/// Why the head row is locked before numbers are given: the naive writer loses an entry for every reader.
#[tokio::test]
async fn numbers_taken_without_the_head_row_are_passed_over_by_readers() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let head = store.snapshot(&[]).await.unwrap().seq;
    let number = head.0.cast_signed();
    let (mut slow, mut quick) = (stranger(&config).await, stranger(&config).await);
    say(&mut slow, &format!("BEGIN; {}", entry(number + 1))).await;
    say(&mut quick, &format!("BEGIN; {}; {}; COMMIT", entry(number + 2), move_head(number + 2))).await;
    let page = store.feed(head, &[Log::Fleet], 10).await.unwrap();
    say(&mut slow, "COMMIT").await;
    let rest = store.feed(page.next, &[Log::Fleet], 10).await.unwrap();
    assert_eq!((page.entries.len(), rest.entries.len()), (1, 0), "one of two entries is never seen");
}

#[tokio::test]
async fn a_row_of_a_table_of_a_newer_version_hides_no_entry_beside_it() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let head = store.snapshot(&[]).await.unwrap().seq;
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await.unwrap();
    let newer = head.0.cast_signed() + 2;
    let row = format!(
        "INSERT INTO fleet_event (site_id, seq, tbl, subject, revision, body, kind, actor, at_unix_ms) \
         VALUES ('north', {newer}, 'next_version', 's', 1, '{{}}', 'offered', 'other', 0)"
    );
    say(&mut stranger(&config).await, &format!("{LOCK_HEAD}; {row}; {}; COMMIT", move_head(newer))).await;
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "b", Expect::Absent, "{}")]).await.unwrap();

    let page = store.feed(head, &[Log::Fleet], 10).await.unwrap();
    let tables: Vec<_> = page.entries.iter().map(|e| (e.table, &*e.subject, e.body.is_some())).collect();
    assert_eq!(
        tables,
        [(Some(Table::Attempt), "a", true), (None, "s", false), (Some(Table::Attempt), "b", true)],
        "and it is nothing that this version obeys"
    );
    assert_ne!(&*page.entries[1].kind, "offered");
    let (mut after, mut seen) = (head, 0);
    while after < page.next {
        let one = store.feed(after, &[Log::Fleet], 1).await.unwrap();
        (after, seen) = (one.next, seen + one.entries.len());
    }
    assert_eq!(seen, 3, "also one at a time");
}

#[tokio::test]
async fn a_kept_row_guards_against_another_process() {
    let config = database().await;
    let store = Arc::new(postgres_at(&config).await);
    one(&*store, Writer::Telemetry, vec![put(Table::Presence, "r1", Expect::Absent, "{}")]).await.unwrap();
    let mut other = stranger(&config).await;
    say(&mut other, &format!("{LOCK_HEAD}; UPDATE presence SET revision = 2 WHERE id = 'r1'")).await;
    let mut relying = item(Writer::Fleet, vec![put(Table::RobotAuthority, "r1", Expect::Absent, "{}")]);
    relying.keep_row(Key::new(Table::Presence, "r1"), at(1));
    let writer = store.clone();
    let waiting = tokio::spawn(async move { writer.commit(vec![relying]).await.remove(0) });
    until_a_writer_waits(&mut stranger(&config).await).await;
    say(&mut other, "COMMIT").await;
    let refused = waiting.await.unwrap();
    assert!(matches!(refused, Err(CommitError::Conflict { found: Some(Revision(2)), .. })), "{refused:?}");
    assert!(store.get(vec![Key::new(Table::RobotAuthority, "r1")]).await.unwrap().is_empty());
}

#[tokio::test]
async fn processes_that_start_at_once_on_an_empty_database_make_one_store() {
    let config = PostgresConfig::new(PostgresServer::shared().database());
    let open = || PostgresStore::open(&config, site(), clock());
    let frames = || PostgresFrames::open(&config, site(), clock(), 1_000);
    let (a, b, c, d, e, f) = tokio::join!(open(), open(), open(), open(), frames(), frames());
    let stores = [a.unwrap(), b.unwrap(), c.unwrap(), d.unwrap()];
    assert!(e.is_ok() && f.is_ok());
    assert!(stores.iter().all(|store| store.id() == stores[0].id()));
    let again = migrate_postgres(&config).await.unwrap();
    assert!(again.iter().all(|schema| schema.applied.is_empty() && schema.from == schema.to), "{again:?}");
}

#[tokio::test]
async fn of_two_sites_that_start_at_once_one_has_the_database() {
    let config = PostgresConfig::new(PostgresServer::shared().database());
    let open = |id: &str| PostgresStore::open(&config, SiteId::parse(id).unwrap(), clock());
    let (north, south) = tokio::join!(open("north"), open("south"));
    let refused = if north.is_ok() { south.err() } else { north.err().filter(|_| south.is_ok()) };
    assert!(matches!(refused, Some(OpenError::OtherSite { .. })), "{refused:?}");
}

#[tokio::test]
async fn a_database_that_is_newer_or_not_durable_or_not_there_is_refused() {
    let config = database().await;
    let mut other = stranger(&config).await;
    let name: String = sqlx::query_scalar("SELECT current_database()").fetch_one(&mut other).await.unwrap();
    let open = async || PostgresStore::open(&config, site(), clock()).await.map(|_| ()).unwrap_err();
    say(&mut other, "INSERT INTO schema_version (version, name) VALUES (9999, 'of the future')").await;
    let newer = open().await;
    assert!(matches!(newer, OpenError::NewerSchema { found: 9_999, .. }), "{newer:?}");
    say(&mut other, &format!("ALTER DATABASE {name} SET synchronous_commit = off")).await;
    let careless = open().await;
    assert!(matches!(careless, OpenError::NotDurable { name: "synchronous_commit", .. }), "{careless:?}");
    let nowhere = PostgresConfig::new(PostgresServer::shared().url("nowhere"));
    assert!(matches!(PostgresStore::open(&nowhere, site(), clock()).await, Err(OpenError::Sql { .. })));
}

/// The newest number that `listener` hears of.
async fn heard(listener: &mut PgListener) -> Seq {
    Seq(listener.recv().await.unwrap().payload().parse().unwrap())
}

#[tokio::test]
async fn a_commit_is_told_to_other_processes_outside_its_transaction() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let mut other = stranger(&config).await;
    let channel = "SELECT query FROM pg_stat_activity WHERE datname = current_database() AND query LIKE 'LISTEN%'";
    let listening = loop {
        if let Some(row) = sqlx::query(channel).fetch_optional(&mut other).await.unwrap() {
            break row.get::<String, _>(0);
        }
    };
    let mut listener = PgListener::connect(&config.url).await.unwrap();
    listener.listen(listening.trim_start_matches("LISTEN ").trim_matches('"')).await.unwrap();
    let applied = one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    while heard(&mut listener).await < applied.seq {}
}

async fn woken(config: &PostgresConfig, before_the_commit: impl AsyncFnOnce()) {
    let (writer, reader) = (postgres_at(config).await, postgres_at(config).await);
    before_the_commit().await;
    let mut wake = reader.wake();
    let applied = one(&writer, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    wake.wait_for(|seq| *seq >= applied.seq).await.unwrap();
}

#[tokio::test]
async fn a_process_whose_listener_is_dead_still_wakes() {
    let config = database().await;
    let mut other = stranger(&config).await;
    let listeners = "FROM pg_stat_activity WHERE datname = current_database() AND query LIKE 'LISTEN%'";
    woken(&config, async || {
        while number(&mut other, &format!("SELECT COUNT(*) {listeners}")).await < 2 {}
        let ended = number(&mut other, &format!("SELECT COUNT(pg_terminate_backend(pid)) {listeners}")).await;
        assert_eq!(ended, 2, "the fault happened");
    })
    .await;
}

#[tokio::test]
async fn without_notifications_a_process_wakes_all_the_same() {
    let config = PostgresConfig { wakes: Wakes::Swept, ..database().await };
    let mut other = stranger(&config).await;
    woken(&config, async || {}).await;
    let spoken = "SELECT COUNT(*) FROM pg_stat_activity WHERE datname = current_database() \
                  AND (query LIKE 'LISTEN%' OR query LIKE '%pg_notify%') AND pid <> pg_backend_pid()";
    assert_eq!(number(&mut other, spoken).await, 0, "nobody listens and nobody tells");
}

#[tokio::test]
async fn the_schema_on_postgresql_is_the_golden_one() {
    let config = database().await;
    let mut other = stranger(&config).await;
    let columns = "SELECT format('%s.%s.%s %s%s%s', c.table_schema, c.table_name, c.column_name, c.data_type, \
         COALESCE(' collate ' || c.collation_name, ''), CASE c.is_nullable WHEN 'NO' THEN ' not null' ELSE '' END) \
         FROM information_schema.columns c WHERE c.table_schema IN ('control', 'telemetry') \
         ORDER BY c.table_schema COLLATE \"C\", c.table_name COLLATE \"C\", c.ordinal_position";
    let indexes = "SELECT indexdef FROM pg_indexes WHERE schemaname IN ('control', 'telemetry') \
         ORDER BY schemaname, indexname COLLATE \"C\"";
    let mut schema = String::new();
    for select in [columns, indexes] {
        for row in sqlx::query(AssertSqlSafe(select)).fetch_all(&mut other).await.unwrap() {
            schema += &(row.get::<String, _>(0) + "\n");
        }
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/postgres.txt");
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, &schema).unwrap();
    }
    let expected = std::fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(schema, expected, "run with BLESS=1 if the change is meant");
}
