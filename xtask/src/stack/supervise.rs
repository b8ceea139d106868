//! Starts processes of a plan in the order of what they depend on, starts again what ends, and ends all when asked.
//!
//! Invariant: every process that it started is in the state file with its id and the moment of its start, so that `down` ends exactly those, also
//! after this program was killed. Each leads a group of its own: Ctrl-C reaches this program alone, which then ends them in order.

use super::plan::{Kind, Process};
use super::postgresql;
use super::state::{Mark, State};
use crate::run;
use anyhow::{Context, Result};
use rustix::process::{Pid, Signal};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};
use tokio::time::Instant;

/// How often processes are looked at.
const LOOK: Duration = Duration::from_millis(200);
/// What ended is started again after so long.
const AGAIN: Duration = Duration::from_secs(1);
/// While it becomes healthy it is asked at least this often.
const ASK: Duration = Duration::from_millis(500);
/// A stack that is not healthy by then is given up.
pub const HEALTHY_WITHIN: Duration = Duration::from_secs(180);

/// One process and what is known of it.
struct Held {
    process: Process,
    child: Option<Child>,
    healthy: bool,
    /// When to start it, or to ask it.
    next: Instant,
}

/// Runs the processes until Ctrl-C or SIGTERM; `ready` is called once all are healthy. Whether they ever were.
pub fn run(processes: Vec<Process>, mut state: State, ready: impl FnOnce()) -> Result<bool> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().context("starting a runtime")?;
    runtime.block_on(async {
        let mut interrupt = signal(SignalKind::interrupt()).context("hearing Ctrl-C")?;
        let mut terminate = signal(SignalKind::terminate()).context("hearing SIGTERM")?;
        let now = Instant::now();
        let held = processes.into_iter().map(|process| Held { process, child: None, healthy: false, next: now });
        let mut held: Vec<Held> = held.collect();
        let mut looks = tokio::time::interval(LOOK);
        let mut ready = Some(ready);
        let outcome = loop {
            tokio::select! {
                _ = interrupt.recv() => break Ok(()),
                _ = terminate.recv() => break Ok(()),
                _ = looks.tick() => {}
            }
            if let Err(error) = mend_stack(&mut held, &mut state) {
                break Err(error);
            }
            if ready.is_some() && held.iter().all(|h| h.healthy) {
                state.ready = true;
                state.write()?;
                ready.take().into_iter().for_each(|ready| ready());
            }
            if ready.is_some() && now.elapsed() > HEALTHY_WITHIN {
                let late: Vec<_> = held.iter().filter(|h| !h.healthy).map(|h| h.process.name.as_str()).collect();
                run::tell_person(&format!("not healthy within {HEALTHY_WITHIN:?}: {}", late.join(", ")));
                break Ok(());
            }
        };
        end(&mut held, &mut looks).await;
        state.remove();
        outcome.map(|()| ready.is_none())
    })
}

/// One look at all of them.
fn mend_stack(held: &mut [Held], state: &mut State) -> Result<()> {
    let healthy: Vec<String> = held.iter().filter(|h| h.healthy).map(|h| h.process.name.clone()).collect();
    for one in held.iter_mut() {
        if let Some(child) = &mut one.child
            && let Some(status) = child.try_wait().context("looking at a process")?
        {
            if one.process.once && status.success() {
                (one.child, one.healthy) = (None, true);
                continue;
            }
            run::tell_person(&format!("{} ended: {status}; it is started again", one.process.name));
            (one.child, one.healthy, one.next) = (None, false, Instant::now() + AGAIN);
        }
        // What has done its work is not done again.
        if Instant::now() < one.next || (one.process.once && one.healthy) {
            continue;
        }
        if one.child.is_none() {
            // Only the first start waits for others: later they are there, or come back by themselves.
            if one.process.depends_on.iter().all(|on| healthy.contains(on)) || state.has(&one.process.name) {
                let child = start(&one.process, &state.folder)?;
                state.add(&one.process.name, Mark::new(child.id()))?;
                one.child = Some(child);
                one.next = Instant::now() + ASK;
            }
        } else if !one.healthy && !one.process.once {
            one.healthy = is_healthy(&one.process);
            let every = one.process.health.as_ref().map_or(ASK, |(_, _, every)| *every);
            one.next = Instant::now() + every.min(ASK);
        }
    }
    Ok(())
}

fn start(process: &Process, state: &Path) -> Result<Child> {
    for folder in &process.folders {
        std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    }
    if process.kind == Kind::Postgresql {
        postgresql::prepare(process)?;
    }
    let log = log_of(state, &process.name);
    let file = std::fs::OpenOptions::new().create(true).append(true).open(&log);
    let file = file.with_context(|| format!("opening {}", log.display()))?;
    let mut command = Command::new(&process.program);
    command.args(&process.arguments).envs(&process.environment).process_group(0);
    command.stdin(Stdio::null()).stdout(file.try_clone().context("its log")?).stderr(file);
    if process.kind == Kind::Postgresql {
        postgresql::as_user(&mut command);
    }
    command.spawn().with_context(|| format!("starting {} ({})", process.name, process.program.display()))
}

/// Where a process says what it does.
pub fn log_of(state: &Path, name: &str) -> PathBuf {
    state.join(format!("{name}.log"))
}

fn is_healthy(process: &Process) -> bool {
    let Some((program, arguments, _)) = &process.health else { return true };
    run::quietly(Command::new(program).args(arguments))
}

/// Asks all to end, those first that others do not depend on, and kills what does not.
async fn end(held: &mut [Held], looks: &mut tokio::time::Interval) {
    while held.iter().any(|h| h.child.is_some()) {
        let needed: Vec<String> =
            held.iter().filter(|h| h.child.is_some()).flat_map(|h| h.process.depends_on.clone()).collect();
        let mut now: Vec<&mut Held> =
            held.iter_mut().filter(|h| h.child.is_some() && !needed.contains(&h.process.name)).collect();
        if now.is_empty() {
            // Two that depend on each other never started.
            return;
        }
        for one in &mut now {
            if let Some(child) = &one.child {
                send_signal(child.id(), &one.process.stop_signal);
            }
            one.next = Instant::now() + one.process.grace;
        }
        while now.iter().any(|h| h.child.is_some()) {
            looks.tick().await;
            for one in &mut now {
                let Some(child) = &mut one.child else { continue };
                let ended = child.try_wait().is_ok_and(|status| status.is_some());
                if !ended && Instant::now() > one.next {
                    run::tell_person(&format!("{} did not end by itself", one.process.name));
                    send_signal(child.id(), "KILL");
                    let _ = child.wait();
                    one.child = None;
                } else if ended {
                    one.child = None;
                }
            }
        }
    }
}

/// Sends a signal by its name; a process that is gone is no error.
pub fn send_signal(id: u32, name: &str) {
    let signal = match name {
        "INT" => Signal::INT,
        "QUIT" => Signal::QUIT,
        "KILL" => Signal::KILL,
        _ => Signal::TERM,
    };
    if let Some(pid) = i32::try_from(id).ok().and_then(Pid::from_raw) {
        let _ = rustix::process::kill_process(pid, signal);
    }
}
