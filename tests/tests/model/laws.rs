//! What must hold in every state, what must be able to happen, and that every drain can end from wherever things stand.

use super::protocol::{Action, Asked, Holder, Protocol, State, in_flight};
use stateright::{Checker, HasDiscoveries, Model, Property};
use std::collections::HashMap;
use std::fmt::Debug;
use std::hash::Hash;

pub const IN_FLIGHT: &str = "no more robots are out of work than the wave allows";
pub const ONE_HOLDER: &str = "a robot switches or works only while it is held for that and nothing else";
pub const OWN_DRAIN: &str = "a roll-out switches a robot only in a drain that it asked for itself";
pub const NOT_FREED: &str = "no drain is released whose robot switches or still may";
pub const NO_GRANT: &str = "no grant is written while its roll-out does not run";
pub const NOT_LATE: &str = "nothing is activated past the grant's life after a pause or an abort";
pub const OWN_LEDGER: &str = "a robot activates only while its ledger's holder is the drain of the grant";

impl Model for Protocol {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        vec![self.first()]
    }

    fn actions(&self, state: &State, actions: &mut Vec<Action>) {
        actions.extend(self.possible(state));
    }

    fn next_state(&self, state: &State, action: Action) -> Option<State> {
        Some(self.after(state, action))
    }

    fn properties(&self) -> Vec<Property<Self>> {
        let mut properties = vec![
            Property::always(IN_FLIGHT, |m: &Self, s: &State| (0..m.rollouts).all(|k| in_flight(s, k) <= m.wave)),
            Property::always(ONE_HOLDER, one_holder),
            Property::always(OWN_DRAIN, |_, s: &State| {
                s.robots.iter().all(|r| r.switching.is_none() || r.held_for.is_none() || r.held_for == r.switching)
            }),
            Property::always(NOT_FREED, not_freed),
            Property::always(NO_GRANT, |_, s: &State| !s.granted_in_pause),
            Property::always(NOT_LATE, |_, s: &State| !s.activated_late),
            Property::always(OWN_LEDGER, |_, s: &State| !s.activated_unheld),
            Property::sometimes("a robot switches", |_, s: &State| s.robots.iter().any(|r| r.switching == Some(0))),
            Property::sometimes(
                "a grant written before a pause or an abort is used after it, within its life",
                |_, s: &State| s.robots.iter().any(|r| r.after_stop),
            ),
            Property::sometimes("a drain is released after a grant that was not used", |_, s: &State| {
                s.robots.iter().any(|r| r.drains[0].asked == Asked::Over && r.drains[0].grant.is_some() && !r.used[0])
            }),
        ];
        if self.rollouts == 2 {
            properties.push(Property::sometimes(
                "the next roll-out switches a robot that the first had drained",
                |_, s: &State| s.robots.iter().any(|r| r.switching == Some(1) && r.drains[0].asked == Asked::Over),
            ));
        }
        if self.cuts + self.kills > 0 {
            properties.push(Property::sometimes(
                "a grant is used that was anchored to a new session",
                |_, s: &State| {
                    s.robots
                        .iter()
                        .any(|r| r.switching.is_some_and(|k| r.drains[k].grant.is_some_and(|g| g.session > 0)))
                },
            ));
        }
        properties
    }
}

fn one_holder(protocol: &Protocol, state: &State) -> bool {
    state.robots.iter().all(|robot| {
        let switches = robot.switching.is_none_or(|k| robot.authority == Holder::Drain(protocol.drain_id(k)));
        let works = robot.holder != Holder::Attempt || robot.authority == Holder::Attempt;
        switches && works
    })
}

fn not_freed(protocol: &Protocol, state: &State) -> bool {
    state.robots.iter().all(|robot| {
        let freed = |k: usize| matches!(robot.drains[k].asked, Asked::Released | Asked::Over);
        let switches = robot.switching.is_some_and(freed);
        let mut orders = robot.order.iter().chain(robot.update_down.iter().flatten());
        !switches && !orders.any(|order| freed(order.rollout) && protocol.may_activate(robot, *order))
    })
}

/// All that was asked for is over, and the robot is nobody's or at work.
pub fn is_end(state: &State) -> bool {
    state.robots.iter().all(|robot| {
        let over = robot.drains.iter().all(|d| matches!(d.asked, Asked::Never | Asked::Over));
        let told = robot.switching.is_none() && !robot.untold.contains(&true);
        over && told && !matches!(robot.authority, Holder::Drain(_))
    })
}

/// Counts the states from which one can be reached that `is_end`. Stateright has no word for it: its "eventually" means every way, and
/// some ways never let a message arrive.
pub fn ends_everywhere<M: Model>(model: &M, is_end: impl Fn(&M::State) -> bool) -> usize
where
    M::State: Clone + Eq + Hash,
{
    let mut open = model.init_states();
    let mut numbers: HashMap<M::State, usize> = open.iter().cloned().zip(0..).collect();
    let mut before: Vec<Vec<u32>> = vec![Vec::new(); open.len()];
    let (mut ends, mut actions) = (Vec::new(), Vec::new());
    while let Some(state) = open.pop() {
        let number = numbers[&state];
        if is_end(&state) {
            ends.push(number);
        }
        model.actions(&state, &mut actions);
        for next in actions.drain(..).filter_map(|action| model.next_state(&state, action)) {
            let count = numbers.len();
            let known = *numbers.entry(next.clone()).or_insert(count);
            if known == count {
                before.push(Vec::new());
                open.push(next);
            }
            before[known].push(number as u32);
        }
    }
    let mut reaches = vec![false; before.len()];
    while let Some(number) = ends.pop() {
        if !std::mem::replace(&mut reaches[number], true) {
            ends.extend(before[number].iter().map(|n| *n as usize));
        }
    }
    reaches.iter().filter(|reaches| **reaches).count()
}

/// Steps of the longest way that is looked for.
const STEPS_MAX: usize = 30;

/// The shortest way to break a law of a model without one rule has so many steps, these among them in this order.
#[expect(clippy::print_stdout, reason = "a way that breaks a law belongs to the result")]
pub fn assert_way<M>(model: M, naive: &dyn Debug, law: &'static str, steps: usize, among: &[M::Action])
where
    M: Model + Clone + Send + Sync + 'static,
    M::State: Clone + Hash + PartialEq + Send + Sync + 'static,
    M::Action: Clone + PartialEq + Debug,
{
    let way = shortest(model, law).unwrap_or_else(|| panic!("{naive:?} breaks nothing: {law}"));
    println!("{naive:?} in {} steps: not true that {law}: {way:?}", way.len());
    assert_eq!(way.len(), steps, "{way:?}");
    let mut rest = way.iter();
    for action in among {
        assert!(rest.any(|taken| taken == action), "{action:?} is not in its place in {way:?}");
    }
}

/// The shortest way to break a law, if there is one. One depth after the other: where several states of a block break a law, stateright
/// tells the last that it saw.
fn shortest<M>(model: M, law: &'static str) -> Option<Vec<M::Action>>
where
    M: Model + Clone + Send + Sync + 'static,
    M::State: Clone + Hash + PartialEq + Send + Sync + 'static,
    M::Action: Clone + PartialEq,
{
    (1..=STEPS_MAX).find_map(|steps| {
        let found = HasDiscoveries::AllOf([law].into());
        // It counts states, of which there is one more than steps, and stops before the one that is named.
        let checker = model.clone().checker().finish_when(found).target_max_depth(steps + 2).spawn_bfs().join();
        checker.discovery(law).map(|path| path.into_actions())
    })
}
