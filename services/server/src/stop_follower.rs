//! Beside a stop service: copies its stops into the store, and writes for it who the robots of the site are.
//!
//! The stop service never sees the store, and nobody on its way waits for this: it reads the files that the stop service keeps, whatever state that is in. Invariant: a
//! stop that was copied is taken out only after its reset was forgotten, also if the stop service has lost its folder, to which it is written back. One process at a time follows a folder:
//! whoever holds the lock in it.

use anyhow::Context;
use midshift_core::fleet::rows::RobotControl;
use midshift_core::identity::RobotIdentity;
use midshift_core::ids::{RobotId, StopId};
use midshift_core::limits;
use midshift_core::rows::{BadRow, Log, Revision, Row, Seq, Table};
use midshift_core::stop::Latch;
use midshift_core::stop::record::{StopRecord, copy};
use midshift_core::time::{Clock, Now, Utc};
use midshift_identity::{IdentityService, RevocationList, ServerProof};
use midshift_stop::{Copied, Principals, Roster};
use midshift_store::{CommitError, SkippedRows, Store, follow};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{DirBuilder, File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// How often the files are looked at: fleet knows of a stop a quarter of a second after robots at the latest.
const LOOK: Duration = Duration::from_millis(250);
/// Whoever follows holds this, in the folder of the stop service; the system lets it go with the process, however that ends.
const TURN: &str = "follower.lock";
/// How often it is looked up which robots a person has retired, and said that who is known has not changed, in looks: ten seconds.
const NOW_AND_THEN: u32 = (limits::PRINCIPALS_TOLD_EVERY.as_ms() / LOOK.as_millis() as u64) as u32;

/// Who is known, as the stop service is told.
fn principals(identity: &IdentityService) -> Principals {
    let ServerProof { chain_pem, key_pem, authority_pem } = identity.proof().borrow().clone();
    Principals { directory: (**identity.directory().borrow()).clone(), chain_pem, key_pem, authority_pem }
}

/// Writes it into the folder of a stop service that is about to be started.
///
/// # Errors
/// The disk.
pub fn tell_principals(folder: &Path, identity: &IdentityService) -> io::Result<()> {
    principals(identity).write(folder)
}

/// Stops that the store has as engaged.
async fn engaged(store: &dyn Store, skipped: &mut SkippedRows) -> anyhow::Result<Copied> {
    let snapshot = store.snapshot(&[Table::StopRecord]).await.context("reading copies of stops")?;
    let mut stops = Vec::new();
    for row in &snapshot.rows {
        let record = skipped.read::<StopRecord>(row)?.filter(StopRecord::is_effective);
        stops.extend(record.map(|record| record.stop));
    }
    stops.sort_unstable();
    Ok(Copied { stops })
}

/// Writes what the store has as engaged into the folder of a stop service that is about to be started: it takes what it has lost of it.
///
/// # Errors
/// The disk, or the store.
pub async fn tell_stops(folder: &Path, store: &dyn Store) -> anyhow::Result<()> {
    Ok(engaged(store, &mut SkippedRows::default()).await?.write(folder)?)
}

/// The turn to follow, if nobody has it; the folder is made if it is not there.
fn turn_of(folder: &Path) -> io::Result<Option<File>> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
    let path = folder.join(TURN);
    let file = OpenOptions::new().create(true).truncate(false).write(true).mode(0o600).open(path)?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Ok(None),
        Err(TryLockError::Error(error)) => Err(error),
    }
}

/// What follows one stop service.
pub struct StopFollower {
    folder: PathBuf,
    store: Arc<dyn Store>,
    clock: Arc<dyn Clock>,
    /// Generation of the latch that was copied last.
    copied: Option<u64>,
    /// Stops of the store as they were written down last.
    told: Option<Copied>,
    /// Robots that have ever said hello, up to an entry of the feed.
    attached: Option<(BTreeSet<RobotId>, Seq)>,
    /// Retired or revoked: nobody waits for their word any more.
    gone: BTreeSet<RobotId>,
    /// As it was written last.
    roster: Option<BTreeSet<RobotId>>,
    /// Who is known, and what that was when it was written last.
    identity: Option<(IdentityService, Option<Principals>)>,
    /// A copy of what was taken back: this folder is not in the backup of the rows, and may be on another machine.
    revoked: RevocationList,
    /// Rows of a newer version, which nothing here is done by.
    skipped: SkippedRows,
    /// As the log was told.
    failing: bool,
}

