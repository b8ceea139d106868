//! Which map a server goes on with when its site file has changed: the new one, or the stored one while something is in the way of the new.
//!
//! Called by `serve`, and by `dev` for data that it keeps, before any service begins. Invariant: nothing is written here; fleet tells people, and stores the map that is taken.

use anyhow::Context;
use midshift_core::fleet::maps::{MapChange, in_the_way};
use midshift_core::fleet::projection::{FleetProjection, alive, named};
use midshift_core::fleet::rows::SiteRow;
use midshift_core::site::file::Loaded;
use midshift_core::site::{Site, read_stored};
use midshift_core::time::Now;
use midshift_store::{Store, load};
use std::sync::Arc;

/// What to try where the stored map cannot be read.
const FORCE: &str =
    "start the version that wrote it; or take the map of the file with --force-map, whatever is in its way";
const FOLLOW: &str = "start the version that wrote it; or start a process with role fleet and --force-map first";

/// The map to go on with, and what became of the one of the file.
pub async fn choose(
    store: &dyn Store,
    loaded: Loaded,
    is_forced: bool,
    now: Now,
) -> anyhow::Result<(Loaded, MapChange)> {
    let Some((row, stored)) = other_stored(store, &loaded, is_forced, FORCE).await? else {
        return Ok((loaded, MapChange::Taken));
    };
    let snapshot = store.read(&alive(), named).await.context("reading what is in the way of the changed map")?;
    let mut view = FleetProjection::new(stored.clone(), now, now);
    view.load(&snapshot.rows, snapshot.seq).context("reading what is in the way of the changed map")?;
    let obstacles = in_the_way(&view, &stored, &loaded.site);
    let (version, count) = (loaded.site.map_version().to_owned(), obstacles.len());
    if obstacles.is_empty() {
        tracing::info!(map_version = version, stored = row.map_version, "the changed map is taken");
        return Ok((loaded, MapChange::Taken));
    }
    if is_forced {
        tracing::warn!(map_version = version, stored = row.map_version, count, "the changed map is forced");
        return Ok((loaded, MapChange::Forced { obstacles }));
    }
    tracing::warn!(
        map_version = version,
        stored = row.map_version,
        count,
        "the changed map is not taken: tasks, robots or held places are in its way (MAP_NOT_TAKEN), and the stored one goes on"
    );
    let goes_on = Loaded { site: stored, text: row.text, warnings: Vec::new() };
    Ok((goes_on, MapChange::NotTaken { version, obstacles }))
}

/// The map of a process that does not plan: the stored one, which fleet plans on, whatever its own file says.
pub async fn follow(store: &dyn Store, loaded: Loaded) -> anyhow::Result<Loaded> {
    let Some((row, stored)) = other_stored(store, &loaded, false, FOLLOW).await? else { return Ok(loaded) };
    let (version, stored_version) = (loaded.site.map_version(), &row.map_version);
    tracing::info!(map_version = version, stored = stored_version, "the stored map goes on, whatever the file says");
    Ok(Loaded { site: stored, text: row.text, warnings: Vec::new() })
}

