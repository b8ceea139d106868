//! What the ledger knows of the sets that may run: which were committed, and the documents by which what is in them was
//! believed.
//!
//! A fact of its own, which an older agent leaves as it is. Invariant: a change of what is committed is written here
//! before the switch record says it, so that of two records that disagree it is known which is meant. Pure values; the
//! core holds what runs against them.

use crate::launcher::switch::{FACTORY, Switch};
use crate::sets::Holdings;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{Component, Migration};
use midshift_bundle::release::Release;
use midshift_bundle::set::SetManifest;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The set committed last and the one before it, by their names in the switch record.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Committed {
    /// Name of the set that was committed last.
    pub current: String,
    /// Before it; none: nothing is kept.
    pub previous: Option<String>,
}

impl Default for Committed {
    fn default() -> Self {
        Self { current: FACTORY.to_owned(), previous: None }
    }
}

impl Committed {
    /// As a switch record says it.
    pub fn named_by(switch: &Switch) -> Self {
        Self { current: switch.current.clone(), previous: switch.previous.clone() }
    }
    fn names(&self) -> impl Iterator<Item = &str> {
        [Some(self.current.as_str()), self.previous.as_deref()].into_iter().flatten()
    }
}

/// What may run, and why.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Proven {
    /// What is committed.
    pub committed: Committed,
    /// What the switch record is about to say of that.
    #[serde(default)]
    pub intended: Option<Committed>,
    /// Generation of the newest directive that was taken by an agent that keeps documents.
    pub directive_generation: u64,
    /// Sets that are committed, on trial or staged, by id.
    pub sets: BTreeMap<Digest, SetManifest>,
    /// Components without documents: they lay on the disk, or were on their way, before documents were kept.
    pub believed: Vec<Component>,
    /// Documents by bundle.
    pub releases: BTreeMap<Digest, Arc<Release>>,
}

impl Proven {
    /// Whether this set is known and all that is in it stands in documents that hold, or was believed before any were
    /// kept.
    ///
    /// # Errors
    /// What does not.
    pub fn check(&self, set: &SetManifest) -> Result<(), String> {
        if self.sets.get(&set.id()) != Some(set) {
            return Err("no set of this manifest was staged".to_owned());
        }
        let signed = self.contents();
        let is_signed = |c: &Component| signed.values().any(|manifest| manifest.contains(c));
        match set.components.values().find(|c| !self.believed.contains(c) && !is_signed(c)) {
            Some(c) => Err(format!("{} {} stands in no release that holds", c.name, c.version)),
            None => Ok(()),
        }
    }

    /// Components of each release whose documents hold.
    fn contents(&self) -> BTreeMap<Digest, Vec<Component>> {
        let holds = |(bundle, release): (&Digest, &Arc<Release>)| {
            let manifest = release.check().ok().filter(|_| release.bundle() == *bundle)?;
            Some((*bundle, manifest.components))
        };
        self.releases.iter().filter_map(holds).collect()
    }

    /// Takes over what an older agent, which kept no documents, has left: the sets that the switch record names, and
    /// the one on its way.
    pub(crate) fn adopt(&mut self, holdings: &Holdings, on_its_way: Option<&SetManifest>) {
        let switch = &holdings.switch;
        let named = [Some(switch.running()), Some(switch.current.as_str()), switch.previous.as_deref()];
        let there = named.into_iter().flatten().filter_map(|name| holdings.sets.get(&name.parse().ok()?));
        for set in there.chain(on_its_way) {
            self.sets.insert(set.id(), set.clone());
            self.believed.extend(set.components.values().cloned());
        }
        (self.committed, self.intended) = (Committed::named_by(switch), None);
    }

    /// Forgets what no set needs that is committed, about to be, or named here.
    pub(crate) fn prune(&mut self, others: &BTreeSet<Digest>) {
        let committed = self.intended.iter().chain([&self.committed]).flat_map(Committed::names);
        let mut named: BTreeSet<Digest> = committed.filter_map(|name| name.parse().ok()).collect();
        named.extend(others);
        self.sets.retain(|id, _| named.contains(id));
        let components: Vec<Component> = self.sets.values().flat_map(|set| set.components.values().cloned()).collect();
        let believed = std::mem::take(&mut self.believed);
        for component in believed.into_iter().filter(|c| components.contains(c)) {
            if !self.believed.contains(&component) {
                self.believed.push(component);
            }
        }
        let contents = self.contents();
        let mut needed: BTreeSet<Digest> =
            self.sets.values().filter_map(|set| set.bundle).filter(|bundle| contents.contains_key(bundle)).collect();
        for component in components.iter().filter(|c| !self.believed.contains(c)) {
            let holds = |bundle: &Digest| contents.get(bundle).is_some_and(|manifest| manifest.contains(component));
            if !needed.iter().any(holds) {
                needed.extend(contents.keys().find(|bundle| holds(bundle)));
            }
        }
        self.releases.retain(|bundle, _| needed.contains(bundle));
    }

    /// The set before, if it may be gone back to from the committed one by the robot itself: it is proven, not below
    /// the floors, and no data were brought where it cannot read them.
    pub(crate) fn way_back(&self, floors: &BTreeMap<String, u64>) -> Option<&str> {
        let name = self.committed.previous.as_deref()?;
        let current = self.sets.get(&self.committed.current.parse().ok()?)?;
        let empty = SetManifest::default();
        let previous = match name {
            FACTORY => &empty,
            _ => self.sets.get(&name.parse().ok()?)?,
        };
        let is_proven = name == FACTORY || self.check(previous).is_ok();
        let floor = |c: &Component| floors.get(&c.name).copied().unwrap_or(0);
        let is_above = previous.components.values().all(|c| c.rollback_index >= floor(c));
        let is_new = |c: &Component| previous.components.get(&c.name).map(|p| p.digest) != Some(c.digest);
        let closes = |c: &Component| c.data_migration == Migration::Irreversible && is_new(c);
        (is_proven && is_above && !current.components.values().any(closes)).then_some(name)
    }
}
