//! `midshift dev`: a whole factory in one process, in memory, on loopback, with simulated robots and work of its own. Not for production.

use crate::background::{Acknowledged, Background, Pressure, Source, all_stand};
use crate::planning::Planning;
use crate::report::{self, Inputs, Kind, Report};
use crate::scenario::{self, Launched, Release, Scenario, Sight, Stage, Story};
use crate::serve::{self, Say};
use crate::server::{Naive, Parts, Server};
use crate::stop::{self, Beside};
use crate::tally::{self, SharedTasks, Tasks};
use crate::throwaway::Throwaway;
use crate::under_way::{self, UnderWay};
use crate::{changed_map, clock, clock_doubt, door, resuming, stop_follower};
use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use midshift_agent::trust::Trust;
use midshift_cli::roles::Roles;
use midshift_cli::site_file::{self, Loaded};
use midshift_cli::task_list::read_list;
use midshift_core::Boxed;
use midshift_core::site::{Site, grid};
use midshift_core::task::Phase;
use midshift_core::time::{Clock, SiteTime};
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig, Persistence};
use midshift_sim::service::SimFace;
use midshift_sim::swarm::{Swarm, SwarmConfig};
use midshift_store::{
    FRAME_BYTES_DEFAULT, FrameLog, MemoryFrames, MemoryStore, SqliteFrames, SqliteStore, Store, StoreId,
};
use std::collections::VecDeque;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// What `dev` was asked for.
#[derive(Clone, Debug, clap::Args)]
pub struct Dev {
    /// Simulated robots.
    #[arg(long, default_value_t = 12)]
    pub robots: usize,
    /// A site file instead of the built-in demo factory.
    #[arg(long, conflicts_with = "map")]
    pub site: Option<PathBuf>,
    /// A grid map (.map) or LIF layout (.json) instead of a site.
    #[arg(long)]
    pub map: Option<PathBuf>,
    /// Start cells of a grid map (.agents).
    #[arg(long, requires = "map")]
    pub agents: Option<PathBuf>,
    /// A task list: .tasks (grid), .csv or .jsonl. Without it transports are drawn.
    #[arg(long)]
    pub tasks: Option<PathBuf>,
    /// How many times as fast as real time the site runs.
    #[arg(long, default_value_t = 1.0)]
    pub speedup: f64,
    /// Seed of robots, faults and work. The run is seeded, not reproducible: threads and sockets have their own mind.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Stop after so much site time (e.g. 10m) instead of at Ctrl-C, and fail if the run was not good.
    ///
    /// Good is: no place ever too full, no item lost or doubled, no step done twice, every task accounted for, and at most twice the
    /// robots' number of tasks open (unless --keep-open or --rate). From 5m on also: at most 2 % of the tasks, or one, with an operator;
    /// and 8 tasks a robot succeeded in 10m, in the built-in factory with its own work and up to 20 robots.
    #[arg(long = "for", value_parser = midshift_cli::duration)]
    pub run_for: Option<Duration>,
    /// Keep everything in this directory instead of in memory.
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Write a JSON report at the end.
    #[arg(long)]
    pub report: Option<PathBuf>,
    /// Address to listen on, loopback only. Port 0 takes a free one.
    #[arg(long, default_value = "127.0.0.1:7420")]
    pub listen: SocketAddr,
    /// UDP address to hear launchers of robots on whose agent does not run. By default 127.0.0.1:7422, if nobody else has it.
    #[arg(long, value_name = "ADDR")]
    pub beacon_listen: Option<SocketAddr>,
    /// Keep so many tasks open. The default with --for is twice the robots.
    #[arg(long, conflicts_with = "rate")]
    pub keep_open: Option<usize>,
    /// Submit so many tasks an hour of site time, e.g. 300/h.
    #[arg(long, value_parser = rate)]
    pub rate: Option<f64>,
    /// Play a story and fail if it did not go as it should. Five of the robots are launcher and agent processes; --speedup is that of bodies.
    #[arg(long, value_enum, conflicts_with_all = ["run_for", "map", "data", "rate"])]
    pub scenario: Option<Scenario>,
    /// Which bundles the story rolls out, in this order, each once. Robots must keep the good one and go back from every other.
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        requires = "scenario",
        default_values = ["good", "bad-at-start", "hangs", "bad-with-load"]
    )]
    pub bundles: Vec<Release>,
    /// How long the story's roll-outs keep a robot on probation and let a wave soak, e.g. 3s.
    #[arg(long, value_parser = midshift_cli::duration, requires = "scenario", default_value = "10s")]
    pub watched: Duration,
    /// Nothing goes wrong by itself. What is bad only with a load makes such faults more frequent, so a story does without that bundle then.
    #[arg(long)]
    pub no_faults: bool,
}

