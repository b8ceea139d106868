//! A robot among lost messages, kills, slow disks and careless orders: what must hold after each step, whatever came
//! before.

use crate::rig::{Rig, action, goto, place_id, point};
use crate::test_body::TestBody;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_agent::core::Input;
use midshift_agent::memory::MemoryStore;
use midshift_core::authority::SentHeartbeats;
use midshift_core::desired_state::{Assignment, DesiredWork, GrantedPlace, RoutePoint};
use midshift_core::ids::AttemptId;
use midshift_core::robot::Lane;
use midshift_core::robot::WorkState;
use midshift_core::robot_events::{PlaceNews, RobotEvent};
use midshift_core::step::{Effect, StepKind, WorkStep};
use midshift_core::time::LinkTime;
use proptest::prelude::{Just, ProptestConfig, Strategy, any, prop_oneof, proptest};
use proptest::test_runner::{RngAlgorithm, TestRng, TestRunner};
use std::collections::{BTreeMap, BTreeSet};

/// What may happen to a robot.
#[derive(Clone, Debug)]
enum Act {
    Pass(u64),
    Silence(u64),
    Reach,
    Done,
    Desire { epoch: u64, fresh: bool, grants: u8, released: u32, stop: bool, suspend: bool, held: bool },
    Nothing,
    Reconnect,
    Kill,
    SlowDisk(bool),
}

fn acts() -> impl Strategy<Value = Act> {
    prop_oneof![
        4 => (1u64..6).prop_map(|n| Act::Pass(n * 500)),
        2 => (1u64..80).prop_map(|n| Act::Silence(n * 500)),
        6 => Just(Act::Reach),
        3 => Just(Act::Done),
        8 => (1u64..4, any::<bool>(), any::<u8>(), 0u32..5, 0u8..10, 0u8..10, 0u8..6).prop_map(
            |(epoch, fresh, grants, released, stop, suspend, held)| Act::Desire {
                epoch, fresh, grants, released, stop: stop == 0, suspend: suspend == 0, held: held == 0
            }
        ),
        1 => Just(Act::Nothing),
        1 => Just(Act::Reconnect),
        1 => Just(Act::Kill),
        1 => any::<bool>().prop_map(Act::SlowDisk),
    ]
}

fn route() -> Vec<RoutePoint> {
    vec![
        point("A", None, true, &[]),
        point("B", None, false, &["door"]),
        point("C", None, true, &["door"]),
        point("D", None, false, &["aisle"]),
        point("E", Some(0), true, &["aisle"]),
    ]
}

fn steps() -> Vec<WorkStep> {
    vec![goto("E"), action("pick", Effect::AtMostOnce), action("place", Effect::AtMostOnce)]
}

/// What the test knows beside the robot.
struct Judge {
    rig: Rig,
    /// Send times of heartbeats in this session, as the robot must have noted them.
    sent: SentHeartbeats,
    noted: u64,
    grants: Vec<GrantedPlace>,
    next_grant: u64,
    inside: BTreeMap<String, u64>,
    spent: BTreeSet<u64>,
    /// Picks and places that the body began, by attempt.
    begun: BTreeMap<(AttemptId, String), u32>,
    acts: u32,
    offered: Option<Assignment>,
    last: Option<AttemptId>,
}

impl Judge {
    fn new(bugs: Bugs) -> Self {
        let mut rig = Rig::with(TestBody::at("A"), MemoryStore::new(), bugs);
        rig.connect();
        let mut judge = Self {
            sent: SentHeartbeats::new(rig.epoch, None),
            rig,
            noted: 0,
            grants: Vec::new(),
            next_grant: 1,
            inside: BTreeMap::new(),
            spent: BTreeSet::new(),
            begun: BTreeMap::new(),
            acts: 0,
            offered: None,
            last: None,
        };
        judge.note_heartbeats();
        judge
    }

    fn note_heartbeats(&mut self) {
        // The rig ticks twice a second, so each heartbeat went out in the tick that first shows it.
        if self.rig.hb > self.noted {
            self.noted = self.rig.hb;
            self.sent.sent(self.rig.hb, LinkTime(self.rig.ms));
        }
    }

