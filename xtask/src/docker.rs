//! The part `compose` of the suite: the stacks of deploy/compose brought up for real by docker-compose on a docker of the suite's own.
//!
//! Invariant: the daemon has its files, its socket and its networks apart from any other, is ended by its id, and leaves nothing but what is cached
//! nowhere. It is not skipped: where docker cannot run the part fails, unless the suite was told `--no-docker`.

use crate::stack::site::{PORTS, Site, submit_task};
use crate::workspace::Workspace;
use crate::{apt, images, run, stack};
use anyhow::{Context, Result, bail, ensure};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

const LOOK: Duration = Duration::from_millis(200);
/// Looks at a daemon that starts, and at one that ends: a minute.
const LOOKS: usize = 300;
/// Debian's programs; its compose is 1.29, the older of the two that the files are written for.
const PACKAGES: [&str; 2] = ["docker.io", "docker-compose"];
/// Storage of layers: the usual one, and one that works everywhere and copies.
const DRIVERS: [&str; 2] = ["overlay2", "vfs"];

/// A stack that is brought up.
struct Stack {
    file: &'static str,
    /// Its containers that stay, and how many of them are asked for their health.
    containers: usize,
    asked: usize,
    /// What its port for people is called.
    public: &'static str,
    /// Which one hands out the first token.
    identity: &'static str,
}

const STACKS: [Stack; 2] = [
    Stack {
        file: "deploy/compose/one-box.yaml",
        containers: 3,
        asked: 2,
        identity: "midshift",
        public: "MIDSHIFT_ONE_BOX_PORT",
    },
    Stack {
        file: "deploy/compose/split.yaml",
        containers: 14,
        asked: 11,
        identity: "identity",
        public: "MIDSHIFT_PUBLIC_PORT",
    },
];

/// The daemon is often where only root looks.
fn program(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let folders = std::env::split_paths(&path).chain(["/usr/sbin".into(), "/sbin".into()]);
    folders.map(|folder| folder.join(name)).find(|program| program.is_file())
}

/// What is missing to run it.
pub fn missing() -> Vec<&'static str> {
    let all = ["dockerd", "docker", "docker-compose"];
    all.into_iter().filter(|name| program(name).is_none()).collect()
}

/// Installs what is missing.
pub fn install(workspace: &Workspace) -> Result<()> {
    if !missing().is_empty() {
        apt::install(workspace, &PACKAGES)?;
    }
    ensure!(missing().is_empty(), "still missing: {}", missing().join(", "));
    Ok(())
}

/// A daemon of our own, ended when it is let go.
struct Daemon {
    folder: PathBuf,
    child: Child,
}

impl Daemon {
    fn start(folder: &Path) -> Result<Self> {
        for driver in DRIVERS {
            let daemon = Self::start_with(folder, driver)?;
            match daemon {
                Ok(daemon) => return Ok(daemon),
                Err(said) => run::tell_person(&format!("dockerd with {driver} does not start:\n{said}")),
            }
        }
        bail!(
            "dockerd does not run on this machine; next: `cargo xtask test --no-docker` and `dist --no-image` do without"
        )
    }

    /// The daemon, or the end of what it said.
    fn start_with(folder: &Path, driver: &str) -> Result<Result<Self, String>> {
        let folder = folder.join(driver);
        std::fs::create_dir_all(&folder).with_context(|| format!("making {}", folder.display()))?;
        let log = folder.join("dockerd.log");
        let file = std::fs::File::create(&log).with_context(|| format!("opening {}", log.display()))?;
        let mut command = Command::new(program("dockerd").context("no dockerd")?);
        for (flag, name) in [("--data-root", "data"), ("--exec-root", "exec"), ("--pidfile", "pid")] {
            command.arg(flag).arg(folder.join(name));
        }
        command.arg("-H").arg(format!("unix://{}", folder.join("sock").display()));
        command.args(["--storage-driver", driver, "--bridge", "none", "--ip-masq=false"]);
        // Nothing of the machine's network is changed but bridges, which go with their stacks; unless a firewall stands between containers already.
        command.arg(format!("--iptables={}", is_forwarding_denied()));
        command.stdin(Stdio::null()).stdout(file.try_clone().context("its log")?).stderr(file);
        let child = command.spawn().context("starting dockerd")?;
        let mut daemon = Self { folder, child };
        for _ in 0..LOOKS {
            if run::quietly(daemon.docker().args(["info"])) {
                return Ok(Ok(daemon));
            }
            if daemon.child.try_wait().context("looking at dockerd")?.is_some() {
                break;
            }
            pause();
        }
        let said = std::fs::read_to_string(&log).unwrap_or_default();
        let last: Vec<&str> = said.lines().rev().take(5).collect();
        Ok(Err(last.into_iter().rev().collect::<Vec<_>>().join("\n")))
    }

    fn command(&self, name: &str) -> Command {
        let mut command = Command::new(program(name).unwrap_or_else(|| name.into()));
        command.env("DOCKER_HOST", format!("unix://{}", self.folder.join("sock").display()));
        // Both are of Debian, where the other builder is a package of its own; nobody's settings take part.
        command.env("DOCKER_BUILDKIT", "0").env("DOCKER_CONFIG", &self.folder).stdin(Stdio::null());
        command
    }

