//! Services in processes of their own over one PostgreSQL server, behind the proxy with the configuration that is shipped.

use crate::clients::http1;
use crate::harness::{Running, channel, free_port, in_states, midshift, tool, until};
use anyhow::Context;
use midshift_proto::ota::v1::ListBundlesRequest;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_tests::line::Line;
use midshift_tests::postgres::PostgresServer;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// Processes of a stack.
const ROLES: [&str; 7] = ["task", "fleet", "fleet", "telemetry", "telemetry", "ota", "ota"];

/// One process of a service.
struct Member {
    role: &'static str,
    address: SocketAddr,
    /// Its way to the database.
    url: String,
    log: PathBuf,
    running: Running,
}

impl Member {
    /// Some if it may be given work; an error if it has ended.
    fn is_ready(&mut self) -> anyhow::Result<Option<()>> {
        anyhow::ensure!(!self.running.has_ended()?, "{} at {} ended", self.role, self.address);
        Ok(is_ready(self.address).is_some_and(|ready| ready).then_some(()))
    }
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
    url: String,
    members: Vec<Member>,
    proxy: Running,
    /// The first gateway's own way to the database.
    pub line: Line,
    /// Where people and programs go.
    pub public: SocketAddr,
    /// Where robots go.
    pub robots: SocketAddr,
}

impl Stack {
    /// One task intake, and two of each of the others, on a site of text or of a grid; `flags` are for every process, `of_ota` for those with software as well.
    pub async fn start(dir: &Path, site: &str, flags: &[&str], of_ota: &[&str]) -> anyhow::Result<Self> {
        let name = if site.starts_with("type octile") { "site.map" } else { "site.toml" };
        let file = dir.join(name);
        std::fs::write(&file, site)?;
        let postgres = tokio::task::block_in_place(PostgresServer::start);
        let url = tokio::task::block_in_place(|| postgres.database());
        let owned = |flags: &[&str]| flags.iter().map(|flag| (*flag).to_owned()).collect();
        let flags = Flags { of_all: owned(flags), of_ota: owned(of_ota) };
        let line = Line::to(postgres.socket()).await?;
        let mut members: Vec<Member> = Vec::new();
        for role in ROLES {
            let (address, nth) = (free_port()?, members.iter().filter(|member| member.role == role).count());
            let url = if (role, nth) == ("telemetry", 0) { line.url(&url) } else { url.clone() };
            let log = dir.join(format!("{role}-{nth}.log"));
            let running = run(dir, &file, role, address, &url, &flags, &log)?;
            members.push(Member { role, address, url, log, running });
        }
        let (public, robots) = (free_port()?, free_port()?);
        let proxy = proxy(dir, &members, public, robots, None)?;
        let mut stack =
            Self { dir: dir.to_owned(), site: file, flags, postgres, url, members, proxy, line, public, robots };
        stack.answers().await?;
        Ok(stack)
    }

    /// Waits until every process is ready and the proxy knows it.
    async fn answers(&mut self) -> anyhow::Result<()> {
        for member in &mut self.members {
            until("a process that is ready", Duration::from_secs(60), || {
                std::future::ready(member.is_ready().with_context(|| said(&member.log)))
            })
            .await?;
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

    /// The database, by the way of all but the first gateway.
    pub fn url(&self) -> &str {
        &self.url
    }

    fn member(&mut self, role: &str, nth: usize) -> anyhow::Result<&mut Member> {
        let mut of_role = self.members.iter_mut().filter(|member| member.role == role);
        of_role.nth(nth).with_context(|| format!("no {role} {nth}"))
    }

    /// SIGKILL.
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
        member.running = run(&dir, &site, role, member.address, &member.url, &flags, &member.log)?;
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
            member.running =
                run(&self.dir, &self.site, member.role, member.address, &member.url, &self.flags, &member.log)?;
        }
        self.proxy = proxy(&self.dir, &self.members, self.public, self.robots, None)?;
        self.answers().await
    }

    /// A new proxy takes over; streams that run go on in the old one, which this test ends with itself.
    pub fn reload_proxy(&mut self) -> anyhow::Result<Running> {
        let old = self.proxy.id();
        let new = proxy(&self.dir, &self.members, self.public, self.robots, Some(old))?;
        Ok(std::mem::replace(&mut self.proxy, new))
    }

    /// Waits until every gateway has let its robots go, since it does not reach the database.
    pub async fn all_cut_off(&self) -> anyhow::Result<()> {
        for gateway in self.members.iter().filter(|member| member.role == "telemetry") {
            until("a gateway that says it is cut off", Duration::from_secs(60), || async {
                let page =
                    http1(gateway.address, "GET /metrics HTTP/1.1\r\nHost: midshift\r\nConnection: close\r\n\r\n");
                Ok(page.is_ok_and(|page| page.lines().any(|line| line == "midshift_telemetry_cut_off 1")).then_some(()))
            })
            .await?;
        }
        Ok(())
    }

    /// Ends every connection that hears of commits.
    pub fn deafen(&self) -> anyhow::Result<()> {
        let sql = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity \
                   WHERE query ILIKE 'LISTEN%' AND pid <> pg_backend_pid()";
        let said = self.postgres.ask(&self.url, sql);
        anyhow::ensure!(said != "0", "nobody listened");
        Ok(())
    }
}

/// What a process says to a proxy that asks whether it is ready; none: nothing.
pub fn is_ready(address: SocketAddr) -> Option<bool> {
    let page = http1(address, "GET /ready HTTP/1.1\r\nHost: midshift\r\nConnection: close\r\n\r\n").ok()?;
    Some(page.starts_with("HTTP/1.1 200"))
}

fn run(
    dir: &Path,
    site: &Path,
    role: &str,
    address: SocketAddr,
    url: &str,
    flags: &Flags,
    log: &Path,
) -> anyhow::Result<Running> {
    let mut command = Command::new(midshift()?);
    command.args(["serve", "--insecure", "--roles", role, "--store", url, "--listen", &address.to_string(), "--data"]);
    command.arg(dir.join("data")).arg("--site").arg(site).args(&flags.of_all);
    if role == "ota" {
        command.args(&flags.of_ota);
    }
    Running::start(&mut command, log)
}

fn proxy(
    dir: &Path,
    members: &[Member],
    public: SocketAddr,
    robots: SocketAddr,
    takes_over: Option<u32>,
) -> anyhow::Result<Running> {
    let configuration = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/proxy/haproxy.cfg");
    let mut command = Command::new(tool("MIDSHIFT_TEST_HAPROXY")?);
    command.args(["-db", "-f", configuration]);
    if let Some(old) = takes_over {
        command.args(["-sf", &old.to_string()]);
    }
    for (variable, role) in
        [("TASK", "task"), ("FLEET", "fleet"), ("TELEMETRY", "telemetry"), ("OTA", "ota"), ("GATEWAY", "telemetry")]
    {
        for (nth, member) in members.iter().filter(|member| member.role == role).enumerate() {
            let suffix = if nth == 0 { String::new() } else { format!("_{}", nth + 1) };
            command.env(format!("MIDSHIFT_{variable}{suffix}"), member.address.to_string());
        }
    }
    command.env("MIDSHIFT_SPREAD_CONNECTIONS", "1");
    command.env("MIDSHIFT_PUBLIC", public.to_string()).env("MIDSHIFT_ROBOTS", robots.to_string());
    Running::start(&mut command, &dir.join("proxy.log"))
}
