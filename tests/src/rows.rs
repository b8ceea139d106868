//! Everything that a store holds, read as this build reads it.
//!
//! Invariant: a row is held against what it says itself: read and written again it has lost nothing, its id and its index columns are those
//! that its table gives it. What is missing in a store is the caller's to judge.

use crate::shape::Shapes;
use anyhow::{Context, ensure};
use midshift_core::once::CommandKey;
use midshift_core::rows::{Entry, Index, Log, Record, Seq, Table};
use midshift_core::work::{InboxEntry, Told};
use midshift_core::{audit, fleet, identity, lead, maintenance, policy, rollout, stop, task, update, work};
use midshift_proto::link::v1::LaneBatch;
use midshift_proto::parse;
use midshift_proto::session;
use midshift_store::{FrameLog, HeardLog, Store, follow};
use prost::Message;
use serde_json::Value;
use std::collections::BTreeMap;

/// What was found in a store.
#[derive(Debug, Default)]
pub struct Found {
    /// Rows of each table and what logs say of its earlier ones, also of tables with neither.
    pub rows: BTreeMap<&'static str, usize>,
    /// Entries of each log.
    pub entries: BTreeMap<&'static str, usize>,
    /// Frames of STATUS.
    pub frames: usize,
    /// Newest heartbeats that processes share.
    pub heard: usize,
    /// What all of it may be made of.
    pub shapes: Shapes,
}

impl Found {
    /// Names of what has nothing.
    pub fn empty(&self) -> Vec<&'static str> {
        let none = self.rows.iter().chain(&self.entries).filter(|(_, count)| **count == 0);
        let frames = (self.frames == 0).then_some("frame_log");
        let heard = (self.heard == 0).then_some("robot_last");
        none.map(|(name, _)| *name).chain(frames).chain(heard).collect()
    }
}

/// Reads all of it.
///
/// # Errors
/// With the first row that cannot be read, or would lose something.
pub async fn read(store: &dyn Store, frames: &dyn FrameLog, heard: Option<&dyn HeardLog>) -> anyhow::Result<Found> {
    let mut found = Found::default();
    for table in Table::ALL {
        found.rows.insert(table.name(), 0);
    }
    for row in store.snapshot(Table::ALL).await?.rows {
        *found.rows.entry(row.key.table.name()).or_default() += 1;
        let held = hold(&mut found.shapes, row.key.table, &row.key.id, &row.index, &row.body);
        held.with_context(|| format!("row {:?}", row.key))?;
    }
    for log in Log::ALL {
        found.entries.insert(log.name(), 0);
    }
    let mut entries = Vec::new();
    follow(store, &mut Seq(0), &Log::ALL, |page| entries.extend(page.iter().cloned())).await?;
    for entry in entries {
        *found.entries.entry(entry.log.name()).or_default() += 1;
        hold_entry(&mut found, &entry).with_context(|| format!("entry {:?} of {:?}", entry.seq, entry.log))?;
    }
    for stored in frames.read(0, usize::MAX).await? {
        found.frames += 1;
        let batch = LaneBatch::decode(&*stored.frame.bytes)?;
        ensure!(batch.encode_to_vec() == *stored.frame.bytes, "frame {} has lost something", stored.position);
        parse::<session::LaneBatch, _>(batch).with_context(|| format!("frame {}", stored.position))?;
    }
    if let Some(heard) = heard {
        for told in heard.read(0).await?.0 {
            found.heard += 1;
            let value = serde_json::from_str(&told.body)?;
            let read: Told = found.shapes.read("robot_last", &value)?;
            keeps(&value, &serde_json::to_value(&read)?, "robot_last")?;
        }
    }
    Ok(found)
}

fn hold_entry(found: &mut Found, entry: &Entry) -> anyhow::Result<()> {
    let Some(body) = &entry.body else { return Ok(()) };
    if let Some(table) = entry.table {
        *found.rows.entry(table.name()).or_default() += 1;
        return hold(&mut found.shapes, table, &entry.subject, &entry.index, body);
    }
    if entry.log == Log::RobotInbox {
        let value = serde_json::from_str(body)?;
        let read: InboxEntry = found.shapes.read(entry.log.name(), &value)?;
        keeps(&value, &serde_json::to_value(&read)?, entry.log.name())?;
    }
    Ok(())
}

