//! Starts real programs in folders of their own and ends exactly those; waits for conditions, with limits.

use crate::engine::fresh_store;
use crate::secrets::{keep_keys, keep_secret, secret_part, told_by_log};
use anyhow::{Context, bail, ensure};
use midshift_cli::endpoint::{Endpoint, Line};
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::identity::v1::CreateTokenRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{ListTasksRequest, Task, TaskFilter, TaskState};
use std::collections::BTreeMap;
use std::future::Future;
use std::net::{SocketAddr, TcpListener};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use tokio::time::Instant;

/// The site of a server, in its folder.
const SITE_FILE: &str = "site.toml";
/// How often a condition is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// A program named by the environment, or built beside this test.
pub fn program(variable: &str, name: &str) -> anyhow::Result<PathBuf> {
    if let Some(path) = std::env::var_os(variable) {
        return Ok(path.into());
    }
    let test = std::env::current_exe()?;
    let beside = test.parent().and_then(Path::parent).map(|dir| dir.join(name)).filter(|p| p.exists());
    beside.with_context(|| {
        format!("{variable} is not set and there is no {name} beside the tests: run `cargo xtask test`")
    })
}

/// The midshift program.
pub fn midshift() -> anyhow::Result<PathBuf> {
    program("MIDSHIFT_TEST_BIN", "midshift")
}

/// The program of the stop service.
pub fn midshift_stop() -> anyhow::Result<PathBuf> {
    program("MIDSHIFT_TEST_STOP", "midshift-stop")
}

/// A tool of `cargo xtask test --install`.
pub fn tool(variable: &str) -> anyhow::Result<PathBuf> {
    let path = std::env::var_os(variable)
        .with_context(|| format!("{variable} is not set: run `cargo xtask test --install`"))?;
    Ok(path.into())
}

/// What a program writes about itself, in every end-to-end test that says nothing else: more than it does by default.
const LOG: &str = "info,midshift=debug,midshift_agent=debug,midshift_edge=debug,midshift_identity=debug,midshift_stop=debug,\
                   midshift_store=debug,midshift_telemetry=debug";

/// The variable that says so.
const LOG_LEVEL: &str = "MIDSHIFT_LOG";

fn telling(command: &mut Command) -> &mut Command {
    let is_told = command.get_envs().any(|(name, _)| name == LOG_LEVEL);
    if is_told { command } else { command.env(LOG_LEVEL, LOG) }
}

/// A program that is killed when the test lets it go. Then its log is read: no secret of the run may be in it.
pub struct Running {
    child: Child,
    log: PathBuf,
}

