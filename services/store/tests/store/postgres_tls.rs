//! PostgreSQL over TLS: each side proves itself, and nothing goes over the network before that.

use crate::line::Line;
use crate::server::{PostgresServer, Proof};
use crate::support::{clock, one, postgres_at, put, site};
use midshift_core::item::Expect;
use midshift_core::rows::{Table, Writer};
use midshift_store::{
    OpenError, PostgresConfig, PostgresCopy, PostgresFrames, PostgresHeartbeats, PostgresStore, Store, migrate_postgres,
};
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Who signs for a database and its clients.
struct CertificateAuthority {
    issuer: Issuer<'static, KeyPair>,
    pem: String,
}

impl CertificateAuthority {
    fn new() -> Self {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Self { issuer: Issuer::new(params, key), pem }
    }

    /// Certificate and key of a server with these names.
    fn server(&self, names: &[&str]) -> (String, String) {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        self.sign(CertificateParams::new(names).unwrap(), ExtendedKeyUsagePurpose::ServerAuth)
    }

    /// Of a client that is this user.
    fn client(&self, user: &str) -> (String, String) {
        let mut params = CertificateParams::default();
        params.distinguished_name = DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, user);
        self.sign(params, ExtendedKeyUsagePurpose::ClientAuth)
    }

    fn sign(&self, mut params: CertificateParams, usage: ExtendedKeyUsagePurpose) -> (String, String) {
        params.extended_key_usages = vec![usage];
        let key = KeyPair::generate().unwrap();
        (params.signed_by(&key, &self.issuer).unwrap().pem(), key.serialize_pem())
    }
}

/// Looks until there is a value: somebody else's process takes its time, and not for ever.
async fn within<T>(mut look: impl AsyncFnMut() -> Option<T>) -> T {
    let looks = async {
        loop {
            if let Some(seen) = look().await {
                return seen;
            }
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), looks).await.expect("in time")
}

/// Files that addresses name.
struct Files(tempfile::TempDir);

impl Files {
    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    fn client(&self, name: &str, (chain, key): &(String, String)) -> String {
        let chain = self.write(&format!("{name}.crt"), chain);
        format!("&sslcert={}&sslkey={}", chain.display(), self.write(&format!("{name}.key"), key).display())
    }
}

fn address(host: &str, port: u16, database: &str, root: &Path) -> String {
    format!("postgres://postgres@{host}:{port}/{database}?sslmode=verify-full&sslrootcert={}", root.display())
}

/// Why there is no store at an address.
async fn refused(url: &str) -> String {
    let error = PostgresStore::open(&PostgresConfig::new(url), site(), clock()).await.map(|_| ()).expect_err(url);
    let OpenError::Sql { source, .. } = error else { panic!("{error:?}") };
    source.to_string()
}

