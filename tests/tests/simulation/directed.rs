//! Roll-outs in the same room, directed: each run is brought to one situation and must come out of it in one way. Every law of the
//! witness holds in them too.

use crate::client::Wish;
use crate::disk::Mood;
use crate::net::LineState;
use crate::orders::Order;
use crate::room::{Naive, Room, RoomConfig};
use crate::run::{spec, steer};
use crate::software::{BAD_AT_START, GOOD, HANGS};
use midshift_agent::body::Body as _;
use midshift_core::reason::Code;
use midshift_core::rollout::bugs;
use midshift_core::rollout::rows::{Outcome, Pause, Phase, Rollout};
use midshift_core::site::DEMO;
use midshift_core::update::UpdateState;
use midshift_proto::ota::v1::RolloutSpec;
use midshift_proto::ota::v1::rollout_wave::Size;
use midshift_sim::faults::FaultRates;
use std::collections::BTreeSet;

const PATIENCE_MS: u64 = 900_000;

pub fn config(seed: u64, robots: usize, naive: Naive) -> RoomConfig {
    RoomConfig {
        seed,
        robots,
        skews: Vec::new(),
        latency_ms: 20,
        faults: FaultRates::none(),
        naive,
        planners: 1,
        stops: false,
        site: DEMO.to_owned(),
        players: Vec::new(),
        newer: None,
    }
}

/// A room in which nothing goes wrong by itself.
pub struct Scene {
    /// The room.
    pub room: Room,
    robots: usize,
    asked: u64,
}

