//! What must hold in every state, and what must be able to happen.

use super::parties::{Action, Parties, Robot, Stage, State, effective};
use stateright::{Model, Property};

pub const UNION: &str = "on each side that is effective which it heard was engaged and did not hear was reset, by name";
pub const NOT_FREED: &str = "no robot moves that was stood before each stop was reset by name and resumed";
pub const NOT_LOST: &str = "a stop that was answered as kept is effective at the service until it is reset by name";
pub const OBEYS: &str = "a robot whose check-ins are answered stands under every stop of the service";
pub const AGREE: &str = "a robot whose check-ins are answered knows as effective what the service does";
pub const STARTS: &str = "a robot that began stands until it was told and answered";

impl Model for Parties {
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
            Property::always(UNION, |m: &Self, s: &State| {
                s.robots.iter().all(|r| effective(m, r.known.facts) == r.heard.effective())
                    && effective(m, s.service) == s.service.engaged & !(s.service.reset & s.reset)
            }),
            Property::always(NOT_FREED, |_, s: &State| {
                s.robots.iter().all(|r| !r.moves || r.stood & !(r.let_go() & (s.reset | !s.engaged)) == 0)
            }),
            Property::always(NOT_LOST, |m: &Self, s: &State| s.answered & !s.reset & !effective(m, s.service) == 0),
            Property::always(OBEYS, |m: &Self, s: &State| {
                let stops = effective(m, s.service);
                (0..).zip(&s.robots).all(|(at, r)| !m.is_answered(r) || !r.moves || m.over(at, stops) == 0)
            }),
            Property::always(AGREE, |m: &Self, s: &State| {
                s.robots.iter().all(|r| !m.is_answered(r) || effective(m, r.known.facts) == effective(m, s.service))
            }),
            Property::always(STARTS, |_, s: &State| {
                s.robots.iter().all(|r| !r.moves || r.told && r.stage == Stage::Heard)
            }),
            Property::sometimes("a robot moves that was stood", |_, s: &State| {
                s.robots.iter().any(|r| r.moves && r.stood != 0)
            }),
        ];
        if self.kills > 0 {
            properties
                .push(Property::sometimes("a stop that the service lost comes back with a robot", |_, s: &State| {
                    s.came_back
                }));
        }
        if self.restarts > 0 {
            properties.push(Property::sometimes("a robot begins with a stop that it kept", |_, s: &State| {
                s.robots.iter().any(|r| r.stage == Stage::Begun && r.line.is_none() && r.known.awaiting != 0)
            }));
        }
        properties
    }
}

/// Everybody is answered, all that was engaged is reset, and everybody moves.
pub fn is_end(parties: &Parties, state: &State) -> bool {
    let moves = |robot: &Robot| robot.moves && parties.is_answered(robot);
    effective(parties, state.service) == 0 && state.robots.iter().all(moves)
}