impl Running {
    /// Starts it; what it says goes to `log`.
    pub fn start(command: &mut Command, log: &Path) -> anyhow::Result<Self> {
        let file = std::fs::OpenOptions::new().create(true).append(true).open(log)?;
        let child = telling(command).stdin(Stdio::null()).stdout(file.try_clone()?).stderr(file).spawn();
        Ok(Self { child: child.with_context(|| format!("starting {command:?}"))?, log: log.to_owned() })
    }
    /// The same for a program that is spoken to.
    pub fn start_listening(command: &mut Command, log: &Path) -> anyhow::Result<(Self, ChildStdin)> {
        let file = std::fs::OpenOptions::new().create(true).append(true).open(log)?;
        let child = telling(command).stdin(Stdio::piped()).stdout(file.try_clone()?).stderr(file).spawn();
        let mut child = child.with_context(|| format!("starting {command:?}"))?;
        let ear = child.stdin.take().context("stdin was piped")?;
        Ok((Self { child, log: log.to_owned() }, ear))
    }
    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }
    /// SIGKILL, and waits until it is gone.
    pub fn kill(&mut self) -> anyhow::Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
    /// Sends a signal by its name, e.g. `INT`.
    pub fn signal(&self, name: &str) -> anyhow::Result<()> {
        let sent = Command::new("kill").args(["-s", name, &self.child.id().to_string()]).status()?;
        anyhow::ensure!(sent.success(), "kill -s {name}: {sent}");
        Ok(())
    }
    /// The same to the whole group that it leads: it must have been started with `process_group(0)`.
    pub fn signal_group(&self, name: &str) -> anyhow::Result<()> {
        let sent = Command::new("kill").args(["-s", name, "--", &format!("-{}", self.child.id())]).output()?;
        anyhow::ensure!(sent.status.success(), "kill -s {name}: {}", sent.status);
        Ok(())
    }
    /// Waits until it ends by itself; its exit code, none if a signal ended it.
    pub async fn ends(&mut self) -> anyhow::Result<Option<i32>> {
        let end = Instant::now() + Duration::from_secs(60);
        let mut look = tokio::time::interval(LOOK_EVERY);
        while Instant::now() < end {
            look.tick().await;
            if let Some(status) = self.child.try_wait()? {
                return Ok(status.code());
            }
        }
        bail!("it did not end")
    }
    /// Whether it has ended by itself.
    pub fn has_ended(&mut self) -> anyhow::Result<bool> {
        Ok(self.child.try_wait()?.is_some())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.kill();
        // A test that has failed says why itself.
        if !std::thread::panicking() {
            let log = std::fs::read(&self.log);
            let log =
                log.unwrap_or_else(|error| panic!("what it said in {} is not there: {error}", self.log.display()));
            let told = told_by_log(&log);
            assert!(told.is_empty(), "{} tells {told:?}", self.log.display());
        }
    }
}

/// Which ports this program may have, of those below the ones that the system gives to connections, as `FIRST..END`; not set: all.
const PORTS: &str = "MIDSHIFT_TEST_PORTS";

fn ports() -> anyhow::Result<Range<u32>> {
    let told = std::env::var(PORTS).unwrap_or_else(|_| "12000..32000".to_owned());
    let (first, end) = told.split_once("..").with_context(|| format!("{PORTS} is {told:?}: say FIRST..END"))?;
    let ports = first.parse::<u32>().context(PORTS)?..end.parse::<u32>().context(PORTS)?;
    ensure!(!ports.is_empty(), "{PORTS} is {told:?}: there is none");
    Ok(ports)
}

/// A port nobody has: none has it when a server is started there again, and no two of one test program. Programs that `cargo xtask test` runs
/// beside each other have no port in common.
pub fn free_port() -> anyhow::Result<SocketAddr> {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let ports = ports()?;
    // Programs that run beside each other begin elsewhere.
    let first = std::process::id().wrapping_mul(997);
    for _ in ports.clone() {
        let nth = first.wrapping_add(NEXT.fetch_add(1, Ordering::Relaxed)) % (ports.end - ports.start);
        let address = SocketAddr::from(([127, 0, 0, 1], u16::try_from(ports.start + nth)?));
        if TcpListener::bind(address).is_ok() {
            return Ok(address);
        }
    }
    bail!("no port is free")
}

/// A folder for one test, taken away at its end unless `MIDSHIFT_TEST_KEEP` is set, for whoever wants to know what happened.
pub fn folder() -> anyhow::Result<tempfile::TempDir> {
    let keep = std::env::var_os("MIDSHIFT_TEST_KEEP").is_some();
    Ok(tempfile::Builder::new().prefix("midshift-e2e-").disable_cleanup(keep).tempdir()?)
}

/// Looks until `condition` gives a value; an error names what was waited for.
pub async fn until<T, F>(what: &str, limit: Duration, mut condition: impl FnMut() -> F) -> anyhow::Result<T>
where
    F: Future<Output = anyhow::Result<Option<T>>>,
{
    let end = Instant::now() + limit;
    let mut look = tokio::time::interval(LOOK_EVERY);
    loop {
        look.tick().await;
        // A look at somebody who says nothing must end too.
        match tokio::time::timeout_at(end, condition()).await {
            Ok(found) => {
                if let Some(value) = found? {
                    return Ok(value);
                }
                // A look that waits for nothing is never too late by itself.
                ensure!(Instant::now() < end, "waited {limit:?} in vain for: {what}");
            }
            Err(_) => bail!("waited {limit:?} in vain for: {what}"),
        }
    }
}