impl StopFollower {
    /// Of the stop service that keeps its files in `folder`.
    pub fn new(
        folder: PathBuf,
        store: Arc<dyn Store>,
        identity: Option<IdentityService>,
        clock: Arc<dyn Clock>,
    ) -> Self {
        let (copied, told, attached, gone, roster) = (None, None, None, BTreeSet::new(), None);
        let identity = identity.map(|identity| (identity, None));
        let (skipped, revoked) = (SkippedRows::default(), RevocationList::new(&folder));
        Self { folder, store, clock, copied, told, attached, gone, roster, identity, revoked, skipped, failing: false }
    }

    /// Until it is dropped.
    pub async fn run(mut self) {
        let mut look = tokio::time::interval(LOOK);
        let _turn = self.turn(&mut look).await;
        for n in 0_u32.. {
            look.tick().await;
            let followed = self.follow(n % NOW_AND_THEN == 0).await;
            if let (Err(error), false) = (&followed, self.failing) {
                tracing::warn!(
                    error = format!("{error:#}"),
                    "what the stop service and the store tell each other is not up to date"
                );
            }
            self.failing = followed.is_err();
            metrics::gauge!("midshift_stop_follower_failing").set(f64::from(u8::from(self.failing)));
        }
    }

    /// Waits until nobody else follows this folder.
    async fn turn(&mut self, look: &mut tokio::time::Interval) -> File {
        let mut is_told = false;
        loop {
            look.tick().await;
            match turn_of(&self.folder) {
                Ok(Some(turn)) => {
                    self.failing = false;
                    return turn;
                }
                Ok(None) if !is_told => {
                    tracing::info!(folder = %self.folder.display(), "another process follows this stop service; this one waits for its end");
                    is_told = true;
                }
                Ok(None) => {}
                Err(error) => {
                    if !self.failing {
                        tracing::warn!(%error, folder = %self.folder.display(), "the folder of the stop service cannot be used");
                    }
                    self.failing = true;
                    metrics::gauge!("midshift_stop_follower_failing").set(1.0);
                }
            }
        }
    }

    async fn follow(&mut self, is_due: bool) -> anyhow::Result<()> {
        // One that begins finds what it may have lost before it is told who is known, for which it waits.
        let stops = self.tell_stops(is_due).await;
        let has_changed = self.has_news_of_who_is_known();
        // Whatever the stop service and the store are doing. A disk that refuses it holds up no copy of a stop.
        let told = self.tell_who_is_known(is_due).await;
        let revoked = if is_due || has_changed { self.copy_revocations().await } else { Ok(()) };
        let copied = self.copy_stops(is_due).await;
        stops.and(told).and(revoked).and(copied)
    }

    /// Writes what the store has as engaged, if that may have changed and has.
    async fn tell_stops(&mut self, is_due: bool) -> anyhow::Result<()> {
        if self.told.is_some() && !is_due {
            return Ok(());
        }
        let newest = engaged(&*self.store, &mut self.skipped).await?;
        if self.told.as_ref() == Some(&newest) && self.folder.join(Copied::NAME).exists() {
            return Ok(());
        }
        let (folder, writing) = (self.folder.clone(), newest.clone());
        let written = tokio::task::spawn_blocking(move || writing.write(&folder)).await;
        written.context("writing what is engaged")?.context("writing what is engaged")?;
        self.told = Some(newest);
        Ok(())
    }

    /// Whether who is known is not what was written last: something may have been taken back.
    fn has_news_of_who_is_known(&self) -> bool {
        let Some((identity, told)) = &self.identity else { return false };
        told.as_ref().is_none_or(|told| told.directory != **identity.directory().borrow())
    }

    /// Appends what was taken back since.
    async fn copy_revocations(&mut self) -> anyhow::Result<()> {
        let Some((identity, _)) = &self.identity else { return Ok(()) };
        identity.append_revocations(&self.revoked).await.context("copying what was taken back")
    }

