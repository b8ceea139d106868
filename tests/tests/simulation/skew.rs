//! Neighbouring versions of server and agents: each pair plays a shift with tasks, a roll-out and its way back, and comes out of it as two of one version do.
//! Every law of the witness holds in them too.

use crate::directed::{Scene, config};
use crate::incidents;
use crate::newer::{Newer, Speaker, Version};
use crate::orders::Order;
use crate::room::{Naive, RoomConfig};
use crate::software::GOOD;
use crate::stops::effective;
use midshift_core::reason::Code;
use midshift_core::rollout::rows::Phase;
use midshift_core::task::machine::Phase as TaskPhase;
use midshift_proto::stop::v1;
use midshift_sim::world::lock;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;

const ROBOTS: usize = 4;
/// Seeds of a plain run.
const SEEDS: u64 = 3;
/// Tasks before the roll-out, and again before its way back.
const TASKS: usize = 5;
/// A robot that says nothing more for so long says nothing more.
const QUIET_MS: u64 = 10_000;
/// What every agent of the next version says in a shift with a roll-out, and what every server says and writes.
const SAID: [&str; 12] = [
    "link.v1.Hello",
    "link.v1.Heartbeat",
    "link.v1.RobotEvent",
    "link.v1.AttemptReport",
    "link.v1.PlaceReport",
    "link.v1.Vitals",
    "link.v1.UpdateReport",
    "version of the wire",
    "capability",
    "label",
    "reason",
    "ota.v1.FetchChunksRequest",
];
const TOLD: [&str; 11] = [
    "link.v1.Welcome",
    "link.v1.HeartbeatEcho",
    "link.v1.LaneAck",
    "link.v1.DesiredWork",
    "link.v1.Assignment",
    "link.v1.GrantedPlace",
    "link.v1.DesiredPolicy",
    "link.v1.DesiredUpdate",
    "link.v1.ActivationGrant",
    "ota.v1.FetchChunksResponse",
    "row",
];

/// Which programs are of the next version.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pair {
    /// Neither the server nor an agent.
    Equal,
    /// None, and the server is killed in the roll-out and started again.
    EqualKilled,
    /// The server.
    Server,
    /// The server until it is killed in the roll-out; the one that is started again finds its rows.
    ServerGoesBack,
    /// Every agent.
    Agents,
    /// Every other agent.
    Mixed,
    /// Who runs the release that is rolled out and taken back.
    Release,
}

impl Pair {
    const fn kills(self) -> bool {
        matches!(self, Self::EqualKilled | Self::ServerGoesBack)
    }
    const fn equal(self) -> Self {
        if self.kills() { Self::EqualKilled } else { Self::Equal }
    }
}

/// A shift on its way.
struct Shift {
    scene: Scene,
    newer: Newer,
    pair: Pair,
}

/// What came of one.
struct Ended {
    incidents: BTreeSet<Code>,
    newer: Newer,
    /// How often agents had said more than this version: before the roll-out, after it, after its way back, and later.
    said: [u64; 4],
}