/// The stored map, if it is another one than that of the file. One that cannot be read, since a newer version wrote it,
/// is an error, or none if the file's is forced.
async fn other_stored(
    store: &dyn Store,
    loaded: &Loaded,
    is_forced: bool,
    hint: &str,
) -> anyhow::Result<Option<(SiteRow, Arc<Site>)>> {
    let row = load::<SiteRow>(store, loaded.site.site_id().as_str()).await.context("reading the stored map")?;
    let Some((row, _)) = row.filter(|(row, _)| row.text != loaded.text) else { return Ok(None) };
    match read_stored(row.site_id.as_str(), &row.text) {
        Ok(stored) => Ok(Some((row, Arc::new(stored)))),
        Err(error) if is_forced => {
            tracing::warn!(%error, "the stored map cannot be read, so nobody can say what is in the way of the file's, which is forced");
            Ok(None)
        }
        Err(error) => {
            let text = format!("the stored map cannot be read: a newer version may have written it\n  try: {hint}");
            Err(anyhow::Error::new(error).context(text))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::fleet::maps::Obstacle;
    use midshift_core::fleet::rows::{HolderState, Place, PlaceHolder};
    use midshift_core::ids::{PlaceId, RobotId};
    use midshift_core::item::Item;
    use midshift_core::rows::Writer;
    use midshift_core::site::{CORRIDOR, PlaceKind, text};
    use midshift_core::time::{Clock, ScaledClock, Utc};
    use midshift_store::{MemoryStore, StoreId};

    fn loaded(text: String) -> Loaded {
        Loaded { site: Arc::new(text::parse(&text).expect("a site")), text, warnings: Vec::new() }
    }

    /// A store in which a robot stands in park-a of the corridor.
    async fn store() -> MemoryStore {
        let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(|| 0, Utc(1_800_000_000_000), 1000));
        let site = loaded(CORRIDOR.to_owned()).site;
        let store = MemoryStore::new(site.site_id().clone(), StoreId(Arc::from("s")), clock);
        let robot_id = RobotId::parse("r1").expect("a name");
        let (grant_id, state) = (1, HolderState::Inside);
        let holder = PlaceHolder { robot_id, grant_id, state, since: Utc(0), claimed: false };
        let place_id = PlaceId::parse("park-a").expect("a place");
        let place = Place {
            place_id,
            capacity: 1,
            kind: PlaceKind::Standing,
            holders: vec![holder],
            quarantine: None,
            cleared: Vec::new(),
        };
        let map_version = site.map_version().to_owned();
        let row = SiteRow { site_id: site.site_id().clone(), map_version, text: CORRIDOR.to_owned() };
        let mut item = Item::new(Writer::Fleet, "tests");
        item.create(&row, "site.loaded").create(&place, "place.founded");
        store.commit(vec![item]).await.pop().expect("a result").expect("applied");
        store
    }

    fn moved(waypoint: &str, from: &str, to: &str) -> String {
        let (before, after) =
            (format!("id = \"{waypoint}\", at = [{from}]"), format!("id = \"{waypoint}\", at = [{to}]"));
        assert!(CORRIDOR.contains(&before), "{before}");
        CORRIDOR.replace(&before, &after).replace("map_version = \"1\"", "map_version = \"2\"")
    }

    #[tokio::test]
    async fn a_changed_map_waits_for_what_is_in_its_way_and_is_taken_by_force_or_once_nothing_is() {
        let store = store().await;
        let choose = async |text: String, is_forced| {
            let (taken, change) = choose(&store, loaded(text), is_forced, Now::default()).await.expect("readable");
            (taken.site.map_version().to_owned(), change)
        };
        assert_eq!(choose(CORRIDOR.to_owned(), false).await, ("1".to_owned(), MapChange::Taken));
        let elsewhere = moved("park-b", "20000, 3000", "21000, 3000");
        assert_eq!(choose(elsewhere, false).await, ("2".to_owned(), MapChange::Taken), "nobody is there");
        let under_it = moved("park-a", "0, 3000", "0, 4000");
        let obstacles = vec![Obstacle::Place(PlaceId::parse("park-a").expect("a place"))];
        let not_taken = MapChange::NotTaken { version: "2".to_owned(), obstacles: obstacles.clone() };
        assert_eq!(choose(under_it.clone(), false).await, ("1".to_owned(), not_taken));
        assert_eq!(choose(under_it, true).await, ("2".to_owned(), MapChange::Forced { obstacles }));
    }

    #[tokio::test]
    async fn a_stored_map_that_only_a_newer_version_can_read_is_replaced_by_force_alone() {
        let store = store().await;
        let newer = CORRIDOR.replace("map_version", "gravity = 3\nmap_version");
        let row = load::<SiteRow>(&store, "corridor").await.expect("readable").expect("a row");
        let mut item = Item::new(Writer::Fleet, "tests");
        item.update(&SiteRow { text: newer, ..row.0 }, row.1, "site.loaded");
        store.commit(vec![item]).await.pop().expect("a result").expect("applied");
        let own = || loaded(CORRIDOR.to_owned());
        let refused =
            choose(&store, own(), false, Now::default()).await.expect_err("nobody can say what is in the way");
        assert!(format!("{refused:#}").contains("--force-map"), "{refused:#}");
        assert!(follow(&store, own()).await.is_err());
        let (taken, change) = choose(&store, own(), true, Now::default()).await.expect("forced");
        assert_eq!((taken.text.as_str(), change), (CORRIDOR, MapChange::Taken));
    }

    #[tokio::test]
    async fn a_process_that_does_not_plan_goes_by_the_stored_map_whatever_its_file_says() {
        let store = store().await;
        let elsewhere = loaded(moved("park-b", "20000, 3000", "21000, 3000"));
        let taken = follow(&store, elsewhere).await.expect("readable");
        assert_eq!((taken.site.map_version(), taken.text.as_str()), ("1", CORRIDOR));
    }
}
