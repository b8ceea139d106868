//! Roll-outs over rows in memory: the real planner of roll-outs, fleet's real drains and budgets, and robots that obey
//! their section `update` as agents do, one second at a time.
//!
//! Invariant: every item finds its rows as it expects them, and after each turn a projection built from the rows equals
//! the one that was kept.

mod aborts;
mod agents;
mod asks;
mod drains_and_grants;
mod ended;
mod endings;
mod held_back;
mod jams;
mod keyless;
mod lost;
mod newcomers_and_pins;
mod once;
mod people;
mod reach;
mod recovery;
mod refusals;
mod retention;
mod reverts_and_second_pass;
mod sequences;
mod staging;
mod steps;
mod trial_and_gates;
mod waves_and_matching;
mod ways_back;

use crate::drain_request::ReleasedBy;
use crate::fleet;
use crate::fleet::Board;
use crate::fleet::maintenance::{budget, drain};
use crate::fleet::rows::{
    DrainState, HolderState, Place, PlaceHolder, RobotAuthority, RobotControl, RobotCounter, RobotHolder,
};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AreaId, BundleId, DrainId, RobotId, RolloutId, WaypointId};
use crate::item::{Expect, Item, Write};
use crate::policy::AreaPolicy;
use crate::reason::{Code, Reason, Refusal};
use crate::robot::{Fault, HardwareStop, Inventory, Lane, Load, ReportedState, Vitals};
use crate::robot_events::{InboxEntry, InboxItem, RobotEvent, Sample, SampleBody, WorkStats};
use crate::rollout::commands::carry_out::{carry_out, decide_request};
use crate::rollout::commands::check::check_command;
use crate::rollout::decision::directive::{Order, Sign};
use crate::rollout::decision::plan::Plan;
use crate::rollout::projection::requests::{Command, Verb};
use crate::rollout::projection::rows::{
    AreaBundle, Bundle, Outcome, Phase, RobotSoftware, Rollout, RolloutRobot, Step,
};
use crate::rollout::projection::spec::{RolloutSpec, Wave};
use crate::rollout::projection::{RolloutProjection, RowMap};
use crate::rollout::robots::{due, machine};
use crate::rollout::{absorb, cycle};
use crate::rows::{Entry, Key, Log, Record, Revision, Row, Seq, Table};
use crate::session::{LaneMark, Session};
use crate::site::{DEMO, PlaceKind, Site};
use crate::time::{LinkTime, Now, SiteTime, Utc};
use crate::update::{DesiredUpdate, Goal, UpdateEvent, UpdateReport, UpdateState};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A directive may be taken for so long, milliseconds.
const DIRECTIVE_LIVES_MS: u64 = 7 * 24 * 3_600_000;

/// Where robots stand unless a test says otherwise.
const BAY: &str = "park-1";

/// Milliseconds since 1970 at which each test begins: a Friday morning.
const BEGIN: i64 = 1_795_000_000_000;

/// What a robot does with a bundle that it is given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Fate {
    /// It comes through.
    #[default]
    Good,
    /// It goes back by itself, still on probation.
    BadAtStart,
    /// Nothing is heard of it after the switch.
    Silent,
    /// It stays on probation.
    Probation,
    /// It never asks to activate.
    NeverReady,
    /// It does not get any bytes.
    NoBytes,
    /// It does not take the bundle.
    Unfit,
    /// It does not take the bundle for this reason.
    Refuses(Code),
    /// It takes permissions and does not use them.
    Dawdles,
    /// It gave up what it kept.
    KeepsNothing,
    /// It takes no order to go back, whatever it says.
    Stubborn,
}

/// One robot as the server meets it.
#[derive(Clone, Debug)]
struct Robot {
    id: RobotId,
    epoch: u64,
    hb: u64,
    events: u64,
    version: String,
    kept: String,
    report: Option<UpdateReport>,
    seen_grant: u64,
    /// The directive that it looked at last and did not take.
    judged: String,
    fate: Fate,
    is_off: bool,
    /// It gets no tasks.
    idles: bool,
    stop: HardwareStop,
    /// What it carries.
    load: Option<Load>,
    at: &'static str,
}

/// Envelopes of tests: generation, bundle, and when it was signed, as text.
struct Plain;

