//! The stop service of a `dev` run.

use super::args::Dev;
use anyhow::Context;
use midshift_core::site::Site;
use midshift_core::stop::{FOLDER, PORT};
use midshift_core::time::Clock;
use midshift_server::stop_follower;
use midshift_server::stop_service::{self, InProcessStopService};
use midshift_store::Store;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use tempfile::TempDir;

/// The stop service of the run, in a folder that goes with it unless everything is kept.
pub struct Stops {
    /// It, beside this process.
    pub service: InProcessStopService,
    /// Where it keeps its files.
    pub folder: PathBuf,
    _temporary: Option<TempDir>,
}

impl Stops {
    /// On the usual port, or on a free one if that is taken or the server asked for a free one too. With a new store it
    /// begins with nothing engaged.
    pub async fn start(
        args: &Dev,
        site: Arc<Site>,
        clock: Arc<dyn Clock>,
        (address, store): (SocketAddr, &dyn Store),
    ) -> anyhow::Result<Self> {
        let free = SocketAddr::new(address.ip(), 0);
        let usual = if args.listen.port() == 0 { free } else { SocketAddr::new(address.ip(), PORT) };
        let listener = std::net::TcpListener::bind(usual).or_else(|_| std::net::TcpListener::bind(free));
        let listener = listener.context("listening for stops")?;
        let (folder, temporary) = match &args.data {
            Some(data) => (data.join(FOLDER), None),
            None => {
                let temporary = tempfile::tempdir().context("making a folder for stops")?;
                (temporary.path().join(FOLDER), Some(temporary))
            }
        };
        stop_service::announce(&folder, store, stop_service::Occasion::Start).await?;
        stop_follower::tell_stops(&folder, store).await?;
        let service = InProcessStopService::start(folder.clone(), site, clock, listener)?;
        Ok(Self { service, folder, _temporary: temporary })
    }
}
