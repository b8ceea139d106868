//! The stop service beside a server on one box: started as a process that outlives the server, and started again as soon as it is gone.
//!
//! Invariant: only one that answered nothing three times is ended, the process that holds the folder, once in 30 s; beyond that a person is told.
//! What it says goes to a file of its own: it must not depend on where the server's own words go.

use super::program;
use anyhow::{Context, bail};
use midshift_agent::dial::{Dial, TcpDial};
use midshift_agent::tls::{self, Tls};
use midshift_core::drain_request::INCIDENT;
use midshift_core::item::{Fact, Item};
use midshift_core::limits;
use midshift_core::reason::{Code, Reason};
use midshift_core::rows::{Log, Writer};
use midshift_core::stop::hung::{Answer, Hung, Look, Verdict};
use midshift_core::stop::{FOLDER, LOG};
use midshift_core::time::{Clock, LinkTime};
use midshift_process::clock;
use midshift_stop::NotEnded;
use midshift_store::Store;
use std::fs::{DirBuilder, File, OpenOptions};
use std::future::pending;
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;
use tokio::process::{Child, Command};
use tokio::time::{Instant, sleep, timeout};
use tonic::transport::Channel;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// How often it is looked whether one that was started answers: whoever starts a server waits for it.
const ANSWER_EVERY: Duration = Duration::from_millis(5);
/// One that lives and has not answered by then is not coming. Its disk may be slow: it answers once its files are on it.
const ANSWERS_WITHIN: Duration = Duration::from_secs(60);
/// How often one that runs is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// One that has more than this begins anew, bytes.
const LOG_BYTES_MAX: u64 = 4 * 1024 * 1024;
/// One that hangs is found out when it has not answered for so long, time after time; one that is gone is found out at the next look.
const WITHIN: Duration = Duration::from_millis(limits::STOP_LOOK_WITHIN.as_ms());
/// A process that was ended lets go of the folder within this.
const GONE_WITHIN: Duration = Duration::from_secs(2);
/// Its log is looked at so often, in looks at itself.
const LOG_EVERY: u32 = 100;
/// One that ended sooner than this after its start is started again after a pause, which doubles up to the longest.
const LIVED: Duration = Duration::from_secs(10);
const PAUSE_LONGEST: Duration = Duration::from_secs(5);

/// How to start it, and how to reach it.
pub struct Supervisor {
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

impl Supervisor {
    /// Starts it as a process that outlives this one, unless one of this site answers already. None: one does.
    ///
    /// # Errors
    /// Its program is missing or of another version, or it did not come up: no `serve` without a way to stop robots,
    /// unless `--no-stop` says that it is elsewhere.
    pub async fn start(&self) -> anyhow::Result<Option<Child>> {
        program::check_program().await?;
        self.start_program(&program::find()?).await
    }

    /// The same for one that is gone, whichever version lies there now: robots wait for it.
    async fn start_again(&self) -> anyhow::Result<Option<Child>> {
        let program = program::find()?;
        let child = self.start_program(&program).await?;
        if child.is_some()
            && let Err(error) = program::check_version(&program).await
        {
            tracing::warn!(error = format!("{error:#}"), "the stop service was started again all the same");
        }
        Ok(child)
    }

    async fn start_program(&self, program: &Path) -> anyhow::Result<Option<Child>> {
        let listen = self.listen;
        if self.answers().await {
            tracing::info!(address = %listen, "a stop service answers already and is left alone");
            return Ok(None);
        }
        let mut child = self.spawn(program)?;
        let begun = Instant::now();
        while !self.answers().await {
            if let Some(status) = child.try_wait()? {
                bail!(
                    "the stop service ended at once ({status}); what it said is in {}. `midshift-stop` by itself shows it too; --no-stop if it runs elsewhere",
                    self.data.join(FOLDER).join(LOG).display()
                );
            }
            if begun.elapsed() >= ANSWERS_WITHIN {
                bail!(
                    "the stop service at {listen} did not answer within {} s, or one of another site has the port; --no-stop if it runs elsewhere, --stop-listen for another port",
                    ANSWERS_WITHIN.as_secs()
                );
            }
            sleep(ANSWER_EVERY).await;
        }
        tracing::info!(address = %listen, process = child.id(), "a stop service was started; it stays when this process ends");
        Ok(Some(child))
    }

    fn spawn(&self, program: &Path) -> anyhow::Result<Child> {
        let mut command = Command::new(program);
        command.args(["--listen", &self.listen.to_string(), "--data"]).arg(&self.data);
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
        command.spawn().with_context(|| format!("starting {}", program.display()))
    }

    /// Looks after it until the task is ended: one that is gone is started again, before robots among people slow down for want of an answer. `child`: what
    /// [`Supervisor::start`] has started.
    pub async fn keep_running(&self, mut child: Option<Child>, store: &dyn Store) {
        let (mut pause, mut watch) = (Duration::ZERO, Watch::default());
        loop {
            let begun = Instant::now();
            self.until_gone(&mut child, &mut watch, store).await;
            if self.is_followed().await {
                tracing::info!(address = %self.listen, "another stop service has taken the place of the one that was here");
                child = None;
                continue;
            }
            pause = if begun.elapsed() >= LIVED { Duration::ZERO } else { longer(pause) };
            tracing::error!(address = %self.listen, "the stop service does not answer and is started again");
            sleep(pause).await;
            child = match self.start_again().await {
                Ok(started) => started,
                Err(error) => {
                    tracing::error!(%error, "the stop service was not started");
                    None
                }
            };
        }
    }