/// What this program knows of a site whose ports have TLS and login: where its root is, and a token that may do everything.
#[derive(Clone)]
struct Known {
    authority: PathBuf,
    token: String,
    /// Of somebody else, who may approve what the first one wrote.
    second: String,
    way: Endpoint,
}

/// By address. What is not here is spoken to in plain text.
static KNOWN: Mutex<BTreeMap<SocketAddr, Known>> = Mutex::new(BTreeMap::new());

fn known(address: SocketAddr) -> Option<Known> {
    KNOWN.lock().unwrap_or_else(PoisonError::into_inner).get(&address).cloned()
}

/// The file with the root of the site at `address`.
pub fn authority(address: SocketAddr) -> anyhow::Result<PathBuf> {
    known(address).map(|site| site.authority).with_context(|| format!("{address} has no login"))
}

/// Whether the site at `address` has TLS and login.
pub fn has_login(address: SocketAddr) -> bool {
    known(address).is_some()
}

/// Waits for the first token of a new site, which comes into the file `token`, and remembers the site: its identity is at `address`.
pub async fn sign_in_to(address: SocketAddr, authority: PathBuf, token: &Path) -> anyhow::Result<()> {
    let token = until("the first token", Duration::from_secs(30), async || {
        let token = std::fs::read_to_string(token).unwrap_or_default();
        Ok(token.ends_with('\n').then(|| token.trim().to_owned()))
    });
    let token = token.await?;
    let way = Endpoint::secure(&address.to_string(), &std::fs::read_to_string(&authority)?, Some(&token))?;
    let identity = IdentityServiceClient::new(way.lazy());
    let grants = vec!["ota-approver".to_owned()];
    let request = CreateTokenRequest { name: "second".to_owned(), grants, valid_seconds: 86_400, ..Default::default() };
    let second = until("a second token", Duration::from_secs(30), || {
        let (mut identity, request) = (identity.clone(), request.clone());
        async move { Ok(identity.create_token(request).await.ok().map(|made| made.into_inner().secret)) }
    })
    .await?;
    for token in [&token, &second] {
        keep_secret("a token", secret_part(token)?);
    }
    let site = Known { authority, token, second, way };
    KNOWN.lock().unwrap_or_else(PoisonError::into_inner).insert(address, site);
    Ok(())
}

/// The token of this program for the site at `address`, if that has a login.
pub fn token(address: SocketAddr) -> Option<String> {
    known(address).map(|site| site.token)
}

/// The token of somebody else, who may approve what this program wrote.
pub fn approver(address: SocketAddr) -> Option<String> {
    known(address).map(|site| site.second)
}

/// Another port of the site that `of` is known for.
pub fn same_site(of: SocketAddr, port: SocketAddr) -> anyhow::Result<()> {
    let Some(site) = known(of) else { return Ok(()) };
    let way = Endpoint::secure(&port.to_string(), &std::fs::read_to_string(&site.authority)?, Some(&site.token))?;
    KNOWN.lock().unwrap_or_else(PoisonError::into_inner).insert(port, Known { way, ..site });
    Ok(())
}

/// Signs a command in to the site at `address`, if that has a login.
pub fn sign_in(command: &mut Command, address: SocketAddr) {
    if let Some(site) = known(address) {
        command.env("MIDSHIFT_CA", site.authority).env("MIDSHIFT_TOKEN", site.token);
    }
}

/// The same as somebody else, who may approve what the first one wrote.
pub fn sign_in_second(command: &mut Command, address: SocketAddr) {
    sign_in(command, address);
    if let Some(site) = known(address) {
        command.env("MIDSHIFT_TOKEN", site.second);
    }
}

