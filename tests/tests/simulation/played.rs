//! Honest robots at work beside robots that behave badly, on one server: what one of them says harms nobody's work but its own.
//!
//! A seed plays for a while, then its players are gone for ever, and a person does what a person can do about them. Every law of the witness
//! holds in all of it; of players only what robots are free to say is left out.

use crate::client::Wish;
use crate::counted::{self, TOLD, counted};
use crate::incidents::{self, ASKED};
use crate::law_names::{BOUNDED, GOES_ON, ONCE, REFUSED};
use crate::observer::{Observer, ready};
use crate::orders::Order;
use crate::plan::background;
use crate::room::{Naive, Room, RoomConfig, player_machine, site};
use crate::run::{Outcome, outcome_of};
use crate::seeds::{Twin, break_laws, elsewhere, every_seed_holds, hash_of, naive_of, own_seed, report_seed};
use midshift_core::ids::{AttemptId, RobotId, TaskId};
use midshift_core::rows::Table;
use midshift_core::site::{DEMO, Site};
use midshift_core::task::machine::Phase;
use midshift_core::task::{Attempt, TaskIntake};
use midshift_proto::task::v1::CancelTaskRequest;
use midshift_sim::faults::FaultRates;
use midshift_store::Store;
use midshift_tests::metrics::Metrics;
use midshift_tests::player::{Around, Habit, Player};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};

/// Seeds of a plain run.
const SEEDS: u64 = 100;
/// Runs with so many seeds or more must have met every habit and looked at every law.
const ENOUGH: u64 = 100;
/// The test that plays one seed.
const ONE: &str = "played::one_seed_of_robots_that_behave_badly_keeps_every_law";
/// When tasks are asked for, milliseconds: their names have it.
const BEGIN_MS: u64 = 3_000;
/// Players play for so long, milliseconds.
const PLAY_MS: std::ops::Range<u64> = 25_000..60_000;
/// When they are gone every task must end within this, milliseconds: longer than nobody knows where a robot's authority ends, twice.
const END_WITHIN_MS: u64 = 400_000;
/// Laws of a moment are looked at this often while players play, milliseconds.
const LOOK_MS: u64 = 1_000;
/// People look after what waits for them this often, milliseconds.
const LOOK_AFTER_MS: u64 = 10_000;

/// An honest robot that was given a task drives or comes to its next step within this, milliseconds: longer than players play, people take to
/// clear behind them, and honest robots wait for one another after that.
const STANDS_MS: u64 = 240_000;

/// Laws beyond those of the witness, by the name under which each is looked at.
const LAWS: [&str; 8] = [GOES_ON, BUILT_ANEW, REFUSED, BOUNDED, TOLD, ASKED, ONCE, WAS_THERE];
const BUILT_ANEW: &str = "the planner is built anew only after a conflict";
/// Players have no bodies: of them it is where they say that they were. What bodies did with the items of honest robots is a matter of `GOES_ON`.
const WAS_THERE: &str = "no task is done by a robot that was never where it ends";

/// Each naive rule, the law that it breaks, and the habit of every player that shows it.
const TWINS: [(&str, &str, Habit); 8] = [
    ("steps_are_not_told", TOLD, Habit::NeverMovesOn),
    ("doubt_is_kept_quiet", ASKED, Habit::WrongSteps),
    ("late_reports_count", GOES_ON, Habit::ForeignAttempts),
    ("silence_frees_task", ONCE, Habit::FallsSilent),
    ("holds_come_at_once", REFUSED, Habit::EndlessLists),
    ("each_word_is_told", BOUNDED, Habit::WrongPlaces),
    ("success_is_believed", WAS_THERE, Habit::NeverGoes),
    ("fenced_reports_rebuild", BUILT_ANEW, Habit::ForeignAttempts),
];

/// Rows that one seed may leave in a table beyond what it begins with: a robot, a task or a place has so many at most.
const ROWS_MAX: usize = 2_000;

struct Game {
    room: Room,
    site: Arc<Site>,
    players: Vec<Arc<Mutex<Player>>>,
    names: BTreeSet<RobotId>,
    play_ms: u64,
    asked: u64,
    /// How far each task of an honest robot is (its step, and what the robot has driven), and since when, milliseconds.
    stands: BTreeMap<AttemptId, ((u32, u64), u64)>,
}

