//! Services in processes of their own over one PostgreSQL server, behind the proxy with the configuration that is shipped.

use crate::clients::http1;
use crate::harness::{Running, channel, free_port, in_states, midshift, tool, until};
use anyhow::Context;
use midshift_proto::ota::v1::ListBundlesRequest;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_tests::postgres::PostgresServer;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// What all processes say, below the stack's folder.
const LOG: &str = "stack.log";

/// One process of a service.
struct Member {
    role: &'static str,
    address: SocketAddr,
    running: Running,
}

impl Member {
    /// Some if it may be given work; an error if it has ended.
    fn is_ready(&mut self) -> anyhow::Result<Option<()>> {
        anyhow::ensure!(!self.running.has_ended()?, "{} at {} ended", self.role, self.address);
        let page = http1(self.address, "GET /ready HTTP/1.1\r\nHost: midshift\r\nConnection: close\r\n\r\n");
        Ok(page.is_ok_and(|page| page.starts_with("HTTP/1.1 200")).then_some(()))
    }
}

/// The end of what all processes said.
fn said(dir: &Path) -> String {
    let log = std::fs::read_to_string(dir.join(LOG)).unwrap_or_default();
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
        let mut members = Vec::new();
        for role in ["task", "fleet", "fleet", "telemetry", "telemetry", "ota", "ota"] {
            let address = free_port()?;
            members.push(Member { role, address, running: run(dir, &file, role, address, &url, &flags)? });
        }
        let (public, robots) = (free_port()?, free_port()?);
        let proxy = proxy(dir, &members, public, robots, None)?;
        let mut stack = Self { dir: dir.to_owned(), site: file, flags, postgres, url, members, proxy, public, robots };
        for member in &mut stack.members {
            until("a process that is ready", Duration::from_secs(60), || {
                std::future::ready(member.is_ready().with_context(|| said(dir)))
            })
            .await?;
        }
        until("the stack's first answer", Duration::from_secs(60), || async {
            let bundles = BundleServiceClient::new(channel(public)?).list_bundles(ListBundlesRequest::default()).await;
            let is_served = |status: &tonic::Status| status.code() == tonic::Code::FailedPrecondition;
            let has_ota = bundles.as_ref().map_or_else(is_served, |_| true);
            Ok(in_states(public, &[]).await?.filter(|_| has_ota).map(|_| ()))
        })
        .await?;
        Ok(stack)
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
    pub fn restart(&mut self, role: &'static str, nth: usize) -> anyhow::Result<()> {
        let (dir, site, url, flags) = (self.dir.clone(), self.site.clone(), self.url.clone(), self.flags.clone());
        let member = self.member(role, nth)?;
        member.running = run(&dir, &site, role, member.address, &url, &flags)?;
        Ok(())
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

fn run(dir: &Path, site: &Path, role: &str, address: SocketAddr, url: &str, flags: &Flags) -> anyhow::Result<Running> {
    let mut command = Command::new(midshift()?);
    command.args(["serve", "--roles", role, "--store", url, "--listen", &address.to_string(), "--data"]);
    command.arg(dir.join("data")).arg("--site").arg(site).args(&flags.of_all);
    if role == "ota" {
        command.args(&flags.of_ota);
    }
    Running::start(&mut command, &dir.join(LOG))
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
