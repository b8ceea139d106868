//! The stop service beside a server on one box: started as a process that outlives the server, and started again as soon as it is gone.
//!
//! Invariant: nothing here ends one that runs. What it says goes to a file of its own: it must not depend on where the server's own words go.

use super::program::{FOLDER, LOOK_EVERY, UP_WITHIN, program};
use anyhow::{Context, bail};
use midshift_agent::dial::{Dial, TcpDial};
use midshift_agent::tls::{self, Tls};
use std::fs::{DirBuilder, File, OpenOptions};
use std::future::pending;
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;
use tokio::process::{Child, Command};
use tokio::time::{Instant, sleep, timeout};
use tonic::transport::Channel;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// In its folder: what a stop service says that `serve` has started.
pub const LOG: &str = "log";
/// One that has more than this begins anew, bytes.
const LOG_BYTES_MAX: u64 = 4 * 1024 * 1024;
/// One that hangs is found out when it has not answered for so long, and started again after so many times in vain; one that is gone is found out at the next look.
const KEPT_EVERY: Duration = Duration::from_secs(2);
const MISSES: u32 = 2;
/// Its log is looked at so often, in looks at itself.
const LOG_EVERY: u32 = 100;
/// One that ended sooner than this after its start is started again after a pause, which doubles up to the longest.
const LIVED: Duration = Duration::from_secs(10);
const PAUSE_LONGEST: Duration = Duration::from_secs(5);

/// How to start it, and how to reach it.
pub struct Started {
    /// The site file.
    pub site: Option<PathBuf>,
    /// The data folder.
    pub data: PathBuf,
    /// Where it listens.
    pub listen: SocketAddr,
    /// The site's root; none: plain text, no login.
    pub authority_pem: Option<String>,
    /// Further arguments of it.
    pub arguments: Vec<String>,
}

impl Started {
    /// Starts it as a process that outlives this one, unless one of this site answers already. None: one does.
    ///
    /// # Errors
    /// It did not come up: no `serve` without a way to stop robots, unless `--no-stop` says that it is elsewhere.
    pub async fn start(&self) -> anyhow::Result<Option<Child>> {
        let listen = self.listen;
        if self.answers().await {
            tracing::info!(address = %listen, "a stop service answers already and is left alone");
            return Ok(None);
        }
        let mut child = self.spawn()?;
        let mut waited = Duration::ZERO;
        while !self.answers().await {
            if let Some(status) = child.try_wait()? {
                bail!(
                    "the stop service ended at once ({status}); what it said is in {}. `midshift stop serve` by itself shows it too; --no-stop if it runs elsewhere",
                    self.data.join(FOLDER).join(LOG).display()
                );
            }
            if waited >= UP_WITHIN {
                bail!(
                    "the stop service at {listen} did not answer within {} s, or one of another site has the port; --no-stop if it runs elsewhere, --stop-listen for another port",
                    UP_WITHIN.as_secs()
                );
            }
            sleep(LOOK_EVERY).await;
            waited += LOOK_EVERY;
        }
        tracing::info!(address = %listen, process = child.id(), "a stop service was started; it stays when this process ends");
        Ok(Some(child))
    }

    fn spawn(&self) -> anyhow::Result<Child> {
        let mut command = Command::new(program()?);
        command.args(["stop", "serve", "--listen", &self.listen.to_string(), "--data"]).arg(&self.data);
        if let Some(site) = &self.site {
            command.arg("--site").arg(site);
        }
        if self.authority_pem.is_none() {
            command.arg("--insecure");
        }
        command.args(&self.arguments);
        // A stop service that cannot be heard is better than none.
        let said = log(&self.data.join(FOLDER)).map_or_else(|_| Stdio::null(), Stdio::from);
        // A group of its own: neither Ctrl-C at a terminal nor a kill of this group reaches it.
        command.process_group(0).stdin(Stdio::null()).stdout(Stdio::null()).stderr(said);
        command.spawn().context("starting the stop service")
    }

    /// Looks after it until the task is ended: one that is gone is started again, before robots among people slow down for want of an answer. `child`: what
    /// [`Started::start`] has started.
    pub async fn keep(&self, mut child: Option<Child>) {
        let mut pause = Duration::ZERO;
        loop {
            let begun = Instant::now();
            self.until_gone(&mut child).await;
            if self.answers().await {
                tracing::info!(address = %self.listen, "another stop service has taken the place of the one that was here");
                child = None;
                continue;
            }
            pause = if begun.elapsed() >= LIVED { Duration::ZERO } else { longer(pause) };
            tracing::error!(address = %self.listen, "the stop service does not answer and is started again");
            sleep(pause).await;
            child = match self.start().await {
                Ok(started) => started,
                Err(error) => {
                    tracing::error!(%error, "the stop service was not started");
                    None
                }
            };
        }
    }