impl Sign for Plain {
    fn directive(&self, order: &Order) -> String {
        format!("{} {} {}", order.generation, order.bundle, order.issued_at.0)
    }
}

fn rollout_id(text: &str) -> RolloutId {
    RolloutId::parse(text).expect("an id")
}

fn robot_id(n: usize) -> RobotId {
    RobotId::parse(&format!("r{n:03}")).expect("an id")
}

fn bundle_id(n: u32) -> BundleId {
    BundleId::parse(&format!("{n:064x}")).expect("an id")
}

fn hall() -> AreaId {
    AreaId::parse("hall").expect("an id")
}

/// A factory in which a roll-out runs.
struct Rig {
    now: Now,
    seq: u64,
    rows: BTreeMap<Key, Row>,
    feed: Vec<Entry>,
    ota: RolloutProjection,
    ota_at: usize,
    fleet: fleet::projection::FleetProjection,
    fleet_at: usize,
    board: Board,
    heard: BTreeSet<RobotId>,
    robots: Vec<Robot>,
    /// Robots on trial end a task each second.
    works: bool,
    /// What a task costs a robot with a new version, milliwatt-hours. With the old one it is 10.
    trial_energy_mwh: u64,
    /// Fleet does nothing.
    fleet_sleeps: bool,
    /// The service has no key that robots know.
    keyless: bool,
    checks_rebuild: bool,
}

impl Rig {
    /// So many robots, parked in the hall, of which all may be out of work at once, and bundles 1, 2 and 3.
    fn new(count: usize) -> Self {
        let site: Arc<Site> = Arc::new(crate::site::text::parse(DEMO).expect("the demo reads"));
        let now = Now { site: SiteTime(0), link: LinkTime(1_000_000), utc: Utc(BEGIN), wall: Utc(BEGIN), jump: None };
        let mut rig = Self {
            now,
            seq: 0,
            rows: BTreeMap::new(),
            feed: Vec::new(),
            ota: RolloutProjection::new(site.clone(), now, now),
            ota_at: 0,
            fleet: fleet::projection::FleetProjection::new(site, now, now),
            fleet_at: 0,
            board: Board::new(),
            heard: BTreeSet::new(),
            robots: Vec::new(),
            works: true,
            trial_energy_mwh: 10,
            fleet_sleeps: false,
            keyless: false,
            checks_rebuild: true,
        };
        rig.rules(|s| s.off_work_permille = 1_000);
        for n in 1..=3 {
            rig.put_row(bundle(n));
        }
        (0..count).for_each(|_| rig.arrive());
        rig.tick();
        rig
    }

    /// One more robot comes.
    fn arrive(&mut self) {
        let id = robot_id(self.robots.len());
        self.robots.push(Robot {
            id: id.clone(),
            epoch: 1,
            hb: 0,
            events: 0,
            version: "0.9.0".into(),
            kept: "0.9.0".into(),
            report: None,
            seen_grant: 0,
            judged: String::new(),
            fate: Fate::Good,
            is_off: false,
            idles: false,
            stop: HardwareStop::None,
            load: None,
            at: BAY,
        });
        self.put_row(RobotAuthority { robot_id: id.clone(), holder: RobotHolder::None });
        self.stand(&id);
        self.put_row(RobotControl::new(id));
        self.attach(self.robots.len() - 1, |_| {});
    }

    /// Gives the robot a place to stand in: one bay that holds them all.
    fn stand(&mut self, robot_id: &RobotId) {
        let (state, since) = (HolderState::Inside, self.now.utc);
        let holder = PlaceHolder { robot_id: robot_id.clone(), grant_id: 1, state, since, claimed: false };
        let site = &self.fleet.site;
        let bay = site.find(&WaypointId::parse(BAY).expect("an id")).and_then(|at| site.standing_at(at));
        let place_id = site.place(bay.expect("the demo has this bay")).place_id.clone();
        let mut place = self.row::<Place>(place_id.as_str()).unwrap_or(Place {
            place_id,
            capacity: u32::MAX,
            kind: PlaceKind::Standing,
            holders: Vec::new(),
            quarantine: None,
            cleared: Vec::new(),
        });
        place.holders.push(holder);
        self.put_row(place);
    }