    fn new_session(&mut self) {
        self.rig.connect();
        self.sent = SentHeartbeats::new(self.rig.epoch, None);
        self.noted = 0;
        self.note_heartbeats();
    }

    fn act(&mut self, act: &Act) {
        match act {
            Act::Pass(ms) => self.time(*ms, true),
            Act::Silence(ms) => self.time(*ms, false),
            Act::Reach => {
                if !self.rig.body.goes_to().is_empty() && !self.rig.body.log().paused {
                    self.rig.body.reach();
                    self.rig.give(Input::Tick);
                }
            }
            Act::Done => {
                if self.rig.body.log().acting.is_some() && !self.rig.body.log().paused {
                    self.rig.body.done();
                    self.rig.give(Input::Tick);
                }
            }
            Act::Desire { epoch, fresh, grants, released, stop, suspend, held } => {
                self.desire(*epoch, *fresh, *grants, *released, (*stop, *suspend, *held));
            }
            Act::Nothing => {
                self.grants.clear();
                self.rig.work(self.rig.desired(None));
            }
            Act::Reconnect => {
                self.rig.give(Input::Disconnected);
                self.new_session();
            }
            Act::Kill => self.kill(),
            Act::SlowDisk(slow) => {
                if *slow {
                    self.rig.slow_disk = true;
                } else {
                    self.rig.flush();
                }
            }
        }
        self.note_heartbeats();
    }

    fn time(&mut self, ms: u64, echoed: bool) {
        for _ in 0..ms / 500 {
            if echoed {
                self.rig.pass(500);
            } else {
                self.rig.silence(500);
            }
            self.note_heartbeats();
            self.check();
        }
    }

    fn desire(&mut self, epoch: u64, fresh: bool, grants: u8, released: u32, flags: (bool, bool, bool)) {
        for (bit, place) in ["A", "C", "E", "door", "aisle"].into_iter().enumerate() {
            let granted = grants & (1 << bit) != 0;
            let have = self.grants.iter().position(|g| g.place_id.as_str() == place);
            match have {
                Some(i) if !granted => drop(self.grants.remove(i)),
                Some(i) if fresh => self.grants[i].entry = Some(self.rig.authority(10_000)),
                None if granted => {
                    self.grants.push(self.rig.grant(place, self.next_grant));
                    self.next_grant += 1;
                }
                _ => {}
            }
        }
        let (stop, suspend, held) = flags;
        let route_number = 1;
        let offer = self.rig.offer("T1", epoch, steps(), route());
        let old = self.offered.take().filter(|o| o.attempt == offer.attempt && !fresh).map(|o| o.offer);
        let offer = old.unwrap_or(offer.offer);
        let base = self.rig.offer("T1", epoch, steps(), route());
        let assignment = Assignment { offer, released_index: Some(released), stop, suspend, route_number, ..base };
        self.offered = Some(assignment.clone());
        self.last = Some(assignment.attempt.clone());
        let resume = (fresh && !held).then(|| self.rig.authority(10_000));
        let grants = self.grants.clone();
        self.rig.work(DesiredWork { grants, held, resume, ..self.rig.desired(Some(assignment)) });
    }

    /// The process dies with what was not durable; its body stands where it is.
    fn kill(&mut self) {
        let rig = std::mem::replace(&mut self.rig, Rig::at("A"));
        rig.body.set(|b| {
            b.path.clear();
            b.acting = None;
            b.paused = false;
        });
        self.rig = rig.restart();
        self.new_session();
    }

    fn check(&mut self) {
        self.check_events();
        self.check_path();
        self.check_acts();
        self.check_report();
    }

    /// A place is entered on a listed or remembered grant, once, and left before it is entered again.
    fn check_events(&mut self) {
        for event in std::mem::take(&mut self.rig.events) {
            let RobotEvent::Place { place_id, grant_id, news } = &event else { continue };
            let place = place_id.to_string();
            match news {
                PlaceNews::Entered => {
                    assert!(*grant_id == 0 || !self.spent.contains(grant_id), "{event:?} on a spent grant");
                    // After a kill the robot says again where it is.
                    self.inside.insert(place, *grant_id);
                }
                PlaceNews::Left => {
                    self.inside.remove(&place);
                    self.spent.insert(*grant_id);
                }
                PlaceNews::NotEntered => {
                    assert_ne!(self.inside.get(&place), Some(grant_id), "{event:?} while inside");
                    self.spent.insert(*grant_id);
                }
            }
        }
    }