macro_rules! records {
    ($($table:ident $record:ty;)*) => {
        fn hold(shapes: &mut Shapes, table: Table, id: &str, index: &Index, body: &str) -> anyhow::Result<()> {
            match table {
                $(Table::$table => hold_as::<$record>(shapes, id, index, body),)*
            }
        }
    };
}

records! {
    TaskIntake task::TaskIntake;
    TaskRequest task::TaskRequest;
    RequestKey task::state::RequestKey;
    TaskState task::TaskState;
    Attempt task::Attempt;
    Timer fleet::rows::Timer;
    HoldToken fleet::rows::HoldToken;
    PlaceGrant fleet::rows::Place;
    RobotAuthority fleet::rows::RobotAuthority;
    RobotControl fleet::rows::RobotControl;
    RobotCounter fleet::rows::RobotCounter;
    Site fleet::rows::SiteRow;
    AreaPolicy policy::AreaPolicy;
    DesiredWork work::DesiredWork;
    DesiredPolicy work::DesiredPolicy;
    ServiceClock fleet::rows::ServiceClock;
    FleetMark fleet::rows::FleetMark;
    Incident fleet::rows::Incident;
    Drain fleet::rows::Drain;
    AreaBudget fleet::rows::AreaBudget;
    CommandKey CommandKey<fleet::asked::Command>;
    FleetLeader lead::FleetLeader;
    Session work::Session;
    Presence work::PresenceRow;
    LaneMark work::LaneMark;
    Bundle rollout::rows::Bundle;
    Rollout rollout::rows::Rollout;
    RolloutRobot rollout::rows::RolloutRobot;
    DrainRequest maintenance::DrainRequest;
    DrainRelease maintenance::DrainRelease;
    DesiredUpdate update::DesiredUpdate;
    RobotSoftware rollout::rows::RobotSoftware;
    Quarantine rollout::rows::Quarantine;
    AreaBundle rollout::rows::AreaBundle;
    OtaMark rollout::rows::OtaMark;
    OtaClock rollout::rows::OtaClock;
    OtaCommandKey CommandKey<rollout::commands::Command>;
    OtaLeader lead::OtaLeader;
    StopRecord stop::record::StopRecord;
    Token identity::TokenRecord;
    RobotIdentity identity::RobotIdentity;
    Authority identity::Authority;
    ServerCertificate identity::ServerCertificate;
    TaskAudit audit::TaskAudit;
    FleetAudit audit::FleetAudit;
    OtaAudit audit::OtaAudit;
    StopAudit audit::StopAudit;
    IdentityAudit audit::IdentityAudit;
}

fn hold_as<R: Record>(shapes: &mut Shapes, id: &str, index: &Index, body: &str) -> anyhow::Result<()> {
    let name = R::TABLE.name();
    let value = serde_json::from_str(body)?;
    let read: R = shapes.read(name, &value)?;
    keeps(&value, &serde_json::from_str(&read.body())?, name)?;
    ensure!(read.id() == id, "its id is {id}, this build would write {}", read.id());
    ensure!(read.index() == *index, "its index is {index:?}, this build would write {:?}", read.index());
    Ok(())
}

/// Whether `after` says all that `before` says. It may say more.
///
/// # Errors
/// With the place of the first difference.
pub fn keeps(before: &Value, after: &Value, at: &str) -> anyhow::Result<()> {
    match (before, after) {
        (Value::Object(before), Value::Object(after)) => {
            for (name, value) in before {
                let kept = after.get(name).with_context(|| format!("{at}.{name} is lost"))?;
                keeps(value, kept, &format!("{at}.{name}"))?;
            }
        }
        (Value::Array(before), Value::Array(after)) => {
            ensure!(before.len() == after.len(), "{at} had {} items and has {}", before.len(), after.len());
            for (nth, (before, after)) in before.iter().zip(after).enumerate() {
                keeps(before, after, &format!("{at}[{nth}]"))?;
            }
        }
        _ => ensure!(before == after, "{at} was {before} and is {after}"),
    }
    Ok(())
}
