//! `cargo xtask stack up|down|test`: the stack of a compose file as processes of this machine, without docker.
//!
//! Invariant: the compose file is the only description of the stack. What is started is ended by id. Called by `main` and by the suite.

mod compose;
mod plan;
pub mod postgresql;
pub mod site;
mod state;
mod supervise;

use crate::run;
use crate::workspace::Workspace;
use anyhow::{Context, Result, bail, ensure};
use clap::{Args, Subcommand};
use plan::{Kind, Programs};
use site::{PORTS, Site, submit_task};
use state::State;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;
pub use supervise::send_signal;

/// The default file.
const SPLIT: &str = "deploy/compose/split.yaml";
const LOOK: Duration = Duration::from_millis(200);
/// Which stack.
#[derive(Args, Clone)]
pub struct Which {
    /// The compose file. Its variables come from the environment, else from .env beside it, else from .env.example.
    #[arg(long, default_value = SPLIT)]
    file: PathBuf,
    /// Where logs, volumes and ids of processes are; without it a folder of target/stack.
    #[arg(long)]
    state: Option<PathBuf>,
}

/// What to do with it.
#[derive(Subcommand)]
pub enum Verb {
    /// Start it, and keep it running until Ctrl-C: what ends is started again.
    Up {
        #[command(flatten)]
        which: Which,
        /// Return once all are healthy; `down` ends it.
        #[arg(long)]
        detach: bool,
        /// A midshift that is already built, instead of building one.
        #[arg(long)]
        binary: Option<PathBuf>,
    },
    /// End it.
    Down {
        #[command(flatten)]
        which: Which,
        /// Remove its volumes and logs too.
        #[arg(long)]
        volumes: bool,
    },
    /// Do one task through its public address; a stack that does not run is started for that, on free ports, and ended.
    Test {
        #[command(flatten)]
        which: Which,
        /// A midshift that is already built, instead of building one.
        #[arg(long)]
        binary: Option<PathBuf>,
        /// In containers, of deploy/compose/split.yaml, on a docker of its own.
        #[arg(long, conflicts_with_all = ["file", "state"])]
        docker: bool,
    },
}

/// Runs one verb with processes of this machine; whether it succeeded.
pub fn run(workspace: &Workspace, verb: Verb) -> Result<bool> {
    match verb {
        Verb::Up { which, detach: false, binary } => up(workspace, &which, binary),
        Verb::Up { which, detach: true, binary } => detached(workspace, &which, binary),
        Verb::Down { which, volumes } => down(&which.folder(workspace)?, volumes),
        Verb::Test { which, binary, .. } => test(workspace, &which, binary),
    }
}

impl Which {
    /// The split stack, its state where it is by itself.
    pub fn split() -> Self {
        Self { file: SPLIT.into(), state: None }
    }

    fn file(&self, workspace: &Workspace) -> PathBuf {
        workspace.root.join(&self.file)
    }

    /// Where its state is. The database runs as a user that may not come into a home: as root it is not below the checkout.
    fn folder(&self, workspace: &Workspace) -> Result<PathBuf> {
        if let Some(state) = &self.state {
            return std::path::absolute(state).context("the folder for state");
        }
        let name = self.file.file_stem().context("the file has a name")?;
        Ok(match postgresql::unprivileged()? {
            None => workspace.target.join("stack").join(name),
            Some(_) => {
                use std::hash::{DefaultHasher, Hash, Hasher};
                let mut of = DefaultHasher::new();
                (&workspace.target, name).hash(&mut of);
                std::env::temp_dir().join(format!("midshift-stack-{:016x}", of.finish()))
            }
        })
    }
}

/// The program that was named, or one that is built for it.
pub fn midshift(workspace: &Workspace, binary: Option<PathBuf>) -> Result<PathBuf> {
    if let Some(binary) = binary {
        return std::fs::canonicalize(&binary).with_context(|| format!("no {}", binary.display()));
    }
    ensure!(run::succeeds(&mut workspace.cargo(&["build", "--workspace", "--bins"]))?, "midshift does not build");
    Ok(workspace.midshift())
}

fn variables(file: &Path) -> compose::Variables {
    let beside = |name: &str| std::fs::read_to_string(file.with_file_name(name)).ok();
    let text = beside(".env").or_else(|| beside(".env.example")).unwrap_or_default();
    let mut variables = compose::variables_of(&text);
    variables.extend(std::env::vars().filter(|(name, _)| name.starts_with("MIDSHIFT_")));
    variables
}