/// The command line with these arguments, signed in to the server that they name.
pub fn command(arguments: &[&str]) -> anyhow::Result<Command> {
    let mut command = Command::new(midshift()?);
    let named = |flag: &str| arguments.iter().skip_while(|a| **a != flag).nth(1).and_then(|a| a.parse().ok());
    if let Some(address) = named("--server").or_else(|| named("--stop-server")) {
        sign_in(&mut command, address);
    }
    command.args(arguments);
    Ok(command)
}

/// The same, signed in as somebody else, who may approve what the first one wrote.
pub fn second(arguments: &[&str]) -> anyhow::Result<Command> {
    let mut command = command(arguments)?;
    if let Some(address) = arguments.iter().skip_while(|a| **a != "--server").nth(1).and_then(|a| a.parse().ok()) {
        sign_in_second(&mut command, address);
    }
    Ok(command)
}

/// A `midshift serve` on a data directory and a store, which can be killed and started again.
pub struct Server {
    /// Where it listens.
    pub address: SocketAddr,
    dir: PathBuf,
    flags: Vec<String>,
    running: Running,
}

impl Server {
    /// Starts it with TLS and login, and waits until it answers; this program is signed in and may do everything.
    pub async fn start(dir: &Path) -> anyhow::Result<Self> {
        Self::start_on(dir, DEMO).await
    }
    /// On a site that names its robots.
    pub async fn start_for(dir: &Path, site: &Site) -> anyhow::Result<Self> {
        Self::start_on(dir, &text::render(site)).await
    }
    /// On another site than the demo.
    pub async fn start_on(dir: &Path, site: &str) -> anyhow::Result<Self> {
        Self::start_with(dir, site, &[]).await
    }
    /// With more flags of `serve`. A store that they name is the test's own; else it is a new one of the engine that the tests run on.
    pub async fn start_with(dir: &Path, site: &str, flags: &[&str]) -> anyhow::Result<Self> {
        std::fs::write(dir.join(SITE_FILE), site)?;
        let (address, token) = (free_port()?, dir.join("token").display().to_string());
        let of_one_machine = ["--connections-per-address", "16000", "--requests-per-second", "100000"];
        let flags = [&of_one_machine[..], &["--first-token-file", &token], flags].concat();
        let mut flags: Vec<String> = flags.into_iter().map(str::to_owned).collect();
        if !flags.iter().any(|flag| flag == "--store") {
            flags.extend(fresh_store()?);
        }
        let running = Self::run(dir, address, &flags)?;
        let server = Self { address, dir: dir.to_owned(), flags, running };
        server.sign_in().await?;
        server.answers().await?;
        Ok(server)
    }
    fn run(dir: &Path, address: SocketAddr, flags: &[String]) -> anyhow::Result<Running> {
        let mut command = Command::new(midshift()?);
        // Its stop service would outlive the test, on a port that all tests share.
        command
            .env("MIDSHIFT_NO_STOP", "true")
            .args(["serve", "--data"])
            .arg(dir.join("data"))
            .args(["--listen", &address.to_string()]);
        command.arg("--site").arg(dir.join(SITE_FILE)).args(flags);
        Running::start(&mut command, &dir.join("server.log"))
    }
    async fn sign_in(&self) -> anyhow::Result<()> {
        let said = || std::fs::read_to_string(self.dir.join("server.log")).unwrap_or_default();
        let authority = self.data().join("identity/ca.pem");
        sign_in_to(self.address, authority, &self.dir.join("token")).await.with_context(said)?;
        keep_keys(&self.dir)
    }
    /// SIGKILL and a new start on the same data.
    pub async fn kill_and_restart(&mut self) -> anyhow::Result<()> {
        self.kill()?;
        self.restart().await
    }
    /// SIGSTOP: it neither reads nor answers any more, until it is killed.
    pub fn freeze(&self) -> anyhow::Result<()> {
        self.running.signal("STOP")
    }
    /// Ends it by SIGKILL.
    pub fn kill(&mut self) -> anyhow::Result<()> {
        self.running.kill()
    }
    /// Its process id.
    pub fn id(&self) -> u32 {
        self.running.id()
    }
    /// Whether its process has ended by itself.
    pub fn has_ended(&mut self) -> anyhow::Result<bool> {
        self.running.has_ended()
    }
    /// Its data directory.
    pub fn data(&self) -> PathBuf {
        self.dir.join("data")
    }
    /// A new start after a kill, with whatever lies in the data directory now.
    pub async fn restart(&mut self) -> anyhow::Result<()> {
        self.running = Self::run(&self.dir, self.address, &self.flags)?;
        self.answers().await
    }
    /// The same with flags of this start alone.
    pub async fn restart_with(&mut self, flags: &[&str]) -> anyhow::Result<()> {
        let flags: Vec<String> = self.flags.iter().cloned().chain(flags.iter().map(|f| (*f).to_owned())).collect();
        self.running = Self::run(&self.dir, self.address, &flags)?;
        self.answers().await
    }
    /// Changes the site file, which the next start reads.
    pub fn change_site(&self, site: &str) -> anyhow::Result<()> {
        Ok(std::fs::write(self.dir.join(SITE_FILE), site)?)
    }
    async fn answers(&self) -> anyhow::Result<()> {
        until("the server's first answer", Duration::from_secs(30), || async {
            let mut client = TaskServiceClient::new(self.channel()?);
            let request = ListTasksRequest { page_size: 1, ..ListTasksRequest::default() };
            Ok(client.list_tasks(request).await.ok().map(|_| ()))
        })
        .await
    }
    /// A channel that connects when it is used.
    pub fn channel(&self) -> anyhow::Result<Line> {
        channel(self.address)
    }
    /// The way there, signed in; only of a site with a login.
    pub fn way(&self) -> anyhow::Result<Endpoint> {
        known(self.address).map(|site| site.way).context("the site has no login")
    }
    /// A client of the service of tasks.
    pub fn tasks(&self) -> anyhow::Result<TaskServiceClient<Line>> {
        tasks(self.address)
    }
    /// Every task in one of these states; none while the server does not answer.
    pub async fn in_states(&self, states: &[TaskState]) -> anyhow::Result<Option<Vec<Task>>> {
        in_states(self.address, states).await
    }
}

