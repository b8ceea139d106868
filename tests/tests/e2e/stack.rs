//! Services in processes of their own over one PostgreSQL server, behind the proxy with the configuration that is shipped: all of it over TLS, with robots that are
//! enrolled, but for the first gateway's line to the database, which tests cut.

use crate::harness::{
    Running, channel, free_port, in_states, midshift, same_site, sign_in_to, token, tool, until, way,
};
use crate::secrets::{heard, keep_keys};
use anyhow::Context;
use midshift_proto::ota::v1::ListBundlesRequest;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_tests::line::Line;
use midshift_tests::postgres::{PostgresServer, Proof};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

/// Processes of a stack.
const ROLES: [&str; 9] = ["identity", "task", "task", "fleet", "fleet", "telemetry", "telemetry", "ota", "ota"];
/// The proxy is one address, and a test one token.
const OF_ONE_ADDRESS: [&str; 4] = ["--connections-per-address", "16000", "--requests-per-second", "100000"];

/// Where robots that dial an address get their certificates, of the stacks of this program.
static MACHINES: Mutex<BTreeMap<SocketAddr, SocketAddr>> = Mutex::new(BTreeMap::new());

/// Tells a robot that dials `server` where it gets its certificate, if that is elsewhere.
pub fn tell_identity(command: &mut Command, server: &str) {
    let known = MACHINES.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(machines) = server.parse().ok().and_then(|server: SocketAddr| known.get(&server)) {
        command.args(["--identity-server", &machines.to_string()]);
    }
}

/// Where robots of the server at this address get their certificates.
pub fn machines_of(server: SocketAddr) -> SocketAddr {
    MACHINES.lock().unwrap_or_else(PoisonError::into_inner).get(&server).copied().unwrap_or(server)
}

/// One process of a service.
struct Member {
    role: &'static str,
    nth: usize,
    address: SocketAddr,
    /// Its way to the database.
    url: String,
    log: PathBuf,
    running: Running,
}

/// The end of what a process said.
fn said(log: &Path) -> String {
    let log = std::fs::read_to_string(log).unwrap_or_default();
    let lines: Vec<&str> = log.lines().rev().take(20).collect();
    lines.into_iter().rev().collect::<Vec<_>>().join("\n")
}

/// Flags of processes.
#[derive(Clone, Default)]
struct Flags {
    of_all: Vec<String>,
    of_ota: Vec<String>,
}

/// All of them.
pub struct Stack {
    dir: PathBuf,
    /// The site's file.
    pub site: PathBuf,
    flags: Flags,
    /// The database server.
    pub postgres: PostgresServer,
    /// The database by its socket, for whoever looks at it from beside.
    near: String,
    url: String,
    members: Vec<Member>,
    proxy: Running,
    /// The first gateway's own way to the database.
    pub line: Line,
    /// Where people and programs go.
    pub public: SocketAddr,
    /// Where robots go.
    pub robots: SocketAddr,
    /// Where they get their certificates.
    machines: SocketAddr,
}