    /// A robot begins a new session, with a changed inventory.
    fn attach(&mut self, n: usize, change: impl FnOnce(&mut Inventory)) {
        let key = Key::new(Session::TABLE, self.robots[n].id.as_str());
        let known = self.rows.get(&key).map(|row| row.decode::<Session>().expect("a session").inventory);
        let mut inventory = known.unwrap_or_else(|| Inventory {
            model: "m1".into(),
            capabilities: vec!["lift".into()],
            labels: BTreeMap::from([("line".into(), if n.is_multiple_of(2) { "even" } else { "odd" }.into())]),
            ..Inventory::default()
        });
        let robot = &mut self.robots[n];
        robot.epoch += 1;
        robot.hb = 0;
        inventory.software.clone_from(&robot.version);
        change(&mut inventory);
        let row = Session { ring: "ring".into(), ..Session::new(robot.id.clone(), robot.epoch, inventory) };
        self.put_row(row);
    }

    // --- the store

    fn entry(
        &mut self,
        log: Log,
        row: Option<(&Key, Revision)>,
        subject: Arc<str>,
        body: Option<Arc<str>>,
        kind: &str,
    ) {
        self.seq += 1;
        self.feed.push(Entry {
            seq: Seq(self.seq),
            log,
            table: row.map(|(key, _)| key.table),
            subject,
            revision: row.map_or(Revision(0), |(_, revision)| revision),
            index: crate::rows::Index::default(),
            body,
            kind: kind.into(),
            actor: "test".into(),
            request_id: None,
            at_unix_ms: self.now.wall.0,
        });
    }

    fn write(&mut self, key: Key, body: Option<Arc<str>>, kind: &str) {
        let revision = self.rows.get(&key).map_or(Revision(1), |row| row.revision.next());
        match &body {
            Some(body) => {
                let index = crate::rows::Index::default();
                self.rows.insert(key.clone(), Row { key: key.clone(), revision, index, body: body.clone() });
            }
            None => drop(self.rows.remove(&key)),
        }
        self.entry(Log::Telemetry, Some((&key, revision)), key.id.clone(), body, kind);
    }

    /// Somebody else's row.
    fn put_row<R: Record>(&mut self, record: R) {
        self.write(record.key(), Some(record.body()), "test.put");
    }

    fn commit(&mut self, items: Vec<Item>) {
        for item in items {
            assert!(item.rows.len() <= crate::limits::ITEM_ROWS_MAX, "an item of {} rows", item.rows.len());
            for change in &item.rows {
                let found = self.rows.get(&change.key).map_or(Expect::Absent, |row| Expect::At(row.revision));
                assert_eq!(change.expect, found, "{:?} of {:?} by {}", change.key, change.kind, item.actor);
            }
            for change in item.rows {
                match change.write {
                    Write::Put { body, .. } => self.write(change.key, Some(body), change.kind),
                    Write::Delete => self.write(change.key, None, change.kind),
                    Write::Keep => {}
                }
            }
            for fact in item.facts {
                self.entry(fact.log, None, fact.subject, Some(fact.body), fact.kind);
            }
        }
    }

    // --- time

    /// One second of everything.
    fn tick(&mut self) {
        self.pass(1_000);
        self.robots_act();
        self.turn();
    }

    fn ticks(&mut self, count: usize) {
        (0..count).for_each(|_| self.tick());
    }

    /// Ticks until it holds; fails after `most` of them.
    fn until(&mut self, most: usize, holds: impl Fn(&Self) -> bool) {
        for _ in 0..most {
            if holds(self) {
                return;
            }
            self.tick();
        }
        panic!("{:#?}", self.ota.robots.values().map(|r| (&r.row.robot_id, r.row.step)).collect::<Vec<_>>());
    }

    /// All clocks go on, and whoever is there sends a heartbeat.
    fn pass(&mut self, ms: u64) {
        self.now.site.0 += ms;
        self.now.link.0 += ms;
        self.now.utc = self.now.utc.plus_ms(ms);
        self.now.wall = self.now.wall.plus_ms(ms);
        for n in 0..self.robots.len() {
            self.beat(n);
        }
    }

