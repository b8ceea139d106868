//! Rows as values: which tables exist, who writes them, and what a reader of rows and of their log gets.
//!
//! Invariant: each table has one writing service; the single exception is declared in [`Table::born_by`]. The store refuses
//! any other write at run time, and the architecture test holds this list against `docs/rows.md`.
//! A revision counts the writes of one row, from 1. Ids of rows that can be deleted are never used again, so
//! a revision never means two things; or only after [`crate::limits::GONE_KEPT`] ([`Table::OF_A_ROBOT`]), when nobody remembers the first.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// A service that writes rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Writer {
    /// Task intake.
    Task,
    /// Fleet scheduling.
    Fleet,
    /// Telemetry ingest.
    Telemetry,
    /// Software of robots.
    Ota,
    /// What follows the stop service and keeps a copy of its stops.
    Stop,
    /// Who is who.
    Identity,
}

impl Writer {
    /// All writers.
    pub const ALL: [Writer; 6] =
        [Writer::Task, Writer::Fleet, Writer::Telemetry, Writer::Ota, Writer::Stop, Writer::Identity];
    /// Name in tables and logs.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Task => "task",
            Self::Fleet => "fleet",
            Self::Telemetry => "telemetry",
            Self::Ota => "ota",
            Self::Stop => "stop",
            Self::Identity => "identity",
        }
    }
}

macro_rules! tables {
    ($($variant:ident $name:literal $writer:ident, $doc:literal;)*) => {
        /// Closed list of the tables of control.db.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Table { $(#[doc = $doc] $variant,)* }
        impl Table {
            /// Every table.
            pub const ALL: &'static [Table] = &[$(Self::$variant),*];
            /// Its name in SQL.
            pub const fn name(self) -> &'static str { match self { $(Self::$variant => $name),* } }
            /// The one service that changes it.
            pub const fn writer(self) -> Writer { match self { $(Self::$variant => Writer::$writer),* } }
        }
    };
}