impl Stack {
    /// One identity, which is the site's authority, and two of each of the others, on a site of text or of a grid; `flags` are for every process, `of_ota` for those with software as well.
    pub async fn start(dir: &Path, site: &str, flags: &[&str], of_ota: &[&str]) -> anyhow::Result<Self> {
        let name = if site.starts_with("type octile") { "site.map" } else { "site.toml" };
        let file = dir.join(name);
        std::fs::write(&file, site)?;
        let proof = Proven::make(dir)?;
        let postgres = tokio::task::block_in_place(|| proof.server())?;
        let near = tokio::task::block_in_place(|| postgres.database());
        let url = proof.address(&postgres, &near)?;
        let owned = |flags: &[&str]| flags.iter().map(|flag| (*flag).to_owned()).collect();
        let flags = Flags { of_all: owned(flags), of_ota: owned(of_ota) };
        let line = Line::to(postgres.socket()).await?;
        let mut members: Vec<Member> = Vec::new();
        for role in ROLES {
            let (address, nth) = (free_port()?, members.iter().filter(|member| member.role == role).count());
            let url = if (role, nth) == ("telemetry", 0) { line.url(&near) } else { url.clone() };
            let log = dir.join(format!("{role}-{nth}.log"));
            let running = run(dir, &file, (role, nth), address, &url, &flags, &log)?;
            members.push(Member { role, nth, address, url, log, running });
        }
        let (public, robots, machines) = (free_port()?, free_port()?, free_port()?);
        let identity = &members[0];
        let signed_in = sign_in_to(identity.address, dir.join("ca.pem"), &dir.join("token")).await;
        signed_in.with_context(|| said(&identity.log))?;
        for port in members[1..].iter().map(|member| member.address).chain([public, robots, machines]) {
            same_site(identity.address, port)?;
        }
        MACHINES.lock().unwrap_or_else(PoisonError::into_inner).insert(robots, machines);
        let mut ask = Command::new(midshift()?);
        ask.args(["certificate", "get", "--name", "localhost", "--store", &url, "--site"]).arg(&file);
        let got = heard(ask.arg("--out").arg(dir.join("proxy")))?;
        anyhow::ensure!(got.status.success(), "{}", String::from_utf8_lossy(&got.stderr));
        keep_keys(dir)?;
        let proxy = proxy(dir, &members, [public, robots, machines], None)?;
        let mut stack = Self {
            dir: dir.to_owned(),
            site: file,
            flags,
            postgres,
            near,
            url,
            members,
            proxy,
            line,
            public,
            robots,
            machines,
        };
        stack.answers().await?;
        Ok(stack)
    }

    /// Waits until every process is ready and the proxy knows it.
    async fn answers(&mut self) -> anyhow::Result<()> {
        for member in &mut self.members {
            until("a process that is ready", Duration::from_secs(60), || {
                let (role, address, log) = (member.role, member.address, member.log.clone());
                let has_ended = member.running.has_ended();
                async move {
                    anyhow::ensure!(!has_ended?, "{role} at {address} ended: {}", said(&log));
                    Ok(is_ready(address).await.is_some_and(|ready| ready).then_some(()))
                }
            })
            .await
            .with_context(|| format!("{}: {}", member.role, said(&member.log)))?;
        }
        until("the stack's first answer", Duration::from_secs(60), || async {
            let mut client = BundleServiceClient::new(channel(self.public)?);
            let bundles = client.list_bundles(ListBundlesRequest::default()).await;
            let is_served = |status: &tonic::Status| status.code() == tonic::Code::FailedPrecondition;
            let has_ota = bundles.as_ref().map_or_else(is_served, |_| true);
            Ok(in_states(self.public, &[]).await?.filter(|_| has_ota).map(|_| ()))
        })
        .await
    }

    /// Where one process listens, behind the proxy.
    pub fn address(&mut self, role: &str, nth: usize) -> anyhow::Result<SocketAddr> {
        Ok(self.member(role, nth)?.address)
    }

    /// What one process has said so far.
    pub fn said(&mut self, role: &str, nth: usize) -> anyhow::Result<String> {
        Ok(std::fs::read_to_string(&self.member(role, nth)?.log)?)
    }

    /// The database is lost: an empty one stands in its place. No process may use it then.
    pub fn lose_database(&self) -> anyhow::Result<()> {
        let name = self.near.split(['/', '?']).nth(3).context("a database has a name")?;
        tokio::task::block_in_place(|| self.postgres.emptied(name));
        Ok(())
    }

    /// The database, by the way of all but the first gateway.
    pub fn url(&self) -> &str {
        &self.url
    }

    fn member(&mut self, role: &str, nth: usize) -> anyhow::Result<&mut Member> {
        let mut of_role = self.members.iter_mut().filter(|member| member.role == role);
        of_role.nth(nth).with_context(|| format!("no {role} {nth}"))
    }

    /// Ends it by SIGKILL.
    pub fn kill(&mut self, role: &str, nth: usize) -> anyhow::Result<()> {
        self.member(role, nth)?.running.kill()
    }

    /// A signal by its name.
    pub fn signal(&mut self, role: &str, nth: usize, signal: &str) -> anyhow::Result<()> {
        self.member(role, nth)?.running.signal(signal)
    }

    /// SIGTERM, and waits for the end; its exit code.
    pub async fn ask_to_end(&mut self, role: &str, nth: usize) -> anyhow::Result<Option<i32>> {
        let member = self.member(role, nth)?;
        member.running.signal("TERM")?;
        member.running.ends().await
    }