/// Runs a seed whose players all have this habit too, if there is one.
fn run(seed: u64, naive: Naive, habit: Option<Habit>) -> Outcome {
    outcome_of(|| Game::open(seed, naive, habit).map(Game::run))
}

impl Game {
    fn open(seed: u64, naive: Naive, habit: Option<Habit>) -> anyhow::Result<Self> {
        // Counters are counted from the first on.
        midshift_process::recorder::handle();
        let mut rng = StdRng::seed_from_u64(seed);
        let (honest, many, tasks) = (rng.random_range(2..=4), rng.random_range(1..=2), rng.random_range(4..=8));
        let site = site()?;
        let tasks = background(BEGIN_MS, tasks, &site)?;
        let names: Vec<TaskId> = tasks.iter().map(|t| TaskId::parse(&t.task_id)).collect::<Result<_, _>>()?;
        let player = |number: usize| {
            let name = RobotId::parse(&format!("player-{number}")).expect("a name");
            let robot = |n: usize| RobotId::parse(&format!("rbt-{:02}", n + 1)).expect("a name");
            let around = Around::of_site(&site, number, (0..honest).map(robot).collect(), names.clone());
            let mut player = Player::of_seed(seed, number, name, around);
            if let Some(habit) = habit {
                player.take_up(habit);
            }
            Arc::new(Mutex::new(player))
        };
        let players: Vec<_> = (0..many).map(player).collect();
        let config = RoomConfig {
            seed,
            robots: honest,
            skews: Vec::new(),
            latency_ms: rng.random_range(2..60),
            faults: FaultRates::none(),
            naive,
            planners: 1,
            stops: false,
            site: DEMO.to_owned(),
            players: players.clone(),
            newer: None,
        };
        let room = Room::open(&config)?;
        let robot_ids = players.iter().map(|p| p.lock().unwrap_or_else(PoisonError::into_inner).robot_id().clone());
        let names = robot_ids.collect();
        let play_ms = rng.random_range(PLAY_MS);
        for task in tasks {
            room.desk.wish(Wish::Submit(Box::new(task)));
        }
        Ok(Self { room, site, players, names, play_ms, asked: 0, stands: BTreeMap::new() })
    }

    fn run(mut self) -> Outcome {
        if let Err(error) = self.play() {
            let mut seen = self.room.observer.lock();
            if seen.findings().is_empty() {
                seen.find(format!("{error:#}"));
            }
        }
        let mut hits = BTreeMap::new();
        let mut planned = BTreeMap::new();
        for player in &self.players {
            let player = player.lock().unwrap_or_else(PoisonError::into_inner);
            player.habits().iter().for_each(|habit| *planned.entry(habit.name()).or_insert(0) += 1);
            player.deeds().iter().for_each(|(name, n)| *hits.entry(*name).or_insert(0) += n);
        }
        let seen = self.room.observer.lock();
        Outcome {
            findings: seen.findings().to_vec(),
            hash: seen.hash(),
            lasted_ms: self.room.now_ms(),
            checks: seen.checks().clone(),
            counts: seen.counts().clone(),
            planned,
            hits,
        }
    }

    fn play(&mut self) -> anyhow::Result<()> {
        let play_ms = self.play_ms;
        while self.room.now_ms() < play_ms {
            let round_ms = (self.room.now_ms() + LOOK_MS).min(play_ms);
            self.room.until("one round of the game", 2 * LOOK_MS, |room| room.now_ms() >= round_ms)?;
            self.check_laws();
        }
        for number in 0..self.players.len() {
            self.room.sim.crash(player_machine(number));
        }
        self.end()?;
        self.judge();
        Ok(())
    }

    /// Waits for the end of everything; people look after what waits for them.
    fn end(&mut self) -> anyhow::Result<()> {
        let end_ms = self.room.now_ms() + END_WITHIN_MS;
        loop {
            self.look_after();
            let round_ms = self.room.now_ms() + LOOK_AFTER_MS;
            let mut is_over = false;
            self.room.until("one round", 2 * LOOK_AFTER_MS, |room| {
                let all_over = room.observer.lock().tasks().values().all(|t| t.phase.is_terminal());
                is_over = room.desk.is_empty() && all_over;
                is_over || room.now_ms() >= round_ms
            })?;
            self.check_laws();
            if is_over {
                return Ok(());
            }
            if self.room.now_ms() >= end_ms {
                let mut seen = self.room.observer.lock();
                let open: Vec<_> = seen.tasks().values().filter(|t| !t.phase.is_terminal()).cloned().collect();
                seen.find(format!("I8 every task ends: {} are open: {open:?}", open.len()));
                return Ok(());
            }
        }
    }