    /// Until its process has ended, or nobody listens any more, or nothing was answered for a while.
    async fn until_gone(&self, child: &mut Option<Child>) {
        let ended = async {
            match child {
                Some(child) => drop(child.wait().await),
                None => pending().await,
            }
        };
        let silent = async {
            let mut misses = 0;
            while misses < MISSES {
                self.watch().await;
                if !self.is_listening().await {
                    return;
                }
                let answers = self.answers().await;
                misses = if answers { 0 } else { misses + 1 };
                // One that only ended a connection that was old goes on.
                sleep(LOOK_EVERY).await;
            }
        };
        tokio::select! {
            () = ended => {}
            () = silent => {}
        }
    }

    /// Stays on a connection as long as what is asked on it is answered. When its process ends, that is seen here soon, whoever has started it.
    async fn watch(&self) {
        let Ok(Some(mut client)) = timeout(KEPT_EVERY, self.client()).await else { return };
        for n in 0_u32.. {
            // Of a process that runs for years too. Where it cannot be, it is said at the next start.
            if n.is_multiple_of(LOG_EVERY) {
                drop(log(&self.data.join(FOLDER)));
            }
            let asked = client.check(HealthCheckRequest::default());
            if !timeout(KEPT_EVERY, asked).await.is_ok_and(|answer| answer.is_ok()) {
                return;
            }
            sleep(LOOK_EVERY).await;
        }
    }

    /// Whether anything listens there.
    async fn is_listening(&self) -> bool {
        timeout(KEPT_EVERY, tokio::net::TcpStream::connect(self.listen)).await.is_ok_and(|connected| connected.is_ok())
    }

    async fn client(&self) -> Option<HealthClient<Channel>> {
        let tls = self.authority_pem.as_deref().map(|root| tls::config(root, None)).transpose().ok()?;
        let scheme = if tls.is_some() { "https" } else { "http" };
        let dial = TcpDial::new(&format!("{scheme}://{}", self.listen), None).ok()?.with_tls(tls.map(Tls::fixed));
        Some(HealthClient::new(dial.dial().await.ok()?))
    }

    /// Whether a stop service of this site serves there.
    async fn answers(&self) -> bool {
        let asked = async {
            let service = "midshift.stop.v1.StopService".to_owned();
            self.client().await?.check(HealthCheckRequest { service }).await.ok()
        };
        let answer = timeout(LOOK_EVERY * 10, asked).await;
        answer.is_ok_and(|answer| answer.is_some_and(|answer| answer.get_ref().status() == ServingStatus::Serving))
    }
}

/// The pause before the next start of one that ends at once.
fn longer(pause: Duration) -> Duration {
    (pause * 2).max(LOOK_EVERY).min(PAUSE_LONGEST)
}

/// Where it says what it says: at the end of what was said before, unless that is much.
fn log(folder: &Path) -> io::Result<File> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
    let file = OpenOptions::new().append(true).create(true).mode(0o600).open(folder.join(LOG))?;
    if file.metadata()?.len() > LOG_BYTES_MAX {
        file.set_len(0)?;
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    #[test]
    fn what_it_says_is_added_to_one_file_that_begins_anew_when_it_is_large() -> io::Result<()> {
        let dir = tempfile::tempdir()?;
        let folder = dir.path().join("stop");
        for _ in 0..2 {
            log(&folder)?.write_all(b"a line\n")?;
        }
        let said = folder.join(LOG);
        assert_eq!(std::fs::read(&said)?, b"a line\na line\n");
        OpenOptions::new().write(true).open(&said)?.set_len(LOG_BYTES_MAX + 1)?;
        log(&folder)?.write_all(b"anew\n")?;
        assert_eq!(std::fs::read(&said)?, b"anew\n");
        Ok(())
    }

    #[test]
    fn one_that_ends_again_and_again_is_started_less_and_less_often() {
        let pauses: Vec<u128> = std::iter::successors(Some(Duration::ZERO), |pause| Some(longer(*pause)))
            .map(|pause| pause.as_millis())
            .take(9)
            .collect();
        assert_eq!(pauses, [0, 100, 200, 400, 800, 1_600, 3_200, 5_000, 5_000]);
    }
}