    /// Starts one again that has ended, at its old address.
    pub fn restart(&mut self, role: &str, nth: usize) -> anyhow::Result<()> {
        let (dir, site, flags) = (self.dir.clone(), self.site.clone(), self.flags.clone());
        let member = self.member(role, nth)?;
        let who = (member.role, member.nth);
        member.running = run(&dir, &site, who, member.address, &member.url, &flags, &member.log)?;
        Ok(())
    }

    /// SIGKILL of the proxy and of every process behind it.
    pub fn kill_all(&mut self) -> anyhow::Result<()> {
        self.proxy.kill()?;
        self.members.iter_mut().try_for_each(|member| member.running.kill())
    }

    /// Starts all of them again after [`Stack::kill_all`], and waits until they answer.
    pub async fn restart_all(&mut self) -> anyhow::Result<()> {
        for member in &mut self.members {
            let who = (member.role, member.nth);
            member.running = run(&self.dir, &self.site, who, member.address, &member.url, &self.flags, &member.log)?;
        }
        self.proxy = proxy(&self.dir, &self.members, self.ports(), None)?;
        self.answers().await
    }

    /// A new proxy takes over; streams that run go on in the old one, which this test ends with itself.
    pub fn reload_proxy(&mut self) -> anyhow::Result<Running> {
        let old = self.proxy.id();
        let new = proxy(&self.dir, &self.members, self.ports(), Some(old))?;
        Ok(std::mem::replace(&mut self.proxy, new))
    }

    const fn ports(&self) -> [SocketAddr; 3] {
        [self.public, self.robots, self.machines]
    }

    /// Waits until every gateway has let its robots go, since it does not reach the database.
    pub async fn all_cut_off(&self) -> anyhow::Result<()> {
        for gateway in self.members.iter().filter(|member| member.role == "telemetry") {
            until("a gateway that says it is cut off", Duration::from_secs(60), || async {
                let page = page(gateway.address, "/metrics").await;
                Ok(page
                    .is_some_and(|page| page.lines().any(|line| line == "midshift_telemetry_cut_off 1"))
                    .then_some(()))
            })
            .await?;
        }
        Ok(())
    }

    /// A process beside a stop service that has its data below `apart`.
    pub fn follower(&self, nth: usize, apart: &Path) -> anyhow::Result<Running> {
        let address = free_port()?;
        let mut command = Command::new(midshift()?);
        command.args(["serve", "--roles", "stop-follower", "--store", &self.url, "--listen", &address.to_string()]);
        command.arg("--site").arg(&self.site).arg("--data").arg(apart.join("data"));
        command.arg("--identity").arg(apart.join(format!("follower-{nth}-own")));
        Running::start(&mut command, &apart.join(format!("follower-{nth}.log")))
    }

    /// Ends every connection that hears of commits.
    pub fn deafen(&self) -> anyhow::Result<()> {
        let sql = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity \
                   WHERE query ILIKE 'LISTEN%' AND pid <> pg_backend_pid()";
        let said = self.postgres.ask(&self.near, sql);
        anyhow::ensure!(said != "0", "nobody listened");
        Ok(())
    }
}

/// What a process says to a proxy that asks whether it is ready; none: nothing.
pub async fn is_ready(address: SocketAddr) -> Option<bool> {
    Some(page(address, "/ready").await?.starts_with("HTTP/1.1 200"))
}

/// A page over HTTP/1.1; none: nobody answers.
pub async fn page(address: SocketAddr, path: &str) -> Option<String> {
    let asked = async {
        let mut wire = way(address).ok()?.wire().await.ok()?;
        let who = token(address).map_or_else(String::new, |token| format!("Authorization: Bearer {token}\r\n"));
        let request = format!("GET {path} HTTP/1.1\r\nHost: midshift\r\n{who}Connection: close\r\n\r\n");
        wire.write_all(request.as_bytes()).await.ok()?;
        let mut answer = Vec::new();
        // How the connection ends is nothing to us.
        let _ended = wire.read_to_end(&mut answer).await;
        Some(String::from_utf8_lossy(&answer).into_owned()).filter(|answer| !answer.is_empty())
    };
    tokio::time::timeout(Duration::from_secs(5), asked).await.ok().flatten()
}