#[tokio::test]
async fn everything_of_a_store_goes_over_tls_1_3_when_both_sides_prove_themselves() {
    let (authority, files) = (CertificateAuthority::new(), Files(tempfile::tempdir().unwrap()));
    let (chain, key) = authority.server(&["127.0.0.1"]);
    let server = PostgresServer::secured(&Proof { chain: &chain, key: &key, root: &authority.pem });
    let root = files.write("root.crt", &authority.pem);
    let own = files.client("client", &authority.client("postgres"));
    let near = server.database_named("rows");
    let config = PostgresConfig::new(address("127.0.0.1", server.port().unwrap(), "rows", &root) + &own);
    migrate_postgres(&config).await.unwrap();
    let (writer, reader) = (postgres_at(&config).await, postgres_at(&config).await);
    let _frames = PostgresFrames::open(&config, site(), clock(), 1_000).await.unwrap();
    let _heard = PostgresHeartbeats::open(&config, site()).await.unwrap();
    let mut wake = reader.wake();
    let applied = one(&writer, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await.unwrap();
    wake.wait_for(|seq| *seq >= applied.seq).await.unwrap();
    assert_eq!(reader.snapshot(&[Table::Attempt]).await.unwrap().rows.len(), 1);
    let of_ours = "FROM pg_stat_activity JOIN pg_stat_ssl USING (pid) WHERE application_name = 'midshift'";
    let count = |what: &str| server.ask(&near, &format!("SELECT count(*) {of_ours} {what}")).parse::<u32>().unwrap();
    within(async || (count("AND query LIKE 'LISTEN%'") >= 2).then_some(())).await;
    assert!(count("") >= 5, "writers, readers and who listens");
    let others = format!("SELECT count(*) {of_ours} AND version IS DISTINCT FROM 'TLSv1.3'");
    assert_eq!(server.ask(&near, &others), "0", "connections without it");
    assert!(PostgresCopy::begin(&config, files.0.path()).await.unwrap().is_some(), "a backup goes the same way");
}

#[tokio::test]
async fn neither_a_false_server_nor_a_client_without_a_certificate_comes_to_a_connection() {
    let (authority, other) = (CertificateAuthority::new(), CertificateAuthority::new());
    let files = Files(tempfile::tempdir().unwrap());
    let (chain, key) = authority.server(&["127.0.0.1"]);
    let server = PostgresServer::secured(&Proof { chain: &chain, key: &key, root: &authority.pem });
    server.database_named("rows");
    let port = server.port().unwrap();
    let (root, foreign) = (files.write("root.crt", &authority.pem), files.write("foreign.crt", &other.pem));
    let own = files.client("client", &authority.client("postgres"));

    let of_another = refused(&(address("127.0.0.1", port, "rows", &foreign) + &own)).await;
    assert!(of_another.contains("invalid peer certificate"), "another root: {of_another}");
    let elsewhere = refused(&(address("localhost", port, "rows", &root) + &own)).await;
    assert!(elsewhere.contains("certificate"), "a name that it has not: {elsewhere}");
    let nobody = refused(&address("127.0.0.1", port, "rows", &root)).await;
    assert!(nobody.contains("certificate"), "no certificate: {nobody}");
    let as_another = files.client("another", &authority.client("somebody"));
    let as_another = refused(&(address("127.0.0.1", port, "rows", &root) + &as_another)).await;
    assert!(as_another.contains("authentication failed"), "another user's certificate: {as_another}");
    let strange = files.client("strange", &other.client("postgres"));
    assert!(!refused(&(address("127.0.0.1", port, "rows", &root) + &strange)).await.is_empty());

    server.ask(&server.url("rows"), "ALTER SYSTEM SET ssl_max_protocol_version = 'TLSv1.2'");
    server.ask(&server.url("rows"), "SELECT pg_reload_conf()");
    let good = address("127.0.0.1", port, "rows", &root) + &own;
    let old = within(async || match PostgresStore::open(&PostgresConfig::new(&good), site(), clock()).await {
        Err(OpenError::Sql { source, .. }) => Some(source.to_string()),
        Err(error) => panic!("{error:?}"),
        // It has not read its settings again yet.
        Ok(store) => {
            store.close().await;
            None
        }
    })
    .await;
    assert!(old.contains("ssl_min_protocol_version"), "an old version: {old}");
}

#[tokio::test]
async fn a_server_that_speaks_plain_text_is_told_nothing_where_proof_was_asked() {
    let (authority, files) = (CertificateAuthority::new(), Files(tempfile::tempdir().unwrap()));
    let root = files.write("root.crt", &authority.pem);
    let server = PostgresServer::start();
    server.database_named("rows");
    let line = Line::to(server.socket()).await.unwrap();
    let plain = line.url(&server.url("rows"));
    assert!(PostgresStore::open(&PostgresConfig::new(&plain), site(), clock()).await.is_ok());
    let proven = refused(&format!("{plain}?sslmode=verify-full&sslrootcert={}", root.display())).await;
    assert!(proven.contains("does not support TLS"), "{proven}");
}