    fn docker(&self) -> Command {
        self.command("docker")
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        stack::send_signal(self.child.id(), "TERM");
        for _ in 0..LOOKS {
            if self.child.try_wait().is_ok_and(|status| status.is_some()) {
                return;
            }
            pause();
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// As another docker leaves it; then each stack needs rules of its own.
fn is_forwarding_denied() -> bool {
    let iptables = program("iptables").unwrap_or_else(|| "iptables".into());
    run::output(Command::new(iptables).args(["-S", "FORWARD"])).is_some_and(|rules| rules.contains("-P FORWARD DROP"))
}

#[expect(clippy::disallowed_methods, reason = "a pause between looks at another program, outside of any runtime")]
fn pause() {
    std::thread::sleep(LOOK);
}

/// Gives `work` a docker: the one that answers here, else one of its own below `temporary`, ended afterwards.
pub fn with_any(temporary: &Path, work: impl FnOnce(&dyn Fn() -> Command) -> Result<()>) -> Result<()> {
    let usual = || {
        let mut command = Command::new("docker");
        command.stdin(Stdio::null());
        command
    };
    if run::quietly(usual().arg("info")) {
        return work(&usual);
    }
    let daemon = Daemon::start(temporary)?;
    work(&|| daemon.docker())
}

/// Brings each stack up, does a task through its public address, brings it down. Whether all of that was done.
pub fn test(workspace: &Workspace, midshift: &Path) -> Result<bool> {
    let missing = missing();
    ensure!(
        missing.is_empty(),
        "docker cannot run, missing: {}; next: cargo xtask test --install, or --no-docker to leave this part out",
        missing.join(", ")
    );
    // Short, since a socket's path may not be longer than 107 bytes.
    let temporary = std::env::temp_dir().join(format!("midshift-docker-{}", std::process::id()));
    let outcome = Daemon::start(&temporary).and_then(|daemon| stacks(&daemon, workspace, &temporary, midshift));
    if temporary.exists() {
        std::fs::remove_dir_all(&temporary).with_context(|| format!("removing {}", temporary.display()))?;
    }
    outcome
}

fn stacks(daemon: &Daemon, workspace: &Workspace, temporary: &Path, midshift: &Path) -> Result<bool> {
    let images = images::make(&|| daemon.docker(), temporary, &workspace.root, midshift)?;
    for stack in &STACKS {
        run::tell_person(stack.file);
        if !works(stack, daemon, workspace, temporary, &images, midshift)? {
            return Ok(false);
        }
    }
    Ok(true)
}

fn works(
    stack: &Stack,
    daemon: &Daemon,
    workspace: &Workspace,
    temporary: &Path,
    images: &images::Images,
    midshift: &Path,
) -> Result<bool> {
    let held = PORTS.map(|name| (name, TcpListener::bind("127.0.0.1:0")));
    let mut ports = Vec::new();
    for (name, listener) in &held {
        let listener = listener.as_ref().map_err(|e| anyhow::anyhow!("a free port: {e}"))?;
        ports.push((*name, listener.local_addr().context("its number")?.port()));
    }
    drop(held);
    let compose = |arguments: &[&str]| {
        let mut command = daemon.command("docker-compose");
        command.arg("-f").arg(workspace.root.join(stack.file)).args(arguments);
        command.env("COMPOSE_PROJECT_NAME", "midshift-suite").env("MIDSHIFT_POSTGRES_PASSWORD", "of-the-suite");
        command.env("MIDSHIFT_IMAGE", images.midshift).env("MIDSHIFT_PROXY_IMAGE", images.proxy);
        command.env("MIDSHIFT_POSTGRES_IMAGE", images.postgresql).env("MIDSHIFT_SITES", workspace.root.join("sites"));
        command.envs(ports.iter().map(|(name, port)| (name, port.to_string())));
        command
    };
    let of_public = ports.iter().find(|(name, _)| *name == stack.public);
    let public = format!("127.0.0.1:{}", of_public.context("it publishes none")?.1);
    // It waits for health where the file says so: the robots start last, after the proxy, after everything else.
    let done = run::succeeds(&mut compose(&["up", "-d", "--no-build"]))?
        && all_healthy(daemon, stack)?
        && submit_task(workspace, midshift, &public, &site(stack, daemon, temporary, &compose)?)?;
    if !done {
        run::succeeds(&mut compose(&["ps"]))?;
        run::succeeds(&mut compose(&["logs", "--no-color", "--tail", "20"]))?;
    }
    Ok(run::succeeds(&mut compose(&["down", "-v", "-t", "5"]))? && done)
}

/// What a person would take out of the stack to sign in.
fn site(stack: &Stack, daemon: &Daemon, to: &Path, compose: &dyn Fn(&[&str]) -> Command) -> Result<Site> {
    let id = run::output(&mut compose(&["ps", "-q", stack.identity])).context("docker-compose ps")?;
    let site = Site { root: to.join("ca.pem"), token: to.join("token") };
    for (from, to) in [("site/ca.pem", &site.root), ("token/token", &site.token)] {
        let from = format!("{}:/var/lib/midshift-{from}", id.trim());
        ensure!(run::succeeds(daemon.docker().args(["cp", &from]).arg(to))?, "{from} cannot be copied");
    }
    Ok(site)
}

/// Every container that is asked for its health says that it is healthy, and none of the others ended.
fn all_healthy(daemon: &Daemon, stack: &Stack) -> Result<bool> {
    let mut list = daemon.docker();
    let said = run::output(list.args(["ps", "-a", "--format", "{{.Names}} {{.Status}}"])).context("docker ps")?;
    let (mut up, mut healthy) = (0, 0);
    for line in said.lines() {
        up += usize::from(line.contains(" Up "));
        healthy += usize::from(line.ends_with("(healthy)"));
    }
    run::tell_person(&format!("{up} containers are up, {healthy} of them say that they are healthy"));
    Ok(up == stack.containers && healthy == stack.asked)
}