impl Scene {
    pub fn open(seed: u64, robots: usize) -> Self {
        Self::from_seed(seed, robots, Naive::default())
    }
    /// With naive rules.
    pub fn from_seed(seed: u64, robots: usize, naive: Naive) -> Self {
        Self::with(config(seed, robots, naive))
    }
    /// One robot's machine is not there yet.
    pub fn late(seed: u64, robots: usize, late: usize) -> Self {
        let mut scene = Self::closed(&config(seed, robots, Naive::default()));
        scene.room.crash_agent(late, false);
        scene.pass(6_000);
        scene
    }
    fn closed(config: &RoomConfig) -> Self {
        Self { room: Room::open(config).expect("a room"), robots: config.robots, asked: 0 }
    }
    pub fn with(config: RoomConfig) -> Self {
        let mut scene = Self::closed(&config);
        // Every robot is heard.
        scene.pass(6_000);
        scene
    }
    pub fn until(&mut self, what: &str, done: impl FnMut(&mut Room) -> bool) {
        if let Err(error) = self.room.until(what, PATIENCE_MS, done) {
            let mut seen = self.room.observer.lock();
            let rows: Vec<String> = seen
                .changes()
                .rollouts()
                .map(|r| format!("{} {:?} wave {} {:?}", r.rollout_id, r.phase, r.wave, r.pauses))
                .collect();
            panic!("{error:#}: {:#?} {rows:#?} {:#?}", seen.findings(), seen.counts());
        }
    }
    pub fn pass(&mut self, ms: u64) {
        let until_ms = self.room.now_ms() + ms;
        self.until("time to pass", |room| room.now_ms() >= until_ms);
    }
    pub fn order(&mut self, order: Order) {
        self.room.desk.wish(Wish::Order(Box::new(order)));
    }
    pub fn answered(&mut self) {
        self.until("an answer", |room| room.desk.is_empty());
    }
    /// Their own safety systems stop these bodies, and they brake until they stand.
    pub fn stop_hard(&mut self, robots: &[usize], lasts_ms: u64) {
        robots.iter().for_each(|robot| self.room.stop_body(*robot, lasts_ms));
        self.until("the stopped bodies to stand", |room| {
            let now = room.time.site();
            robots.iter().all(|robot| room.hall.robots()[*robot].standstill(now))
        });
    }
    /// Lets a robot go on that was stopped.
    pub fn let_go(&mut self, robot: usize) {
        self.asked += 1;
        let robot_id = self.room.robot_id(robot).to_string();
        self.order(Order::LetGo { robot_id, request_id: format!("go-{}", self.asked) });
        self.answered();
    }
    pub fn all(&self) -> BTreeSet<usize> {
        (0..self.robots).collect()
    }
    pub fn begin(&mut self, id: &str, version: &str, change: impl FnOnce(&mut RolloutSpec)) {
        self.begin_for(id, version, &self.all(), false, change);
    }
    pub fn begin_for(
        &mut self,
        id: &str,
        version: &str,
        robots: &BTreeSet<usize>,
        supersede: bool,
        change: impl FnOnce(&mut RolloutSpec),
    ) {
        let mut spec = spec(&self.room, version, robots);
        change(&mut spec);
        self.order(Order::Begin { id: id.to_owned(), spec: Box::new(spec), supersede });
        let begun = id.to_owned();
        self.until("the roll-out to begin", move |room| {
            room.observer.lock().changes().rollout(&begun).is_some_and(|row| row.started.is_some())
        });
    }
    pub fn row(&self, id: &str) -> Rollout {
        self.room.observer.lock().changes().rollout(id).expect("was written down").clone()
    }
    pub fn comes_to(&mut self, id: &str, phase: Phase) {
        let what = format!("{id} to come to {phase:?}");
        self.until(&what, |room| room.observer.lock().changes().rollout(id).is_some_and(|row| row.phase == phase));
    }
    pub fn ends(&mut self, id: &str) -> Rollout {
        let what = format!("{id} to end");
        self.until(&what, |room| room.observer.lock().changes().rollout(id).is_some_and(|row| row.phase.is_over()));
        self.row(id)
    }
    /// Everything has ended well: drains released, touched robots back.
    pub fn comes_to_rest(&mut self) {
        self.until("everything to come to rest", |room| {
            room.observer.lock().changes().ended().iter().all(|(_, holds, _)| *holds)
        });
    }
    /// So many tasks.
    pub fn work(&mut self, tasks: usize) {
        let site = crate::room::site().expect("a site");
        let wishes = crate::plan::background(self.room.now_ms(), tasks, &site).expect("tasks");
        wishes.into_iter().for_each(|task| self.room.desk.wish(Wish::Submit(Box::new(task))));
    }
    /// Laws that were broken.
    pub fn findings(&self) -> Vec<String> {
        self.room.observer.lock().findings().to_vec()
    }
    /// Robots whose ledger says this.
    pub fn robots_in(&self, state: UpdateState) -> Vec<usize> {
        robots_in(&self.room, self.robots, state)
    }
    pub fn some_is_in(&mut self, state: UpdateState) -> usize {
        let robots = self.robots;
        self.until(&format!("a robot in {state:?}"), |room| !robots_in(room, robots, state).is_empty());
        self.robots_in(state)[0]
    }
    pub fn runs(&self, robot: usize) -> Option<String> {
        let robot_id = self.room.robot_id(robot);
        self.room.observer.lock().changes().runs(&robot_id)
    }
    pub fn bundle(&self, version: &str) -> Option<String> {
        Some(self.room.software.bundle(version).to_string())
    }
    pub fn all_run(&self, version: Option<&str>) {
        let bundle = version.and_then(|version| self.bundle(version));
        for robot in 0..self.robots {
            assert_eq!(self.runs(robot), bundle, "robot {robot}");
        }
    }
    pub fn activations(&self) -> u64 {
        self.room.observer.lock().checks().get("I18 no activation after the word to stand still").copied().unwrap_or(0)
    }
}

fn robots_in(room: &Room, robots: usize, state: UpdateState) -> Vec<usize> {
    let mut seen = room.observer.lock();
    (0..robots).filter(|robot| seen.changes().state(&room.robot_id(*robot)) == Some(state)).collect()
}

pub fn waves(spec: &mut RolloutSpec, sizes: &[Size]) {
    let wave = |size: &Size| midshift_proto::ota::v1::RolloutWave { size: Some(size.clone()) };
    spec.waves = sizes.iter().map(wave).collect();
}

