//! The stop service on a machine of its own beside the server, and each robot's line to it.
//!
//! Invariant: its folder outlives its process, and what a robot keeps of stops outlives the robot's; everything else dies with its process.

use crate::clock::{MachineClock, Skew, TrueTime};
use crate::net::{self, Ear, LineState, STOPS, SimDial, Wire, machine};
use crate::newer::Voice;
use midshift_agent::stop::line::StopLine;
use midshift_agent::stop::storage::MemoryStops;
use midshift_core::identity::Caller;
use midshift_core::ids::StopId;
use midshift_core::site::Site;
use midshift_core::stop::Latch;
use midshift_core::stop::robot::SavedStops;
use midshift_stop::{Error, Parts, StopService, announce_first_start};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use tonic::service::{InterceptorLayer, Routes};
use tonic::transport::Server;
use tonic::{Request, Status};

/// A service manager starts it again after this.
const AGAIN: Duration = Duration::from_millis(200);

/// One robot's line, and what it keeps.
#[derive(Clone)]
pub struct RobotLine {
    saved: MemoryStops,
    wire: Wire,
}

impl RobotLine {
    /// For one process of the robot.
    pub fn dial(&self, machine: String, voice: Option<Voice>) -> StopLine {
        let dial = SimDial { to: STOPS, ear: Ear::default(), machine, wire: self.wire.clone(), voice };
        StopLine { dial: Arc::new(dial), storage: Box::new(self.saved.clone()) }
    }
}

/// The stop service, its folder and the robots' lines.
pub struct Stops {
    folder: TempDir,
    lines: Vec<RobotLine>,
    wire: Wire,
}

impl Stops {
    /// Puts its machine into the network.
    pub fn open(
        sim: &mut turmoil::Sim<'static>,
        time: &TrueTime,
        site: &Arc<Site>,
        robots: usize,
    ) -> anyhow::Result<Self> {
        let (folder, wire) = (TempDir::new()?, Wire::default());
        let path = folder.path().join("stop");
        announce_first_start(&path)?;
        let (time, site, of_service) = (time.clone(), site.clone(), wire.clone());
        sim.host(STOPS, move || live(path.clone(), site.clone(), time.clone(), of_service.clone()));
        let lines = (0..robots).map(|_| RobotLine { saved: MemoryStops::default(), wire: wire.clone() }).collect();
        Ok(Self { folder, lines, wire })
    }
    /// Where it keeps its files.
    pub fn folder(&self) -> PathBuf {
        self.folder.path().join("stop")
    }
    /// One robot's line.
    pub fn line(&self, robot: usize) -> RobotLine {
        self.lines[robot].clone()
    }
    /// What one robot's file has.
    pub fn saved(&self, robot: usize) -> SavedStops {
        self.lines[robot].saved.saved()
    }
    /// What the service's file has.
    pub fn latch(&self) -> Latch {
        latch(&self.folder())
    }
    /// Messages on broken lines.
    pub fn hits(&self) -> u64 {
        self.wire.hits().values().sum()
    }
    /// Makes the line of one robot so: open or cut.
    pub fn steer(&self, sim: &turmoil::Sim<'static>, robot: usize, way: LineState) {
        let other = machine(robot);
        match (self.wire.set_way(&other, way), way) {
            (LineState::Open, LineState::Cut) => sim.partition(STOPS, other.as_str()),
            (LineState::Cut, LineState::Open) => sim.repair(STOPS, other.as_str()),
            _ => {}
        }
    }
}

/// Names of what is engaged and not reset.
pub fn effective(latch: &Latch) -> BTreeSet<StopId> {
    latch.effective().map(|stop| stop.stop_id.clone()).collect()
}

fn latch(folder: &Path) -> Latch {
    midshift_stop::latch(folder).expect("the latch can be read").map(|(_, latch)| latch).unwrap_or_default()
}

async fn live(folder: PathBuf, site: Arc<Site>, time: TrueTime, wire: Wire) -> turmoil::Result {
    loop {
        let clock = MachineClock::boot(&time, Skew::default());
        let parts = Parts { folder: folder.clone(), site: Some(site.clone()), clock };
        match StopService::open(parts, CancellationToken::new()) {
            Ok(service) => {
                let incoming = net::incoming(wire.clone()).await?;
                let drained = service.drained().cancelled_owned();
                // As a port without login.
                let everybody = InterceptorLayer::new(|mut request: Request<()>| {
                    request.extensions_mut().insert(Caller::local());
                    Ok::<_, Status>(request)
                });
                let port = Server::builder()
                    .layer(everybody)
                    .add_routes(service.add_to(Routes::default()))
                    .serve_with_incoming_shutdown(incoming, drained);
                midshift_stop::serve(service, port).await??;
            }
            // The process before has not let go of it yet.
            Err(Error::Latch(_)) => {}
            Err(error) => return Err(error.into()),
        }
        tokio::time::sleep(AGAIN).await;
    }
}