tables! {
    TaskIntake "task_intake" Task, "What was asked for: immutable. id = task_id, order = admission number.";
    TaskRequest "task_request" Task, "What people ask of a task or robot afterwards (cancel, resolve, edit, hold, release, resume): append-only, kept 30 days.";
    RequestKey "request_key" Task, "request_id -> payload hash and answer; kept 7 days.";
    TaskType "task_type" Task, "A task type of the site, that one was deleted, or whether only known types are taken. id = its name; * for the last.";
    TaskState "task_state" Fleet, "Where a task is. Born QUEUED with its intake. state = phase.";
    Attempt "attempt" Fleet, "One grant of a task or errand to one robot. id = subject/epoch, parent = subject.";
    Timer "timer" Fleet, "A deadline in serving time. id = kind and attempt.";
    HoldToken "hold_token" Fleet, "A reason why a task or robot must not move. id = scope, owner and token.";
    PlaceGrant "place_grant" Fleet, "One passage or standing place: holders, queue, quarantine. id = place_id.";
    PlaceBlock "place_block" Fleet, "A person's word that nobody is let into a place. id = place_id.";
    RobotAuthority "robot_authority" Fleet, "The robot's mutex: none, a task's attempt, an errand, maintenance. id = robot_id.";
    RobotControl "robot_control" Fleet, "Cordon, breaker, counters of failures, errand number. id = robot_id.";
    RobotCounter "robot_counter" Fleet, "Work done per robot and software version. id = robot_id@software.";
    Site "site" Fleet, "The site as text and its version. id = site_id.";
    AreaPolicy "area_policy" Fleet, "Live rules of one area. id = area_id.";
    PlannerPolicy "planner_policy" Fleet, "Live rules of the site's planner. id = site_id.";
    DesiredWork "desired_work" Fleet, "Section `work` of a robot's desired state. id = robot_id.";
    DesiredPolicy "desired_policy" Fleet, "Section `policy` of a robot's desired state. id = robot_id.";
    ServiceClock "service_clock" Fleet, "Serving time of fleet, written with any commit, at most once a second.";
    FleetMark "fleet_mark" Fleet, "Last position of each log that fleet has consumed.";
    Incident "incident" Fleet, "Something a person should look into.";
    Drain "drain" Fleet, "One taking of a robot out of work for maintenance. id = drain_id.";
    AreaBudget "area_budget" Fleet, "Robots of one area that are out of work, against how many may be. id = area_id.";
    CommandKey "command_key" Fleet, "request_id -> command carried out; kept 7 days.";
    FleetLeader "fleet_leader" Fleet, "Which process of fleet plans; renewed each second where there may be several.";
    Session "session" Telemetry, "A robot's newest session: epoch, secret, hello inventory. id = robot_id.";
    Presence "presence" Telemetry, "ONLINE, SUSPECT, OFFLINE of a robot. id = robot_id.";
    LaneMark "lane_mark" Telemetry, "Highest durable CRITICAL and EVENT number per ring. id = robot_id/ring.";
    Bundle "bundle" Ota, "A bundle of a published release. id = digest of its manifest, order = when it was published.";
    Rollout "rollout" Ota, "One roll-out: what was asked for, where it is, verdicts. state = phase, order = creation.";
    RolloutRobot "rollout_robot" Ota, "One robot in one roll-out. id = rollout_id/robot_id, parent = rollout_id, order = wave.";
    DrainRequest "drain_request" Ota, "Fleet is asked to take a robot out of work. id = drain_id.";
    DrainRelease "drain_release" Ota, "Fleet may give a robot back. id = drain_id.";
    DesiredUpdate "desired_update" Ota, "Section `update` of a robot's desired state, with its signed directive. id = robot_id.";
    RobotSoftware "robot_software" Ota, "What a robot runs, as it said, and whether a person pinned it. id = robot_id.";
    Quarantine "quarantine" Ota, "A bundle that a robot went back from. id = robot_id/bundle.";
    AreaBundle "area_bundle" Ota, "What robots get that come to an area later. id = area_id.";
    OtaMark "ota_mark" Ota, "Last position of the feed that ota has consumed.";
    OtaClock "ota_clock" Ota, "Serving time of ota, and the last number it gave to a drain or permission.";
    OtaCommandKey "ota_command_key" Ota, "request_id -> command about software carried out; kept 7 days.";
    OtaLeader "ota_leader" Ota, "Which process of ota plans and signs; renewed each second where there may be several.";
    StopRecord "stop_record" Stop, "A copy of one fleet stop and of its reset. id = stop_id, order = when it was engaged.";
    Token "token" Identity, "A token of a person or a program: digest, rights, expiry. id = token_id, order = creation.";
    TokenName "token_name" Identity, "The newest token of a name, so that no two are made of one. id = name.";
    RobotIdentity "robot_identity" Identity, "A robot's key, the newest secret that enrols it, keys that were taken out. id = robot_id.";
    RootCertificate "authority" Identity, "The root certificate of the site. id = site_id.";
    ServerCertificate "server_certificate" Identity, "What one server process asked to prove itself with, and the answer. id = digest of its key.";
    TaskAudit "task_audit" Task, "What people and programs asked of task intake, as a chain. Order = number. Written by notes of items alone.";
    FleetAudit "fleet_audit" Fleet, "What they decided about robots, places and areas, as a chain.";
    OtaAudit "ota_audit" Ota, "What they decided about software, as a chain.";
    StopAudit "stop_audit" Stop, "Stops and resets as they were copied, as a chain.";
    IdentityAudit "identity_audit" Identity, "What they decided about tokens and identities of robots, as a chain.";
}

/// Each service that decides for somebody, with the table of its audit.
const AUDITS: &[(Writer, Table)] = &[
    (Writer::Task, Table::TaskAudit),
    (Writer::Fleet, Table::FleetAudit),
    (Writer::Ota, Table::OtaAudit),
    (Writer::Stop, Table::StopAudit),
    (Writer::Identity, Table::IdentityAudit),
];

