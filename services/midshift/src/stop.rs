//! `midshift stop serve`: the stop service in a process of its own; in `dev` a thread of its own; beside `serve` on one box a process that outlives it.
//!
//! An operational stop request, not a safety function. Invariant: nothing of the store, the task queue or the business server lies on its way. `serve`
//! starts one where none is, leaves one that answers alone, and replaces one that hangs. Rooms: `started` is that, `manager` what a service manager hears, `first_start` says that one may begin with nothing engaged, `next` how one takes the place of another,
//! `program` which program both start and how long it may take.

mod first_start;
mod manager;
mod next;
mod program;
mod started;

pub use first_start::{Occasion, announce};
pub use midshift_cli::stop_service::{FOLDER, PORT};
pub use started::{LOG, Started};

use crate::door::{self, Login, Share};
use crate::{clock, recorder};
use anyhow::{Context, bail, ensure};
use axum::routing::get;
use midshift_cli::site_file;
use midshift_core::Boxed;
use midshift_core::site::Site;
use midshift_core::time::{Clock, LinkDuration, Utc};
use midshift_edge::{Config, Denial, Denials};
use midshift_identity::ServerProof;
use midshift_stop::{Parts, Principals, StopService};
use program::{LOOK_EVERY, UP_WITHIN};
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::mpsc::Receiver;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;

/// As metrics and logs name it.
const PORT_NAME: &str = "stop";
/// How often one that follows looks whether the folder is free: nobody is answered meanwhile.
const NEXT_EVERY: Duration = Duration::from_millis(10);
/// Pings on a quiet connection of a watcher: one that is gone is found out twice as fast as on the business port.
const KEEPALIVE_EVERY: LinkDuration = LinkDuration::from_secs(10);
/// How often it is looked whether somebody else is known: with the writer's own second, two after a revocation at the latest.
const PRINCIPALS_EVERY: Duration = Duration::from_millis(500);

/// What `stop serve` was asked for.
#[derive(Clone, Debug, clap::Args)]
pub struct StopServe {
    /// The site file, as for `midshift serve`: where areas and zones are. Without it the built-in demo site.
    #[arg(long)]
    pub site: Option<PathBuf>,
    /// The data folder; its own files are in stop below it, made with mode 0700.
    #[arg(long, default_value = "midshift-data")]
    pub data: PathBuf,
    /// Address to listen on.
    #[arg(long, default_value_t = SocketAddr::from(([127, 0, 0, 1], PORT)))]
    pub listen: SocketAddr,
    /// No TLS and no login: whoever reaches the port may stop the fleet and reset stops.
    #[arg(long)]
    pub insecure: bool,
    /// What one peer may take.
    #[command(flatten)]
    pub share: Share,
    /// Takes the place of the stop service that has started this one, on its open port.
    #[arg(long, hide = true)]
    pub follows: bool,
}

/// Serves until `shutdown`, or until another one that SIGUSR2 has asked for takes its place.
///
/// # Errors
/// The folder cannot be used or another process has it, the port is taken, or a part ended by itself.
pub fn run(args: StopServe, shutdown: CancellationToken) -> Boxed<'static, anyhow::Result<()>> {
    Box::pin(async move {
        let opened = OnceLock::new();
        tokio::select! {
            served = run_watched(args, shutdown, &opened) => served,
            () = manager::is_watched(&opened) => Ok(()),
        }
    })
}