#[test]
fn a_small_fleet_takes_a_good_bundle_without_a_person_and_each_verdict_says_what_it_proves() {
    let mut scene = Scene::open(1, 6);
    scene.begin("good", GOOD[0], |spec| waves(spec, &[Size::Count(1), Size::Percent(25), Size::Rest(true)]));
    let row = scene.ends("good");
    assert_eq!((row.phase, row.verdicts.len()), (Phase::Completed, 3), "{row:?}");
    let proved: Vec<_> = row.verdicts.iter().map(|v| (v.outcome, v.attempted, v.robots.upper_bound_permille)).collect();
    assert!(proved.iter().all(|(outcome, ..)| *outcome == Outcome::PromotedUnproven), "{proved:?}");
    assert_eq!(proved.iter().map(|(_, n, _)| *n).collect::<Vec<_>>(), [1, 3, 6]);
    assert_eq!(proved[0].2, 950, "{proved:?}");
    assert!(proved.windows(2).all(|pair| pair[0].2 > pair[1].2), "{proved:?}");
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[0]));
}

#[test]
fn a_bundle_that_is_bad_at_its_start_or_hangs_touches_its_canary_only_and_the_canary_is_back() {
    for (seed, version) in [(2, BAD_AT_START), (3, HANGS)] {
        let mut scene = Scene::open(seed, 6);
        scene.begin("bad", version, |_| {});
        let row = scene.ends("bad");
        assert_eq!((row.phase, row.abort.map(|a| a.touched)), (Phase::Aborted, Some(1)), "{version}");
        scene.comes_to_rest();
        assert_eq!(scene.activations(), 1, "{version}");
        scene.all_run(None);
    }
}

#[test]
fn robots_that_their_own_safety_system_stopped_go_back_and_nothing_moves_until_a_person_says_so() {
    let mut scene = Scene::open(4, 6);
    scene.begin("bad", GOOD[0], |spec| spec.soak = Some(prost_types::Duration { seconds: 600, nanos: 0 }));
    scene.comes_to("bad", Phase::Soaking);
    let canary = scene.some_is_in(UpdateState::Trial);
    scene.stop_hard(&[canary], 120_000);
    let stands = scene.room.hall.robots()[canary].lock().odometers_mm();
    // A hardware stop on trial ends the roll-out by itself, before any person does.
    let row = scene.ends("bad");
    assert_eq!(row.phase, Phase::Aborted);
    assert_eq!(row.abort.map(|a| (a.reason.code, a.hard)), Some((Code::HardwareStopOnTrial, true)));
    scene.order(Order::Abort("bad".to_owned()));
    scene.answered();
    assert_eq!(scene.robots_in(UpdateState::RolledBack), [canary], "it went back while it was stopped");
    assert!(scene.room.is_stopped(canary), "the stop was longer than the way back");
    let stopped = scene.room.hall.robots()[canary].lock().odometers_mm();
    assert_eq!(stopped, stands);
    scene.until("the stop to be released", |room| !room.is_stopped(canary));
    scene.pass(60_000);
    assert_eq!(scene.room.hall.robots()[canary].lock().odometers_mm(), stands, "nobody said that it may go on");
    scene.let_go(canary);
    scene.comes_to_rest();
    scene.all_run(None);
}

#[test]
fn a_server_that_is_killed_in_any_phase_ends_the_roll_out_as_without() {
    let phases = [
        (Phase::Prefetching, GOOD[0], Phase::Completed),
        (Phase::Applying, GOOD[0], Phase::Completed),
        (Phase::Soaking, GOOD[0], Phase::Completed),
        (Phase::Gate, GOOD[0], Phase::Review),
        (Phase::Review, GOOD[0], Phase::Review),
        (Phase::Aborting, BAD_AT_START, Phase::Aborted),
        (Phase::RollingBack, BAD_AT_START, Phase::Aborted),
    ];
    for (seed, (phase, version, end)) in (10..).zip(phases) {
        let mut scene = Scene::open(seed, 3);
        let waits_for_work = end == Phase::Review;
        scene.begin("killed", version, |spec| spec.exposure_tasks = Some(u64::from(waits_for_work)));
        // A way back is short: where nobody has to be waited for, it may be a phase further when it is seen.
        scene.until("the phase to be killed in", |room| {
            let mut seen = room.observer.lock();
            let row = seen.changes().rollout("killed").map(|row| row.phase);
            row.is_some_and(|now| now == phase || (phase.goes_back() && now.goes_back()))
        });
        kill(&mut scene);
        scene.comes_to("killed", end);
        if waits_for_work {
            scene.order(Order::Promote("killed".to_owned()));
            scene.answered();
            scene.until("the next wave", |room| {
                room.observer.lock().changes().rollout("killed").is_some_and(|row| row.promoted == 1)
            });
            scene.order(Order::Abort("killed".to_owned()));
            assert_eq!(scene.ends("killed").phase, Phase::Aborted);
        }
        scene.comes_to_rest();
        if end != Phase::Completed {
            scene.all_run(None);
        }
    }
}

