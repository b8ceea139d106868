//! `midshift dev`: a whole factory in one process, in memory, on loopback, with simulated robots and work of its own.
//! Not for production.
//!
//! Invariant: its one door is [`run`], and what the rooms below tell each other goes through none of the server's own
//! files. Of other crates only tests use [`task_summary`] and [`throwaway`].

mod args;
mod background;
mod greeting;
mod report;
mod run;
mod scenario;
mod simulated_person;
mod stops;
mod supervision;
pub mod task_summary;
pub mod throwaway;

pub use args::Dev;

use anyhow::{Context, bail};
use greeting::greeting;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_cli::roles::Roles;
use midshift_cli::site_file::{self, Loaded};
use midshift_core::Boxed;
use midshift_core::site::{Site, grid};
use midshift_core::time::Clock;
use midshift_process::{clock, door};
use midshift_server::changed_map;
use midshift_server::planning::Planning;
use midshift_server::serve::{self, Say};
use midshift_server::{Components, NaiveRules, Server};
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig, Persistence};
use midshift_sim::service::SimFace;
use midshift_sim::swarm::{Swarm, SwarmConfig};
use midshift_store::{
    FRAME_BYTES_DEFAULT, FrameLog, MemoryFrames, MemoryStore, SqliteFrames, SqliteStore, Store, StoreId,
};
use report::Report;
use run::Run;
use scenario::{Release, Sight, Stage};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use stops::Stops;
use task_summary::{SharedTasks, Tasks};
use tempfile::TempDir;
use throwaway::Throwaway;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

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
    midshift_process::recorder::handle();
    let hall_config = hall_config(&args, &site, scene.as_ref());
    let hall = Arc::new(Fleet::open(&hall_config, &clock.now())?);
    let listener = TcpListener::bind(args.listen)
        .await
        .with_context(|| format!("listening on {}; is another midshift running?", args.listen))?;
    let address = listener.local_addr()?;
    let beacons = match args.beacon_listen {
        Some(address) => Some(serve::listen_for_beacons(address).await?),
        // Another midshift may have it: it is only for display.
        None => serve::listen_for_beacons(BEACONS).await.ok(),
    };
    let run_id = format!("dev-{}-{}-", args.seed, clock.now().wall.0);
    let (store, frames) = stores(&args, &site, &clock).await?;
    // Its floor is made anew at each start, so what is kept of another one is only told.
    let (loaded, map) = changed_map::choose(&*store, loaded, true, clock.now()).await?;
    let before = task_summary::newest_number(&*store).await?;
    let tasks = Arc::new(Mutex::new(Tasks::of_run(&run_id, before)));
    let stops = Stops::start(&args, site.clone(), clock.clone(), (address, &*store)).await?;
    let mut swarm = SwarmConfig::tcp(hall.clone(), clock.clone(), &format!("http://{address}"), args.seed)
        .with_stop(&format!("http://{}", stops.service.address()));
    let live = tasks.clone();
    swarm.person = Some(Arc::new(move |id| task_summary::read_tasks(&live, |t| t.is_live(id))));
    let (software, ota) = Throwaway::make(clock.clone()).await?;
    let trust = software.trust(site.site_id().clone())?;
    swarm.software = Some(trust.clone());
    let swarm = Swarm::new(swarm);
    let planning = Planning::start()?;
    let parts = Components {
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
        naive: NaiveRules::default(),
        stops: Some(stops.folder.clone()),
        stop_port: Some(stops.service.address().port()),
        keep: Default::default(),
        jumped_before: None,
        identity: None,
        port: door::alone("business"),
        planning: planning.handle(),
    };
    // The server ends after its robots and its client, or the last of them would be cut off at Ctrl-C.
    let served_until = CancellationToken::new();
    let server = Server::new(parts, served_until.clone()).await?.hearing(beacons).with_probation(PROBATION_MS);
    let made = (software.keys(), software.repository());
    say(&greeting(&args, &site, address, stops.service.address(), made));
    let stage = match scene {
        Some(scene) => {
            let sight = Sight { store: store.clone(), board: server.board(), site: site.clone(), clock: clock.clone() };
            Some(scene.stage(
                &args,
                &hall_config,
                &hall,
                (sight, tasks.clone()),
                [address, stops.service.address()],
                trust,
                &software,
            )?)
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
        (sight, tasks): (Sight, SharedTasks),
        [address, stops]: [SocketAddr; 2],
        trust: TrustAnchors,
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
            tasks,
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