    /// One heartbeat of a robot that is there.
    fn beat(&mut self, n: usize) {
        let robot = &mut self.robots[n];
        if robot.is_off {
            return;
        }
        robot.hb += 1;
        let report = ReportedState {
            hb: robot.hb,
            session_epoch: robot.epoch,
            produced: BTreeMap::from([(Lane::Event, robot.events)]),
            vitals: Vitals {
                waypoint: Some(WaypointId::parse(robot.at).expect("an id")),
                battery_permille: 950,
                ..Vitals::default()
            },
            hardware_stop: robot.stop,
            load: robot.load.clone(),
            update: robot.report.clone(),
            ..ReportedState::default()
        };
        let live = NewestHeartbeat {
            robot_id: robot.id.clone(),
            report,
            processed_at: self.now.link,
            processed_site: self.now.site,
            received_unix_ms: self.now.wall.0,
            progress_at: self.now.site,
            clock: None,
        };
        self.heard.insert(robot.id.clone());
        self.board.insert(robot.id.clone(), Arc::new(live));
    }

    /// A turn of the roll-outs, then one of fleet.
    fn turn(&mut self) {
        self.ota_turn();
        if !self.fleet_sleeps {
            self.fleet_turn();
        }
    }

    fn ota_turn(&mut self) {
        self.ota_plan(|_, _| {});
    }

    fn ota_plan(&mut self, ask: impl FnOnce(&mut Self, &mut Plan)) {
        let mut plan = Plan::default();
        let entries = self.feed[self.ota_at..].to_vec();
        self.ota_at = self.feed.len();
        absorb(&mut self.ota, self.now, &entries, &mut plan);
        ask(self, &mut plan);
        let heard = std::mem::take(&mut self.heard);
        let sign: Result<&dyn Sign, Code> = if self.keyless { Err(Code::NoDirectiveKey) } else { Ok(&Plain) };
        cycle(&mut self.ota, self.now, &self.board, &heard, sign, &mut plan);
        assert_eq!(plan.unreadable, Vec::<String>::new());
        self.commit(plan.items);
        if self.checks_rebuild {
            self.assert_rebuilt();
        }
        self.assert_laws();
    }

    fn fleet_turn(&mut self) {
        let items = self.fleet_plan();
        self.commit(items);
    }

    /// What fleet decides, before it is committed.
    fn fleet_plan(&mut self) -> Vec<Item> {
        let mut plan = fleet::Plan::default();
        let entries = self.feed[self.fleet_at..].to_vec();
        self.fleet_at = self.feed.len();
        for entry in &entries {
            let Some(table) = entry.table else { continue };
            let key = Key { table, id: entry.subject.clone() };
            let row = crate::projection::row_of(entry, table);
            self.fleet.absorb(&key, entry.revision, row.as_ref()).expect("a row");
        }
        drain::obey_requests(&mut self.fleet, self.now, &mut plan);
        budget::plan(&mut self.fleet, &self.board, self.now, &mut plan);
        drain::plan(&mut self.fleet, &self.board, self.now, &mut plan);
        plan.items
    }

    /// The service dies and reads everything again.
    fn restart(&mut self) {
        let mut fresh = self.rebuilt();
        fresh.started = self.now;
        // As the service does: the row is as old as the last commit.
        fresh.served.site_ms = self.ota.served_ms(&self.now);
        self.ota_at = self.feed.partition_point(|entry| entry.seq <= fresh.absorbed);
        self.ota = fresh;
    }

    fn rebuilt(&self) -> RolloutProjection {
        let mut view = RolloutProjection::new(self.ota.site.clone(), self.ota.started, self.now);
        let is_read = |table| {
            RolloutProjection::WHOLE.contains(&table)
                || matches!(table, Table::Rollout | Table::RolloutRobot | Table::OtaCommandKey)
        };
        let rows: Vec<Row> = self.rows.values().filter(|row| is_read(row.key.table)).cloned().collect();
        view.load(&rows, Seq(self.seq)).expect("rows read");
        view
    }

    fn assert_rebuilt(&self) {
        let fresh = self.rebuilt();
        let old = &self.ota;
        // What others wrote since is not in it yet: compared is what is its own.
        same(&old.rollouts, &fresh.rollouts);
        same(&old.robots, &fresh.robots);
        same(&old.requests, &fresh.requests);
        same(&old.releases, &fresh.releases);
        same(&old.desired, &fresh.desired);
        same(&old.software, &fresh.software);
        same(&old.quarantines, &fresh.quarantines);
        same(&old.area_bundles, &fresh.area_bundles);
        same(&old.marks, &fresh.marks);
        same(&old.clocks, &fresh.clocks);
        same(&old.bundles, &fresh.bundles);
        same(&old.drains, &fresh.drains);
        same(&old.authority, &fresh.authority);
        assert_eq!(old.open, fresh.open);
        let sizes =
            |view: &RolloutProjection| view.wave_sizes.clone().into_iter().filter(|(_, n)| *n > 0).collect::<Vec<_>>();
        assert_eq!(sizes(old), sizes(&fresh));
    }

