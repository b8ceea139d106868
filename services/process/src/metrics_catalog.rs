//! Every metric that a program of midshift has, with what it says: HELP of a scrape, and docs/metrics.md.
//!
//! Called by `recorder`. Invariant: what a program counts is here, and nothing else (the architecture test).

/// How a metric is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// It only rises, from 0 at the start of the process.
    Counter,
    /// What stands now.
    Gauge,
    /// How often something was at most so much.
    Histogram(Buckets),
}

/// Upper bounds of a histogram's buckets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Buckets {
    /// What a program does: a half millisecond to 10 s.
    Machine,
    /// What a shift does, site time: 1 s to 4 h.
    Shift,
    /// Things in a group.
    Items,
}

impl Buckets {
    /// The bounds, rising.
    pub const fn bounds(self) -> &'static [f64] {
        match self {
            Self::Machine => &[0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0],
            Self::Shift => {
                &[1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 90.0, 120.0, 300.0, 600.0, 1_200.0, 3_600.0, 14_400.0]
            }
            Self::Items => &[1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0],
        }
    }
}

/// One metric.
#[derive(Clone, Copy, Debug)]
pub struct Metric {
    /// As a scrape has it.
    pub name: &'static str,
    /// How it is read.
    pub kind: Kind,
    /// What it says, with its labels.
    pub help: &'static str,
}

const fn counter(name: &'static str, help: &'static str) -> Metric {
    Metric { name, kind: Kind::Counter, help }
}

const fn gauge(name: &'static str, help: &'static str) -> Metric {
    Metric { name, kind: Kind::Gauge, help }
}

const fn seconds(name: &'static str, help: &'static str) -> Metric {
    Metric { name, kind: Kind::Histogram(Buckets::Machine), help }
}

const fn shift(name: &'static str, help: &'static str) -> Metric {
    Metric { name, kind: Kind::Histogram(Buckets::Shift), help }
}

const fn items(name: &'static str, help: &'static str) -> Metric {
    Metric { name, kind: Kind::Histogram(Buckets::Items), help }
}