impl Table {
    /// Rows of one robot, by its id, that go when it was retired long ago. Its `robot_control` stays: it says that it was retired, and how many
    /// errands it had, so that no id is given twice.
    pub const OF_A_ROBOT: &[Self] = &[
        Self::RobotAuthority,
        Self::DesiredWork,
        Self::DesiredPolicy,
        Self::Session,
        Self::Presence,
        Self::DesiredUpdate,
        Self::RobotSoftware,
    ];
    /// Rows of which a robot may have several, which go with those of [`Table::OF_A_ROBOT`].
    pub const OWNED_BY_A_ROBOT: &[Self] = &[Self::RobotCounter, Self::HoldToken, Self::LaneMark, Self::Quarantine];
    /// Who may create a row. `task_state` is born with its `task_intake`: the one declared exception.
    pub const fn born_by(self) -> Writer {
        match self {
            Self::TaskState => Writer::Task,
            other => other.writer(),
        }
    }
    /// Where the audit of a service is; none: it decides nothing for anybody.
    pub fn audit_of(writer: Writer) -> Option<Self> {
        AUDITS.iter().find(|(of, _)| *of == writer).map(|(_, table)| *table)
    }
    /// Where the audit of the service of this name is.
    pub fn audit_named(service: &str) -> Option<Self> {
        AUDITS.iter().find(|(of, _)| of.as_str() == service).map(|(_, table)| *table)
    }
    /// Whether its rows say how far a service has read.
    pub const fn is_mark(self) -> bool {
        matches!(self, Self::FleetMark | Self::OtaMark)
    }
    /// Whether it is an audit, which only notes of items write.
    pub fn is_audit(self) -> bool {
        AUDITS.iter().any(|(_, table)| *table == self)
    }
    /// The services that have an audit, and where it is.
    pub const fn audits() -> &'static [(Writer, Self)] {
        AUDITS
    }
}

/// A stream of facts in commit order. Row changes go to the log of their writer; robots' events have one of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Log {
    /// Rows of task intake, in `task_event`.
    Task,
    /// Rows of fleet, in `fleet_event`.
    Fleet,
    /// Rows of telemetry, in `telemetry_event`.
    Telemetry,
    /// `robot_inbox`: EVENT and CRITICAL of robots, acknowledged from here. Written by telemetry.
    RobotInbox,
    /// Rows of software, in `ota_event`.
    Ota,
    /// Copies of stops, in `stop_event`.
    Stop,
    /// Rows of identity, in `identity_event`.
    Identity,
}

impl Log {
    /// All logs.
    pub const ALL: [Log; 7] =
        [Log::Task, Log::Fleet, Log::Telemetry, Log::RobotInbox, Log::Ota, Log::Stop, Log::Identity];
    /// Its name in SQL.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Task => "task_event",
            Self::Fleet => "fleet_event",
            Self::Telemetry => "telemetry_event",
            Self::RobotInbox => "robot_inbox",
            Self::Ota => "ota_event",
            Self::Stop => "stop_event",
            Self::Identity => "identity_event",
        }
    }
    /// The one service that writes it.
    pub const fn writer(self) -> Writer {
        match self {
            Self::Task => Writer::Task,
            Self::Fleet => Writer::Fleet,
            Self::Telemetry | Self::RobotInbox => Writer::Telemetry,
            Self::Ota => Writer::Ota,
            Self::Stop => Writer::Stop,
            Self::Identity => Writer::Identity,
        }
    }
    /// The log that row changes of `writer` go to.
    pub const fn of_writer(writer: Writer) -> Self {
        match writer {
            Writer::Task => Self::Task,
            Writer::Fleet => Self::Fleet,
            Writer::Telemetry => Self::Telemetry,
            Writer::Ota => Self::Ota,
            Writer::Stop => Self::Stop,
            Writer::Identity => Self::Identity,
        }
    }
}

/// Name of one row.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key {
    /// Its table.
    pub table: Table,
    /// Its id, unique within site and table.
    pub id: Arc<str>,
}

impl Key {
    /// A key.
    pub fn new(table: Table, id: impl AsRef<str>) -> Self {
        Self { table, id: Arc::from(id.as_ref()) }
    }
}

/// Number of writes of one row, from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, Default)]
pub struct Revision(pub u64);

impl Revision {
    /// The revision after the next write.
    #[must_use]
    pub const fn next(self) -> Self {
        Self(self.0 + 1)
    }
}

/// Position in the commit order of one store. Starts at unix ms of the store's creation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, Default)]
pub struct Seq(pub u64);

/// The few columns that a list may filter and sort by.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Index {
    /// State number of the row, if it has states.
    pub state: Option<i64>,
    /// Owner of the row (robot of an attempt, task of a request).
    pub parent: Option<Arc<str>>,
    /// Sort key.
    pub order: Option<i64>,
}

