//! One `dev` run from the first task to the report.

use super::args::Dev;
use super::background::{Acknowledged, Background, Pressure, Source, all_stand};
use super::report::{self, Inputs, Report};
use super::scenario::{self, Launched, Stage, Story};
use super::simulated_person;
use super::stops::Stops;
use super::supervision::{self, RunningTasks};
use super::task_summary::{self, SharedTasks};
use super::throwaway::Throwaway;
use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use midshift_cli::task_list::read_list;
use midshift_core::site::Site;
use midshift_core::task::Phase;
use midshift_core::time::{Clock, SiteTime};
use midshift_server::Server;
use midshift_server::clock_doubt;
use midshift_server::serve::Say;
use midshift_sim::fleet::Fleet;
use midshift_sim::swarm::Swarm;
use midshift_store::Store;
use std::collections::VecDeque;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, PoisonError};
use std::time::Duration;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Tasks an hour that one robot can do on a small site: what `dev` takes 60 % of.
const TASKS_PER_ROBOT_HOUR: f64 = 45.0;
const LOAD: f64 = 0.6;
/// Open tasks a robot of the Poisson client at most.
const BACKLOG_PER_ROBOT: usize = 3;

/// Everything of a run.
pub struct Run {
    /// What it was asked for.
    pub args: Dev,
    /// Its site.
    pub site: Arc<Site>,
    /// Its clocks.
    pub clock: Arc<dyn Clock>,
    /// Its bodies.
    pub hall: Arc<Fleet>,
    /// How request ids of its client begin.
    pub run_id: String,
    /// Number of the newest task when the run began.
    pub before: u64,
    /// Its tasks as their rows say it.
    pub tasks: SharedTasks,
    /// Where the rows are.
    pub store: Arc<dyn Store>,
    /// Ends it.
    pub stop: CancellationToken,
    /// Ends the server, after robots and client.
    pub served_until: CancellationToken,
    /// What is played, in the folder of its robots.
    pub stage: Option<(Stage, TempDir)>,
    /// Its folder goes with the run.
    pub _software: Throwaway,
    /// Ends after everything else.
    pub _stops: Stops,
}

impl Run {
    fn pressure(&self) -> Pressure {
        let robots = self.args.robots;
        match (self.args.keep_open, self.args.rate) {
            (Some(open), _) => Pressure::KeepOpen(open),
            (None, Some(per_hour)) => Pressure::Rate { per_hour, backlog: usize::MAX },
            (None, None) if self.args.run_for.is_some() || self.args.tasks.is_some() || self.stage.is_some() => {
                Pressure::KeepOpen(2 * robots)
            }
            (None, None) => {
                let per_hour = robots as f64 * TASKS_PER_ROBOT_HOUR * LOAD;
                Pressure::Rate { per_hour, backlog: robots * BACKLOG_PER_ROBOT }
            }
        }
    }

    fn background(&self, acknowledged: &Acknowledged) -> anyhow::Result<Background> {
        let source = match &self.args.tasks {
            Some(path) => Source::Listed(VecDeque::from(read_list(path, &self.site)?)),
            None => Source::drawn(&self.site, self.args.seed)?,
        };
        let (tasks, counted) = (self.tasks.clone(), acknowledged.clone());
        // What was acknowledged and is not in the picture yet is open too.
        let open = move || {
            let acknowledged = counted.lock().unwrap_or_else(PoisonError::into_inner).len();
            task_summary::read_tasks(&tasks, |t| t.open() + acknowledged.saturating_sub(t.own_count()))
        };
        Ok(Background {
            pressure: self.pressure(),
            source,
            run_id: self.run_id.clone(),
            clock: self.clock.clone(),
            acknowledged: acknowledged.clone(),
            open: Arc::new(open),
        })
    }

    /// Work for robots that stand where fleet knows of them; where nothing is reserved they may stand anywhere.
    fn work(
        &self,
        background: Background,
        channel: tonic::transport::Channel,
        stop: CancellationToken,
        standing: oneshot::Sender<()>,
    ) -> impl Future<Output = anyhow::Result<()>> + Send + use<> {
        let reserved = self.site.collisions_modelled().then_some(self.args.robots);
        let store = self.store.clone();
        async move {
            if let Some(robots) = reserved {
                let asked = stop.cancelled();
                tokio::select! {
                    standing = all_stand(&*store, robots) => standing?,
                    () = asked => return Ok(()),
                }
            }
            // Nobody asks any more if the run is over.
            let _ = standing.send(());
            background.run(channel, stop).await
        }
    }

    /// Takes a person's word for the clock, where there is a folder to leave it in. The clock of the start is not held
    /// against the store: what is signed here, and who believes it, is made anew by the same clock.
    fn accept_clock(&self) -> Option<AbortOnDropHandle<()>> {
        let (data, clock, store) = (self.args.data.clone()?, self.clock.clone(), self.store.clone());
        let words = async move { clock_doubt::run(&data, &*clock, &*store).await };
        Some(AbortOnDropHandle::new(tokio::spawn(words)))
    }