impl Dev {
    fn kind(&self) -> Kind {
        Kind {
            built_in: self.site.is_none() && self.map.is_none() && self.tasks.is_none(),
            own_backlog: self.keep_open.is_none() && self.rate.is_none(),
        }
    }
}

fn rate(text: &str) -> Result<f64, String> {
    let number = text.strip_suffix("/h").unwrap_or(text);
    number
        .parse::<f64>()
        .ok()
        .filter(|n| *n > 0.0 && n.is_finite())
        .ok_or_else(|| "must be a number above 0 with /h, e.g. 300/h".to_owned())
}

/// Tasks an hour that one robot can do on a small site: what `dev` takes 60 % of.
const TASKS_PER_ROBOT_HOUR: f64 = 45.0;
const LOAD: f64 = 0.6;
/// Open tasks a robot of the Poisson client at most.
const BACKLOG_PER_ROBOT: usize = 3;
/// Probation of roll-outs that name none, milliseconds of site time: nobody waits minutes for each simulated robot.
const PROBATION_MS: u64 = 10_000;
/// Probation as the server takes it.
const WATCHED: std::ops::RangeInclusive<Duration> = Duration::from_secs(1)..=Duration::from_secs(24 * 3_600);
/// Where `dev` hears beacons if nobody else does.
const BEACONS: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 7422);

