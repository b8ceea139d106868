//! Bundles of the newest release as rows: what the planner knows of them.
//!
//! Invariant: nothing is deleted here: a bundle that the release lists no more is unlisted, and its row stays as long
//! as something names it ([`crate::retention`]).

use crate::repository::{Newest, Publishers};
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{ComponentKind, Manifest, Migration};
use midshift_core::audit::Note;
use midshift_core::identity::Actor;
use midshift_core::ids::BundleId;
use midshift_core::limits;
use midshift_core::rollout::Plan;
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::rows::Bundle;
use midshift_core::rows::Table;
use midshift_core::task::raw::parse_version;
use midshift_core::time::Now;
use midshift_store::Store;
use std::collections::{BTreeMap, BTreeSet};

/// Bundles that the rows of a store know: with any, its folder of releases cannot be empty.
///
/// # Errors
/// The store's.
pub async fn known_bundles(store: &dyn Store) -> Result<usize, midshift_store::Error> {
    Ok(store.snapshot(&[Table::Bundle]).await?.rows.len())
}

/// Makes the rows say what the release says.
pub fn take_release(view: &mut RolloutProjection, now: Now, newest: Option<&Newest>, plan: &mut Plan) {
    let releases = newest.map(|newest| newest.releases.as_slice()).unwrap_or_default();
    let mut changed = Vec::new();
    let mut listed = BTreeSet::new();
    for release in releases {
        let Ok(bundle) = BundleId::parse(&release.digest.to_string()) else { continue };
        listed.insert(bundle.clone());
        let known = view.bundles.get(bundle.as_str()).map(|b| &b.row);
        if known.is_none_or(|known| !known.listed) {
            let (revoked, ended) = (known.and_then(|k| k.revoked.clone()), known.and_then(|k| k.ended));
            let length = release.manifest.to_bytes().len() as u64;
            changed.push(Bundle { revoked, ended, ..fresh(bundle, &release.manifest, length, release.seen) });
        }
    }
    // What the disk does not give at the moment is not unlisted for that.
    let unread = newest.into_iter().flat_map(|newest| &newest.unread);
    listed.extend(unread.filter_map(|digest| BundleId::parse(&digest.to_string()).ok()));
    let gone = view.bundles.values().map(|b| &b.row).filter(|b| b.listed && !listed.contains(&b.bundle));
    changed.extend(gone.map(|b| Bundle { listed: false, ..b.clone() }));
    let mut by_whom: BTreeMap<Actor, Vec<Bundle>> = BTreeMap::new();
    for row in changed {
        by_whom.entry(publisher(newest, &row)).or_default().push(row);
    }
    for (actor, changed) in by_whom {
        for rows in changed.chunks(limits::ITEM_ROWS_MAX) {
            plan.decide(view, now, &actor, |tx| {
                let about = |listed| rows.iter().filter(move |row| row.listed == listed).map(|row| &row.bundle);
                let (listed, unlisted) = (about(true), about(false).map(ToString::to_string).collect::<Vec<_>>());
                let note = listed.fold(Note::new("bundle.publish"), |note, bundle| note.about("bundle", bundle));
                let note = unlisted.iter().fold(note, |note, bundle| note.about("bundle", bundle));
                tx.audit(if unlisted.is_empty() { note } else { note.with("unlisted", unlisted.join(" ")) });
                for row in rows {
                    tx.put_row(row.clone(), if row.listed { "bundle.listed" } else { "bundle.unlisted" });
                }
            });
        }
    }
}

/// Who listed a bundle, or published the release that lists it no more. Of a release that an older version of midshift
/// took nobody knows.
fn publisher(newest: Option<&Newest>, row: &Bundle) -> Actor {
    let by = newest.map(|newest| &newest.by);
    let digest = row.bundle.as_str().parse::<Digest>().ok();
    let whom = match row.listed {
        true => digest.and_then(|digest| by?.bundle(&digest)),
        false => by.and_then(Publishers::newest),
    };
    whom.unwrap_or_else(|| "ota".into())
}

fn fresh(bundle: BundleId, manifest: &Manifest, manifest_length: u64, published: midshift_core::time::Utc) -> Bundle {
    Bundle {
        bundle,
        name: manifest.name.clone(),
        version: manifest.version.clone(),
        manifest_length,
        length: manifest.length(),
        room: room(manifest),
        hardware: manifest.hardware().into_iter().map(str::to_owned).collect(),
        needs: manifest.needs().as_str().to_owned(),
        hard_stop_codes: manifest.hard_stop_codes.clone(),
        is_irreversible: manifest.components.iter().any(|c| c.data_migration == Migration::Irreversible),
        has_base: manifest.components.iter().any(|c| c.kind == ComponentKind::Base),
        requires: required(manifest),
        rollback_index: manifest.components.iter().map(|c| c.rollback_index).min(),
        listed: true,
        revoked: None,
        published,
        ended: None,
    }
}

/// Bytes that a robot needs free while it fetches it. A file that comes encoded is there until its component is made of
/// it.
fn room(manifest: &Manifest) -> u64 {
    let longest = manifest.components.iter().map(|c| c.length).max().unwrap_or_default();
    let base = manifest.components.iter().filter(|c| c.kind == ComponentKind::Base).map(|c| c.length);
    manifest.length().saturating_add(longest).saturating_add(base.sum())
}

/// What its components need that is not among them. Of two lowest versions the higher counts.
fn required(manifest: &Manifest) -> BTreeMap<String, String> {
    let mut required: BTreeMap<String, String> = BTreeMap::new();
    let own = |name: &String| manifest.components.iter().any(|c| c.name == *name);
    for (name, version) in manifest.components.iter().flat_map(|c| &c.requires).filter(|(name, _)| !own(name)) {
        let lowest = required.entry(name.clone()).or_insert_with(|| version.clone());
        if parse_version(lowest) < parse_version(version) {
            lowest.clone_from(version);
        }
    }
    required
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture;

    #[test]
    fn a_bundle_needs_room_for_its_set_its_longest_file_as_it_comes_and_a_base_in_its_slot() {
        let (mut manifest, _) = fixture::bundle("walk", "1.0.0");
        let mut second = manifest.components[0].clone();
        manifest.components.truncate(1);
        manifest.components[0].length = 700;
        (second.name, second.length) = ("walk-arms".to_owned(), 300);
        manifest.components.push(second);
        assert_eq!(room(&manifest), 1_000 + 700);
        manifest.components[1].kind = ComponentKind::Base;
        assert_eq!(room(&manifest), 1_000 + 700 + 300);
    }

    #[test]
    fn a_bundle_requires_what_its_components_need_and_none_of_them_is() {
        let (mut manifest, _) = fixture::bundle("walk", "1.0.0");
        let own = manifest.components[0].name.clone();
        let mut second = manifest.components[0].clone();
        second.name = "walk-arms".to_owned();
        second.requires = [(own, "1.0.0"), ("map".to_owned(), "1.10.0")].map(|(n, v)| (n, v.to_owned())).into();
        manifest.components[0].requires = [("map".to_owned(), "1.9.0".to_owned())].into();
        manifest.components.push(second);
        assert_eq!(required(&manifest), BTreeMap::from([("map".to_owned(), "1.10.0".to_owned())]));
    }
}