    /// A person takes the players out of the fleet, looks into their places, and gives up what they had.
    fn look_after(&mut self) {
        self.asked += 1;
        let (places, tasks) = {
            let seen = self.room.observer.lock();
            let theirs = |robot: &Option<RobotId>| robot.as_ref().is_some_and(|r| self.names.contains(r));
            let mine = |t: &&midshift_core::task::TaskState| {
                let stuck = t.phase == Phase::NeedsOperator;
                !t.phase.is_terminal() && (stuck || theirs(&t.robot_id) || theirs(&t.opened_robot_id))
            };
            let tasks: Vec<TaskId> = seen.tasks().values().filter(mine).map(|t| t.task_id.clone()).collect();
            (seen.places_of(&self.names), tasks)
        };
        for robot_id in &self.names {
            self.order(Order::Retire(robot_id.to_string()));
        }
        places.iter().for_each(|place_id| self.order(Order::Clear(place_id.to_string())));
        for task_id in tasks {
            let request = CancelTaskRequest {
                task_id: task_id.to_string(),
                request_id: format!("give-up-{task_id}-{}", self.asked),
                reason: "its robot behaves badly".to_owned(),
                force: true,
                ..CancelTaskRequest::default()
            };
            self.room.desk.wish(Wish::Cancel(request));
        }
    }
    fn order(&self, order: Order) {
        self.room.desk.wish(Wish::Order(Box::new(order)));
    }

    fn judge(&self) {
        let verdict = self.room.hall.verdict();
        let drops = midshift_sim::world::lock(&self.room.hall.worlds()[0]).judge().drops_by_task();
        let mut seen = self.room.observer.lock();
        match verdict {
            Ok(verdict) => {
                seen.check("I4 no step is done twice", verdict.steps_done_twice == 0, || format!("{verdict:?}"));
                seen.check("I7 no place was too full", verdict.exclusion_violations == 0, || format!("{verdict:?}"));
            }
            Err(error) => seen.find(format!("the journals cannot be read: {error}")),
        }
        let honest: Vec<_> =
            seen.tasks().values().filter(|t| seen.given_to(&t.task_id).is_disjoint(&self.names)).cloned().collect();
        for task in honest {
            let times = drops.get(&task.task_id).copied().unwrap_or(0);
            let done = task.phase == Phase::Succeeded && times == 1;
            seen.check(GOES_ON, done, || format!("put down {times} times: {task:?}"));
        }
        self.judge_where(&mut seen);
    }

    /// What a player ended as done ends where it said that it was.
    fn judge_where(&self, seen: &mut Observer) {
        let site = &self.site;
        let rows =
            ready(self.room.store.snapshot(&[Table::TaskIntake])).map(|snapshot| snapshot.rows).unwrap_or_default();
        for intake in rows.iter().filter_map(|row| row.decode::<TaskIntake>().ok()) {
            let task = seen.tasks().get(&intake.task_id).filter(|task| task.phase == Phase::Succeeded);
            let Some(robot_id) = task.and_then(|task| task.robot_id.clone()) else { continue };
            let end = intake.spec.goals(0).last().and_then(|waypoint| site.standing_at(site.find(waypoint)?));
            let Some(end) = end.map(|place| &site.place(place).place_id) else { continue };
            for player in &self.players {
                let player = player.lock().unwrap_or_else(PoisonError::into_inner);
                if *player.robot_id() == robot_id {
                    let holds = !player.was_never_in(end);
                    seen.check(WAS_THERE, holds, || format!("{robot_id} was never in {end}: {}", intake.task_id));
                }
            }
        }
    }

