//! Fleet stop in the same room: stops are engaged and reset while lines to the stop service are cut, the service and robots are killed, and tasks are
//! worked. Every law of the witness holds in these too.

use crate::directed::{Scene, config};
use crate::net::{LineState, STOPS};
use crate::orders::Order;
use crate::room::{Naive, Room, RoomConfig};
use crate::stops::{Stops, effective};
use midshift_agent::body::Body;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_core::ids::StopId;
use midshift_core::limits;
use midshift_core::robot::{Pose, StopLevel};
use midshift_core::stop::robot::is_silence;
use midshift_proto::stop::v1;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeSet;

const ROBOTS: usize = 4;
/// Seeds of a plain run.
const SEEDS: u64 = 3;
/// From what a robot's file has to a body that stands: it brakes.
const BRAKES_MS: u64 = 1_500;
/// After the last fault everybody has heard everything: the longest pause before a line is dialed again, twice, and three check-ins.
const HEALED_MS: u64 = 20_000;
/// Faults are drawn for so long.
const FAULTS_MS: u64 = 90_000;

/// The scene, with somebody who looks at every robot in each step.
struct Stopped {
    scene: Scene,
    watch: Watch,
    asked: u64,
}

/// What a robot's file says stands it, since when and where.
#[derive(Default)]
struct Watch {
    since: Vec<Option<u64>>,
    at: Vec<Option<Pose>>,
    broken: Vec<String>,
    /// Looks at robots that had to stand, and moves of robots that had not.
    stood: u64,
    moved: u64,
}

fn stops(room: &Room) -> &Stops {
    room.stop.as_ref().expect("a stop service")
}

impl Watch {
    fn check_room(&mut self, room: &Room) {
        let (now, now_ms) = (room.time.site(), room.now_ms());
        self.since.resize(ROBOTS, None);
        self.at.resize(ROBOTS, None);
        for robot in 0..ROBOTS {
            let state = room.hall.robots()[robot].state(now);
            let kept = stops(room).saved(robot);
            let over = kept.latch.level(&room.robot_id(robot), Some(&state.pose));
            let stands = over >= StopLevel::Halt || !kept.awaiting.is_empty();
            let since = if stands { Some(self.since[robot].unwrap_or(now_ms)) } else { None };
            let moved = self.at[robot].is_some_and(|at| (at.x_mm, at.y_mm) != (state.pose.x_mm, state.pose.y_mm));
            if since.is_some_and(|since| now_ms > since + BRAKES_MS) {
                self.stood += 1;
                if moved && self.broken.len() < 5 {
                    self.broken.push(format!("robot {robot} moved at {now_ms} ms under {kept:?}"));
                }
            } else {
                self.moved += u64::from(moved);
            }
            (self.since[robot], self.at[robot]) = (since, Some(state.pose));
        }
    }
}

impl Stopped {
    fn open(seed: u64, naive: Naive) -> Self {
        let scene = Scene::with(RoomConfig { stops: true, ..config(seed, ROBOTS, naive) });
        Self { scene, watch: Watch::default(), asked: 0 }
    }
    fn stops(&self) -> &Stops {
        stops(&self.scene.room)
    }
    fn pass(&mut self, ms: u64) {
        let end_ms = self.scene.room.now_ms() + ms;
        self.until("time to pass", move |room| room.now_ms() >= end_ms);
    }
    fn until(&mut self, what: &str, mut done: impl FnMut(&Room) -> bool) {
        let watch = &mut self.watch;
        self.scene.until(what, |room| {
            if room.now_ms().is_multiple_of(100) {
                watch.check_room(room);
            }
            done(room)
        });
    }
    fn engage(&mut self, scope: v1::scope::Scope) {
        self.asked += 1;
        let (scope, request_id) = (Some(v1::Scope { scope: Some(scope) }), format!("stop-{}", self.asked));
        let request =
            v1::EngageRequest { scope, reason: "drawn".to_owned(), request_id, ..v1::EngageRequest::default() };
        self.scene.order(Order::Engage(Box::new(request)));
    }
    fn reset(&mut self, stop_id: &StopId) {
        self.scene.order(Order::Reset(stop_id.to_string()));
    }
    /// A person goes round and lets everybody go on who waits for it.
    fn let_go(&mut self) {
        for robot in 0..ROBOTS {
            self.asked += 1;
            let robot_id = self.scene.room.robot_id(robot).to_string();
            self.scene.order(Order::LetGo { robot_id, request_id: format!("go-on-{}", self.asked) });
        }
    }
    /// The same until nobody waits any more: fleet hears what a robot waits for a little later.
    fn let_all_go(&mut self) {
        for _ in 0..10 {
            self.let_go();
            self.pass(5_000);
            if (0..ROBOTS).all(|robot| self.stops().saved(robot).awaiting.is_empty()) {
                return;
            }
        }
        panic!("a robot was not let go: {:?}", (0..ROBOTS).map(|robot| self.stops().saved(robot)).collect::<Vec<_>>());
    }
    fn line(&self, robot: usize, way: LineState) {
        self.stops().steer(&self.scene.room.sim, robot, way);
    }
    fn effective(&self) -> BTreeSet<StopId> {
        effective(&self.stops().latch())
    }
    /// What robots know as effective, each.
    fn known(&self) -> Vec<BTreeSet<StopId>> {
        (0..ROBOTS).map(|robot| effective(&self.stops().saved(robot).latch)).collect()
    }
    fn silences(&self) -> usize {
        (0..ROBOTS).filter(|robot| self.stops().saved(*robot).awaiting.iter().any(is_silence)).count()
    }
    /// I11, I12: nobody moved who had to stand, and everybody knows what the service knows.
    fn assert_agrees(&self) {
        assert!(self.watch.broken.is_empty(), "{:#?}", self.watch.broken);
        let service = self.effective();
        assert!(self.known().iter().all(|known| *known == service), "{service:?} and robots {:?}", self.known());
    }
}

