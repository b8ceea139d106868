//! What a robot says at an attach of its software: the sets it has, signed with its device key.
//!
//! Called by the shell.

use super::state::AgentCore;
use crate::sets::Holdings;
use midshift_bundle::digest::Digest;
use midshift_core::ids::{BundleId, SetId};
use midshift_core::limits;
use midshift_core::update::{Installed, InstalledSet};
use std::collections::BTreeSet;

impl AgentCore {
    /// What it has installed, signed for this start of the agent. None: its software is not changed, or its sets were
    /// never seen.
    pub fn installed(&self, boot_id: &str) -> Option<String> {
        let (holdings, key) = (self.holdings()?, self.memory().ledger.device.as_ref()?);
        let staged = self.memory().ledger.software.update.as_ref().and_then(|u| u.set.as_ref()).map(|set| set.id());
        let id = |name: &str| SetId::parse(name).ok();
        let switch = &holdings.switch;
        let installed = Installed {
            robot_id: self.robot_id().clone(),
            boot_id: boot_id.to_owned(),
            device_key: key.public(),
            model: self.inventory().model.clone(),
            free_bytes: holdings.free_bytes,
            running: id(switch.running())?,
            current: id(&switch.current)?,
            previous: switch.previous.as_deref().and_then(id),
            sets: sets(holdings, staged),
        };
        Some(key.seal(installed))
    }
}

/// Whole sets that the switch record names, and the one that is staged.
fn sets(holdings: &Holdings, staged: Option<Digest>) -> Vec<InstalledSet> {
    let switch = &holdings.switch;
    let names = [Some(switch.running()), Some(&switch.current), switch.previous.as_deref()];
    let named = names.into_iter().flatten().filter_map(|name| name.parse::<Digest>().ok());
    let listed: BTreeSet<Digest> = named.chain(staged).collect();
    let set = |id: Digest| {
        let set = holdings.sets.get(&id)?;
        let components = set.components.values().map(|c| (c.name.clone(), c.version.clone()));
        Some(InstalledSet {
            set: SetId::parse(&id.to_string()).ok()?,
            bundle: set.bundle.and_then(|bundle| BundleId::parse(&bundle.to_string()).ok()),
            version: set.version.clone(),
            components: components.take(limits::INSTALLED_COMPONENTS_MAX).collect(),
            components_left_out: set.components.len().saturating_sub(limits::INSTALLED_COMPONENTS_MAX) as u32,
        })
    };
    listed.into_iter().filter_map(set).take(limits::INSTALLED_SETS_MAX).collect()
}