/// The two ways of the body of a record, within its `impl`: serde's code for it is compiled here, once, and not where it is read and written.
macro_rules! body_is_json {
    () => {
        fn body(&self) -> std::sync::Arc<str> {
            $crate::rows::written(self)
        }
        fn of_row(row: &$crate::rows::Row) -> Result<Self, $crate::rows::BadRow> {
            $crate::rows::read(row)
        }
    };
}
pub(crate) use body_is_json;

/// Plain data as JSON.
pub(crate) fn written(data: &impl Serialize) -> Arc<str> {
    // Plain data serde_json cannot fail to write.
    serde_json::to_string(data).map_or_else(|e| unreachable!("plain data is not JSON: {e}"), Arc::from)
}

pub(crate) fn read<R: Record>(row: &Row) -> Result<R, BadRow> {
    serde_json::from_str(&row.body).map_err(|source| BadRow { key: row.key.clone(), source: Arc::new(source) })
}

/// A core type that is a row of control.db. The body is JSON.
pub trait Record: Serialize + DeserializeOwned + Clone + Send + Sync + 'static {
    /// Where it is kept.
    const TABLE: Table;
    /// Its id within the table.
    fn id(&self) -> String;
    /// Its index columns.
    fn index(&self) -> Index {
        Index::default()
    }
    /// Its key.
    fn key(&self) -> Key {
        Key::new(Self::TABLE, self.id())
    }
    /// The row body.
    fn body(&self) -> Arc<str>;
    /// Reads it back; an error names the row.
    fn of_row(row: &Row) -> Result<Self, BadRow>;
}

/// One stored row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// Its name.
    pub key: Key,
    /// Writes so far.
    pub revision: Revision,
    /// Index columns.
    pub index: Index,
    /// What the row holds, as JSON.
    pub body: Arc<str>,
}

impl Row {
    /// Reads the body; an error names the row.
    pub fn decode<R: Record>(&self) -> Result<R, BadRow> {
        R::of_row(self)
    }
}

/// A row whose body is not what its table holds.
#[derive(Clone, Debug, thiserror::Error)]
#[error("row {key:?} cannot be read")]
pub struct BadRow {
    key: Key,
    #[source]
    source: Arc<serde_json::Error>,
}

impl BadRow {
    /// Whether the row is whole and holds a value that this build does not know; else its text is damaged.
    pub fn is_unknown(&self) -> bool {
        self.source.is_data()
    }
    /// What is not known of it, in a few words.
    pub fn value(&self) -> String {
        let told = self.source.to_string();
        let end = told.find(", expected").or_else(|| told.find(" at line")).unwrap_or(told.len());
        told[..end].chars().take(128).collect()
    }
}

/// Selects rows with which a reading of the store begins.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RowSelection {
    /// A table whole: it holds only what is alive, or is bounded by count.
    Whole(Table),
    /// Rows of a table in one of these states, by its index of states.
    InStates(Table, Vec<i64>),
    /// Rows by their keys; what is not there is left out.
    Rows(Vec<Key>),
    /// Rows of a table, by its index of parents, of each row of another table that is read or named.
    OfParents {
        /// Of which rows are read.
        table: Table,
        /// Where their parents are.
        parents: Table,
    },
}

/// Which rows the rows just read name. What it names is read at the same moment, and asked in turn.
pub type Naming = fn(&[Row]) -> Vec<Key>;

/// One entry of a log: a row change with its after-image, or a fact.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Its number; number order is commit order.
    pub seq: Seq,
    /// Its log.
    pub log: Log,
    /// The row that changed; none for a fact.
    pub table: Option<Table>,
    /// Row id, or the fact's subject.
    pub subject: Arc<str>,
    /// The row's revision after the change; 0 for a fact.
    pub revision: Revision,
    /// Index columns of the row after the change.
    pub index: Index,
    /// After-image of the row, or the fact. None: the row was deleted.
    pub body: Option<Arc<str>>,
    /// What happened.
    pub kind: Arc<str>,
    /// On whose behalf.
    pub actor: Arc<str>,
    /// The request behind it.
    pub request_id: Option<Arc<str>>,
    /// UTC of the wall when committed, unix ms.
    pub at_unix_ms: i64,
}