#[test]
fn a_server_that_is_killed_before_a_roll_out_begins_begins_it_as_it_was_asked_to() {
    for (seed, phase) in (40..).zip([Phase::Draft, Phase::Validated, Phase::Approved]) {
        let mut scene = Scene::open(seed, 3);
        let spec = spec(&scene.room, GOOD[0], &scene.all());
        scene.order(Order::Begin { id: "killed".to_owned(), spec: Box::new(spec), supersede: false });
        scene.comes_to("killed", phase);
        kill(&mut scene);
        assert_eq!(scene.ends("killed").phase, Phase::Completed, "{phase:?}");
        scene.comes_to_rest();
        scene.all_run(Some(GOOD[0]));
    }
}

#[test]
fn a_roll_out_that_stands_still_goes_on_standing_when_its_server_was_killed() {
    let mut scene = Scene::open(43, 3);
    scene.begin("killed", GOOD[0], |_| {});
    scene.comes_to("killed", Phase::Applying);
    scene.order(Order::Pause("killed".to_owned()));
    let stands = |room: &mut Room| {
        room.observer.lock().changes().rollout("killed").is_some_and(|row| row.pauses.contains(&Pause::Operator))
    };
    scene.until("it to stand still", stands);
    kill(&mut scene);
    scene.pass(30_000);
    assert!(stands(&mut scene.room));
    scene.order(Order::Resume("killed".to_owned()));
    scene.answered();
    assert_eq!(scene.ends("killed").phase, Phase::Completed);
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[0]));
}

fn kill(scene: &mut Scene) {
    scene.room.crash_server();
    scene.pass(2_000);
    scene.room.restart_server();
}

#[test]
fn a_server_that_is_killed_at_any_step_of_a_robot_ends_the_roll_out_as_without() {
    use UpdateState::{Committing, Downloading, Probation, RollingBack, Staged, Switching, Trial};
    let steps = [Downloading, Staged, Switching, Probation, Trial, Committing, RollingBack];
    for (seed, step) in (20..).zip(steps) {
        let mut scene = Scene::open(seed, 3);
        let back = step == RollingBack;
        scene.begin("killed", GOOD[0], |_| {});
        if back {
            scene.some_is_in(Probation);
            scene.order(Order::Abort("killed".to_owned()));
        }
        scene.some_is_in(step);
        kill(&mut scene);
        let end = if back { Phase::Aborted } else { Phase::Completed };
        assert_eq!(scene.ends("killed").phase, end, "{step:?}");
        scene.comes_to_rest();
        scene.all_run((!back).then_some(GOOD[0]));
    }
}