impl Shift {
    fn open(seed: u64, pair: Pair) -> Self {
        let newer = Newer::default();
        match pair {
            Pair::Server | Pair::ServerGoesBack => newer.server_is(Version::Next),
            Pair::Agents => newer.robots_are_next(0..ROBOTS),
            Pair::Mixed => newer.robots_are_next((0..ROBOTS).step_by(2)),
            Pair::Equal | Pair::EqualKilled | Pair::Release => {}
        }
        let room = RoomConfig { newer: Some(newer.clone()), ..config(seed, ROBOTS, Naive::default()) };
        let scene = Scene::with(room);
        if pair == Pair::Release {
            newer.comes_with(scene.bundle(GOOD[0]).expect("it was signed"));
        }
        Self { scene, newer, pair }
    }
    fn said(&self) -> u64 {
        self.newer.said_by(Speaker::Robot)
    }
    fn play(mut self) -> Ended {
        self.scene.work(TASKS);
        self.scene.pass(QUIET_MS);
        let before = self.said();
        self.rolls_out();
        let after = self.said();
        self.scene.work(TASKS);
        self.goes_back();
        let back = self.said();
        self.scene.pass(QUIET_MS);
        let said = [before, after, back, self.said()];
        self.judge();
        let incidents = incidents::codes(&self.scene.room.store);
        Ended { incidents, newer: self.newer, said }
    }
    fn rolls_out(&mut self) {
        let scene = &mut self.scene;
        // Nobody is offered again later because it had a task.
        scene.begin("on", GOOD[0], |spec| spec.drain_within = Some(prost_types::Duration { seconds: 600, nanos: 0 }));
        if self.pair.kills() {
            scene.comes_to("on", Phase::Applying);
            scene.room.crash_server();
            self.newer.server_is(Version::This);
            scene.pass(2_000);
            scene.room.restart_server();
        }
        assert_eq!(scene.ends("on").phase, Phase::Completed, "{:?}", self.pair);
        scene.comes_to_rest();
        scene.all_run(Some(GOOD[0]));
    }
    fn goes_back(&mut self) {
        let scene = &mut self.scene;
        scene.order(Order::Rollback { of: "on".to_owned(), id: "back".to_owned() });
        scene.answered();
        assert_eq!(scene.ends("back").phase, Phase::Completed, "{:?}", self.pair);
        scene.comes_to_rest();
        scene.all_run(None);
    }
    /// No task was lost and none done twice, and ledger and switch record agree.
    fn judge(&mut self) {
        let scene = &mut self.scene;
        scene.until("every task to end", |room| {
            let seen = room.observer.lock();
            let tasks = seen.tasks();
            room.desk.is_empty() && tasks.len() == 2 * TASKS && tasks.values().all(|task| task.phase.is_terminal())
        });
        let drops = lock(&scene.room.hall.worlds()[0]).judge().drops_by_task();
        for task in scene.room.observer.lock().tasks().values() {
            let done = (task.phase, drops.get(&task.task_id).copied());
            assert_eq!(done, (TaskPhase::Succeeded, Some(1)), "{:?}: {task:?}", self.pair);
        }
        let verdict = scene.room.hall.verdict().expect("the journals are in memory");
        assert!(verdict.items_conserved(), "{:?}: {verdict:?}", self.pair);
        assert_eq!((verdict.steps_done_twice, verdict.exclusion_violations), (0, 0), "{:?}: {verdict:?}", self.pair);
        scene.room.observer.lock().changes_ended();
        let refused = scene.room.desk.refused.borrow().clone();
        assert_eq!((scene.findings(), refused), (Vec::new(), Vec::new()), "{:?}", self.pair);
    }
}

/// Incidents of a shift in which all are of one version; of each seed it is played once.
fn of_one_version(seed: u64, pair: Pair) -> BTreeSet<Code> {
    static PLAYED: Mutex<BTreeMap<(u64, bool), BTreeSet<Code>>> = Mutex::new(BTreeMap::new());
    let mut played = PLAYED.lock().expect("shifts of one version hold");
    let shift = || {
        let ended = Shift::open(seed, pair).play();
        let said = [Speaker::Robot, Speaker::Server].map(|speaker| ended.newer.said_by(speaker));
        assert_eq!(said, [0, 0], "nobody says more than this version");
        ended.incidents
    };
    played.entry((seed, pair.kills())).or_insert_with(shift).clone()
}

/// Plays a pair with each seed; `looks` at what came of it.
fn each_seed(pair: Pair, looks: impl Fn(&Ended)) {
    let seeds = crate::seeds::number("MIDSHIFT_SEEDS").unwrap_or(SEEDS);
    let first = crate::seeds::number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    for seed in first..first + seeds {
        crate::stderr::print_line(&format!("{pair:?}: seed {seed}"));
        let ended = Shift::open(seed, pair).play();
        let equal = of_one_version(seed, pair.equal());
        let more: Vec<_> = ended.incidents.difference(&equal).collect();
        assert!(more.is_empty(), "seed {seed}: {pair:?} has incidents that two of one version have not: {more:?}");
        looks(&ended);
    }
}

fn is_said(ended: &Ended, speaker: Speaker, names: &[&str]) {
    let silent: Vec<_> = names.iter().filter(|name| ended.newer.said(speaker, name) == 0).collect();
    assert!(silent.is_empty(), "{speaker:?} never said more in {silent:?}");
}

