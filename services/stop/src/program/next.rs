//! The next stop service in the place of the one that runs: started by it, which ends only when the next one has read what it needs and waits for the folder.
//!
//! Both have the same open port, which the next one gets as its standard input: whoever dials between them waits a moment and is refused by nobody. Invariant:
//! a next one that cannot begin costs nothing, this one goes on; two never have the folder at once.

use super::manager;
use crate::service::StopService;
use anyhow::{Context, anyhow, bail, ensure};
use std::env;
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::process::Stdio;
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::net::TcpListener;
use tokio::process::{Child, Command};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::time::timeout;

/// A stop service that was started answers within this, or whoever has started it says that it did not.
pub const UP_WITHIN: Duration = Duration::from_secs(10);
/// What tells the next one that it is one.
const FOLLOWS: &str = "--follows";
/// What it says when it needs nothing more than the folder.
const READY: u8 = b'.';

/// The open port of the one before.
///
/// # Errors
/// The standard input is no open port: it is not started by hand.
pub fn port() -> anyhow::Result<TcpListener> {
    let listener = std::net::TcpListener::from(io::stdin().as_fd().try_clone_to_owned()?);
    // Open once more, the port would stay so until this process has ended.
    rustix::stdio::dup2_stdin(File::open("/dev/null")?)?;
    listener.local_addr().with_context(|| format!("{FOLLOWS} is for a process that a stop service starts itself"))?;
    listener.set_nonblocking(true)?;
    Ok(TcpListener::from_std(listener)?)
}

/// Says to the one before that it may end.
///
/// # Errors
/// Nobody hears it.
pub fn ready() -> anyhow::Result<()> {
    let mut out = io::stdout();
    out.write_all(&[READY]).and_then(|()| out.flush()).context("the stop service before this one is gone")
}

/// Listens from now on for SIGUSR2, which asks for a next service. Without a listener it would end this process.
///
/// # Errors
/// The system gives no way to hear it.
pub fn listen() -> anyhow::Result<Signal> {
    signal(SignalKind::user_defined2()).context("hearing SIGUSR2")
}

/// Waits until one is asked for and is ready to have `port`, as often as it takes, and `service` ends for it.
pub async fn begun(mut asked: Signal, port: &OwnedFd, service: &StopService) {
    while asked.recv().await.is_some() {
        match start(port, service).await {
            Ok(process) => {
                tracing::info!(process, "the next stop service is ready: this one ends");
                manager::is_now(process);
                return;
            }
            Err(error) => {
                tracing::error!(error = format!("{error:#}"), "the next stop service did not begin: this one goes on");
            }
        }
    }
    std::future::pending().await
}

/// Starts one, and waits until it is ready and this one has nothing left that it alone knows. Its process.
async fn start(port: &OwnedFd, service: &StopService) -> anyhow::Result<u32> {
    // With it the container would end.
    ensure!(std::process::id() != 1, "the first process of a container is replaced with its container");
    let mut command = Command::new(midshift_os::program().context("finding this program")?);
    command.args(env::args_os().skip(1).filter(|argument| argument != FOLLOWS)).arg(FOLLOWS);
    command.stdin(Stdio::from(port.try_clone()?)).stdout(Stdio::piped());
    let mut next = Next(Some(command.spawn().context("starting it")?));
    let Some(child) = &mut next.0 else { bail!("it is gone") };
    let ready = timeout(UP_WITHIN, until_ready(child)).await;
    let process = ready.unwrap_or_else(|_| Err(anyhow!("it was not ready within {} s", UP_WITHIN.as_secs())))?;
    ensure!(child.try_wait()?.is_none(), "it ended when it was ready");
    ensure!(service.is_followed().await, "the disk does not hold all that this one knows");
    drop(next.0.take());
    Ok(process)
}

/// One that is not needed any more if nobody takes it out.
struct Next(Option<Child>);

impl Drop for Next {
    fn drop(&mut self) {
        let ended = self.0.as_mut().map(Child::start_kill).transpose();
        if let Err(error) = ended {
            tracing::warn!(%error, "a stop service that did not begin was not ended");
        }
    }
}

async fn until_ready(child: &mut Child) -> anyhow::Result<u32> {
    let said = child.stdout.as_mut().context("its standard output")?.read_u8().await;
    if said.is_ok_and(|said| said == READY) {
        return child.id().context("it ended at once");
    }
    bail!("it ended before it was ready; what it said is above: {}", child.wait().await?)
}