#[test]
fn a_set_that_dies_after_a_power_cut_at_any_step_leaves_ledger_and_switch_record_of_one_mind() {
    use UpdateState::{Committing, Probation, RollingBack, Switching, Trial};
    let mut fell = 0;
    for (seed, step) in (60..).zip([Switching, Probation, Trial, Committing, RollingBack]) {
        let mut scene = Scene::open(seed, 3);
        scene.begin("cut", GOOD[0], |_| {});
        if step == RollingBack {
            scene.some_is_in(Probation);
            scene.order(Order::Abort("cut".to_owned()));
        }
        let robot = scene.some_is_in(step);
        scene.room.crash_agent(robot, true);
        scene.room.launched[robot].use_up_tries().expect("its sets are read");
        let tried = scene.room.launched[robot].holdings().expect("are read").switch.trial.map(|trial| trial.set);
        scene.room.restart_agent(robot);
        scene.ends("cut");
        scene.comes_to_rest();
        let switch = scene.room.launched[robot].holdings().expect("are read").switch;
        if let Some(tried) = tried {
            fell += 1;
            assert_ne!(switch.running(), tried, "it does not live: {step:?}");
        }
        assert_eq!(scene.findings(), [] as [String; 0], "{step:?}");
    }
    assert!(fell >= 2, "a set was on trial at {fell} cuts");
}

#[test]
fn an_access_point_that_is_lost_in_probation_stands_the_roll_out_still_and_burns_no_bundle() {
    let mut scene = Scene::open(30, 6);
    scene.begin("unlucky", GOOD[0], |spec| spec.probation = Some(prost_types::Duration { seconds: 10, nanos: 0 }));
    scene.some_is_in(UpdateState::Probation);
    for robot in 0..6 {
        steer(&mut scene.room, robot, LineState::Cut);
    }
    scene.until("the roll-out to stand still", |room| {
        let infrastructure = |row: &Rollout| row.pauses.contains(&Pause::Infrastructure);
        room.observer.lock().changes().rollout("unlucky").is_some_and(infrastructure)
    });
    for robot in 0..6 {
        steer(&mut scene.room, robot, LineState::Open);
    }
    let row = scene.ends("unlucky");
    assert_eq!((row.phase, &row.abort), (Phase::Completed, &None));
    assert!(row.verdicts.iter().all(|v| v.robots.outcomes.failed == 0), "{row:?}");
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[0]));
}

#[test]
fn a_canary_that_alone_is_lost_in_probation_counts_against_its_bundle() {
    let mut scene = Scene::open(31, 6);
    scene.begin("lost", GOOD[0], |spec| spec.probation = Some(prost_types::Duration { seconds: 10, nanos: 0 }));
    let canary = scene.some_is_in(UpdateState::Probation);
    steer(&mut scene.room, canary, LineState::Cut);
    let row = scene.ends("lost");
    assert_eq!(row.phase, Phase::Aborted);
    assert_eq!(row.verdicts.last().map(|v| (v.attempted, v.robots.outcomes.failed)), Some((1, 1)), "{row:?}");
    assert!(row.pauses.is_empty(), "{row:?}");
    steer(&mut scene.room, canary, LineState::Open);
    scene.comes_to_rest();
    scene.all_run(None);
}

#[test]
fn a_pause_whose_answers_are_lost_holds_in_the_middle_of_a_wave_and_the_roll_out_goes_on_after_it() {
    let mut scene = Scene::open(32, 4);
    scene.begin("paused", GOOD[0], |_| {});
    let holds = |room: &mut Room| {
        let mut seen = room.observer.lock();
        (0..4).any(|robot| seen.changes().held_by(&room.hall.robots()[robot].robot_id().clone()).is_some())
    };
    scene.until("a robot in its drain", holds);
    // The server's disk is slow to say that the pause is written; then nothing comes through any more, and what it says to robots waits.
    scene.room.disk.set(Mood { slow_ms: 600, ..Mood::GOOD });
    for robot in 0..4 {
        steer(&mut scene.room, robot, LineState::Held);
    }
    scene.order(Order::Pause("paused".to_owned()));
    scene.until("the pause to be committed", |room| {
        room.observer.lock().changes().rollout("paused").is_some_and(|row| row.pauses.contains(&Pause::Operator))
    });
    steer(&mut scene.room, 4, LineState::Cut);
    scene.room.disk.set(Mood::GOOD);
    scene.pass(4_000);
    for robot in 0..4 {
        steer(&mut scene.room, robot, LineState::Open);
    }
    scene.pass(10_000);
    assert!(scene.room.desk.unanswered.get() > 0, "the answer was lost");
    steer(&mut scene.room, 4, LineState::Open);
    scene.answered();
    let before = scene.activations();
    scene.pass(30_000);
    assert_eq!(scene.activations(), before, "it stands still");
    scene.order(Order::Resume("paused".to_owned()));
    assert_eq!(scene.ends("paused").phase, Phase::Completed);
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[0]));
}