#[test]
fn a_server_of_the_next_version_plays_a_shift_with_agents_of_this_one() {
    each_seed(Pair::Server, |ended| {
        is_said(ended, Speaker::Server, &TOLD);
        assert_eq!(ended.said, [0; 4]);
    });
}

#[test]
fn a_server_that_goes_back_in_a_roll_out_goes_on_with_the_rows_of_the_next_version() {
    each_seed(Pair::ServerGoesBack, |ended| {
        is_said(ended, Speaker::Server, &["link.v1.Welcome", "link.v1.Assignment", "link.v1.DesiredUpdate", "row"]);
    });
}

#[test]
fn agents_of_the_next_version_play_a_shift_with_a_server_of_this_one() {
    each_seed(Pair::Agents, |ended| {
        is_said(ended, Speaker::Robot, &SAID);
        assert_eq!(ended.newer.said_by(Speaker::Server), 0);
    });
}

#[test]
fn a_fleet_of_both_versions_plays_a_shift_with_a_server_of_this_one() {
    each_seed(Pair::Mixed, |ended| is_said(ended, Speaker::Robot, &SAID));
}

#[test]
fn a_release_that_is_the_next_version_is_rolled_out_in_a_shift_and_taken_back() {
    each_seed(Pair::Release, |ended| {
        is_said(ended, Speaker::Robot, &["link.v1.Hello", "link.v1.Heartbeat", "link.v1.UpdateReport", "reason"]);
        let [before, after, back, later] = ended.said;
        assert!(before == 0 && after > 0 && back > after && later == back, "{:?}", ended.said);
    });
}

#[test]
fn a_stop_and_its_reset_reach_agents_whose_stop_service_is_one_version_newer_or_older() {
    for (seed, server) in [(1, Version::Next), (2, Version::This)] {
        let newer = Newer::default();
        newer.server_is(server);
        if server == Version::This {
            newer.robots_are_next(0..ROBOTS);
        }
        let room = RoomConfig { stops: true, newer: Some(newer.clone()), ..config(seed, ROBOTS, Naive::default()) };
        let mut scene = Scene::with(room);
        let knows = |scene: &mut Scene, stops: usize| {
            scene.until(&format!("every robot to know {stops} stops"), |room| {
                let service = room.stop.as_ref().expect("a stop service");
                (0..ROBOTS).all(|robot| effective(&service.saved(robot).latch).len() == stops)
            });
        };
        let scope = Some(v1::Scope { scope: Some(v1::scope::Scope::Fleet(v1::Fleet {})) });
        let (reason, request_id) = ("somebody fell".to_owned(), "stop-1".to_owned());
        let stop = v1::EngageRequest { scope, reason, request_id, ..v1::EngageRequest::default() };
        scene.order(Order::Engage(Box::new(stop)));
        knows(&mut scene, 1);
        let latch = scene.room.stop.as_ref().expect("a stop service").latch();
        let stop_id = effective(&latch).pop_first().expect("one is engaged");
        scene.order(Order::Reset(stop_id.to_string()));
        knows(&mut scene, 0);
        assert_eq!(scene.findings(), [] as [String; 0]);
        let (speaker, said) = match server {
            Version::Next => (Speaker::Server, ["stop.v1.Stop", "stop.v1.Reset"]),
            Version::This => (Speaker::Robot, ["stop.v1.Attend", "stop.v1.CheckIn"]),
        };
        assert!(said.iter().all(|name| newer.said(speaker, name) > 0), "{said:?}");
    }
}

#[test]
fn a_state_that_is_said_before_its_time_is_heard_by_nobody_and_ends_the_release() {
    let newer = Newer::default();
    newer.hastens();
    let room = RoomConfig { newer: Some(newer.clone()), ..config(3, ROBOTS, Naive::default()) };
    let mut scene = Scene::with(room);
    newer.comes_with(scene.bundle(GOOD[0]).expect("it was signed"));
    scene.begin("hasty", GOOD[0], |spec| spec.probation = Some(prost_types::Duration { seconds: 10, nanos: 0 }));
    assert_eq!(scene.ends("hasty").phase, Phase::Aborted);
    assert!(newer.said(Speaker::Robot, "state before its time") > 0);
    assert_eq!(scene.findings(), [] as [String; 0]);
}