    /// Until its process has ended, or nobody listens any more. One that hangs is ended.
    async fn until_gone(&self, child: &mut Option<Child>, watch: &mut Watch, store: &dyn Store) {
        let ended = async {
            match child {
                Some(child) => drop(child.wait().await),
                None => pending().await,
            }
        };
        let silent = async {
            loop {
                if watch.due.is_none() {
                    self.watch().await;
                }
                let (verdict, is_refused) = tokio::join!(watch.look_at_service(self.serves()), self.is_refused());
                match verdict {
                    _ if is_refused => return,
                    Verdict::Leave => {}
                    Verdict::Kill => match self.end().await {
                        Ok(()) => return,
                        Err(error) => watch.tell_person(store, &error.to_string()).await,
                    },
                    Verdict::Tell => watch.tell_person(store, "it hangs again within 30 s after it was replaced").await,
                }
            }
        };
        tokio::select! {
            () = ended => {}
            () = silent => {}
        }
    }

    /// Ends the process that holds the folder, so that another can have it.
    async fn end(&self) -> Result<(), NotEnded> {
        let folder = self.data.join(FOLDER);
        let process = midshift_stop::end_holder(&folder)?;
        tracing::error!(process, "the stop service answered nothing three times: its process is ended");
        let begun = Instant::now();
        while midshift_stop::is_held(&folder) && begun.elapsed() < GONE_WITHIN {
            sleep(LOOK_EVERY).await;
        }
        Ok(())
    }

    /// Stays on a connection as long as what is asked on it is answered. When its process ends, that is seen here soon, whoever has started it.
    async fn watch(&self) {
        let Ok(Some(mut client)) = timeout(WITHIN, self.client()).await else { return };
        for n in 0_u32.. {
            // Of a process that runs for years too. Where it cannot be, it is said at the next start.
            if n.is_multiple_of(LOG_EVERY) {
                drop(log(&self.data.join(FOLDER)));
            }
            let asked = client.check(HealthCheckRequest::default());
            if !timeout(WITHIN, asked).await.is_ok_and(|answer| answer.is_ok()) {
                return;
            }
            sleep(LOOK_EVERY).await;
        }
    }

    /// Whether another answers where one has ended. One that listens is given as long as one that hangs: it may be busy beginning.
    async fn is_followed(&self) -> bool {
        for _ in 0..limits::STOP_LOOKS_MISSED {
            if self.answers().await {
                return true;
            }
            if self.is_refused().await {
                return false;
            }
        }
        false
    }

    /// Whether nothing listens there. Of a process that hangs the system still takes connections, or lets them wait.
    async fn is_refused(&self) -> bool {
        timeout(WITHIN, tokio::net::TcpStream::connect(self.listen)).await.is_ok_and(|connected| connected.is_err())
    }

    async fn client(&self) -> Option<HealthClient<Channel>> {
        let tls = self.authority_pem.as_deref().map(|root| tls::config(root, None)).transpose().ok()?;
        let scheme = if tls.is_some() { "https" } else { "http" };
        let dial = TcpDial::new(&format!("{scheme}://{}", self.listen), None).ok()?.with_tls(tls.map(Tls::fixed));
        Some(HealthClient::new(dial.dial().await.ok()?))
    }

    /// Whether a stop service of this site serves there.
    async fn answers(&self) -> bool {
        timeout(WITHIN, self.serves()).await.unwrap_or(false)
    }

    async fn serves(&self) -> bool {
        let asked = async {
            let service = "midshift.stop.v1.StopService".to_owned();
            self.client().await?.check(HealthCheckRequest { service }).await.ok()
        };
        asked.await.is_some_and(|answer| answer.get_ref().status() == ServingStatus::Serving)
    }
}

/// What was seen of the service at this address.
struct Watch {
    hung: Hung,
    clock: Arc<dyn Clock>,
    due: Option<LinkTime>,
    is_told: bool,
}

impl Default for Watch {
    fn default() -> Self {
        Self { hung: Hung::default(), clock: clock::clock(1000), due: None, is_told: false }
    }
}

impl Watch {
    /// Looks once, when it is time to: right away, and each second as long as nothing is answered.
    async fn look_at_service(&mut self, serves: impl Future<Output = bool>) -> Verdict {
        let now = self.clock.now().link;
        let due = self.due.unwrap_or(now);
        sleep(Duration::from_millis(due.since(now).as_ms())).await;
        let begun = self.clock.now().link;
        let answer = match timeout(WITHIN, serves).await {
            Ok(true) => Answer::Heard,
            Ok(false) | Err(_) => Answer::None,
        };
        let ended = self.clock.now().link;
        self.due = (answer == Answer::None).then_some(begun + limits::STOP_LOOK_WITHIN);
        self.is_told &= answer == Answer::None;
        self.hung.saw(Look { due, begun, ended, answer })
    }

    /// Tells a person, once until it answers again; what the store does not take in time is told at the next look.
    async fn tell_person(&mut self, store: &dyn Store, why: &str) {
        if self.is_told {
            return;
        }
        tracing::error!(why, "the stop service answers nothing and is not replaced");
        let reason = Reason::from(Code::StopServiceHung).with("why", why);
        let mut item = Item::new(Writer::Stop, "midshift");
        item.facts.push(Fact {
            log: Log::Stop,
            subject: Arc::from("stop"),
            kind: INCIDENT,
            body: serde_json::to_string(&reason).unwrap_or_default().into(),
        });
        let kept = timeout(WITHIN, store.commit(vec![item])).await;
        self.is_told = kept.is_ok_and(|done| done.iter().all(Result::is_ok));
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
