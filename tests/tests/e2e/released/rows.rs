//! Everything that a store holds, read as this build reads it.
//!
//! Invariant: a row is held against what it says itself: read and written again it has lost nothing, and its id and its
//! index columns are those that its table gives it.

use anyhow::{Context, ensure};
use midshift_core::heartbeat::SharedHeartbeat;
use midshift_core::idempotency::CommandKey;
use midshift_core::reason::Reason;
use midshift_core::robot_events::InboxEntry;
use midshift_core::rows::{Entry, Key, Log, Record, Revision, Row, Seq, Table};
use midshift_core::session::{LaneMark, Session};
use midshift_core::{
    audit, desired_state, drain_request, fleet, identity, leadership, planner_policy, policy, presence, rollout, stop,
    task, update,
};
use midshift_proto::link::v1::LaneBatch;
use midshift_proto::{parse, session};
use midshift_store::{FrameLog, HeartbeatLog, Store, follow};
use prost::Message;
use serde_json::Value;
use std::collections::BTreeMap;

/// How much was found of each table and log; newest versions of rows and what logs say of earlier ones.
pub struct Found(BTreeMap<&'static str, usize>);

impl Found {
    /// Names of what has nothing, in order.
    pub fn empty(&self) -> Vec<&'static str> {
        self.0.iter().filter(|(_, count)| **count == 0).map(|(name, _)| *name).collect()
    }
    fn count(&mut self, name: &'static str) {
        *self.0.entry(name).or_default() += 1;
    }
}

/// Reads all of it; the first row that cannot be read, or would lose something, is an error.
pub async fn read(store: &dyn Store, frames: &dyn FrameLog, heard: Option<&dyn HeartbeatLog>) -> anyhow::Result<Found> {
    let names = Table::ALL.iter().map(|table| table.name()).chain(Log::ALL.iter().map(|log| log.name()));
    let mut found = Found(names.chain(["frame_log", "robot_last"]).map(|name| (name, 0)).collect());
    for row in store.snapshot(Table::ALL).await?.rows {
        found.count(row.key.table.name());
        hold(&row).with_context(|| format!("row {:?}", row.key))?;
    }
    let mut entries = Vec::new();
    follow(store, &mut Seq(0), &Log::ALL, |page| entries.extend(page.iter().cloned())).await?;
    for entry in entries {
        found.count(entry.log.name());
        let held = hold_entry(&mut found, &entry);
        held.with_context(|| format!("entry {:?} of {:?}", entry.seq, entry.log))?;
    }
    for stored in frames.read(0, usize::MAX).await? {
        found.count("frame_log");
        let batch = LaneBatch::decode(&*stored.frame.bytes)?;
        ensure!(batch.encode_to_vec() == *stored.frame.bytes, "frame {} has lost something", stored.position);
        parse::<session::LaneBatch, _>(batch).with_context(|| format!("frame {}", stored.position))?;
    }
    if let Some(heard) = heard {
        for newest in heard.read(0).await?.0 {
            found.count("robot_last");
            keeps(&newest.body, &SharedHeartbeat::parse(&newest.body)?.text())?;
        }
    }
    Ok(found)
}

fn hold_entry(found: &mut Found, entry: &Entry) -> anyhow::Result<()> {
    let Some(body) = &entry.body else { return Ok(()) };
    if let Some(table) = entry.table {
        found.count(table.name());
        let key = Key::new(table, &*entry.subject);
        return hold(&Row { key, revision: Revision(1), index: entry.index.clone(), body: body.clone() });
    }
    if &*entry.kind == drain_request::INCIDENT {
        return keeps(body, &serde_json::to_string(&serde_json::from_str::<Reason>(body)?)?);
    }
    if entry.log == Log::RobotInbox {
        keeps(body, &serde_json::to_string(&serde_json::from_str::<InboxEntry>(body)?)?)?;
    }
    Ok(())
}

macro_rules! records {
    ($($table:ident $record:ty;)*) => {
        fn hold(row: &Row) -> anyhow::Result<()> {
            match row.key.table {
                $(Table::$table => hold_as::<$record>(row),)*
            }
        }
    };
}

