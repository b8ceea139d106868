//! The software of one robot in a process of its own: its sets, whom it trusts, and how the set that runs makes it behave.
//!
//! Invariant: which set runs is what the launcher says, else what the switch record says; it is found out once, at the start.
//! Called by [`crate::robots`].

use anyhow::ensure;
use midshift_agent::bulk::Bulk;
use midshift_agent::launcher;
use midshift_agent::session::Updates;
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::trust::Trust;
use midshift_agent::update::UpdateConfig;
use midshift_agent::update::io::UpdateWorker;
use midshift_agent::update::remote::GrpcRemote;
use midshift_core::site::Site;
use midshift_core::time::{Clock, LinkDuration};
use midshift_sim::behaviour::{Behaviour, COMPONENT};
use midshift_sim::body::BodyConfig;
use std::path::Path;
use std::sync::Arc;

/// Called once a second while the agent lives.
type Pulse = Box<dyn FnMut() + Send>;

/// Reads the trust file of robots of `site`. An error if it is for those of another one.
pub fn trust_of(file: &Path, site: &Site) -> anyhow::Result<Trust> {
    let trust = Trust::read(file)?;
    let (of, this) = (&trust.site, site.site_id());
    ensure!(of == this, "the trust file is for robots of site {of}; this is site {this}");
    Ok(trust)
}

/// What a robot runs and may take.
pub struct Software {
    trust: Trust,
    sets: DiskSets,
    /// Name of the set that runs.
    running: String,
    is_launched: bool,
    is_on_probation: bool,
    /// Of the bundle taken last; none: what the robot came with.
    version: Option<String>,
    behaviour: Behaviour,
}

impl Software {
    /// Reads the set that runs.
    pub fn open(sets: &Path, trust: Trust) -> anyhow::Result<Self> {
        let mut sets = DiskSets::open(sets)?;
        let told = std::env::var(launcher::SET).ok();
        if let Some(set) = &told {
            sets.started_from(set)?;
        }
        let holdings = sets.holdings()?;
        let is_launched = told.is_some();
        let running = told.unwrap_or_else(|| holdings.switch.running().to_owned());
        ensure!(holdings.set(&running).is_some(), "set {running} is not there");
        let behaviour = match holdings.settings(&running, COMPONENT) {
            Some(_) => Behaviour::read(&sets.component(&running, COMPONENT))?,
            None => Behaviour::default(),
        };
        let is_on_probation = holdings.switch.trial.as_ref().is_some_and(|t| t.set == running && !t.is_proven);
        let version = holdings.version(&running);
        Ok(Self { trust, sets, running, is_launched, is_on_probation, version, behaviour })
    }

    /// Makes a body behave and call itself as the set that runs says.
    pub fn shape(&self, body: &mut BodyConfig) {
        body.behaviour = self.behaviour.clone();
        if let Some(version) = &self.version {
            body.software.clone_from(version);
        }
    }

    /// An error if the set that runs crashes at its start. To be asked when the body's journal has the start.
    pub fn live(&self) -> anyhow::Result<()> {
        ensure!(!self.behaviour.crash_on_start, "set {} crashes at its start, as its {COMPONENT} says", self.running);
        Ok(())
    }

    /// The agent's pulse, which hangs the whole agent if the set that runs does so on probation.
    pub fn pulse(&self, pulse: Option<Pulse>, clock: &Arc<dyn Clock>) -> Option<Pulse> {
        let Some(after_ms) = self.behaviour.hang_in_probation_after_ms.filter(|_| self.is_on_probation) else {
            return pulse;
        };
        let (mut pulse, clock) = (pulse, clock.clone());
        let begun = clock.now().link;
        Some(Box::new(move || {
            while clock.now().link.since(begun) >= LinkDuration(after_ms) {
                // Nobody wakes it: session, body and pulse stand still until the launcher kills the process.
                std::thread::park();
            }
            if let Some(pulse) = &mut pulse {
                pulse();
            }
        }))
    }

    /// What the agent changes its software with, over `bulk`; its clock is taken for set from the network.
    pub fn updates(self, bulk: Bulk) -> Updates {
        let config = UpdateConfig { is_launched: self.is_launched, ..self.trust.config() };
        let remote = Arc::new(GrpcRemote::new(bulk));
        Updates { config, worker: Box::new(UpdateWorker::new(Box::new(self.sets), remote)) }
    }
}