async fn run_watched(
    args: StopServe,
    shutdown: CancellationToken,
    opened: &OnceLock<StopService>,
) -> anyhow::Result<()> {
    let asked = next::asked()?;
    if args.insecure {
        tracing::warn!(address = %args.listen, "no TLS and no login: whoever reaches this port may stop the fleet and reset stops");
    }
    if !args.insecure {
        // Who is known, and what this port proves itself with, lie below it.
        midshift_identity::make_folder(&args.data).context("opening the data folder")?;
    }
    let loaded = site_file::load(args.site.as_deref(), None, None)?;
    let listener = match args.follows {
        true => next::port()?,
        false => TcpListener::bind(args.listen).await.with_context(|| format!("listening on {}", args.listen))?,
    };
    let port = listener.as_fd().try_clone_to_owned()?;
    let folder = args.data.join(FOLDER);
    recorder::handle();
    tracing::info!(address = %listener.local_addr()?, folder = %folder.display(), "midshift stop serves: an operational stop request, not a safety function");
    let clock = clock::clock(1000);
    let (config, login) = match args.insecure {
        true => (door::alone(PORT_NAME), None),
        false => (args.share.config(PORT_NAME)?, Some(known(&folder, &loaded.site, &clock).await?)),
    };
    let parts = Parts { folder, site: Some(loaded.site), clock };
    let service = match args.follows {
        true => {
            if let Some((login, ..)) = &login {
                login.proves()?;
            }
            following(&parts, &shutdown).await?
        }
        false => StopService::open(parts, shutdown.clone())?,
    };
    let leaving = opened.get_or_init(|| service.clone());
    let following = async {
        tokio::select! {
            () = shutdown.cancelled() => {}
            () = next::begun(asked, &port, leaving) => {}
        }
        // Who dials from now on is the next one's.
        drop(port);
        std::future::pending().await
    };
    tokio::select! {
        served = serve(service, (config, login), listener) => served,
        never = following => never,
    }
}

/// Opens the folder as soon as the one before has let go of it, which it does when this one has read everything else.
async fn following(parts: &Parts, shutdown: &CancellationToken) -> anyhow::Result<StopService> {
    // One that cannot read it would stop the whole fleet.
    let latch = midshift_stop::latch(&parts.folder).context("reading the latch")?;
    ensure!(latch.is_some(), "there is no latch in {}", parts.folder.display());
    let mut waited = Duration::ZERO;
    loop {
        match StopService::open(parts.clone(), shutdown.clone()) {
            Err(error) if error.is_held() && waited < UP_WITHIN => {}
            opened => return Ok(opened?),
        }
        if waited.is_zero() {
            // It could have it, but for the one before.
            next::ready()?;
        }
        tokio::select! {
            () = shutdown.cancelled() => bail!("asked to end before it began"),
            () = tokio::time::sleep(NEXT_EVERY) => waited += NEXT_EVERY,
        }
    }
}

/// What a port with login follows, whom it denied what, and when who is known was last written down or said to be so still.
type Followed = (Login, Receiver<Denial>, watch::Receiver<Utc>);

/// Who is known, as whoever has the store wrote it down beside the latch; followed from then on.
async fn known(folder: &Path, site: &Site, clock: &Arc<dyn Clock>) -> anyhow::Result<Followed> {
    let mut waited = Duration::ZERO;
    let first = loop {
        match Principals::read(folder) {
            Ok(Some(principals)) => break principals,
            Err(error) => return Err(error).context("reading who is known"),
            Ok(None) if waited >= UP_WITHIN => bail!(
                "{} says not who is known: start `midshift serve` on the same data folder first, or its role stop-follower beside this",
                folder.join(Principals::NAME).display()
            ),
            Ok(None) => {}
        }
        tokio::time::sleep(LOOK_EVERY).await;
        waited += LOOK_EVERY;
    };
    let (directory, proof) =
        (watch::Sender::new(Arc::new(first.directory.clone())), watch::Sender::new(proof_of(&first)));
    let (denials, told) = Denials::new(PORT_NAME);
    let login = Login {
        site_id: site.site_id().clone(),
        clock: clock.clone(),
        directory: directory.subscribe(),
        proof: proof.subscribe(),
        denials,
    };
    let (folder, mut last) = (folder.to_owned(), first);
    let said = watch::Sender::new(Principals::told(&folder).unwrap_or_default());
    let (followed, mut is_readable) = (said.subscribe(), true);
    // As long as the port is open: it ends with the receivers.
    tokio::spawn(async move {
        while !directory.is_closed() {
            tokio::time::sleep(PRINCIPALS_EVERY).await;
            let read = Principals::read(&folder);
            if let (Ok(Some(_)), Some(told)) = (&read, Principals::told(&folder)) {
                said.send_replace(told);
            }
            match read {
                Ok(Some(newest)) if newest != last => {
                    proof.send_replace(proof_of(&newest));
                    directory.send_replace(Arc::new(newest.directory.clone()));
                    last = newest;
                }
                Ok(_) => is_readable = true,
                // Once, and not twice a second.
                Err(error) => {
                    if std::mem::take(&mut is_readable) {
                        tracing::warn!(%error, "who is known cannot be read; the last that could stays in force");
                    }
                }
            }
        }
    });
    Ok((login, told, followed))
}