/// All of them, by name.
pub const METRICS: &[Metric] = &[
    counter("midshift_beacons_total", "Robots' words beside the connection (UDP); `what`: taken or dropped."),
    counter("midshift_clock_jumps_total", "Jumps of the machine's clock that the site clock did not follow."),
    counter(
        "midshift_denials_lost_total",
        "Denied calls that left no row in the audit: too many at once, or the store took none.",
    ),
    counter("midshift_edge_accept_errors_total", "Connections that could not be accepted; `port`, and `of` what."),
    counter("midshift_edge_closed_total", "Connections that ended; `port` and `reason`."),
    gauge("midshift_edge_connections", "Connections that are open; `port`."),
    counter(
        "midshift_edge_denials_left_out_total",
        "Denied calls without a row of their own, since their caller had enough of them; `port`.",
    ),
    counter(
        "midshift_edge_panics_total",
        "Faults of the program that ended one call or connection; `at` which of both.",
    ),
    counter("midshift_edge_refused_total", "Connections that were not let in; `port` and `reason`."),
    gauge("midshift_edge_requests", "Calls that are open; `port`."),
    counter(
        "midshift_edge_requests_denied_inside_total",
        "Calls that a service denied after the port had let them in; `port` and `reason`.",
    ),
    counter("midshift_edge_requests_refused_total", "Calls that the port did not let in; `port` and `reason`."),
    counter(
        "midshift_fleet_commands_again_total",
        "People's commands that were decided anew, since somebody changed their rows meanwhile.",
    ),
    seconds("midshift_fleet_cycle_seconds", "What one turn of the planner thinks, without its commit."),
    counter(
        "midshift_fleet_decisions_taken_back_total",
        "Turns in which the store refused a decision, and its rows were read again.",
    ),
    counter(
        "midshift_fleet_driven_metres_total",
        "Metres that all robots drove, by `work` (task, errand) and `load` (yes, no), as they say; since the store was made.",
    ),
    counter("midshift_fleet_errands_total", "Errands to charge or park that were offered."),
    counter("midshift_fleet_fenced_reports_total", "Reports of robots about work that is theirs no more."),
    counter(
        "midshift_fleet_items_lost_total",
        "Decisions that the store did not take; `conflict`: whether somebody else changed a row first.",
    ),
    gauge("midshift_fleet_leads", "1 in the process whose planner decides."),
    counter("midshift_fleet_offers_total", "Tasks that were offered to a robot."),
    counter("midshift_fleet_place_waits_total", "How often a robot began to wait for a place."),
    counter("midshift_fleet_rebuilds_total", "How often the planner read its rows anew."),
    counter(
        "midshift_fleet_repairs_total",
        "Differences between a robot's heartbeat and the rows that were put right.",
    ),
    gauge(
        "midshift_fleet_robots",
        "Robots that are not offline, by what has them: `does` task, charge, park, update or nothing. Utilisation is the share of task.",
    ),
    gauge(
        "midshift_fleet_robots_waiting_for_charger",
        "Robots with too little charge for work that nothing has: no charger is free for them yet, or they are kept from work.",
    ),
    gauge("midshift_fleet_robots_waiting_for_place", "Robots that wait for a place on their way."),
    counter("midshift_fleet_stale_authority_total", "Messages that robots refused, since their authority had ended."),
    counter("midshift_fleet_takeovers_total", "How often this process began to lead."),
    counter(
        "midshift_fleet_task_attempts_total",
        "How often ended tasks were given to a robot; `class` and `type`. Above `midshift_fleet_tasks_ended_total`: assigned again.",
    ),
    shift(
        "midshift_fleet_task_completion_seconds",
        "Site time from admission to success; `class` by priority (urgent, normal, background) and `type`.",
    ),
    shift(
        "midshift_fleet_task_wait_seconds",
        "Site time from when first only a robot was missing until one took the task, holds included; `class` and `type`; of tasks that a robot took and that have ended.",
    ),
    counter(
        "midshift_fleet_tasks_ended_total",
        "Tasks that ended; `state`, `class` and `type` (32 of them, then `other`).",
    ),
    gauge("midshift_fleet_tasks_open", "Tasks that have not ended."),
    gauge("midshift_fleet_tasks_waiting", "Tasks that wait for a robot, by the `reason` that comes first."),
    seconds("midshift_fleet_turn_seconds", "What one turn of the planner takes with its commit."),
    counter(
        "midshift_fleet_unexplained_total",
        "Robots or tasks that stood long, and nobody can say why. Each is a fault of midshift.",
    ),
    gauge("midshift_identity_failing", "1 while identity cannot read who may do what."),
    gauge("midshift_oldest_row_seconds", "Age of the oldest row; `table`."),
    gauge("midshift_ota_collect_time_seconds", "Unix time of the last look for release files that nothing names."),
    counter(
        "midshift_ota_collected_bytes_total",
        "Bytes of release files that nothing named any more and that were deleted.",
    ),
    counter("midshift_ota_collected_total", "Release files that nothing named any more and that were deleted."),
    counter("midshift_ota_commands_again_total", "People's commands about roll-outs that were decided anew."),
    counter("midshift_ota_directives_signed_total", "Words to robots' updaters that were signed."),
    gauge("midshift_ota_expires_in_seconds", "Until a signed document of the release repository expires; `role`."),
    counter(
        "midshift_ota_items_lost_total",
        "Decisions about roll-outs that the store did not take; `conflict` as for fleet.",
    ),
    gauge("midshift_ota_keyless", "1 while the release repository has no key to sign with."),
    gauge("midshift_ota_leads", "1 in the process that decides about roll-outs."),
    gauge("midshift_ota_quota_bytes", "Bytes that the release repository may have."),
    counter("midshift_ota_rebuilds_total", "How often roll-outs were read anew."),
    counter("midshift_ota_refused_total", "Calls about releases that were refused; `code`."),
    counter("midshift_ota_takeovers_total", "How often this process began to lead roll-outs."),
    gauge("midshift_ota_unnamed_bytes", "Bytes of release files that nothing names and that are not old enough to go."),
    gauge("midshift_ota_used_bytes", "Bytes that the release repository has."),
    gauge("midshift_retention_seconds", "How old a row may become; `table`."),
    counter("midshift_stop_adopted_total", "Fleet stops that this process took over from its disk or another one."),
    counter("midshift_stop_audit_dropped_total", "Notes of the stop service's audit that were lost."),
    gauge("midshift_stop_audit_durable", "1 while the stop service's audit reaches its disk."),
    counter("midshift_stop_check_ins_total", "Check-ins of robots on their stop line."),
    counter("midshift_stop_denials_left_out_total", "Denied stop calls without a note of their own."),
    counter("midshift_stop_engaged_total", "Fleet stops that were engaged."),
    gauge("midshift_stop_follower_failing", "1 while the server cannot follow the stop service."),
    gauge("midshift_stop_latch_durable", "1 while stops reach the stop service's disk."),
    gauge("midshift_stop_lines", "Stop lines of robots that are open."),
    counter(
        "midshift_stop_lines_contested_total",
        "Stop lines that were not let in, since another start of the robot was heard.",
    ),
    counter("midshift_stop_refused_total", "Stop calls that were refused; `code`."),
    counter("midshift_stop_reset_total", "Fleet stops that were reset."),
    gauge("midshift_stop_roster", "Robots that the stop service knows."),
    seconds("midshift_store_commit_seconds", "What a group of items takes to be durable."),
    counter("midshift_store_conflicts_total", "Items that were not taken, since a row had changed."),
    seconds("midshift_store_frames_commit_seconds", "What a group of robots' samples takes to be durable."),
    items("midshift_store_group_items", "Items in one group."),
    counter("midshift_store_groups_total", "Groups that were committed."),
    counter("midshift_store_retries_total", "Groups that were tried again, since the database asked for it."),
    counter("midshift_store_unknown_total", "Items of which nobody knows whether they are in the store."),
    gauge("midshift_store_wal_bytes", "Length of SQLite's log beside a `file`."),
    counter("midshift_task_admitted_total", "Tasks that were admitted."),
    seconds("midshift_task_commit_seconds", "What an admission takes to be durable."),
    counter("midshift_task_refused_total", "Submits and other calls about tasks that were refused; `code`."),
    counter("midshift_telemetry_clones_total", "Second machines with a robot's name."),
    counter("midshift_telemetry_coarsened_total", "Positions that were made coarser by age."),
    counter(
        "midshift_telemetry_commits_slowed_total",
        "Groups of events that waited, since their robot sent more than it may.",
    ),
    gauge("midshift_telemetry_cut_off", "1 while sessions end here, since the database is not reached."),
    counter("midshift_telemetry_device_keys_changed_total", "Robots that came with another device key than before."),
    seconds("midshift_telemetry_event_commit_seconds", "What robots' events take to be durable."),
    counter("midshift_telemetry_expects_total", "How often a robot was asked to send events again from a number on."),
    counter("midshift_telemetry_facts_total", "Facts that were told to fleet; `kind`."),
    seconds("midshift_telemetry_heartbeat_commit_seconds", "What heartbeats take to be shared between processes."),
    counter(
        "midshift_telemetry_heartbeats_dropped_total",
        "Heartbeats that were not shared between processes: too many waited.",
    ),
    counter("midshift_telemetry_heartbeats_too_long_total", "Heartbeats with a list longer than one may be."),
    counter("midshift_telemetry_heartbeats_total", "Heartbeats that were taken."),
    counter("midshift_telemetry_hellos_put_off_total", "Robots that were asked to come back a little later."),
    counter("midshift_telemetry_installed_rejected_total", "Robots whose list of installed software was not believed."),
    counter("midshift_telemetry_pruned_bytes_total", "Bytes of samples that were deleted by age."),
    gauge("midshift_telemetry_sessions", "Robots with a session in this process."),
    counter("midshift_telemetry_status_gaps_total", "Samples that never came."),
    counter("midshift_telemetry_status_replayed_total", "Samples that came late, from a robot's own memory."),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metrics_stand_in_order_and_once() {
        for pair in METRICS.windows(2) {
            assert!(pair[0].name < pair[1].name, "{}", pair[1].name);
        }
    }
}