    /// The body is on its way only into places that it is in or may enter at this moment.
    fn check_path(&self) {
        let now = LinkTime(self.rig.ms);
        let row = &self.rig.core.memory().ledger.places;
        for name in self.rig.body.goes_to() {
            let Some(point) = route().into_iter().find(|p| p.waypoint.as_str() == name) else { continue };
            for place in point.passages.iter().chain(&point.standing) {
                let granted = self.grants.iter().any(|g| {
                    g.place_id == *place
                        && !self.spent.contains(&g.grant_id)
                        && g.entry.is_some_and(|a| self.sent.check(&a, now).is_ok())
                });
                assert!(granted || row.inside.contains_key(place), "drives to {name} without {place}: {row:?}");
            }
        }
    }

    /// What must not be done twice is begun at most once an attempt: the body of this test never knows.
    fn check_acts(&mut self) {
        let log = self.rig.body.log();
        if log.acts == self.acts {
            return;
        }
        assert_eq!(log.acts, self.acts + 1, "two actions at once");
        self.acts = log.acts;
        let Some(StepKind::Action { name, .. }) = log.acting else { return };
        let holder = self.rig.store.memory().and_then(|k| k.ledger.holder).expect("the ledger knows who acts");
        assert!(holder.intent.is_some(), "no intent on the disk");
        let begun = self.begun.entry((holder.attempt.clone(), name)).or_default();
        *begun += 1;
        assert_eq!(*begun, 1, "{} twice", holder.attempt);
    }

    /// At most one attempt lives, and nothing drives or acts without it.
    fn check_report(&self) {
        let now = crate::rig::now_at(self.rig.ms);
        let reported = self.rig.core.reported(&now);
        let live: Vec<_> = reported.attempts.iter().filter(|a| !a.state.is_over()).collect();
        assert!(live.len() <= 1, "{live:?}");
        let log = self.rig.body.log();
        let busy = !log.path.is_empty() || log.acting.is_some();
        assert!(!busy || live.len() == 1, "works for nobody: {:?}", reported.attempts);
        let unknown = live.iter().any(|a| a.state == WorkState::StepUnknown);
        assert!(!(busy && unknown), "moves while nobody knows");
        let held: BTreeSet<_> = reported.places.iter().filter(|p| p.inside).map(|p| p.place_id.clone()).collect();
        assert!(self.rig.core.memory().ledger.places.inside.keys().all(|p| held.contains(p)));
        // Differences count once every number that was given has been heard.
        let settled = reported.produced[&Lane::Event] == self.rig.heard(Lane::Event);
        assert!(
            !settled || self.inside.keys().all(|p| held.contains(&place_id(p))),
            "said inside and not held: {held:?}"
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_order_of_things_makes_a_robot_enter_act_or_live_without_authority(acts in proptest::collection::vec(acts(), 1..60)) {
        live(Bugs::default(), &acts);
    }
}

fn live(bugs: Bugs, acts: &[Act]) {
    let mut judge = Judge::new(bugs);
    for act in acts {
        judge.act(act);
        judge.check();
    }
}

#[test]
fn the_judge_catches_a_robot_that_counts_its_grants_from_receipt() {
    let config =
        ProptestConfig { cases: 400, failure_persistence: None, max_shrink_iters: 0, ..ProptestConfig::default() };
    let mut runner = TestRunner::new_with_rng(config, TestRng::deterministic_rng(RngAlgorithm::ChaCha));
    let naive = Bugs::seeded(&[SeededBug::GrantFromReceipt]);
    let caught = runner.run(&proptest::collection::vec(acts(), 1..60), |acts| {
        live(naive, &acts);
        Ok(())
    });
    assert!(caught.is_err());
}
