//! What is kept where, of which class, what for and how long: the one list that jobs, metrics and docs/privacy.md are made from, and that the options of
//! messages (`midshift/common/v1/privacy.proto`) are held against.
//!
//! Invariant: each table and each log stands in [`RETENTION_RULES`] once. Nothing here reads a clock or a store.

use crate::limits;
use crate::robot::{Pose, Vitals};
use crate::rows::{Log, Table};
use crate::time::Utc;

/// Milliseconds of an hour.
const HOUR_MS: u64 = 3_600_000;
/// Milliseconds of a day.
const DAY_MS: u64 = 24 * HOUR_MS;

macro_rules! words {
    ($(#[$doc:meta])* $name:ident { $($variant:ident $word:literal, $says:literal;)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum $name { $(#[doc = $says] $variant,)* }
        impl $name {
            /// All of them.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];
            /// As metrics, the page and, in capitals, the wire call it.
            pub const fn as_str(self) -> &'static str { match self { $(Self::$variant => $word),* } }
            /// What it is, as a sentence.
            pub const fn says(self) -> &'static str { match self { $(Self::$variant => $says),* } }
        }
    };
}

words! {
    /// What something is. There is none for images, sound or clouds of points, and none for who is near a robot.
    DataClass {
        None "none", "Nothing of the site: pages, cursors, wrappers.";
        Machine "machine", "How a machine is: charge, faults, clocks, what it can do.";
        Position "position", "Where a robot is or was.";
        PeopleNear "people_near", "That people are near a robot: a zone and a bucket of distance, never who.";
        Person "person", "Which person or program did something, and why in its own words.";
        Credential "credential", "What proves who somebody is. Never shown, never logged.";
        Software "software", "Software of robots, and how far they are with it.";
        Operations "operations", "Work: tasks, grants of places, plans, stops.";
        Site "site", "The map and the rules of the site.";
    }
}

words! {
    /// What something is there for.
    Purpose {
        Call "call", "To carry one call and its answer.";
        Operate "operate", "To give robots work and to keep them apart.";
        Stop "stop", "To stop robots and to know that they stand.";
        Update "update", "To bring software to robots, and to take it back.";
        Diagnose "diagnose", "To find out what went wrong.";
        Account "account", "To tell afterwards who decided what.";
        Identify "identify", "To know who is who.";
    }
}

words! {
    /// How long something is kept.
    Retention {
        Transit "transit", "Not beyond the call.";
        Newest "newest", "Only the newest, which the next one takes the place of.";
        Standing "standing", "As long as what it is about is there.";
        Counted "counted", "The newest so many; the oldest go first.";
        Coarsened "coarsened", "As it came for 24 hours, then coarser, for 30 days in all.";
        Week "week", "7 days.";
        Month "month", "30 days, of what has an end from its end on.";
        Quarter "quarter", "90 days, of what has an end from its end on.";
        Year "year", "400 days.";
    }
}

impl Retention {
    /// What was written before this goes now; none: it does not go by age.
    pub const fn before(self, now: Utc) -> Option<Utc> {
        match self.ms() {
            Some(ms) => Some(Utc(now.0.saturating_sub_unsigned(ms))),
            None => None,
        }
    }
    /// The age at which it goes, milliseconds; none: it does not go by age.
    pub const fn ms(self) -> Option<u64> {
        match self {
            Self::Transit | Self::Newest | Self::Standing | Self::Counted => None,
            Self::Coarsened => Some(limits::STATUS_DAYS * DAY_MS),
            Self::Week => Some(limits::REMEMBER_DAYS * DAY_MS),
            Self::Month => Some(limits::ASKED_DAYS * DAY_MS),
            Self::Quarter => Some(limits::RESETS_KEPT.as_ms()),
            Self::Year => Some(limits::AUDIT_DAYS * DAY_MS),
        }
    }
}

/// The age at which a position is made coarser, milliseconds of the wall.
pub const PRECISE_MS: u64 = limits::POSITION_PRECISE_HOURS * HOUR_MS;

/// Something that outlives the call that it came in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Rows of one table of the store.
    Table(Table),
    /// Entries of one log of the store.
    Log(Log),
    /// STATUS samples as they came, in telemetry.db.
    Samples,
    /// STATUS samples after they were made coarser, in the same place.
    CoarseSamples,
    /// Ranges of samples that never came.
    Gaps,
    /// Newest heartbeats that gateways share.
    Heard,
    /// A file or folder beside the databases.
    File(&'static str),
    /// What a robot itself keeps.
    Robot(&'static str),
}

impl Place {
    /// As metrics and the page call it.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Table(table) => table.name(),
            Self::Log(log) => log.name(),
            Self::Samples => "frame_log",
            Self::CoarseSamples => "frame_log_coarse",
            Self::Gaps => "gap",
            Self::Heard => "robot_last",
            Self::File(name) | Self::Robot(name) => name,
        }
    }
}