/// The intake of tasks at an address.
pub fn tasks(address: SocketAddr) -> anyhow::Result<TaskServiceClient<Line>> {
    Ok(TaskServiceClient::new(channel(address)?))
}

/// Every task in one of these states; none while nobody answers there.
pub async fn in_states(address: SocketAddr, states: &[TaskState]) -> anyhow::Result<Option<Vec<Task>>> {
    let filter = TaskFilter { states: states.iter().map(|s| *s as i32).collect(), ..TaskFilter::default() };
    let mut request = ListTasksRequest { filter: Some(filter), page_size: 1_000, page_token: String::new() };
    let (mut client, mut all) = (tasks(address)?, Vec::new());
    loop {
        let Ok(page) = client.list_tasks(request.clone()).await else { return Ok(None) };
        let page = page.into_inner();
        all.extend(page.tasks);
        if page.next_page_token.is_empty() {
            return Ok(Some(all));
        }
        request.page_token = page.next_page_token;
    }
}

/// A channel that connects when it is used, signed in if the site has a login.
pub fn channel(address: SocketAddr) -> anyhow::Result<Line> {
    Ok(way(address)?.lazy())
}

/// The way to an address, over TLS and signed in if the site has a login.
pub fn way(address: SocketAddr) -> anyhow::Result<Endpoint> {
    known(address).map_or_else(|| Endpoint::plain(&address.to_string()), |site| Ok(site.way))
}