/// What the database and its clients show each other, as `midshift certificate database` makes it.
struct Proven(PathBuf);

impl Proven {
    fn make(dir: &Path) -> anyhow::Result<Self> {
        let folder = dir.join("database");
        let mut make = Command::new(midshift()?);
        make.args(["certificate", "database", "--host", "127.0.0.1", "--user", "postgres"]);
        make.arg("--server-out").arg(folder.join("server")).arg("--client-out").arg(folder.join("client"));
        let made = heard(&mut make)?;
        anyhow::ensure!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        Ok(Self(folder))
    }

    fn server(&self) -> anyhow::Result<PostgresServer> {
        let read = |name: &str| std::fs::read_to_string(self.0.join("server").join(name)).context(name.to_owned());
        let (root, chain, key) = (read("root.crt")?, read("server.crt")?, read("server.key")?);
        Ok(PostgresServer::secured(&Proof { chain: &chain, key: &key, root: &root }))
    }

    /// The database at `near` over TLS.
    fn address(&self, server: &PostgresServer, near: &str) -> anyhow::Result<String> {
        let database = near.split(['/', '?']).nth(3).context("a database has a name")?;
        let (port, client) = (server.port().context("a server with TLS has a port")?, self.0.join("client"));
        Ok(format!(
            "postgres://postgres@127.0.0.1:{port}/{database}?sslmode=verify-full&sslrootcert={0}/root.crt&sslcert={0}/client.crt&sslkey={0}/client.key",
            client.display()
        ))
    }
}

fn run(
    dir: &Path,
    site: &Path,
    (role, nth): (&str, usize),
    address: SocketAddr,
    url: &str,
    flags: &Flags,
    log: &Path,
) -> anyhow::Result<Running> {
    let mut command = Command::new(midshift()?);
    command.args(["serve", "--roles", role, "--store", url, "--listen", &address.to_string(), "--site"]).arg(site);
    command.args(OF_ONE_ADDRESS).args(&flags.of_all).arg("--data");
    match role {
        "identity" => {
            command.arg(dir.join("identity")).arg("--root-file").arg(dir.join("ca.pem"));
            command.arg("--first-token-file").arg(dir.join("token"));
        }
        // The folder of releases is shared.
        _ => {
            command.arg(dir.join("data")).arg("--identity").arg(dir.join(format!("{role}-{nth}-own")));
        }
    }
    if role == "ota" {
        command.args(&flags.of_ota);
    }
    Running::start(&mut command, log)
}

fn proxy(
    dir: &Path,
    members: &[Member],
    [public, robots, machines]: [SocketAddr; 3],
    takes_over: Option<u32>,
) -> anyhow::Result<Running> {
    let configuration = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/proxy/haproxy.cfg");
    let mut command = Command::new(tool("MIDSHIFT_TEST_HAPROXY")?);
    command.args(["-db", "-f", configuration]);
    if let Some(old) = takes_over {
        command.args(["-sf", &old.to_string()]);
    }
    for (variable, role) in [
        ("TASK", "task"),
        ("FLEET", "fleet"),
        ("TELEMETRY", "telemetry"),
        ("OTA", "ota"),
        ("GATEWAY", "telemetry"),
        ("IDENTITY", "identity"),
        ("ENROLMENT", "identity"),
    ] {
        for (nth, member) in members.iter().filter(|member| member.role == role).enumerate() {
            let suffix = if nth == 0 { String::new() } else { format!("_{}", nth + 1) };
            command.env(format!("MIDSHIFT_{variable}{suffix}"), member.address.to_string());
        }
    }
    command.env("MIDSHIFT_SPREAD_CONNECTIONS", "1").env("MIDSHIFT_MACHINES", machines.to_string());
    command.env("MIDSHIFT_PUBLIC", public.to_string()).env("MIDSHIFT_ROBOTS", robots.to_string());
    command.env("MIDSHIFT_CERTIFICATE", dir.join("proxy/server.pem")).env("MIDSHIFT_ROOT", dir.join("proxy/ca.pem"));
    Running::start(&mut command, &dir.join("proxy.log"))
}