    /// Lets all of it run until it is over; what came of it.
    pub async fn together(
        self,
        server: Server,
        swarm: Swarm,
        listener: TcpListener,
        address: SocketAddr,
        say: Say<'_>,
    ) -> anyhow::Result<Report> {
        let acknowledged = Acknowledged::default();
        let no_progress_ms = Arc::new(AtomicU64::new(0));
        let background = self.background(&acknowledged)?;
        let (fleet, board) = (server.fleet().context("a run without fleet")?, server.board());
        let (robots_stop, work_stop) = (CancellationToken::new(), CancellationToken::new());
        // Whatever happens here, nothing goes on without the rest.
        let _ends = [&robots_stop, &work_stop, &self.served_until].map(|token| token.clone().drop_guard());
        let (stand, standing) = oneshot::channel();
        let following = task_summary::follow(self.store.clone(), self.tasks.clone(), self.served_until.clone());
        let swarm = swarm.run(robots_stop.clone());
        let channel = tonic::transport::Endpoint::from_shared(format!("http://{address}"))?.connect_lazy();
        let mut parts = RunningTasks {
            serving: tokio::spawn(server.serve(listener)),
            following: tokio::spawn(async { Ok(following.await?) }),
            robots: tokio::spawn(async { Ok(swarm.await.map(drop)?) }),
            working: tokio::spawn(self.work(background, channel.clone(), work_stop.clone(), stand)),
        };
        let _person =
            AbortOnDropHandle::new(tokio::spawn(simulated_person::resume_silenced(board.clone(), channel.clone())));
        let _accepting = self.accept_clock();
        let progress = report::watch_progress(board, self.clock.clone(), no_progress_ms.clone());
        let _progress = AbortOnDropHandle::new(tokio::spawn(progress));
        let launched = self.stage.as_ref().map(|(stage, _)| stage.launch()).transpose()?;
        // A run is measured from the moment at which there may be work.
        tokio::select! {
            _ = standing => {}
            () = self.stop.cancelled() => {}
            error = parts.first_end() => return Err(error),
        }
        let begun = self.clock.now();
        let story = tokio::select! {
            story = self.until_over(begun.site, launched, say) => story?,
            error = parts.first_end() => return Err(error),
        };
        // No more work, then the count, then the end: what is open stays open and is counted so.
        work_stop.cancel();
        supervision::result_of(parts.working).await?;
        let place_waits = fleet.place_waits().await.context("asking fleet how often robots waited")?;
        robots_stop.cancel();
        supervision::result_of(parts.robots).await?;
        let ended = self.clock.now();
        let mut bodies = self.hall.report(ended.site)?;
        if let Some((stage, folder)) = &self.stage {
            bodies.robots += stage.launched.len();
            bodies.verdict = self.hall.verdict_with(&scenario::journals(folder.path(), &stage.launched))?;
        }
        self.served_until.cancel();
        supervision::result_of(parts.following).await?;
        supervision::result_of(parts.serving).await?;
        let acknowledged = std::mem::take(&mut *acknowledged.lock().unwrap_or_else(PoisonError::into_inner));
        let tasks = task_summary::read_once(self.store.clone(), &self.run_id, self.before).await?;
        let report = Report::from_run(Inputs {
            kind: self.args.kind(),
            seed: self.args.seed,
            acknowledged,
            tasks,
            bodies,
            place_waits,
            no_progress_ms: no_progress_ms.load(Relaxed),
            site_ms: ended.site.since(begun.site).as_ms(),
            wall_ms: ended.link.since(begun.link).as_ms(),
            story,
        });
        if let Some(path) = &self.args.report {
            std::fs::write(path, serde_json::to_string_pretty(&report)?)
                .with_context(|| format!("writing {}", path.display()))?;
        }
        Ok(report)
    }

    /// Until the story or the site time of `--for` is over, or Ctrl-C; a person at a terminal sees how far it is.
    async fn until_over(
        &self,
        begun: SiteTime,
        launched: Option<Launched>,
        say: Say<'_>,
    ) -> anyhow::Result<Option<Story>> {
        if let Some(((stage, _), launched)) = self.stage.as_ref().zip(launched) {
            return stage.play(launched, self.stop.clone(), say).await.map(Some);
        }
        let Some(run_for) = self.args.run_for else {
            self.stop.cancelled().await;
            return Ok(None);
        };
        let wanted_ms = u64::try_from(run_for.as_millis()).unwrap_or(u64::MAX);
        let bar = bar(wanted_ms / 1_000);
        loop {
            let passed_ms = self.clock.now().site.since(begun).as_ms();
            if passed_ms >= wanted_ms {
                break;
            }
            if bar.position() != passed_ms / 1_000 {
                bar.set_position(passed_ms / 1_000);
                let succeeded = |p: Phase| p == Phase::Succeeded;
                bar.set_message(task_summary::read_tasks(&self.tasks, |t| {
                    format!("{} submitted, {} succeeded", t.own_count(), t.count(succeeded))
                }));
            }
            tokio::select! {
                () = self.stop.cancelled() => break,
                () = tokio::time::sleep(Duration::from_millis(20)) => {}
            }
        }
        bar.finish_and_clear();
        Ok(None)
    }
}

/// Seconds of site time on stderr, if somebody sees it.
fn bar(seconds: u64) -> ProgressBar {
    let bar = if std::io::stderr().is_terminal() { ProgressBar::new(seconds) } else { ProgressBar::hidden() };
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} s of site time, {msg}") {
        bar.set_style(style);
    }
    bar
}