/// The rule of one place where something is kept: what it holds, what for, and for how long.
#[derive(Clone, Copy, Debug)]
pub struct RetentionRule {
    /// The place that outlives the call.
    pub place: Place,
    /// What: the first is what the place is there for, the others come with it.
    pub holds: &'static [DataClass],
    /// What for.
    pub purpose: Purpose,
    /// How long.
    pub retention: Retention,
}

impl RetentionRule {
    /// The age beyond which nothing may be here, milliseconds; none: it does not go by age.
    pub const fn age_max_ms(&self) -> Option<u64> {
        match self.place {
            Place::Samples => Some(PRECISE_MS),
            _ => self.retention.ms(),
        }
    }
}

macro_rules! retention_rules {
    ($($place:expr => [$($holds:ident),+] $purpose:ident $retention:ident;)*) => {
        /// The rules of all places where something is kept.
        pub const RETENTION_RULES: &[RetentionRule] = &[$(RetentionRule {
            place: $place,
            holds: &[$(DataClass::$holds),+],
            purpose: Purpose::$purpose,
            retention: Retention::$retention,
        },)*];
    };
}

retention_rules! {
    Place::Table(Table::TaskIntake) => [Operations, Person] Operate Month;
    Place::Table(Table::TaskRequest) => [Operations, Person] Operate Month;
    Place::Table(Table::RequestKey) => [Operations] Operate Week;
    Place::Table(Table::TaskType) => [Site] Operate Standing;
    Place::Table(Table::TaskState) => [Operations, Person] Operate Month;
    Place::Table(Table::Attempt) => [Operations, Machine, Software] Diagnose Month;
    Place::Table(Table::Timer) => [Operations] Operate Standing;
    Place::Table(Table::HoldToken) => [Operations] Operate Standing;
    Place::Table(Table::PlaceGrant) => [Operations, Position] Operate Newest;
    Place::Table(Table::PlaceBlock) => [Operations, Person] Operate Standing;
    Place::Table(Table::RobotAuthority) => [Operations] Operate Newest;
    Place::Table(Table::RobotControl) => [Operations, Person] Operate Standing;
    Place::Table(Table::RobotCounter) => [Machine, Software] Diagnose Month;
    Place::Table(Table::Site) => [Site] Operate Standing;
    Place::Table(Table::AreaPolicy) => [Site] Operate Standing;
    Place::Table(Table::PlannerPolicy) => [Site] Operate Standing;
    Place::Table(Table::DesiredWork) => [Operations] Operate Newest;
    Place::Table(Table::DesiredPolicy) => [Site] Operate Newest;
    Place::Table(Table::ServiceClock) => [None] Operate Newest;
    Place::Table(Table::FleetMark) => [None] Operate Newest;
    Place::Table(Table::Incident) => [Operations, Person] Diagnose Counted;
    Place::Table(Table::Drain) => [Operations, Person] Operate Standing;
    Place::Table(Table::AreaBudget) => [Operations] Operate Newest;
    Place::Table(Table::CommandKey) => [Operations, Person] Operate Week;
    Place::Table(Table::FleetLeader) => [None] Operate Newest;
    Place::Table(Table::Session) => [Machine, Position, Software, Credential] Operate Newest;
    Place::Table(Table::Presence) => [Machine] Operate Newest;
    Place::Table(Table::LaneMark) => [Machine] Operate Month;
    Place::Table(Table::Bundle) => [Software] Update Standing;
    Place::Table(Table::Rollout) => [Software, Person] Update Counted;
    Place::Table(Table::RolloutRobot) => [Software, Machine] Update Counted;
    Place::Table(Table::DrainRequest) => [Operations] Update Standing;
    Place::Table(Table::DrainRelease) => [Operations] Update Standing;
    Place::Table(Table::DesiredUpdate) => [Software] Update Newest;
    Place::Table(Table::RobotSoftware) => [Software, Person] Update Standing;
    Place::Table(Table::Quarantine) => [Software] Update Standing;
    Place::Table(Table::AreaBundle) => [Software] Update Standing;
    Place::Table(Table::OtaMark) => [None] Update Newest;
    Place::Table(Table::OtaClock) => [None] Update Newest;
    Place::Table(Table::OtaCommandKey) => [Software, Person] Update Week;
    Place::Table(Table::OtaLeader) => [None] Update Newest;
    Place::Table(Table::StopRecord) => [Operations, Person, Credential] Stop Quarter;
    Place::Table(Table::Token) => [Person, Credential] Identify Standing;
    Place::Table(Table::TokenName) => [Person] Identify Standing;
    Place::Table(Table::RobotIdentity) => [Machine, Credential, Person] Identify Standing;
    Place::Table(Table::RootCertificate) => [Machine] Identify Standing;
    Place::Table(Table::ServerCertificate) => [Machine] Identify Standing;
    Place::Table(Table::TaskAudit) => [Person, Operations] Account Year;
    Place::Table(Table::FleetAudit) => [Person, Operations] Account Year;
    Place::Table(Table::OtaAudit) => [Person, Software] Account Year;
    Place::Table(Table::StopAudit) => [Person, Operations] Account Year;
    Place::Table(Table::IdentityAudit) => [Person, Machine] Account Year;
    Place::Log(Log::Task) => [Operations, Person] Operate Week;
    Place::Log(Log::Fleet) => [Operations, Person] Operate Week;
    Place::Log(Log::Telemetry) => [Machine, Credential] Operate Week;
    Place::Log(Log::RobotInbox) => [Machine, Operations, Position] Diagnose Week;
    Place::Log(Log::Ota) => [Software, Person] Update Week;
    Place::Log(Log::Stop) => [Operations, Person] Stop Week;
    Place::Log(Log::Identity) => [Person, Credential] Identify Week;
    Place::Samples => [Position, Machine] Diagnose Coarsened;
    Place::CoarseSamples => [Machine, Position] Diagnose Coarsened;
    Place::Gaps => [Machine] Diagnose Counted;
    Place::Heard => [Machine, Position] Operate Newest;
    Place::File("stop/latch") => [Operations, Person] Stop Quarter;
    Place::File("stop/principals") => [Credential, Person] Stop Newest;
    Place::File("stop/roster") => [Machine] Stop Newest;
    Place::File("stop/audit") => [Person, Operations] Account Standing;
    Place::File("stop/log") => [Machine, Operations] Diagnose Counted;
    Place::File("identity") => [Credential] Identify Standing;
    Place::File("releases") => [Software] Update Standing;
    Place::Robot("ledger") => [Operations, Credential] Operate Week;
    Place::Robot("ring") => [Machine, Position] Diagnose Counted;
    Place::Robot("stops") => [Operations, Person] Stop Standing;
}

