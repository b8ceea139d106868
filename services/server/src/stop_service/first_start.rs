//! Announces the first start of a stop service: beside a store that knows of no robot and no stop, so that an empty folder has lost nothing.
//!
//! Invariant: nobody announces one for a store that has history; an announcement that was left over from before is taken back then.
//! Called by whoever opens a store, before the stop service is started or told who is known: it waits for that.

use anyhow::{Context, bail};
use midshift_core::identity::RobotIdentity;
use midshift_core::rows::Table;
use midshift_store::Store;
use std::path::Path;

/// Why a first start may be announced.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Occasion {
    /// This process may just have made the store: it counts only if nothing was ever written to it.
    Start,
    /// A person says so, by `--init-stop`.
    Person,
    /// Beside a stop service whose store is another process' own: whether it has history is all that can be told.
    Follower,
}

/// Announces the first start in the folder of the stop service, where `occasion` and the store allow it.
///
/// # Errors
/// The disk or the store; or a person asked for it and it is no first start.
pub async fn announce(folder: &Path, store: &dyn Store, occasion: Occasion) -> anyhow::Result<()> {
    let (history, is_new) = read_history(store).await.context("reading what the store knows of robots and stops")?;
    if let Some(history) = history {
        if midshift_stop::withdraw_first_start(folder).context("taking back a first start")? {
            tracing::warn!(
                history,
                "the store is not new: a stop service that finds its folder empty begins with the fleet stopped"
            );
        }
        if occasion == Occasion::Person {
            bail!(
                "--init-stop is for a site without robots, and its store has {history}: start without it; if the stop service has lost its memory the fleet is stopped until a person has looked and resets that stop by name (`midshift stop status`)"
            );
        }
        return Ok(());
    }
    if occasion == Occasion::Start && !is_new {
        return Ok(());
    }
    let announced =
        midshift_stop::announce_first_start(folder).context("announcing the first start of the stop service")?;
    if !announced && occasion == Occasion::Person {
        bail!(
            "--init-stop is for a stop service that never began, and {} has a latch or a key: start without it",
            folder.display()
        );
    }
    Ok(())
}

/// What tells of robots and stops, and what the first seconds of a new site's server write.
const TABLES: &[Table] = &[
    Table::Session,
    Table::StopRecord,
    Table::RobotIdentity,
    Table::RootCertificate,
    Table::ServerCertificate,
    Table::Token,
    Table::TokenName,
    Table::Site,
    Table::ServiceClock,
    Table::FleetMark,
];

/// What the store has of robots and stops, in words; none: nothing. And whether no server has written to it yet.
async fn read_history(store: &dyn Store) -> anyhow::Result<(Option<String>, bool)> {
    let snapshot = store.snapshot(TABLES).await?;
    let count = |table: Table| snapshot.rows.iter().filter(|row| row.key.table == table).count();
    let mut enrolled = 0;
    for row in snapshot.rows.iter().filter(|row| row.key.table == Table::RobotIdentity) {
        enrolled += usize::from(row.decode::<RobotIdentity>()?.was_ever_enrolled());
    }
    let found =
        [(count(Table::Session), "sessions"), (count(Table::StopRecord), "stops"), (enrolled, "enrolled robots")];
    let said: Vec<String> = found.iter().filter(|(n, _)| *n > 0).map(|(n, of)| format!("{n} {of}")).collect();
    Ok(((!said.is_empty()).then(|| said.join(", ")), snapshot.rows.is_empty()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::{RobotId, SiteId, StopId};
    use midshift_core::item::Item;
    use midshift_core::robot::StopLevel;
    use midshift_core::rows::Writer;
    use midshift_core::stop::record::StopRecord;
    use midshift_core::stop::{Scope, Stop};
    use midshift_core::time::Utc;
    use midshift_process::clock;
    use midshift_stop::FIRST;
    use midshift_store::{MemoryStore, StoreId};

    fn store() -> MemoryStore {
        MemoryStore::new(SiteId::parse("demo").expect("an id"), StoreId::fresh(), clock::clock(1000))
    }

    async fn write(store: &MemoryStore, item: Item) {
        store.commit(vec![item]).await.remove(0).expect("written");
    }

    fn stopped() -> Item {
        let stop_id = StopId::parse("STOP-1").expect("an id");
        let stop = Stop::new(stop_id, Scope::Fleet, StopLevel::Halt, Utc(1));
        let mut item = Item::new(Writer::Stop, "anna");
        item.create(&StopRecord { stop, reset: None }, "stop.copied");
        item
    }

    fn identity(is_enrolled: bool) -> Item {
        let robot = RobotIdentity {
            enrolled_unix_ms: is_enrolled.then_some(1),
            ..RobotIdentity::new(RobotId::parse("r1").expect("an id"))
        };
        let mut item = Item::new(Writer::Identity, "anna");
        item.create(&robot, "robot.offered");
        item
    }

    #[tokio::test]
    async fn only_the_start_that_makes_a_store_announces_a_first_start_by_itself() {
        let dir = tempfile::tempdir().expect("a folder");
        let (folder, store) = (dir.path().join("stop"), store());
        announce(&folder, &store, Occasion::Start).await.expect("announced");
        assert!(folder.join(FIRST).exists());
        midshift_stop::withdraw_first_start(&folder).expect("taken back");
        write(&store, identity(false)).await;
        announce(&folder, &store, Occasion::Start).await.expect("looked");
        assert!(!folder.join(FIRST).exists(), "the store was made by an earlier start");
        for occasion in [Occasion::Person, Occasion::Follower] {
            announce(&folder, &store, occasion).await.expect("announced");
            assert!(folder.join(FIRST).exists(), "{occasion:?}: no robot was ever there");
            midshift_stop::withdraw_first_start(&folder).expect("taken back");
        }
    }

    #[tokio::test]
    async fn a_store_that_knows_of_a_robot_or_a_stop_announces_nothing_and_takes_back_what_was_left_over() {
        for item in [stopped(), identity(true)] {
            let dir = tempfile::tempdir().expect("a folder");
            let (folder, store) = (dir.path().join("stop"), store());
            announce(&folder, &store, Occasion::Start).await.expect("announced");
            write(&store, item).await;
            for occasion in [Occasion::Start, Occasion::Follower, Occasion::Person] {
                let said = announce(&folder, &store, occasion).await;
                assert!(!folder.join(FIRST).exists(), "{occasion:?}");
                assert_eq!(said.is_err(), occasion == Occasion::Person, "{said:?}");
            }
        }
    }

    #[tokio::test]
    async fn a_latch_or_a_key_is_no_first_start_whoever_says_so() {
        for name in ["latch", "key.pem"] {
            let dir = tempfile::tempdir().expect("a folder");
            std::fs::write(dir.path().join(name), "something").expect("written");
            announce(dir.path(), &store(), Occasion::Start).await.expect("looked");
            assert!(announce(dir.path(), &store(), Occasion::Person).await.is_err());
            assert!(!dir.path().join(FIRST).exists(), "{name}");
        }
    }
}
