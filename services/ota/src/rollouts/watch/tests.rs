//! What a watcher is told of a roll-out on whose trial tasks end.

use super::{Countdowns, RolloutWatcher};
use midshift_core::fleet::rows::RobotCounter;
use midshift_core::gates::{FailureEvidence, TaskTally};
use midshift_core::identity::Caller;
use midshift_core::ids::{BundleId, RobotId, RolloutId};
use midshift_core::robot_events::WorkStats;
use midshift_core::rollout::Board;
use midshift_core::rollout::projection::{RevisedRow, RolloutProjection};
use midshift_core::rollout::rows::{Act, Bundle, Countdown, Moments, Phase, Rollout, RolloutRobot, Step, WayBack};
use midshift_core::rollout::spec::RolloutSpec;
use midshift_core::rows::{Record, Revision};
use midshift_core::site::{DEMO, text};
use midshift_core::time::{Now, SiteTime, Utc};
use midshift_proto::ota::v1;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

fn revised<K: From<String>, R: Record>(row: R) -> (K, RevisedRow<R>) {
    (row.id().into(), RevisedRow { revision: Revision(1), row })
}

fn bundle(bundle: BundleId) -> Bundle {
    Bundle {
        bundle,
        name: "walk".into(),
        version: "1.5.0".into(),
        manifest_length: 1,
        length: 1,
        room: 2,
        hardware: BTreeSet::new(),
        needs: "restart".into(),
        hard_stop_codes: BTreeSet::new(),
        is_irreversible: false,
        has_base: false,
        requires: BTreeMap::new(),
        rollback_index: None,
        listed: true,
        revoked: None,
        published: Utc(0),
        ended: None,
    }
}

/// A wave that is watched for a minute.
fn soaking(bundle: BundleId) -> Rollout {
    Rollout {
        rollout_id: id(),
        spec: Arc::new(RolloutSpec::new(bundle)),
        phase: Phase::Soaking,
        wave: 0,
        pauses: BTreeSet::new(),
        version: 1,
        generation: 1,
        in_flight: 0,
        soak: Some(Countdown::new(0, 60_000)),
        exposure: None,
        wave_sizes: vec![1],
        promoted: 0,
        verdicts: Vec::new(),
        abort: None,
        second_pass: false,
        revert_of: None,
        supersedes: BTreeSet::new(),
        superseded_by: None,
        tasks: FailureEvidence::default(),
        counted: Arc::default(),
        efforts: Default::default(),
        created: Act { person: None, actor: "ana".into(), reason: String::new(), at: Utc(0) },
        approved: None,
        started: Some(Utc(0)),
        resumed: None,
        since: Utc(0),
        outcome: None,
        refusals_seen: BTreeSet::new(),
    }
}

fn on_trial() -> RolloutRobot {
    RolloutRobot {
        rollout_id: id(),
        robot_id: robot_id(),
        wave: 0,
        rank: 0,
        step: Step::Trial,
        since: Utc(0),
        from_version: "1.4.0".into(),
        directive_generation: 1,
        signed: Utc(0),
        way_back: WayBack::default(),
        drain_id: None,
        ready: false,
        grant: None,
        not_used: false,
        attempted: true,
        failure: None,
        why: None,
        again: false,
        before: TaskTally::default(),
        effort_before: Default::default(),
        moments: Moments { on_trial: Some(Utc(0)), ..Moments::default() },
        lost: None,
    }
}

fn id() -> RolloutId {
    RolloutId::parse("walk-1.5.0").expect("an id")
}

fn robot_id() -> RobotId {
    RobotId::parse("r1").expect("an id")
}

struct Rig {
    view: RolloutProjection,
    now: Now,
}

impl Rig {
    fn new() -> Self {
        let site = Arc::new(text::parse(DEMO).expect("the demo reads"));
        let mut view = RolloutProjection::new(site, Now::default(), Now::default());
        let bundle_id = BundleId::parse(&"ab".repeat(32)).expect("an id");
        view.bundles.extend([revised(bundle(bundle_id.clone()))]);
        view.rollouts.extend([revised(soaking(bundle_id))]);
        view.robots.extend([revised(on_trial())]);
        Self { view, now: Now::default() }
    }
    /// So many tasks have ended well on trial.
    fn ended(&mut self, succeeded: u64) {
        self.view.counters.extend([revised(RobotCounter {
            robot_id: robot_id(),
            software: "1.5.0".into(),
            succeeded,
            failures: BTreeMap::new(),
            stats: WorkStats::default(),
            errands: WorkStats::default(),
            attached_ms: 0,
            counted: Utc(0),
            energy_sums: Default::default(),
        })]);
    }
    fn pass(&mut self, secs: u64) {
        self.now.site = SiteTime(self.now.site.0 + secs * 1_000);
    }
    fn next(&self, told: &mut RolloutWatcher) -> Option<v1::WatchRolloutResponse> {
        let next = told.next(&self.view, &Board::new(), &self.now, &id(), &Caller::local());
        next.expect("it is there").0
    }
}

fn watcher(countdowns: Countdowns) -> RolloutWatcher {
    RolloutWatcher { countdowns, rollout: None, robots: BTreeMap::new() }
}

#[test]
fn a_task_that_ends_on_trial_is_told_though_no_row_of_the_roll_out_changes() {
    let mut rig = Rig::new();
    let mut told = watcher(Countdowns::WithChanges);
    let first = rig.next(&mut told).expect("the whole");
    assert_eq!((first.robots.len(), first.rollout.map(|r| r.unexposed)), (1, Some(1)));
    rig.pass(5);
    assert_eq!(rig.next(&mut told), None, "time that passes is no change");
    rig.ended(1);
    let news = rig.next(&mut told).expect("a task has ended");
    assert_eq!(news.robots[0].trial, Some(v1::TaskTally { succeeded: 1, failed: 0 }));
    assert_eq!(rig.next(&mut told), None, "it is told once");
    rig.ended(2);
    let news = rig.next(&mut told).expect("it has worked enough");
    assert_eq!((news.robots.len(), news.rollout.map(|r| r.unexposed)), (1, Some(0)));
}

#[test]
fn what_is_left_of_a_soak_is_told_as_it_passes_to_whoever_follows_it() {
    let mut rig = Rig::new();
    let mut told = watcher(Countdowns::Followed);
    let left = |message: Option<v1::WatchRolloutResponse>| {
        message.and_then(|m| m.rollout).and_then(|r| r.soak_left).map(|left| left.seconds)
    };
    assert_eq!(left(rig.next(&mut told)), Some(60));
    assert_eq!(left(rig.next(&mut told)), None, "the same moment");
    rig.pass(1);
    let news = rig.next(&mut told);
    assert_eq!(news.as_ref().map(|m| m.robots.len()), Some(0));
    assert_eq!(left(news), Some(59));
}