#[test]
fn a_new_roll_out_right_after_an_abort_brings_every_robot_to_its_own_bundle_in_its_own_drains() {
    let mut scene = Scene::open(33, 4);
    scene.begin("first", GOOD[0], |_| {});
    scene.until("a robot in its drain", |room| {
        let robots: Vec<_> = room.hall.robots().iter().map(|body| body.robot_id().clone()).collect();
        let mut seen = room.observer.lock();
        robots.iter().any(|id| seen.changes().held_by(id).is_some())
    });
    scene.order(Order::Abort("first".to_owned()));
    scene.begin_for("second", GOOD[1], &scene.all(), true, |_| {});
    assert_eq!(scene.ends("second").phase, Phase::Completed);
    assert!(matches!(scene.ends("first").phase, Phase::Aborted | Phase::Superseded));
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[1]));
}

#[test]
fn one_that_supersedes_another_waits_until_it_is_undone_and_then_brings_its_own() {
    let mut scene = Scene::open(34, 4);
    scene.begin("older", GOOD[0], |_| {});
    scene.some_is_in(UpdateState::Trial);
    scene.begin_for("newer", GOOD[1], &scene.all(), true, |_| {});
    assert_eq!(scene.ends("older").phase, Phase::Superseded);
    assert_eq!(scene.ends("newer").phase, Phase::Completed);
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[1]));
}

#[test]
fn two_planners_on_one_store_give_nothing_twice() {
    for seed in 40..43 {
        // The lease would keep one of them from planning.
        let rollouts = bugs::Bugs::seeded(&[bugs::SeededBug::EverybodyLeads]);
        let server = midshift_server::NaiveRules { rollouts, ..Default::default() };
        let naive = Naive { server, ..Naive::default() };
        let mut scene = Scene::with(RoomConfig { planners: 2, ..config(seed, 5, naive) });
        scene.begin("raced", GOOD[0], |_| {});
        assert_eq!(scene.ends("raced").phase, Phase::Completed);
        scene.comes_to_rest();
        scene.all_run(Some(GOOD[0]));
        assert_eq!(scene.activations(), 5, "each robot switched once");
    }
}

#[test]
fn the_kept_set_is_always_the_one_committed_last_in_every_order_of_good_and_aborted_releases() {
    // Each release is kept or given up half-way; the robot is one, and its wave too.
    let orders: Vec<Vec<bool>> = (0..8_u8).map(|bits| (0..3).map(|place| bits & (1 << place) != 0).collect()).collect();
    for (seed, order) in (50..).zip(orders) {
        let mut scene = Scene::open(seed, 1);
        let mut kept: Vec<Option<String>> = vec![None];
        for (number, (version, keeps)) in GOOD.iter().zip(&order).enumerate() {
            let id = format!("r{number}");
            scene.begin(&id, version, |_| {});
            if !keeps {
                scene.some_is_in(UpdateState::Probation);
                scene.order(Order::Abort(id.clone()));
            }
            let end = if *keeps { Phase::Completed } else { Phase::Aborted };
            assert_eq!(scene.ends(&id).phase, end, "{order:?}");
            scene.comes_to_rest();
            if *keeps {
                kept.push(scene.bundle(version));
                let number = kept.len();
                scene.until("the commit to be durable", |room| {
                    let robot_id = room.robot_id(0);
                    let mut seen = room.observer.lock();
                    seen.changes()
                        .record(&robot_id)
                        .is_some_and(|switch| switch.trial.is_none() && switch.number as usize >= number)
                });
            }
            assert_eq!(scene.runs(0), kept[kept.len() - 1], "{order:?}");
        }
        // Back and back again: each set that is kept is the one that was committed before.
        if kept.len() > 1 {
            let newest = order.iter().rposition(|keeps| *keeps).expect("one was kept");
            scene.order(Order::Rollback { of: format!("r{newest}"), id: "back".to_owned() });
            scene.until("it to begin", |room| {
                room.observer.lock().changes().rollout("back").is_some_and(|r| r.started.is_some())
            });
            assert_eq!(scene.ends("back").phase, Phase::Completed, "{order:?}");
            scene.comes_to_rest();
            assert_eq!(scene.runs(0), kept[kept.len() - 2], "{order:?}");
        }
    }
}