    async fn copy_stops(&mut self, is_due: bool) -> anyhow::Result<()> {
        let folder = self.folder.clone();
        let read = tokio::task::spawn_blocking(move || midshift_stop::latch(&folder));
        let Some((generation, latch)) = read.await.context("reading the latch")?? else { return Ok(()) };
        if is_due {
            self.look_who_is_gone().await?;
        }
        self.copy(generation, &latch).await?;
        self.look_who_attached().await?;
        self.tell_roster().await
    }

    /// Writes what the latch has and the store has not.
    async fn copy(&mut self, generation: u64, latch: &Latch) -> anyhow::Result<()> {
        if self.copied == Some(generation) {
            return Ok(());
        }
        let snapshot = self.store.snapshot(&[Table::StopRecord]).await.context("reading copies of stops")?;
        let mut copied: BTreeMap<StopId, (StopRecord, Revision)> = BTreeMap::new();
        // Copies of a newer version: that one's to write.
        let mut others = BTreeSet::new();
        for row in &snapshot.rows {
            if let Some(record) = self.skipped.read::<StopRecord>(row)? {
                copied.insert(record.stop.stop_id.clone(), (record, row.revision));
            } else {
                others.insert(&row.key);
            }
        }
        let mut items = copy(latch, &copied);
        items.retain(|item| !item.rows.iter().any(|row| others.contains(&row.key)));
        let mut is_whole = true;
        for result in self.store.commit(items).await {
            match result {
                Ok(_) => {}
                // Another follower was faster: looked at again.
                Err(CommitError::Conflict { .. }) => is_whole = false,
                Err(error) => return Err(error).context("copying a stop"),
            }
        }
        self.copied = is_whole.then_some(generation);
        self.tell_stops(true).await
    }

    async fn look_who_is_gone(&mut self) -> anyhow::Result<()> {
        let snapshot = self.store.snapshot(&[Table::RobotControl, Table::RobotIdentity]).await;
        let rows = snapshot.context("reading who is retired or revoked")?.rows;
        self.gone = who_is_gone(&rows, &mut self.skipped, &self.clock.now())?;
        Ok(())
    }

    async fn look_who_attached(&mut self) -> anyhow::Result<()> {
        let Some((robots, seq)) = &mut self.attached else {
            let snapshot = self.store.snapshot(&[Table::Session]).await.context("reading who the robots are")?;
            let ids = snapshot.rows.iter().map(|row| RobotId::parse(&row.key.id));
            self.attached = Some((ids.collect::<Result<_, _>>()?, snapshot.seq));
            return Ok(());
        };
        let news = follow(&*self.store, seq, &[Log::Telemetry], |page| {
            let sessions = page.iter().filter(|entry| entry.table == Some(Table::Session));
            robots.extend(sessions.filter_map(|entry| RobotId::parse(&entry.subject).ok()));
        });
        if news.await.is_err() {
            // What was missed of the feed stands in the rows.
            self.attached = None;
        }
        Ok(())
    }

    /// Writes who is known, if that has changed; now and then it says that it has not.
    async fn tell_who_is_known(&mut self, is_due: bool) -> anyhow::Result<()> {
        let Some((identity, told)) = &mut self.identity else { return Ok(()) };
        let newest = principals(identity);
        if told.as_ref() == Some(&newest) {
            // One that is gone is written anew at the next look.
            if is_due && let Err(error) = Principals::affirm(&self.folder) {
                *told = None;
                return Err(error).context("saying that who is known has not changed");
            }
            return Ok(());
        }
        let (folder, writing) = (self.folder.clone(), newest.clone());
        let written = tokio::task::spawn_blocking(move || writing.write(&folder)).await;
        written.context("writing who is known")?.context("writing who is known")?;
        *told = Some(newest);
        Ok(())
    }

    /// Writes who the robots are, if that has changed.
    async fn tell_roster(&mut self) -> anyhow::Result<()> {
        let Some((attached, _)) = &self.attached else { return Ok(()) };
        let robots: BTreeSet<RobotId> = attached.difference(&self.gone).cloned().collect();
        if self.roster.as_ref() == Some(&robots) {
            return Ok(());
        }
        let (folder, roster) = (self.folder.clone(), Roster { robots: robots.clone() });
        let written = tokio::task::spawn_blocking(move || roster.write(&folder)).await;
        written.context("writing the roster")?.context("writing the roster")?;
        self.roster = Some(robots);
        Ok(())
    }
}