records! {
    TaskIntake task::TaskIntake;
    TaskRequest task::TaskRequest;
    TaskType task::types::TaskTypeRow;
    RequestKey task::requests::RequestKey;
    TaskState task::TaskState;
    Attempt task::Attempt;
    Timer fleet::rows::Timer;
    HoldToken fleet::rows::HoldToken;
    PlaceGrant fleet::rows::Place;
    PlaceBlock fleet::rows::PlaceBlock;
    RobotAuthority fleet::rows::RobotAuthority;
    RobotControl fleet::rows::RobotControl;
    RobotCounter fleet::rows::RobotCounter;
    Site fleet::rows::SiteRow;
    AreaPolicy policy::AreaPolicy;
    PlannerPolicy planner_policy::PlannerPolicy;
    DesiredWork desired_state::DesiredWork;
    DesiredPolicy desired_state::DesiredPolicy;
    ServiceClock fleet::rows::ServiceClock;
    FleetMark fleet::rows::FleetMark;
    Incident fleet::rows::Incident;
    Drain fleet::rows::Drain;
    AreaBudget fleet::rows::AreaBudget;
    CommandKey CommandKey<fleet::projection::command::Command>;
    FleetLeader leadership::FleetLeader;
    Session Session;
    Presence presence::PresenceRow;
    LaneMark LaneMark;
    Bundle rollout::rows::Bundle;
    Rollout rollout::rows::Rollout;
    RolloutRobot rollout::rows::RolloutRobot;
    DrainRequest drain_request::DrainRequest;
    DrainRelease drain_request::DrainRelease;
    DesiredUpdate update::DesiredUpdate;
    RobotSoftware rollout::rows::RobotSoftware;
    Quarantine rollout::rows::Quarantine;
    AreaBundle rollout::rows::AreaBundle;
    OtaMark rollout::rows::OtaMark;
    OtaClock rollout::rows::OtaClock;
    OtaCommandKey CommandKey<rollout::requests::Command>;
    OtaLeader leadership::OtaLeader;
    StopRecord stop::record::StopRecord;
    Token identity::TokenRecord;
    TokenName identity::TokenName;
    RobotIdentity identity::RobotIdentity;
    RootCertificate identity::RootCertificate;
    ServerCertificate identity::ServerCertificate;
    TaskAudit audit::TaskAudit;
    FleetAudit audit::FleetAudit;
    OtaAudit audit::OtaAudit;
    StopAudit audit::StopAudit;
    IdentityAudit audit::IdentityAudit;
}

fn hold_as<R: Record>(row: &Row) -> anyhow::Result<()> {
    let read: R = row.decode()?;
    keeps(&row.body, &read.body())?;
    ensure!(read.id() == *row.key.id, "its id is {}, this build would write {}", row.key.id, read.id());
    ensure!(read.index() == row.index, "its index is {:?}, this build would write {:?}", row.index, read.index());
    Ok(())
}

/// Whether `after` says all that `before` says. It may say more. An error names the place of the first difference.
fn keeps(before: &str, after: &str) -> anyhow::Result<()> {
    holds_all(&serde_json::from_str(before)?, &serde_json::from_str(after)?, "")
}

fn holds_all(before: &Value, after: &Value, at: &str) -> anyhow::Result<()> {
    match (before, after) {
        (Value::Object(before), Value::Object(after)) => before.iter().try_for_each(|(name, value)| {
            let kept = after.get(name).with_context(|| format!("{at}.{name} is lost"))?;
            holds_all(value, kept, &format!("{at}.{name}"))
        }),
        (Value::Array(before), Value::Array(after)) => {
            ensure!(before.len() == after.len(), "{at} had {} items and has {}", before.len(), after.len());
            let mut pairs = before.iter().zip(after).zip(0..);
            pairs.try_for_each(|((before, after), nth): (_, u32)| holds_all(before, after, &format!("{at}[{nth}]")))
        }
        _ => {
            ensure!(before == after, "{at} was {before} and is {after}");
            Ok(())
        }
    }
}