/// How long rows of a table are kept; [`Retention::Standing`] where the list does not know it.
pub fn retention_of(table: Table) -> Retention {
    let found = RETENTION_RULES.iter().find(|rule| rule.place == Place::Table(table));
    found.map_or(Retention::Standing, |rule| rule.retention)
}

/// One coordinate, as it is kept after [`PRECISE_MS`]: the middle of its stretch of [`limits::POSITION_COARSE_MM`]. Coarse again, it is the same.
pub const fn coarse_mm(mm: i32) -> i32 {
    let stretch = limits::POSITION_COARSE_MM;
    (mm.div_euclid(stretch)).saturating_mul(stretch).saturating_add(stretch / 2)
}

/// A position as it is kept after [`PRECISE_MS`]: where in a grid, and not which way it looked.
#[must_use]
pub const fn coarse(pose: Pose) -> Pose {
    Pose { x_mm: coarse_mm(pose.x_mm), y_mm: coarse_mm(pose.y_mm), theta_mrad: 0 }
}

/// A sample as it is kept after [`PRECISE_MS`]. Waypoints may stand a metre apart: the name of one is a position too, and goes. What was driven stays:
/// the robot has summed it before.
#[must_use]
pub fn coarse_vitals(vitals: Vitals) -> Vitals {
    Vitals { pose: vitals.pose.map(coarse), waypoint: None, ..vitals }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn each_table_and_each_log_is_in_the_list_once() {
        let mut named: Vec<&str> = RETENTION_RULES.iter().map(|rule| rule.place.as_str()).collect();
        let all = named.len();
        named.sort_unstable();
        named.dedup();
        assert_eq!(named.len(), all, "a place stands there twice");
        let tables = Table::ALL.iter().map(|table| Place::Table(*table));
        let missing: Vec<&str> = tables
            .chain(Log::ALL.map(Place::Log))
            .filter(|place| RETENTION_RULES.iter().all(|rule| rule.place != *place))
            .map(Place::as_str)
            .collect();
        assert_eq!(
            missing,
            Vec::<&str>::new(),
            "say in RETENTION_RULES of what class they are and how long they are kept"
        );
    }

    #[test]
    fn who_decided_what_is_kept_as_long_as_the_audit_and_nothing_that_goes_by_age_longer() {
        for table in Table::ALL.iter().filter(|table| table.is_audit()) {
            assert_eq!(retention_of(*table), Retention::Year, "{}", table.name());
        }
        let longest = RETENTION_RULES.iter().filter_map(RetentionRule::age_max_ms).max();
        assert_eq!(longest, Some(limits::AUDIT_DAYS * DAY_MS));
        assert!(
            RETENTION_RULES.iter().all(|rule| rule.retention != Retention::Transit),
            "what is kept outlives its call"
        );
    }

    #[test]
    fn the_words_say_the_limits() {
        let days = |retention: Retention| retention.ms().map(|ms| ms / DAY_MS);
        for (retention, said) in [(Retention::Week, 7), (Retention::Month, 30), (Retention::Quarter, 90)] {
            assert_eq!(days(retention), Some(said), "{}", retention.says());
        }
        assert_eq!((days(Retention::Coarsened), days(Retention::Year)), (Some(30), Some(400)));
        assert_eq!(PRECISE_MS, 24 * HOUR_MS);
    }

    #[test]
    fn a_position_made_coarser_is_near_and_is_no_other_when_it_is_made_coarser_again() {
        let half = limits::POSITION_COARSE_MM / 2;
        let mut seen = BTreeSet::new();
        for mm in [i32::MIN, -5_001, -5_000, -4_999, -1, 0, 1, 2_499, 4_999, 5_000, 12_345, i32::MAX] {
            let kept = coarse_mm(mm);
            assert_eq!(coarse_mm(kept), kept, "{mm}");
            assert!(kept.abs_diff(mm) <= half.unsigned_abs(), "{mm} became {kept}");
            seen.insert(kept);
        }
        assert!(seen.len() > 5);
        assert_eq!(coarse_mm(1), coarse_mm(4_999), "two of one stretch are told apart no more");
        let precise = Pose { x_mm: 1_234, y_mm: -77, theta_mrad: 1_571 };
        assert_eq!(coarse(precise), Pose { x_mm: half, y_mm: -half, theta_mrad: 0 });
    }

    #[test]
    fn a_sample_made_coarser_keeps_all_but_where_it_was() {
        let waypoint = crate::ids::WaypointId::parse("A01").ok();
        assert!(waypoint.is_some());
        let pose = Some(Pose { x_mm: 1, y_mm: 2, theta_mrad: 3 });
        let precise = Vitals { pose, waypoint, battery_permille: 812, odometer_mm: 99_001, ..Vitals::default() };
        let kept = coarse_vitals(precise.clone());
        assert_eq!(kept, Vitals { pose: pose.map(coarse), waypoint: None, ..precise });
        assert_ne!(kept.pose, pose);
        assert_eq!(coarse_vitals(Vitals::default()).pose, None, "nobody knew where it was");
    }
}
