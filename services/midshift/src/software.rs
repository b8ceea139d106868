//! The software of one simulated robot in a process of its own: whose it is, and how the set that runs makes the robot behave.
//!
//! Invariant: which set runs is found out once, at the start ([`midshift_agent::program::Software`]). Called by [`crate::robots`].

use anyhow::ensure;
use midshift_agent::program::{Pulse, Software};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_core::site::Site;
use midshift_core::time::{Clock, LinkDuration};
use midshift_sim::behaviour::{Behaviour, COMPONENT};
use midshift_sim::body::BodyConfig;
use std::path::Path;
use std::sync::Arc;

/// Reads the trust file of robots of `site`. An error if it is for those of another one.
pub fn trust_of(file: &Path, site: &Site) -> anyhow::Result<TrustAnchors> {
    let trust = TrustAnchors::read(file)?;
    of_site(&trust, site)?;
    Ok(trust)
}

fn of_site(trust: &TrustAnchors, site: &Site) -> anyhow::Result<()> {
    let (of, this) = (&trust.site, site.site_id());
    ensure!(of == this, "the trust file is for robots of site {of}; this is site {this}");
    Ok(())
}

/// How a simulated robot behaves by the set that it runs.
pub struct Behaving {
    /// Name of that set.
    running: String,
    is_on_probation: bool,
    version: Option<String>,
    behaviour: Behaviour,
}

impl Behaving {
    /// Reads the set that runs. An error if the robot takes software of another site than this.
    pub fn read(software: &Software, site: &Site) -> anyhow::Result<Self> {
        of_site(software.trust(), site)?;
        let behaviour =
            software.settings(COMPONENT).map(|file| Behaviour::read(&file)).transpose()?.unwrap_or_default();
        Ok(Self {
            running: software.running().to_owned(),
            is_on_probation: software.is_on_probation(),
            version: software.version(),
            behaviour,
        })
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
}