/// Runs until `stop`, Ctrl-C's token, or the end of `--for`. The report is of the whole run.
pub fn run(args: Dev, stop: CancellationToken, say: Say<'_>) -> Boxed<'_, anyhow::Result<Report>> {
    Box::pin(play(args, stop, say))
}

async fn play(args: Dev, stop: CancellationToken, say: Say<'_>) -> anyhow::Result<Report> {
    if !args.listen.ip().is_loopback() {
        bail!("dev listens on loopback only; use `midshift serve`");
    }
    if !(0.01..=200.0).contains(&args.speedup) {
        bail!("--speedup must be 0.01 to 200");
    }
    if args.no_faults && args.scenario.is_some() && args.bundles.contains(&Release::BadWithLoad) {
        bail!("bad-with-load is bad by more faults, and --no-faults leaves none: name the other ones with --bundles");
    }
    if !WATCHED.contains(&args.watched) {
        bail!("--watched must be 1s to 24h");
    }
    let is_twice = |(ix, release): (usize, &Release)| args.bundles[..ix].contains(release);
    if args.bundles.iter().enumerate().any(is_twice) {
        bail!("--bundles must name each bundle once");
    }
    let scene = args.scenario.map(|_| Scene::new(&args)).transpose()?;
    let loaded = site_file::load(args.site.as_deref(), args.map.as_deref(), Some(args.robots as u64))?;
    for warning in &loaded.warnings {
        tracing::warn!(warning, "site");
    }
    let site = site_of(&args, &loaded)?;
    // Journals of several processes are judged by one clock, so a story's is real and its bodies are fast.
    let clock = clock::clock(if scene.is_some() { 1000 } else { (args.speedup * 1000.0) as u32 });
    crate::recorder::handle();
    let hall_config = hall_config(&args, &site, scene.as_ref());
    let hall = Arc::new(Fleet::open(&hall_config, &clock.now())?);
    let listener = TcpListener::bind(args.listen)
        .await
        .with_context(|| format!("listening on {}; is another midshift running?", args.listen))?;
    let address = listener.local_addr()?;
    let beacons = match args.beacon_listen {
        Some(address) => Some(serve::hear(address).await?),
        // Another midshift may have it: it is only for display.
        None => serve::hear(BEACONS).await.ok(),
    };
    let run_id = format!("dev-{}-{}-", args.seed, clock.now().wall.0);
    let (store, frames) = stores(&args, &site, &clock).await?;
    // Its floor is made anew at each start, so what is kept of another one is only told.
    let (loaded, map) = changed_map::choose(&*store, loaded, true, clock.now()).await?;
    let before = tally::newest(&*store).await?;
    let tasks = Arc::new(Mutex::new(Tasks::of_run(&run_id, before)));
    let stops = Stops::start(&args, site.clone(), clock.clone(), (address, &*store)).await?;
    let mut swarm = SwarmConfig::tcp(hall.clone(), clock.clone(), &format!("http://{address}"), args.seed)
        .with_stop(&format!("http://{}", stops.beside.address()));
    let live = tasks.clone();
    swarm.person = Some(Arc::new(move |id| tally::look(&live, |t| t.is_live(id))));
    let (software, ota) = Throwaway::make(clock.clone()).await?;
    let trust = software.trust(site.site_id().clone())?;
    swarm.software = Some(trust.clone());
    let swarm = Swarm::new(swarm);
    let planning = Planning::start()?;
    let parts = Parts {
        roles: Roles::default(),
        drain: Duration::ZERO,
        heard: None,
        store: store.clone(),
        frames,
        site: site.clone(),
        site_text: loaded.text,
        map,
        clock: clock.clone(),
        ota,
        reader: None,
        sim: Some(SimFace::new(hall.clone(), clock.clone(), swarm.crash())),
        naive: Naive::default(),
        stops: Some(stops.folder.clone()),
        stop_port: Some(stops.beside.address().port()),
        jumped_before: None,
        identity: None,
        port: door::alone("business"),
        planning: planning.handle(),
    };
    // The server ends after its robots and its client, or the last of them would be cut off at Ctrl-C.
    let served_until = CancellationToken::new();
    let server = Server::new(parts, served_until.clone()).await?.hearing(beacons).with_probation(PROBATION_MS);
    let made = (software.keys(), software.repository());
    say(&greeting(&args, &site, address, stops.beside.address(), made));
    let stage = match scene {
        Some(scene) => {
            let sight = Sight { store: store.clone(), board: server.board(), site: site.clone(), clock: clock.clone() };
            Some(scene.stage(&args, &hall_config, &hall, sight, [address, stops.beside.address()], trust, &software)?)
        }
        None => None,
    };
    let run = Run {
        args,
        site,
        clock,
        hall,
        run_id,
        before,
        tasks,
        store,
        stop,
        served_until,
        stage,
        _software: software,
        _stops: stops,
    };
    run.together(server, swarm, listener, address, say).await
}

/// The stop service of the run, in a folder that goes with it unless everything is kept.
struct Stops {
    beside: Beside,
    folder: PathBuf,
    _temporary: Option<TempDir>,
}

impl Stops {
    /// On the usual port, or on a free one if that is taken or the server asked for a free one too. With a new store it begins with nothing engaged.
    async fn start(
        args: &Dev,
        site: Arc<Site>,
        clock: Arc<dyn Clock>,
        (address, store): (SocketAddr, &dyn Store),
    ) -> anyhow::Result<Self> {
        let free = SocketAddr::new(address.ip(), 0);
        let usual = if args.listen.port() == 0 { free } else { SocketAddr::new(address.ip(), stop::PORT) };
        let listener = std::net::TcpListener::bind(usual).or_else(|_| std::net::TcpListener::bind(free));
        let listener = listener.context("listening for stops")?;
        let (folder, temporary) = match &args.data {
            Some(data) => (data.join(stop::FOLDER), None),
            None => {
                let temporary = tempfile::tempdir().context("making a folder for stops")?;
                (temporary.path().join(stop::FOLDER), Some(temporary))
            }
        };
        stop::announce(&folder, store, stop::Occasion::Start).await?;
        stop_follower::tell_stops(&folder, store).await?;
        let beside = Beside::start(folder.clone(), site, clock, listener)?;
        Ok(Self { beside, folder, _temporary: temporary })
    }
}

/// What a story needs from the beginning: a folder for what its robots keep.
struct Scene {
    folder: TempDir,
    launched: usize,
}

impl Scene {
    fn new(args: &Dev) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir().context("making a folder for robots")?;
        Ok(Self { folder, launched: scenario::LAUNCHED.min(args.robots / 2) })
    }

    #[expect(clippy::too_many_arguments, reason = "everything of the run that a stage stands on, once")]
    fn stage(
        self,
        args: &Dev,
        config: &FleetConfig,
        hall: &Fleet,
        sight: Sight,
        [address, stops]: [SocketAddr; 2],
        trust: Trust,
        software: &Throwaway,
    ) -> anyhow::Result<(Stage, TempDir)> {
        let in_process = args.robots - self.launched;
        let starts = config.starting_waypoints()?;
        let launched = (in_process..args.robots).map(|ix| Ok((config.robot_id(ix)?, starts[ix].clone())));
        let launched = launched.collect::<anyhow::Result<Vec<_>>>()?;
        let theirs = scenario::journals(self.folder.path(), &launched);
        let stage = Stage {
            server: address.to_string(),
            stop_server: stops.to_string(),
            channel: tonic::transport::Endpoint::from_shared(format!("http://{address}"))?.connect_lazy(),
            sight,
            releases: args.bundles.clone(),
            watched_ms: u64::try_from(args.watched.as_millis()).unwrap_or(u64::MAX),
            no_faults: args.no_faults,
            folder: self.folder.path().to_owned(),
            in_process,
            launched,
            journals: hall.journals().iter().cloned().chain(theirs).collect(),
            trust,
            repository: (software.repository(), software.keys().join("targets-1.pem")),
            seed: args.seed,
            body_speed: args.speedup,
            site: args.site.clone(),
        };
        Ok((stage, self.folder))
    }
}

