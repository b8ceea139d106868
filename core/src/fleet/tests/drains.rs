//! Robots that leave their work, many at once.

use super::*;
use crate::drain_request::{DrainRelease, DrainRequest, ReleasedBy};
use crate::fleet::rows::DrainState;
use crate::ids::{DrainId, RolloutId};
use crate::limits;

/// What the rollout service asks for at once.
const DRAINS: usize = 1_000;

fn drain_id(n: usize) -> DrainId {
    DrainId::parse(&format!("d{n}")).expect("an id")
}

/// Takes turns until nothing is left, none of which decides more than a slice of each stage. How many they were.
fn take_turns(rig: &mut Rig) -> usize {
    for turn in 1..100 {
        let plan = rig.cycle(Pace::Wake);
        for kind in ["drain.asked", "drain.begun", "drain.held", "drain.released"] {
            let decided = plan.items.iter().flat_map(|item| &item.rows).filter(|row| row.kind == kind).count();
            assert!(decided <= limits::DECISIONS_PER_STAGE, "{decided} of {kind} in turn {turn}");
        }
        if !plan.report.more {
            return turn;
        }
    }
    panic!("something is always left");
}

#[test]
fn drains_that_are_asked_for_and_let_go_all_at_once_are_decided_in_slices() {
    let mut rig = Rig::new();
    for n in 0..DRAINS {
        rig.absorb(&DrainRequest {
            drain_id: drain_id(n),
            robot_id: RobotId::parse(&format!("r{n}")).expect("an id"),
            rollout_id: RolloutId::parse("x").expect("an id"),
            reason: "new software".to_owned(),
            within_ms: 600_000,
            urgent: false,
            is_way_back: false,
            forward: false,
            written_off: false,
        });
    }
    assert!(take_turns(&mut rig) > 3);
    assert_eq!(rig.view.drains.values().filter(|drain| drain.row.state == DrainState::Held).count(), DRAINS);
    for n in 0..DRAINS {
        rig.absorb(&DrainRelease { drain_id: drain_id(n), why: ReleasedBy::NoGrant });
    }
    assert!(take_turns(&mut rig) > 3);
    assert!(rig.view.drains.is_empty());
}
