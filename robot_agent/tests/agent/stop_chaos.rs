//! Stops, resets, resumes, permissions, silences and kills in any order: the body never moves before all that let it go
//! on.

use crate::rig::{Rig, goto, point};
use crate::stops::{attend, free, hear_news, moves, reset, serve, stop, stop_id, told};
use midshift_agent::stop::StopNews;
use midshift_core::desired_state::{Assignment, DesiredWork};
use midshift_core::robot::StopLevel;
use proptest::prelude::*;
use proptest::test_runner::{RngAlgorithm, TestRng, TestRunner};
use std::cell::Cell;
use std::collections::BTreeSet;

#[derive(Clone, Copy, Debug)]
enum Act {
    Engage(u64, StopLevel),
    Reset(u64),
    /// People resume this stop if it stood the robot; with a permission to go on.
    Resume(u64, bool),
    Line,
    LineLost,
    Pass,
    Kill,
}

fn acts() -> impl Strategy<Value = Act> {
    let level = prop_oneof![Just(StopLevel::Slow), Just(StopLevel::Halt), Just(StopLevel::ControlledStopPosture)];
    prop_oneof![
        2 => (1..3_u64, level).prop_map(|(n, level)| Act::Engage(n, level)),
        3 => (1..3_u64).prop_map(Act::Reset),
        4 => (1..3_u64, any::<bool>()).prop_map(|(n, is_permitted)| Act::Resume(n, is_permitted)),
        1 => Just(Act::Line),
        1 => Just(Act::LineLost),
        3 => Just(Act::Pass),
        1 => Just(Act::Kill),
    ]
}

/// What the robot was told, as the test knows it.
struct Judge {
    rig: Rig,
    reset: BTreeSet<u64>,
    /// Stops that it was told of before their reset and that stand a robot; those that people resumed since.
    stood: BTreeSet<u64>,
    resumed: BTreeSet<u64>,
    /// A permission was given since it stood last.
    is_permitted: bool,
}

fn order(rig: &Rig) -> Assignment {
    let route = vec![point("A", None, false, &[]), point("B", None, false, &[]), point("C", Some(0), false, &[])];
    rig.offer("T1", 1, vec![goto("C")], route)
}

impl Judge {
    fn new() -> Self {
        let mut rig = free();
        rig.work(rig.desired(Some(order(&rig))));
        assert!(moves(&rig));
        let none = BTreeSet::new();
        Self { rig, reset: none.clone(), stood: none.clone(), resumed: none, is_permitted: true }
    }

    fn act(&mut self, act: Act) {
        match act {
            Act::Engage(n, level) => {
                if level >= StopLevel::Halt && !self.reset.contains(&n) {
                    self.is_permitted &= !self.stood.insert(n);
                }
                told(&mut self.rig, vec![stop(n, level)], vec![]);
            }
            Act::Reset(n) => {
                self.reset.insert(n);
                told(&mut self.rig, vec![], vec![reset(n)]);
            }
            Act::Resume(n, is_permitted) => {
                self.resumed.extend(Some(n).filter(|n| self.stood.contains(n)));
                self.is_permitted |= is_permitted;
                let resumed = self.resumed.iter().map(|n| stop_id(*n)).collect();
                let resume = is_permitted.then(|| self.rig.authority(10_000));
                let work = DesiredWork { resumed, resume, ..self.rig.desired(Some(order(&self.rig))) };
                self.rig.work(work);
            }
            Act::Line => attend(&mut self.rig),
            Act::LineLost => hear_news(&mut self.rig, StopNews::LineLost),
            Act::Pass => serve(&mut self.rig, 4_000),
            Act::Kill => {
                // One that waits for nobody any more is held by fleet's own word until it is permitted, and nobody says
                // it here.
                self.is_permitted |= self.stood.iter().all(|n| self.reset.contains(n) && self.resumed.contains(n));
                let rig = std::mem::replace(&mut self.rig, Rig::at("A"));
                self.rig = rig.restart();
                self.rig.connect();
                self.rig.work(self.rig.desired(Some(order(&self.rig))));
            }
        }
    }

    /// Whether it moves after it stood.
    fn check(&self) -> bool {
        if !moves(&self.rig) {
            return false;
        }
        assert!(self.stood.is_subset(&self.reset), "moves under a stop: {:?}, reset {:?}", self.stood, self.reset);
        assert!(self.stood.is_subset(&self.resumed), "nobody resumed {:?}, but {:?}", self.stood, self.resumed);
        assert!(self.is_permitted, "nobody permitted it");
        !self.stood.is_empty()
    }
}

#[test]
fn in_no_order_of_things_it_moves_before_each_stop_was_reset_and_resumed_and_it_was_permitted() {
    let config =
        ProptestConfig { cases: 400, failure_persistence: None, max_shrink_iters: 200, ..ProptestConfig::default() };
    let mut runner = TestRunner::new_with_rng(config, TestRng::deterministic_rng(RngAlgorithm::ChaCha));
    let freed = Cell::new(0);
    let run = runner.run(&proptest::collection::vec(acts(), 1..40), |acts| {
        let mut judge = Judge::new();
        for act in acts {
            judge.act(act);
            freed.set(freed.get() + u32::from(judge.check()));
        }
        Ok(())
    });
    run.expect("it stands");
    assert!(freed.get() > 20, "only {} times it went on after it stood: nothing was tried", freed.get());
}