fn one(robot: &str) -> v1::scope::Scope {
    v1::scope::Scope::RobotId(robot.to_owned())
}

fn fleet() -> v1::scope::Scope {
    v1::scope::Scope::Fleet(v1::Fleet {})
}

/// What is drawn once a second: what people ask for, and what goes wrong.
fn suffer(stopped: &mut Stopped, rng: &mut StdRng, down: &mut [Option<u64>; 2], cut: &mut BTreeSet<usize>) {
    let now_ms = stopped.scene.room.now_ms();
    let robot = rng.random_range(0..ROBOTS);
    match rng.random_range(0..14) {
        0 => stopped.engage(fleet()),
        1 => stopped.engage(one(stopped.scene.room.robot_id(robot).as_str())),
        2..5 => {
            let engaged = stopped.effective();
            let drawn = rng.random_range(0..engaged.len().max(1));
            engaged.iter().nth(drawn).iter().for_each(|id| stopped.reset(id));
        }
        5 | 6 => stopped.let_go(),
        7 | 8 if cut.insert(robot) => stopped.line(robot, LineState::Cut),
        9 | 10 if cut.remove(&robot) => stopped.line(robot, LineState::Open),
        11 if down[0].is_none() => {
            down[0] = Some(now_ms + rng.random_range(500..8_000));
            stopped.scene.room.sim.crash(STOPS);
        }
        12 if down[1].is_none() => {
            down[1] = Some(now_ms + rng.random_range(500..8_000));
            stopped.scene.room.crash_server();
        }
        13 => {
            stopped.scene.room.crash_agent(robot, false);
            stopped.pass(300);
            stopped.scene.room.restart_agent(robot);
        }
        _ => {}
    }
    heal(stopped, down, now_ms);
}

/// Starts again what was down long enough.
fn heal(stopped: &mut Stopped, down: &mut [Option<u64>; 2], now_ms: u64) {
    if down[0].take_if(|until| *until <= now_ms).is_some() {
        stopped.scene.room.sim.bounce(STOPS);
    }
    if down[1].take_if(|until| *until <= now_ms).is_some() {
        stopped.scene.room.restart_server();
    }
}

/// One seed: faults, the heal, and everybody at work again. How many messages were lost.
fn keeps_every_law(seed: u64) -> u64 {
    let mut stopped = Stopped::open(seed, Naive::default());
    let (mut rng, mut down, mut cut) = (StdRng::seed_from_u64(seed), [None, None], BTreeSet::new());
    stopped.scene.work(12);
    while stopped.scene.room.now_ms() < FAULTS_MS {
        suffer(&mut stopped, &mut rng, &mut down, &mut cut);
        stopped.pass(1_000);
    }
    stopped.engage(fleet());
    heal(&mut stopped, &mut down, u64::MAX);
    cut.iter().for_each(|robot| stopped.line(*robot, LineState::Open));
    stopped.until("all orders to be answered", |room| room.desk.is_empty());
    stopped.pass(HEALED_MS);
    stopped.assert_agrees();
    assert!(!stopped.effective().is_empty() && stopped.watch.stood > 0 && stopped.watch.moved > 0);
    let lost = stopped.stops().hits();
    for stop_id in stopped.effective() {
        stopped.reset(&stop_id);
    }
    let moved = stopped.watch.moved;
    stopped.until("resets to be answered", |room| room.desk.is_empty());
    stopped.pass(HEALED_MS);
    assert_eq!(stopped.watch.moved, moved, "a reset moves nobody");
    stopped.assert_agrees();
    assert!(stopped.effective().is_empty());
    stopped.let_all_go();
    stopped.scene.work(4);
    stopped.pass(30_000);
    assert!(stopped.watch.moved > moved, "nobody works again");
    stopped.assert_agrees();
    lost
}