    /// Laws of a moment.
    fn check_laws(&mut self) {
        let metrics = counted();
        let drops = midshift_sim::world::lock(&self.room.hall.worlds()[0]).judge().drops_by_task();
        let mut seen = self.room.observer.lock();
        incidents::are_open_and_few(&self.room.store, &mut seen);
        counted::nothing_stands_unexplained(&metrics, &mut seen);
        planned_once(&metrics, &mut seen);
        for (task_id, times) in &drops {
            seen.check(ONCE, *times <= 1, || format!("the item of {task_id} was put down {times} times"));
        }
        for (table, rows) in self.rows() {
            seen.check(BOUNDED, rows <= ROWS_MAX, || format!("{table} has {rows} rows"));
            let peak = seen.peak(format!("rows of {table}"));
            *peak = (*peak).max(rows as u64);
        }
        drop(seen);
        self.look_at_honest();
    }

    /// An honest robot that was given a task comes on with it.
    fn look_at_honest(&mut self) {
        let now_ms = self.room.now_ms();
        let mut seen = self.room.observer.lock();
        let is_meant = |a: &&Attempt| a.attempt.subject.task_id().is_some() && !self.names.contains(&a.robot_id);
        let live: Vec<Attempt> = seen.live().filter(is_meant).cloned().collect();
        let mut stands = BTreeMap::new();
        for a in live {
            let driven_mm = self.room.hall.robot(&a.robot_id).map_or(0, |body| body.lock().odometers_mm().0);
            let at = (a.step_index, driven_mm);
            let known = self.stands.get(&a.attempt).filter(|(known, _)| *known == at);
            let since_ms = known.map_or(now_ms, |(_, since_ms)| *since_ms);
            seen.check(GOES_ON, now_ms - since_ms <= STANDS_MS, || format!("since {since_ms} ms: {a:?}"));
            stands.insert(a.attempt, (at, since_ms));
        }
        self.stands = stands;
    }

    /// Rows by table.
    fn rows(&self) -> BTreeMap<&'static str, usize> {
        let mut rows = BTreeMap::new();
        if let Ok(snapshot) = ready(self.room.store.snapshot(Table::ALL)) {
            snapshot.rows.iter().for_each(|row| *rows.entry(row.key.table.name()).or_insert(0) += 1);
        }
        rows
    }
}

/// The planner neither begins anew nor composes what no store takes.
fn planned_once(metrics: &Metrics, seen: &mut Observer) {
    let lost = metrics.sum("midshift_fleet_items_lost_total", "conflict=\"false\"");
    seen.check(REFUSED, lost == 0, || format!("{lost} items"));
    let conflicts = metrics.sum("midshift_fleet_items_lost_total", "conflict=\"true\"");
    let rebuilds = metrics.sum("midshift_fleet_rebuilds_total", "");
    seen.check(BUILT_ANEW, rebuilds <= 1 + conflicts, || format!("{rebuilds} times, {conflicts} conflicts"));
    *seen.peak("planner built anew".to_owned()) = rebuilds;
}

#[test]
fn one_seed_of_robots_that_behave_badly_keeps_every_law() {
    let Some(seed) = own_seed(ONE) else { return };
    let rule = std::env::var("MIDSHIFT_SIM_NAIVE").unwrap_or_default();
    let habit = TWINS.iter().find(|(twin, ..)| *twin == rule).map(|(.., habit)| *habit);
    let outcome = run(seed, naive_of(&rule), habit);
    report_seed(seed, &outcome);
}

#[test]
fn many_seeds_of_robots_that_behave_badly_keep_every_law() {
    let (many, sums) = every_seed_holds(ONE, "played::one_seed", SEEDS);
    let looked = LAWS.iter().map(|law| format!("check {law}"));
    let met = Habit::ALL.iter().map(|habit| format!("hit {}", habit.name()));
    let never: Vec<String> = looked.chain(met).filter(|name| sums.get(name).copied().unwrap_or(0) == 0).collect();
    assert!(never.is_empty() || many < ENOUGH, "{many} seeds and never: {never:#?}");
}

#[test]
fn each_naive_rule_breaks_its_law_beside_robots_that_behave_badly() {
    break_laws(ONE, &TWINS.map(|(rule, law, _)| Twin { rule, law, from: 1 }));
}

#[test]
fn a_seed_of_robots_that_behave_badly_is_the_same_run_in_another_process() {
    let (first, again) = (elsewhere(ONE, 7, ""), elsewhere(ONE, 7, ""));
    let hash = hash_of(&first.0);
    assert!(hash.is_some() && hash == hash_of(&again.0), "{hash:?} {:?}", hash_of(&again.0));
}
