//! Remembers decisions that the store refuses for good, and puts aside what it refused twice.
//!
//! While a decision is aside it is taken back whenever it is composed, and the robots and
//! places it is about get no work and no grant. It is tried again when one of its rows changes, when its robot opens a session, or when a
//! person closes its incident. Invariant: what is aside never reaches the store, and a person is told of it once.

use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::projection::DecisionKey;
use crate::rows::{Key, Table};
use std::collections::BTreeSet;

/// Notes that the store refused a decision for good, or would; the second time puts it aside.
pub fn note_refusal(view: &mut FleetProjection, decision_key: DecisionKey) {
    let robots = robots_of(view, &decision_key);
    view.refused.note(decision_key, robots);
}

/// The store refused a decision for good: it is noted, and what it was about is looked at again.
pub fn undone(view: &mut FleetProjection, decision_key: DecisionKey) {
    let robots = robots_of(view, &decision_key);
    view.refused.look_again(robots);
    note_refusal(view, decision_key);
}

/// Looks again at robots of decisions that were undone, or are not aside any more.
pub(in crate::fleet) fn try_again(view: &mut FleetProjection) {
    let robots = view.refused.take_again();
    if robots.is_empty() {
        return;
    }
    view.compared.retain(|robot_id, _| !robots.contains(robot_id));
    view.dirty.extend(robots.iter().cloned());
    view.policy_dirty.extend(robots);
}

/// Robots that rows are about.
fn robots_of(view: &FleetProjection, decision_key: &DecisionKey) -> BTreeSet<RobotId> {
    let robot = |key: &Key| match key.table {
        Table::RobotAuthority | Table::RobotControl | Table::DesiredWork | Table::DesiredPolicy => {
            RobotId::parse(&key.id).ok()
        }
        Table::HoldToken => key.id.split(':').nth(1).and_then(|id| RobotId::parse(id).ok()),
        Table::Attempt => view.attempts.get(&*key.id).map(|a| a.row.robot_id.clone()),
        _ => None,
    };
    decision_key.keys.iter().filter_map(robot).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::decision::incidents::open_put_aside;
    use crate::fleet::decision::plan::{Plan, Tx};
    use crate::fleet::projection::rows::{HoldToken, RobotAuthority, RobotHolder};
    use crate::limits;
    use crate::reason::Code;
    use crate::site::{CORRIDOR, text};
    use crate::time::Now;
    use std::sync::Arc;

    fn view() -> FleetProjection {
        FleetProjection::new(Arc::new(text::parse(CORRIDOR).expect("reads")), Now::default(), Now::default())
    }

    fn robot() -> RobotId {
        RobotId::parse("r1").expect("an id")
    }

    /// More rows than an item takes.
    fn too_much(tx: &mut Tx) {
        tx.put_row(RobotAuthority { robot_id: robot(), holder: RobotHolder::None }, "robot.known");
        for n in 0..limits::ITEM_ROWS_MAX {
            let token = format!("stop:{n}");
            tx.put_row(HoldToken { robot_id: robot(), token, since: tx.now.utc }, "hold.stopped");
        }
    }

    #[test]
    fn a_decision_that_no_store_takes_leaves_the_projection_as_it_was_and_is_put_aside_at_the_second_time() {
        let (mut view, now, mut plan) = (view(), Now::default(), Plan::default());
        assert!(!plan.decide(&mut view, now, "tests", too_much));
        assert!(view.holds.is_empty() && view.authority.is_empty() && plan.items.is_empty());
        assert_eq!(view.refused.check_robot(&robot()), Ok(()));
        assert!(!plan.decide(&mut view, now, "tests", too_much));
        let why = view.refused.check_robot(&robot()).expect_err("it gets no work");
        assert_eq!(why.code, Code::DecisionPutAside);
        open_put_aside(&mut view, now, &mut plan);
        open_put_aside(&mut view, now, &mut plan);
        assert_eq!(view.incidents.len(), 1, "a person is told once");
    }

    #[test]
    fn what_is_aside_is_tried_again_when_a_row_of_it_changes_or_its_robot_comes_anew() {
        for (table, id) in [(Table::RobotAuthority, "r1"), (Table::Session, "r1")] {
            let (mut view, now, mut plan) = (view(), Now::default(), Plan::default());
            plan.decide(&mut view, now, "tests", too_much);
            plan.decide(&mut view, now, "tests", too_much);
            view.refused.row_changed(&Key::new(table, "r2"));
            assert!(view.refused.keeps_any());
            view.refused.row_changed(&Key::new(table, id));
            assert!(!view.refused.keeps_any());
        }
    }

    #[test]
    fn what_robots_can_make_it_forget_is_bounded() {
        let mut view = view();
        for n in 0..2 * limits::REFUSED_REMEMBERED {
            note_refusal(
                &mut view,
                DecisionKey { kind: "tests", keys: vec![Key::new(Table::Incident, n.to_string())] },
            );
        }
        assert_eq!(view.refused.count(), limits::REFUSED_REMEMBERED);
    }
}
