//! `midshift serve`: everything persistent in one process, for a real site, on SQLite or PostgreSQL.

use crate::planning::Planning;
use crate::server::{Naive, Parts, Server};
use crate::storage::Database;
use crate::{clock, site_file};
use anyhow::{Context, bail};
use midshift_core::limits;
use midshift_core::time::Clock;
use midshift_ota::OtaService;
use midshift_ota::content::Room;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use tokio::net::{TcpListener, UdpSocket};
use tokio_stream::wrappers::TcpListenerStream;
use tokio_util::sync::CancellationToken;

/// What `serve` was asked for.
#[derive(Clone, Debug, clap::Args)]
pub struct Serve {
    /// The site file (or a .map grid, or an LIF .json). Without it the built-in demo site.
    #[arg(long)]
    pub site: Option<PathBuf>,
    /// Where the databases and software of robots are; made with mode 0700.
    #[arg(long, default_value = "midshift-data")]
    pub data: PathBuf,
    /// Rows and samples elsewhere.
    #[command(flatten)]
    pub database: Database,
    /// Address to listen on. Anything but loopback needs --insecure.
    #[arg(long, default_value = "127.0.0.1:7420")]
    pub listen: SocketAddr,
    /// There is no login and no TLS yet: say that you know, and listen off loopback all the same.
    #[arg(long)]
    pub insecure: bool,
    /// UDP address to hear launchers of robots on whose agent does not run, e.g. 0.0.0.0:7422. What is heard is a hint that anybody in the
    /// network can send: it is shown and decides nothing. Without it nobody listens.
    #[arg(long, value_name = "ADDR")]
    pub beacon_listen: Option<SocketAddr>,
    /// Where software of robots comes from.
    #[command(flatten)]
    pub software: Software,
}

/// Where software of robots comes from.
#[derive(Clone, Debug, clap::Args)]
pub struct Software {
    /// The folder with snapshot-*.pem, timestamp-*.pem and directive-*.pem of `bundle keygen`. Without it releases are neither taken nor given.
    #[arg(long, value_name = "DIR")]
    pub ota_keys: Option<PathBuf>,
    /// Room for software, GiB.
    #[arg(long, default_value_t = limits::SOFTWARE_BYTES_DEFAULT >> 30, value_parser = clap::value_parser!(u64).range(1..=1_048_576))]
    pub ota_quota_gib: u64,
    /// Free space of the disk that software must leave alone, GiB. 0: none.
    #[arg(long, default_value_t = limits::SOFTWARE_SPARE_BYTES_DEFAULT >> 30, value_parser = clap::value_parser!(u64).range(0..=1_048_576))]
    pub ota_spare_gib: u64,
    /// Days of serving that software is kept which no release lists, and no roll-out, rule for newcomers or robot names.
    #[arg(long, default_value_t = limits::SOFTWARE_UNNAMED_DAYS_DEFAULT, value_parser = clap::value_parser!(u64).range(1..=3_650))]
    pub ota_keep_days: u64,
}

impl Software {
    /// The service, with its files in `folder`.
    pub async fn open(&self, folder: PathBuf, clock: Arc<dyn Clock>) -> anyhow::Result<OtaService> {
        let Some(keys) = self.ota_keys.clone() else { return Ok(OtaService::without_keys()) };
        let room = Room {
            quota_bytes: self.ota_quota_gib << 30,
            spare_bytes: self.ota_spare_gib << 30,
            unnamed_ms: self.ota_keep_days * 24 * 3_600_000,
        };
        let parts = midshift_ota::Parts { folder, keys, room, clock };
        OtaService::open(parts).await.context("opening software of robots")
    }
}

/// Runs until `shutdown`.
pub async fn run(args: Serve, shutdown: CancellationToken) -> anyhow::Result<()> {
    if !args.listen.ip().is_loopback() && !args.insecure {
        bail!(
            "{} is not loopback and midshift has no login yet: whoever reaches it can move robots. Add --insecure if you mean it",
            args.listen
        );
    }
    let loaded = site_file::load(args.site.as_deref(), None, None)?;
    for warning in &loaded.warnings {
        tracing::warn!(warning, "site");
    }
    let clock = clock::clock(1000);
    crate::server::metrics_handle();
    let site_id = loaded.site.site_id().clone();
    let storage = args.database.open(&args.data, site_id, clock.clone()).await?;
    let ota = args.software.open(args.data.join("ota"), clock.clone()).await?;
    let listener = TcpListener::bind(args.listen).await.with_context(|| format!("listening on {}", args.listen))?;
    let beacons = match args.beacon_listen {
        Some(address) => Some(hear(address).await?),
        None => None,
    };
    tracing::info!(address = %listener.local_addr()?, site_id = %loaded.site.site_id(), data = %args.data.display(), store = storage.engine(), "midshift serves");
    let planning = Planning::start()?;
    let parts = Parts {
        store: storage.store(),
        frames: storage.frames(),
        site: loaded.site,
        site_text: loaded.text,
        clock,
        ota,
        sim: None,
        naive: Naive::default(),
        planning: planning.handle(),
    };
    let server = Server::new(parts, shutdown).await?.hearing(beacons);
    let served = server.serve(nodelay(listener)).await;
    storage.close().await;
    served
}

/// The socket that beacons come to.
pub async fn hear(address: SocketAddr) -> anyhow::Result<UdpSocket> {
    UdpSocket::bind(address).await.with_context(|| format!("listening for beacons on {address}"))
}

/// Connections without Nagle's delay: a grant must not wait for an acknowledgement.
pub fn nodelay(
    listener: TcpListener,
) -> impl tokio_stream::Stream<Item = std::io::Result<tokio::net::TcpStream>> + Send + 'static {
    use tokio_stream::StreamExt;
    TcpListenerStream::new(listener).map(|stream| stream.and_then(|s| s.set_nodelay(true).map(|()| s)))
}