#[test]
fn a_completed_roll_out_that_is_taken_back_leaves_every_robot_on_what_it_ran_before() {
    let mut scene = Scene::open(35, 4);
    scene.begin("first", GOOD[0], |_| {});
    assert_eq!(scene.ends("first").phase, Phase::Completed);
    scene.begin("second", GOOD[1], |_| {});
    assert_eq!(scene.ends("second").phase, Phase::Completed);
    scene.comes_to_rest();
    scene.order(Order::Rollback { of: "second".to_owned(), id: "back".to_owned() });
    scene.answered();
    assert_eq!(scene.ends("back").phase, Phase::Completed);
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[0]));
}

#[test]
fn a_robot_that_the_selector_does_not_name_never_gets_the_bundle() {
    let mut scene = Scene::open(38, 4);
    scene.begin_for("some", GOOD[0], &(0..3).collect(), false, |_| {});
    assert_eq!(scene.ends("some").phase, Phase::Completed);
    scene.pass(60_000);
    scene.comes_to_rest();
    assert_eq!(scene.runs(3), None);
}

#[test]
fn a_robot_that_comes_later_gets_the_bundle_of_its_area() {
    let mut scene = Scene::late(36, 4, 3);
    scene.begin("early", GOOD[0], |spec| spec.selector = None);
    assert_eq!(scene.ends("early").phase, Phase::Completed);
    assert_eq!(scene.runs(3), None);
    scene.room.restart_agent(3);
    let wanted = scene.bundle(GOOD[0]);
    scene.until("the newcomer to run it", |room| {
        let robot_id = room.robot_id(3);
        room.observer.lock().changes().runs(&robot_id) == wanted
    });
    scene.comes_to_rest();
}

#[test]
fn a_fleet_of_twelve_takes_a_good_bundle_without_a_person() {
    let mut scene = Scene::open(37, 12);
    scene.begin("large", GOOD[0], |spec| waves(spec, &[Size::Count(1), Size::Percent(25), Size::Rest(true)]));
    let row = scene.ends("large");
    assert_eq!(row.phase, Phase::Completed);
    let proved: Vec<_> = row.verdicts.iter().map(|v| (v.outcome, v.attempted)).collect();
    assert_eq!(
        proved,
        [(Outcome::PromotedUnproven, 1), (Outcome::PromotedUnproven, 4), (Outcome::Promoted, 12)],
        "twelve clean robots prove it"
    );
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[0]));
}

#[test]
fn a_fleet_of_sixty_takes_a_good_bundle_without_a_person() {
    // The demo floor parks twelve robots, two in each of its six parks.
    let site = DEMO.replace(r#"kind = "park", capacity = 2"#, r#"kind = "park", capacity = 12"#);
    let mut scene = Scene::with(RoomConfig { site, ..config(39, 60, Naive::default()) });
    scene.begin("crowd", GOOD[0], |spec| waves(spec, &[Size::Count(1), Size::Percent(25), Size::Rest(true)]));
    let row = scene.ends("crowd");
    assert_eq!(row.phase, Phase::Completed);
    let proved: Vec<_> = row.verdicts.iter().map(|v| (v.outcome, v.attempted)).collect();
    assert_eq!(
        proved,
        [(Outcome::PromotedUnproven, 1), (Outcome::Promoted, 16), (Outcome::Promoted, 60)],
        "one clean robot proves nothing"
    );
    let bounds: Vec<u16> = row.verdicts.iter().map(|v| v.robots.upper_bound_permille).collect();
    assert!(bounds.is_sorted_by(|a, b| a > b), "{bounds:?}");
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[0]));
}