/// Whether a robot that nobody lets in since `at` stands by its own silence. A moment much later than `now` was read from another clock: it counts as long ago.
fn stands_by_itself(at: Utc, now: Utc) -> bool {
    at.0.abs_diff(now.0) >= limits::SILENCE_STAND.as_ms() + limits::CHECK_IN.as_ms()
}

/// Robots that were retired, and those that were revoked and not enrolled again since: each once it stands by itself, so that a stop service that begins anew
/// meanwhile still lists it.
fn who_is_gone(rows: &[Row], skipped: &mut SkippedRows, now: &Now) -> Result<BTreeSet<RobotId>, BadRow> {
    let mut gone = BTreeSet::new();
    for row in rows {
        let (robot_id, is_gone) = match row.key.table {
            Table::RobotControl => {
                let Some(control) = skipped.read::<RobotControl>(row)? else { continue };
                (control.robot_id, control.retired.is_some_and(|act| stands_by_itself(act.since, now.utc)))
            }
            _ => {
                let Some(robot) = skipped.read::<RobotIdentity>(row)? else { continue };
                let is_gone = robot.revoked.is_some_and(|act| stands_by_itself(Utc(act.at_unix_ms), now.wall));
                (robot.robot_id, is_gone)
            }
        };
        gone.extend(is_gone.then_some(robot_id));
    }
    Ok(gone)
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::SiteId;
    use midshift_core::item::{Expect, Item, RowChange, Write};
    use midshift_core::robot::StopLevel;
    use midshift_core::rows::{Index, Key, Record, Writer};
    use midshift_core::stop::{Scope, Stop};
    use midshift_store::{MemoryStore, StoreId};

    #[tokio::test]
    async fn one_that_was_revoked_is_on_the_roster_no_more_until_it_is_enrolled_again() -> anyhow::Result<()> {
        let store = MemoryStore::new(SiteId::parse("demo")?, StoreId::fresh(), midshift_process::clock::clock(1000));
        let robot_id = RobotId::parse("r1")?;
        let mut robot = RobotIdentity::new(robot_id.clone());
        let gone = async |robot: &RobotIdentity, expect: Expect, ms: i64| {
            let mut item = Item::new(Writer::Identity, "anna");
            item.put_row(robot, expect, "robot.changed");
            assert!(store.commit(vec![item]).await.iter().all(Result::is_ok));
            let snapshot = store.snapshot(&[Table::RobotControl, Table::RobotIdentity]).await?;
            let now = Now { utc: Utc(ms), wall: Utc(ms), ..Now::default() };
            anyhow::Ok(who_is_gone(&snapshot.rows, &mut SkippedRows::default(), &now)?)
        };
        assert!(gone(&robot, Expect::Absent, 50_000).await?.is_empty());
        robot.revoke("anna", Utc(5));
        // It may drive until its own silence stands it.
        assert!(gone(&robot, Expect::At(Revision(1)), 31_004).await?.is_empty());
        assert_eq!(gone(&robot, Expect::At(Revision(2)), 31_005).await?, [robot_id].into());
        robot.revoked = None;
        assert!(gone(&robot, Expect::At(Revision(3)), 50_000).await?.is_empty());
        Ok(())
    }

    #[tokio::test]
    async fn one_that_was_revoked_is_listed_by_whoever_begins_anew_until_it_stands_by_itself() -> anyhow::Result<()> {
        let store =
            Arc::new(MemoryStore::new(SiteId::parse("demo")?, StoreId::fresh(), midshift_process::clock::clock(1000)));
        let mut robot = RobotIdentity::new(RobotId::parse("r1")?);
        robot.revoke("anna", Utc(1_000_000));
        let mut revoked = Item::new(Writer::Identity, "anna");
        revoked.put_row(&robot, Expect::Absent, "robot.revoked");
        let write = Write::Put { index: Index::default(), body: "{}".into() };
        let key = Key::new(Table::Session, "r1");
        let mut attached = Item::new(Writer::Telemetry, "tests");
        attached.rows.push(RowChange { key, expect: Expect::Absent, write, kind: "session.begun" });
        assert!(store.commit(vec![revoked, attached]).await.iter().all(Result::is_ok));
        let folder = tempfile::tempdir()?;
        for (ms, is_listed) in [(1_001_000, true), (1_020_000, true), (1_100_000, false)] {
            let clock = midshift_process::clock::at(Utc(ms), 1000);
            let mut follower = StopFollower::new(folder.path().to_owned(), store.clone(), None, clock);
            follower.look_who_is_gone().await?;
            follower.look_who_attached().await?;
            follower.tell_roster().await?;
            // What a stop service reads that begins now.
            let roster = std::fs::read_to_string(folder.path().join("roster.snapshot"))?;
            assert_eq!(roster.contains("r1"), is_listed, "{roster} at {ms}");
        }
        Ok(())
    }

    fn stop(name: &str) -> anyhow::Result<Stop> {
        let stop = Stop::new(StopId::parse(name)?, Scope::Fleet, StopLevel::Halt, Utc(1));
        Ok(Stop { actor: "anna".to_owned(), ..stop })
    }

    #[tokio::test]
    async fn a_copy_of_a_newer_version_is_left_as_it_is_and_stops_the_copying_of_no_other() -> anyhow::Result<()> {
        let store =
            Arc::new(MemoryStore::new(SiteId::parse("demo")?, StoreId::fresh(), midshift_process::clock::clock(1000)));
        let record = StopRecord { stop: stop("S1")?, reset: None };
        let body = record.body().replace("\"halt\"", "\"hover\"");
        let write = Write::Put { index: record.index(), body: body.as_str().into() };
        let mut item = Item::new(Writer::Stop, "tests");
        item.rows.push(RowChange { key: record.key(), expect: Expect::Absent, write, kind: "stop.engaged" });
        assert!(store.commit(vec![item]).await.iter().all(Result::is_ok));
        let mut latch = Latch::default();
        latch.engage(stop("S1")?);
        latch.engage(stop("S2")?);
        let folder = tempfile::tempdir()?;
        let mut follower =
            StopFollower::new(folder.path().to_owned(), store.clone(), None, midshift_process::clock::clock(1000));
        follower.copy(1, &latch).await?;
        let rows = store.snapshot(&[Table::StopRecord]).await?.rows;
        let kept: Vec<_> = rows.iter().filter(|row| &*row.key.id == "S1").map(|row| &*row.body).collect();
        assert_eq!(kept, [body.as_str()]);
        assert!(rows.iter().any(|row| row.decode::<StopRecord>().is_ok_and(|copy| copy.stop.stop_id.as_str() == "S2")));
        assert_eq!(follower.copied, Some(1), "it is not tried again at each look");
        assert_eq!(follower.told.map(|told| told.stops), Some(vec![stop("S2")?]));
        Ok(())
    }

    #[test]
    fn who_is_known_is_said_to_be_so_still_without_being_written_anew() -> io::Result<()> {
        let folder = tempfile::tempdir()?;
        assert!(Principals::affirm(folder.path()).is_err() && Principals::written_at(folder.path()).is_none());
        let principals = Principals {
            directory: Default::default(),
            chain_pem: "chain".to_owned(),
            key_pem: "key".to_owned(),
            authority_pem: "root".to_owned(),
        };
        principals.write(folder.path())?;
        let path = folder.path().join(Principals::NAME);
        File::options().write(true).open(&path)?.set_modified(std::time::UNIX_EPOCH)?;
        assert_eq!(Principals::written_at(folder.path()).map(|at| at.0), Some(0));
        Principals::affirm(folder.path())?;
        assert!(Principals::written_at(folder.path()).is_some_and(|at| at.0 > 1_700_000_000_000));
        assert!(Principals::read(folder.path())?.is_some_and(|read| read == principals));
        Ok(())
    }

    #[test]
    fn one_process_at_a_time_follows_a_stop_service_and_its_end_makes_room() -> io::Result<()> {
        let dir = tempfile::tempdir()?;
        let folder = dir.path().join("stop");
        let first = turn_of(&folder)?;
        assert!(first.is_some());
        assert!(turn_of(&folder)?.is_none(), "two follow at once");
        drop(first);
        assert!(turn_of(&folder)?.is_some(), "nobody follows any more");
        Ok(())
    }
}