/// The site, with a starting place for each robot of the run: nobody else is given it before the robot was heard.
fn site_of(args: &Dev, loaded: &Loaded) -> anyhow::Result<Arc<Site>> {
    let site = loaded.site.clone();
    let mut config = FleetConfig::new(site.clone(), args.robots, args.seed);
    if let Some(path) = &args.agents {
        let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
        config.starts = Some(grid::parse_starts(&site, &text)?);
    }
    let robot_ids = (0..args.robots).map(|index| config.robot_id(index)).collect::<Result<Vec<_>, _>>()?;
    let starts: Vec<_> = robot_ids.into_iter().zip(config.starting_waypoints()?).collect();
    Ok(Arc::new(Arc::unwrap_or_clone(site).with_starts(&starts)?))
}

fn hall_config(args: &Dev, site: &Arc<Site>, scene: Option<&Scene>) -> FleetConfig {
    let mut config = FleetConfig::new(site.clone(), args.robots, args.seed);
    config.drains = site.chargers().next().is_some();
    if let Some(scene) = scene {
        config.only = Some(0..args.robots - scene.launched);
        config.persistence = Persistence::Dir(scene.folder.path().to_owned());
        config.pace_permille = (args.speedup * 1000.0) as u32;
        config.faults = FaultRates::default().paced(args.speedup);
    }
    if args.no_faults {
        config.faults = FaultRates::none();
    }
    config
}

async fn stores(
    args: &Dev,
    site: &Site,
    clock: &Arc<dyn Clock>,
) -> anyhow::Result<(Arc<dyn Store>, Arc<dyn FrameLog>)> {
    let site_id = site.site_id().clone();
    if let Some(dir) = &args.data {
        let store = SqliteStore::open(dir, site_id.clone(), clock.clone()).await?;
        let frames = SqliteFrames::open(dir, site_id, clock.clone(), FRAME_BYTES_DEFAULT).await?;
        return Ok((Arc::new(store), Arc::new(frames)));
    }
    let id = StoreId(Arc::from(format!("{:016x}", rand::random::<u64>())));
    let frames = MemoryFrames::new(clock.clone(), 64 * 1024 * 1024);
    Ok((Arc::new(MemoryStore::new(site_id, id, clock.clone())), Arc::new(frames)))
}

fn greeting(args: &Dev, site: &Site, address: SocketAddr, stops: SocketAddr, made: (PathBuf, PathBuf)) -> String {
    let program = std::env::args().next().unwrap_or_else(|| "midshift".to_owned());
    let (keys, repository) = (made.0.display(), made.1.display());
    let kept = args
        .data
        .as_ref()
        .map_or("data in memory (--data DIR keeps it)".to_owned(), |d| format!("data in {}", d.display()));
    let server = if address.port() == 7420 { String::new() } else { format!(" --server {address}") };
    let stop_server = if stops.port() == stop::PORT { String::new() } else { format!(" --stop-server {stops}") };
    let mut stations =
        site.stations().chain(site.of_kind(midshift_core::site::Kind::Junction)).map(|w| site.name_of(w).to_string());
    let (from, to) = if site.source() == midshift_core::site::Source::Authored && site.site_id().as_str() == "demo" {
        ("A01".to_owned(), "B03".to_owned())
    } else {
        (stations.next().unwrap_or_default(), stations.next().unwrap_or_default())
    };
    let clock = if args.speedup == 1.0 {
        String::new()
    } else {
        format!(", site clock x{} (task times run ahead of the wall)", args.speedup)
    };
    format!(
        "midshift dev  {} simulated robots, site \"{}\", {kept}{clock}\n\
         gRPC http://{address} (reflection on)   metrics http://{address}/metrics   no login, no TLS: NOT for production\n\
         Stop http://{stops}: an operational stop request, not a safety function\n\
         Try:  {program} task submit{server} --from {from} --to {to} --sku SKU-88231 --wait\n\
         \x20     {program} robot ls{server}\n\
         \x20     {program} sim fault{server} rbt-04 --drop-network 20s\n\
         \x20     {program} stop{stop_server} --all --reason drill\n\
         \x20     grpcurl -plaintext {address} list\n\
         \x20     {program} bundle samples SAMPLES --config-only --repository {repository} --key {keys}/targets-1.pem\n\
         \x20     {program} bundle push{server} {repository}\n\
         Ctrl-C ends it.",
        args.robots,
        site.site_id(),
    )
}

