//! P10 and P12: how long a server takes from its start to its first durable answer, what it takes without robots, and how soon robots are back
//! after it was killed.
//!
//! Starts are of the program beside this one, as it is released, with a stop service. Robots come back to a child of this program, without one.

use crate::child::Child;
use crate::engine::children_of;
use crate::figure::Figure;
use crate::fsync::place;
use crate::grid_map;
use crate::old_sites::old_site::OldSite;
use crate::old_sites::old_tables;
use crate::outcome::unless_stopped;
use crate::process_files::Memory;
use crate::simulators::{await_sessions, start_robots};
use crate::submit::transports;
use anyhow::{Context, anyhow, ensure};
use midshift_agent::clock::wall;
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::SubmitTaskRequest;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_server::storage::Database;
use rustix::process::{Pid, Signal, kill_process};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;
use tokio::time::{Instant, sleep};
use tonic::transport::Endpoint;

/// The first durable answer is there by then.
const WITHIN: Duration = Duration::from_secs(60);
/// A stop service that was ended lets go of its folder by then.
const GONE_WITHIN: Duration = Duration::from_secs(2);
/// How often a server that does not answer yet is asked again.
const ASK_EVERY: Duration = Duration::from_millis(1);

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct StartArgs {
    /// Tasks that are over in the old store.
    #[arg(long, default_value_t = 300_000)]
    ended: u64,
    /// Robots that come back after a kill, in turn. More than some 9,000 want a higher limit of open files.
    #[arg(long, value_delimiter = ',', default_values_t = [1_000])]
    robots: Vec<usize>,
    /// Seconds after a start until memory is read.
    #[arg(long, default_value_t = 5)]
    settle_seconds: u64,
    /// Starts of each kind.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Where the databases are made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    dir: Option<PathBuf>,
}

/// What was measured of the starts of one kind.
#[derive(Default)]
struct Starts {
    answer_ms: Vec<f64>,
    server: Vec<Memory>,
    stop_service: Vec<Memory>,
}

/// Runs each kind of start, then kills; ends early, and what it started with it, when somebody asks for that.
pub async fn run(args: StartArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let mut measured = Err(anyhow!("nothing was measured"));
    let stopped = unless_stopped(async { measured = measure(&args, say).await }).await;
    stopped.map_or(measured, |why| Err(anyhow!(why)))
}

async fn measure(args: &StartArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let (mut first, mut again, mut old, mut bare) = <(Starts, Starts, Starts, Vec<f64>)>::default();
    let old_room = place(args.dir.as_ref())?;
    let database = Database { store: None };
    let site = text::parse(DEMO)?;
    let old_data = old_room.path().join("data");
    old_tables::make(&OldSite::with_ended(args.ended, wall()), &database, &old_data, site.site_id()).await?;
    for round in 1..=args.rounds {
        let room = place(args.dir.as_ref())?;
        bare.push(start_bare_ms(room.path()).await?);
        let data = room.path().join("data");
        start(args, &data, &mut first).await?;
        start(args, &data, &mut again).await?;
        start(args, &old_data, &mut old).await?;
        say(&format!("round {round} of the starts is over"));
    }
    let mut figures = Vec::new();
    for (name, starts) in [("a new folder", &first), ("a store with one task", &again), ("an old store", &old)] {
        figures.extend(figures_of(name, starts, &bare));
    }
    for robots in &args.robots {
        figures.push(measure_return(args, *robots, say).await?);
    }
    Ok(figures)
}

fn figures_of(on: &str, starts: &Starts, bare: &[f64]) -> Vec<Figure> {
    let each = |of: &[Memory], part: fn(&Memory) -> f64| of.iter().map(part).collect::<Vec<_>>();
    let mib = |what: &str, values: &[f64]| Figure::new("P12", format!("{on}, {what}"), "MiB", values, None);
    let answer = format!("{on}, start to its first durable answer");
    vec![
        Figure::new("P12", answer, "ms", &starts.answer_ms, Some(("bare tonic, start to its first answer", bare))),
        mib("RssAnon of the server", &each(&starts.server, |m| m.own_mib)),
        mib("RSS of the server", &each(&starts.server, |m| m.all_mib)),
        mib("RssAnon of the stop service", &each(&starts.stop_service, |m| m.own_mib)),
        mib("RSS of the stop service", &each(&starts.stop_service, |m| m.all_mib)),
    ]
}