#[test]
fn in_cuts_and_kills_nobody_moves_under_a_stop_and_after_them_everybody_knows_the_same_stops() {
    let seeds = crate::seeds::number("MIDSHIFT_SEEDS").unwrap_or(SEEDS);
    let first = crate::seeds::number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    let lost: u64 = (first..first + seeds).map(keeps_every_law).sum();
    assert!(lost > 0, "no message was lost");
}

/// Two stops, of which one is reset while a robot does not hear of it; then all lines are whole again.
fn one_of_two_is_reset(naive: Naive) -> Stopped {
    let mut stopped = Stopped::open(70, naive);
    stopped.engage(fleet());
    stopped.engage(fleet());
    stopped.until("two stops at every robot", |room| {
        (0..ROBOTS).all(|robot| effective(&stops(room).saved(robot).latch).len() == 2)
    });
    stopped.line(0, LineState::Cut);
    let first = stopped.effective().pop_first().expect("two are engaged");
    stopped.reset(&first);
    stopped.pass(5_000);
    stopped.line(0, LineState::Open);
    stopped.pass(HEALED_MS);
    stopped
}

#[test]
fn a_reset_takes_one_stop_away_everywhere_and_no_other_and_a_rule_that_clears_all_is_seen() {
    let real = one_of_two_is_reset(Naive::default());
    assert_eq!(real.effective().len(), 1);
    real.assert_agrees();
    let naive = Naive { agent: Bugs::seeded(&[SeededBug::ResetClearsAll]), ..Naive::default() };
    let twin = one_of_two_is_reset(naive);
    assert_eq!(twin.effective().len(), 1);
    assert!(twin.known().iter().all(BTreeSet::is_empty), "robots forgot what nobody reset: {:?}", twin.known());
}

#[test]
fn a_stop_that_is_engaged_while_a_line_is_cut_reaches_its_robot_by_the_link() {
    let mut stopped = Stopped::open(72, Naive::default());
    stopped.scene.work(8);
    stopped.pass(8_000);
    stopped.line(0, LineState::Cut);
    stopped.engage(fleet());
    stopped.until("the stop at every robot", |room| {
        (0..ROBOTS).all(|robot| effective(&stops(room).saved(robot).latch).len() == 1)
    });
    assert_eq!(stopped.silences(), 0, "nobody stands by silence");
    stopped.pass(BRAKES_MS + 2_000);
    assert!(stopped.watch.broken.is_empty(), "{:#?}", stopped.watch.broken);
    let stop_id = stopped.effective().pop_first().expect("one is engaged");
    stopped.reset(&stop_id);
    stopped.until("its reset at every robot", |room| {
        (0..ROBOTS).all(|robot| effective(&stops(room).saved(robot).latch).is_empty())
    });
    stopped.line(0, LineState::Open);
    stopped.pass(HEALED_MS);
    stopped.let_all_go();
    stopped.assert_agrees();
}

#[test]
fn silence_of_the_stop_service_stands_robots_among_people_within_its_bound_and_restarts_of_the_server_do_not() {
    let mut stopped = Stopped::open(71, Naive::default());
    stopped.pass(4_000);
    for _ in 0..2 {
        stopped.scene.room.crash_server();
        stopped.pass(12_000);
        stopped.scene.room.restart_server();
        stopped.pass(3_000);
    }
    assert_eq!(stopped.silences(), 0, "the business server is not asked");
    (0..ROBOTS).for_each(|robot| stopped.line(robot, LineState::Cut));
    // Less the second that the last check-in may be old.
    let stand_ms = limits::SILENCE_STAND_PEOPLE.as_ms();
    stopped.pass(stand_ms - 1_500);
    assert_eq!(stopped.silences(), 0);
    stopped.pass(2_000);
    // Who knows that no people are around it has more patience.
    let stood = stopped.silences();
    assert!(stood > 0, "nobody was among people");
    (0..ROBOTS).for_each(|robot| stopped.line(robot, LineState::Open));
    stopped.pass(HEALED_MS);
    assert_eq!(stopped.silences(), stood, "among people a person ends it");
    stopped.let_all_go();
    stopped.assert_agrees();
}