    /// What holds after every turn.
    fn assert_laws(&self) {
        for rollout in self.ota.rollouts.values().map(|r| &r.row) {
            let drains: Vec<&DrainId> =
                self.ota.robots_of(&rollout.rollout_id).filter_map(|r| r.drain_id.as_ref()).collect();
            let counted = self.ota.robots_of(&rollout.rollout_id).filter(|r| r.drain_id.is_some() && r.counts());
            assert_eq!(rollout.in_flight as usize, counted.count(), "in flight");
            for r in self.ota.robots_of(&rollout.rollout_id) {
                let due = due::decide_move(&self.ota, &self.board, &self.now, rollout, r);
                let is_in_table = due.as_ref().is_none_or(|due| machine::next(r.step, due).is_some());
                assert!(is_in_table, "{due:?} at {:?}", r.step);
                let waits = crate::rollout::explain::blocked(&self.ota, &self.board, &self.now, rollout, r);
                let until = waits.as_ref().and_then(|waits| waits.deadline);
                assert!(until.is_none_or(|until| until > self.now.utc), "{} waits for the past: {waits:?}", r.robot_id);
            }
            for drain_id in drains {
                assert!(self.ota.requests.contains_key(drain_id.as_str()), "a drain without a request");
                assert!(!self.ota.releases.contains_key(drain_id.as_str()), "a drain that was released");
            }
            assert_eq!(rollout.abort.is_some(), rollout.phase.goes_back(), "an abort is latched");
        }
        for desired in self.ota.desired.values().map(|d| &d.row) {
            if let Some(grant) = &desired.grant {
                assert_eq!(Some(&grant.drain_id), desired.drain_id.as_ref(), "a permission of another drain");
                assert_eq!(desired.goal, Goal::Activate);
            }
        }
    }
}

fn same<R: PartialEq + std::fmt::Debug>(kept: &RowMap<R>, fresh: &RowMap<R>) {
    assert_eq!(kept, fresh, "the projection that was kept, and one built anew");
}

fn fresh_report(state: UpdateState, bundle: &BundleId, directive_generation: u64) -> UpdateReport {
    UpdateReport {
        state,
        bundle: bundle.clone(),
        directive_generation,
        set: None,
        drain_id: None,
        grant_id: 0,
        tries: 0,
        progress_permille: 0,
        reason: None,
    }
}

fn bundle(n: u32) -> Bundle {
    Bundle {
        bundle: bundle_id(n),
        name: "base".into(),
        version: format!("{n}.0.0"),
        manifest_length: 100,
        length: 1_000,
        room: 1_200,
        hardware: BTreeSet::from(["m1".to_owned()]),
        needs: "restart".into(),
        hard_stop_codes: BTreeSet::from([66]),
        is_irreversible: false,
        has_base: false,
        requires: BTreeMap::new(),
        rollback_index: Some(4),
        listed: true,
        revoked: None,
        published: Utc(BEGIN),
        ended: None,
    }
}

/// Bundle 2 in two waves, judged quickly.
fn spec() -> RolloutSpec {
    RolloutSpec {
        waves: vec![Wave::Count(1), Wave::Rest],
        probation_ms: 10_000,
        soak_ms: 10_000,
        exposure_within_ms: 60_000,
        ..RolloutSpec::new(bundle_id(2))
    }
}

/// Four robots of which the canary works with the bundle, and its number.
fn canary_on_trial() -> (Rig, usize) {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let n = rig.order()[0];
    rig.until(60, |r| r.step(n) == Step::Trial);
    (rig, n)
}

/// The same, after an abort: the canary is to go back, and is not heard.
fn canary_on_its_way_back() -> (Rig, usize) {
    let (mut rig, n) = canary_on_trial();
    rig.must("ro", Verb::Abort);
    rig.robots[n].is_off = true;
    rig.until(60, |r| r.step(n) == Step::Reverting);
    (rig, n)
}
