//! Real agents with simulated bodies: what `sim run` starts, and what each needs to change its set.

use midshift_agent::trust_anchors::TrustAnchors;
use midshift_core::time::Clock;
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig};
use midshift_sim::swarm::{Swarm, SwarmConfig};
use std::path::PathBuf;
use std::sync::Arc;
use tokio_util::sync::CancellationToken;

/// What to be.
#[derive(Clone, Debug, clap::Args)]
pub struct SwarmArgs {
    /// The server, host:port.
    #[arg(long)]
    pub server: String,
    /// The site.
    #[arg(long)]
    pub site: PathBuf,
    /// How many.
    #[arg(long)]
    pub robots: usize,
    /// Whose software they take; without it none.
    #[arg(long)]
    pub trust: Option<PathBuf>,
}

/// Runs all of them until `stop`: nothing goes wrong by itself, and no battery empties.
pub async fn run(args: SwarmArgs, stop: CancellationToken) -> anyhow::Result<()> {
    let site = midshift_cli::site_file::load(Some(&args.site), None, None)?.site;
    let clock: Arc<dyn Clock> = midshift_process::clock::clock(1000);
    let mut config = FleetConfig::new(site, args.robots, SEED);
    (config.faults, config.drains) = (FaultRates::none(), false);
    let hall = Arc::new(Fleet::open(&config, &clock.now())?);
    let uri = midshift_cli::endpoint::uri(&args.server);
    let mut swarm = SwarmConfig::tcp(hall, clock, &uri, SEED);
    swarm.software = args.trust.as_deref().map(TrustAnchors::read).transpose()?;
    Swarm::new(swarm).run(stop).await?;
    Ok(())
}

/// Where they stand, and how they spread.
const SEED: u64 = 1;