fn up(workspace: &Workspace, which: &Which, binary: Option<PathBuf>) -> Result<bool> {
    let (file, folder) = (which.file(workspace), which.folder(workspace)?);
    if State::find(&folder).is_some() {
        bail!("it runs already, see {}; next: cargo xtask stack down", folder.display());
    }
    let programs = Programs {
        midshift: midshift(workspace, binary)?,
        haproxy: "haproxy".into(),
        postgresql: postgresql::programs()?,
    };
    let text = std::fs::read_to_string(&file).with_context(|| format!("reading {}", file.display()))?;
    let services = compose::read(&text, &variables(&file)).with_context(|| format!("in {}", file.display()))?;
    make(&folder)?;
    let processes = plan::plan(&services, &programs, &file, &folder, &workspace.root)?;
    if processes.iter().any(|process| process.kind == Kind::Proxy) {
        let found = run::quietly(Command::new(&programs.haproxy).arg("-v"));
        ensure!(found, "no haproxy on this machine; next: install the package haproxy");
    }
    let public = services.iter().find_map(|s| s.ports.first()).map(|(outside, _)| format!("127.0.0.1:{outside}"));
    let public = public.context("no service has a port for people")?;
    let state = State::begin(&folder, public.clone())?;
    let site = Site::below(&folder);
    run::tell_person(&format!("{} processes, logs in {}", processes.len(), folder.display()));
    supervise::run(processes, state, || {
        run::tell_person(&format!("all are healthy; people and programs come in at {public}"));
        let (root, token) = (site.root.display(), site.token.display());
        run::tell_person(&format!("next: midshift login {public} --ca {root} --token-file {token}"));
    })
}

/// For everybody to come through and nobody else to write.
fn make(folder: &Path) -> Result<()> {
    use std::os::unix::fs::PermissionsExt;
    std::fs::create_dir_all(folder.join("volumes")).with_context(|| format!("making {}", folder.display()))?;
    for made in [folder.to_owned(), folder.join("volumes")] {
        let mode = std::fs::Permissions::from_mode(0o755);
        std::fs::set_permissions(&made, mode).with_context(|| format!("opening {}", made.display()))?;
    }
    Ok(())
}

#[expect(clippy::disallowed_methods, reason = "a pause between looks at another program, outside of any runtime")]
fn pause() {
    std::thread::sleep(LOOK);
}

/// The same in the background.
fn detached(workspace: &Workspace, which: &Which, binary: Option<PathBuf>) -> Result<bool> {
    let folder = which.folder(workspace)?;
    if State::find(&folder).is_some() {
        bail!("it runs already, see {}; next: cargo xtask stack down", folder.display());
    }
    let binary = midshift(workspace, binary)?;
    make(&folder)?;
    let log = folder.join("stack.log");
    let file = std::fs::File::create(&log).with_context(|| format!("opening {}", log.display()))?;
    let mut command = Command::new(&workspace.this);
    command.args(["stack", "up", "--binary"]).arg(binary).arg("--file").arg(&which.file).arg("--state").arg(&folder);
    command.stdin(Stdio::null()).stdout(file.try_clone().context("its log")?).stderr(file).process_group(0);
    let mut child = command.spawn().context("starting the supervisor")?;
    loop {
        pause();
        if let Some(status) = child.try_wait().context("looking at the supervisor")? {
            run::tell_person(&std::fs::read_to_string(&log).unwrap_or_default());
            bail!("it ended: {status}; see {}", folder.display());
        }
        if State::find(&folder).is_some_and(|state| state.ready) {
            run::tell_person(std::fs::read_to_string(&log).unwrap_or_default().trim_end());
            return Ok(true);
        }
    }
}

fn down(folder: &Path, volumes: bool) -> Result<bool> {
    if let Some(state) = State::find(folder) {
        if state.supervisor.runs() {
            supervise::send_signal(state.supervisor.id, "TERM");
            while state.supervisor.runs() {
                pause();
            }
        }
        // Left over by a supervisor that was killed.
        let left: Vec<_> = state.running().map(|(_, mark)| mark.clone()).collect();
        left.iter().for_each(|mark| supervise::send_signal(mark.id, "TERM"));
        while left.iter().any(state::Mark::runs) {
            pause();
        }
        state.remove();
    }
    if volumes && folder.exists() {
        std::fs::remove_dir_all(folder).with_context(|| format!("removing {}", folder.display()))?;
    }
    Ok(true)
}

/// Does one task through the stack, which is started and ended for that if it does not run; whether it was done.
pub fn test(workspace: &Workspace, which: &Which, binary: Option<PathBuf>) -> Result<bool> {
    let binary = midshift(workspace, binary)?;
    if let Some(state) = State::find(&which.folder(workspace)?) {
        return submit_task(workspace, &binary, &state.public, &Site::below(&state.folder));
    }
    let folder = std::env::temp_dir().join(format!("midshift-stack-test-{}", std::process::id()));
    let state = folder.display().to_string();
    let own = |verb: &[&str]| {
        let mut command = workspace.command(&workspace.this);
        command.args(["stack"]).args(verb).arg("--file").arg(&which.file).args(["--state", &state]);
        command
    };
    let mut start = own(&["up", "--detach"]);
    start.arg("--binary").arg(&binary);
    // Held together, so that no two are the same.
    let free = PORTS.map(|_| std::net::TcpListener::bind("127.0.0.1:0"));
    for (port, free) in PORTS.iter().zip(free) {
        start.env(port, free.and_then(|f| f.local_addr()).context("a free port")?.port().to_string());
    }
    let done = run::succeeds(&mut start)?
        && State::find(&folder)
            .is_some_and(|s| submit_task(workspace, &binary, &s.public, &Site::below(&folder)).unwrap_or(false));
    if !done {
        run::tell_person(&format!("logs are in {state}"));
        down(&folder, false)?;
        return Ok(false);
    }
    run::succeeds(&mut own(&["down", "--volumes"]))
}