/// A server that is asked to end when it goes, and the stop service that it started.
struct Running {
    server: std::process::Child,
    stop_folder: PathBuf,
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(pid) = i32::try_from(self.server.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, Signal::TERM);
        }
        let _ = self.server.wait();
        let _ = midshift_stop::end_holder(&self.stop_folder);
    }
}

/// Starts the released server on a folder, with a stop service of its own, and ends both.
async fn start(args: &StartArgs, data: &Path, starts: &mut Starts) -> anyhow::Result<()> {
    let program = std::env::current_exe()?.with_file_name("midshift");
    ensure!(program.exists(), "{} is missing: cargo build --release", program.display());
    let (listen, stop_listen) = (find_free_address()?, find_free_address()?);
    let mut command = std::process::Command::new(program);
    command.args(["serve", "--insecure", "--listen", &listen.to_string(), "--stop-listen", &stop_listen.to_string()]);
    command.arg("--data").arg(data).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let begun = Instant::now();
    let server = command.spawn().context("starting midshift")?;
    let running = Running { server, stop_folder: data.join(midshift_core::stop::FOLDER) };
    submit_first(listen).await?;
    starts.answer_ms.push(begun.elapsed().as_secs_f64() * 1e3);
    sleep(Duration::from_secs(args.settle_seconds)).await;
    let server = running.server.id();
    starts.server.push(Memory::read(server)?);
    for stop_service in children_of(server)? {
        starts.stop_service.push(Memory::read(stop_service)?);
    }
    let stop_folder = running.stop_folder.clone();
    drop(running);
    // The next start may be on the same folder.
    let end = Instant::now() + GONE_WITHIN;
    while midshift_stop::is_held(&stop_folder) && Instant::now() < end {
        sleep(ASK_EVERY).await;
    }
    Ok(())
}

fn find_free_address() -> anyhow::Result<SocketAddr> {
    Ok(std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?)
}

/// Submits a task that was never submitted before until it is durable.
async fn submit_first(server: SocketAddr) -> anyhow::Result<()> {
    let request = transports(&text::parse(DEMO)?, 1)?.pop().context("no transport")?;
    let endpoint = Endpoint::from_shared(format!("http://{server}"))?.tcp_nodelay(true);
    let request = SubmitTaskRequest { request_id: format!("bench-{:016x}", rand::random::<u64>()), ..request };
    let end = Instant::now() + WITHIN;
    loop {
        let submitted = async {
            let mut client = TaskServiceClient::new(endpoint.connect().await?);
            client.submit_task(request.clone()).await.map_err(anyhow::Error::from)
        };
        match submitted.await {
            Ok(_) => return Ok(()),
            Err(error) if Instant::now() > end => return Err(error),
            Err(_) => sleep(ASK_EVERY).await,
        }
    }
}

/// Measures a bare tonic service from its start to its first answer.
async fn start_bare_ms(room: &Path) -> anyhow::Result<f64> {
    let answer = room.join("answer");
    std::fs::write(&answer, b"")?;
    let begun = Instant::now();
    let bare = Child::start(&["unary", "--answer", answer.to_str().context("a path that is no text")?], None)?;
    submit_first(bare.address).await?;
    Ok(begun.elapsed().as_secs_f64() * 1e3)
}

/// Kills a server and starts another one: from the kill until that has the sessions of all robots again.
async fn measure_return(args: &StartArgs, robots: usize, say: &dyn Fn(&str)) -> anyhow::Result<Figure> {
    let room = place(args.dir.as_ref())?;
    let map = grid_map::write(room.path(), (robots as f64).sqrt() as usize + 2)?;
    let data = room.path().join("data");
    let mut server = Child::serve(&data, Some(&map), None, Some(0)).await?;
    let listen = server.address;
    let _robots = start_robots(&server, &map, robots)?;
    await_sessions(&mut server, robots).await?;
    let mut back_ms = Vec::new();
    for round in 1..=args.rounds {
        let begun = Instant::now();
        // SIGKILL.
        drop(server);
        server = Child::serve_at(Some(listen), &data, Some(&map), None, Some(0)).await?;
        await_sessions(&mut server, robots).await?;
        back_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        say(&format!("round {round}: {robots} robots are back after {:.1} s", begun.elapsed().as_secs_f64()));
    }
    Ok(Figure::new("P10", format!("kill -9 to {robots} robots back"), "ms", &back_ms, None))
}