struct Run {
    args: Dev,
    site: Arc<Site>,
    clock: Arc<dyn Clock>,
    hall: Arc<Fleet>,
    run_id: String,
    /// Number of the newest task when the run began.
    before: u64,
    tasks: SharedTasks,
    store: Arc<dyn Store>,
    stop: CancellationToken,
    served_until: CancellationToken,
    /// What is played, in the folder of its robots.
    stage: Option<(Stage, TempDir)>,
    /// Its folder goes with the run.
    _software: Throwaway,
    /// Ends after everything else.
    _stops: Stops,
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
            tally::look(&tasks, |t| t.open() + acknowledged.saturating_sub(t.own_count()))
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

    /// Takes a person's word for the clock, where there is a folder to leave it in. The clock of the start is not held against the store: what is signed
    /// here, and who believes it, is made anew by the same clock.
    fn accept_clock(&self) -> Option<AbortOnDropHandle<()>> {
        let (data, clock, store) = (self.args.data.clone()?, self.clock.clone(), self.store.clone());
        let words = async move { clock_doubt::run(&data, &*clock, &*store).await };
        Some(AbortOnDropHandle::new(tokio::spawn(words)))
    }

    async fn together(
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
        let following = tally::follow(self.store.clone(), self.tasks.clone(), self.served_until.clone());
        let swarm = swarm.run(robots_stop.clone());
        let channel = tonic::transport::Endpoint::from_shared(format!("http://{address}"))?.connect_lazy();
        let mut parts = UnderWay {
            serving: tokio::spawn(server.serve(listener)),
            following: tokio::spawn(async { Ok(following.await?) }),
            robots: tokio::spawn(async { Ok(swarm.await.map(drop)?) }),
            working: tokio::spawn(self.work(background, channel.clone(), work_stop.clone(), stand)),
        };
        let _resuming = AbortOnDropHandle::new(tokio::spawn(resuming::rounds(board.clone(), channel.clone())));
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
        under_way::ended(parts.working).await?;
        let place_waits = fleet.place_waits().await.context("asking fleet how often robots waited")?;
        robots_stop.cancel();
        under_way::ended(parts.robots).await?;
        let ended = self.clock.now();
        let mut bodies = self.hall.report(ended.site)?;
        if let Some((stage, folder)) = &self.stage {
            bodies.robots += stage.launched.len();
            bodies.verdict = self.hall.verdict_with(&scenario::journals(folder.path(), &stage.launched))?;
        }
        self.served_until.cancel();
        under_way::ended(parts.following).await?;
        under_way::ended(parts.serving).await?;
        let acknowledged = std::mem::take(&mut *acknowledged.lock().unwrap_or_else(PoisonError::into_inner));
        let tasks = tally::settle(self.store.clone(), &self.run_id, self.before).await?;
        let report = Report::of(Inputs {
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
                bar.set_message(tally::look(&self.tasks, |t| {
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

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        dev: Dev,
    }

    #[test]
    fn the_greeting_says_what_runs_where_and_how_to_put_a_bad_release_into_it() -> anyhow::Result<()> {
        let args = Line::parse_from(["dev"]).dev;
        let site = site_file::load(None, None, None)?.site;
        let made = (PathBuf::from("KEYS"), PathBuf::from("REPOSITORY"));
        let text = greeting(&args, &site, "127.0.0.1:7420".parse()?, "127.0.0.1:7421".parse()?, made);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[..3],
            [
                "midshift dev  12 simulated robots, site \"demo\", data in memory (--data DIR keeps it)",
                "gRPC http://127.0.0.1:7420 (reflection on)   metrics http://127.0.0.1:7420/metrics   no login, no TLS: NOT for production",
                "Stop http://127.0.0.1:7421: an operational stop request, not a safety function",
            ]
        );
        for command in [
            "bundle samples SAMPLES --config-only --repository REPOSITORY --key KEYS/targets-1.pem",
            "bundle push REPOSITORY",
        ] {
            assert!(lines.iter().any(|line| line.ends_with(command)), "{text}");
        }
        Ok(())
    }
}