fn proof_of(principals: &Principals) -> ServerProof {
    let Principals { chain_pem, key_pem, authority_pem, .. } = principals.clone();
    ServerProof { chain_pem, key_pem, authority_pem }
}

async fn serve(
    service: StopService,
    (config, login): (Config, Option<Followed>),
    listener: TcpListener,
) -> anyhow::Result<()> {
    let metrics = || async { recorder::handle().map(|handle| handle.render()).unwrap_or_default() };
    let pages = service.routes().await?.into_axum_router().layer(tonic_web::GrpcWebLayer::new());
    let routes = Routes::from(pages.route("/metrics", get(metrics)));
    let config = Config { keepalive_every: KEEPALIVE_EVERY, ..config };
    let (login, denials) = match login {
        Some((login, denials, told)) => {
            service.show_principals(told);
            (Some(login), Some(denials))
        }
        None => (None, None),
    };
    let port = door::serve(config, login, routes, listener, service.drained());
    let recording = record(service.clone(), denials);
    let port = async {
        tokio::select! {
            served = port => served,
            () = recording => Ok(()),
        }
    };
    midshift_stop::serve(service, port).await.context("serving stops")?
}

/// Records whom the port denies what in the stop service's own file, until it is dropped.
async fn record(service: StopService, denials: Option<Receiver<Denial>>) {
    if let Some(mut denials) = denials {
        while let Some(Denial { actor, network, path, robot_id, code, left_out }) = denials.recv().await {
            service.denied(&actor, network, &path, robot_id.as_deref(), code, left_out);
        }
    }
    std::future::pending().await
}

/// The stop service of `dev`: a thread with a runtime of its own, so that no plan and no simulated robot holds it up.
pub struct Beside {
    shutdown: CancellationToken,
    thread: Option<std::thread::JoinHandle<anyhow::Result<()>>>,
    address: SocketAddr,
}

impl Beside {
    /// Begins to serve `listener`.
    ///
    /// # Errors
    /// No thread or no runtime.
    pub fn start(
        folder: PathBuf,
        site: Arc<Site>,
        clock: Arc<dyn Clock>,
        listener: std::net::TcpListener,
    ) -> anyhow::Result<Self> {
        let address = listener.local_addr()?;
        listener.set_nonblocking(true)?;
        let shutdown = CancellationToken::new();
        let stop = shutdown.clone();
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let work = move || {
            let served = runtime.block_on(async {
                let listener = TcpListener::from_std(listener)?;
                recorder::handle();
                let service = StopService::open(Parts { folder, site: Some(site), clock }, stop)?;
                serve(service, (door::alone(PORT_NAME), None), listener).await
            });
            if let Err(error) = &served {
                tracing::error!(%error, "the stop service ended");
            }
            runtime.shutdown_timeout(Duration::from_secs(2));
            served
        };
        let thread = std::thread::Builder::new().name("stop".to_owned()).spawn(work)?;
        Ok(Self { shutdown, thread: Some(thread), address })
    }
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        self.shutdown.cancel();
        // It ends within its own bounds; why it ended was logged.
        let _ = self.thread.take().map(std::thread::JoinHandle::join);
    }
}
