//! Remembers decisions that the store refuses for good, and puts aside what it refused twice.
//!
//! A decision is the same if its kind and its rows are. While it is aside it is taken back whenever it is composed, and the robots and
//! places it is about get no work and no grant. It is tried again when one of its rows changes, when its robot opens a session, or when a
//! person closes its incident. Invariant: what is aside never reaches the store, and a person is told of it once.

use super::view::View;
use super::{Plan, incidents};
use crate::ids::{PlaceId, RobotId};
use crate::limits;
use crate::picture::Outline;
use crate::reason::{Code, Reason};
use crate::rows::{Key, Table};
use crate::time::Now;
use std::collections::{BTreeMap, BTreeSet};

/// What is known of one refused decision.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Known {
    /// How often it was refused.
    times: u32,
    /// It is not tried any more.
    is_aside: bool,
    /// It was put aside and no person was told yet.
    is_untold: bool,
    /// Robots that it is about.
    robots: BTreeSet<RobotId>,
}

/// Decisions that the store refused for good.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Refused {
    known: BTreeMap<Outline, Known>,
    /// Robots of decisions that are tried again.
    again: BTreeSet<RobotId>,
}

impl Refused {
    /// Whether any decision is aside.
    pub fn keeps_any(&self) -> bool {
        self.known.values().any(|known| known.is_aside)
    }
    /// Whether this one is aside.
    pub fn is_aside(&self, outline: &Outline) -> bool {
        self.known.get(outline).is_some_and(|known| known.is_aside)
    }
    /// Keeps work from a robot that a decision aside is about.
    ///
    /// # Errors
    /// If there is one; the reason names it.
    pub fn screen(&self, robot_id: &RobotId) -> Result<(), Reason> {
        match self.aside().find(|(_, known)| known.robots.contains(robot_id)) {
            Some((outline, _)) => Err(reason(outline)),
            None => Ok(()),
        }
    }
    /// Whether a decision aside is about the place.
    pub fn is_place_aside(&self, place_id: &PlaceId) -> bool {
        let is_it = |key: &Key| key.table == Table::PlaceGrant && *key.id == *place_id.as_str();
        self.aside().any(|(outline, _)| outline.keys.iter().any(is_it))
    }
    /// A row changed: what is about it is tried again. Of the robots' rows a session counts too.
    pub fn row_changed(&mut self, key: &Key) {
        self.try_those(|outline, known| {
            let is_session = || key.table == Table::Session && known.robots.iter().any(|r| r.as_str() == &*key.id);
            outline.keys.contains(key) || is_session()
        });
    }
    /// A person closed an incident: the decision that it was about is tried again.
    pub fn incident_closed(&mut self, told: &Reason) {
        self.try_those(|outline, _| reason(outline) == *told);
    }
    fn try_those(&mut self, are_meant: impl Fn(&Outline, &Known) -> bool) {
        for (outline, known) in self.known.iter_mut().filter(|(_, known)| known.is_aside) {
            if are_meant(outline, known) {
                known.is_aside = false;
                self.again.extend(known.robots.iter().cloned());
            }
        }
    }
    fn aside(&self) -> impl Iterator<Item = (&Outline, &Known)> {
        self.known.iter().filter(|(_, known)| known.is_aside)
    }
}

/// Notes that the store refused a decision for good, or would; the second time puts it aside.
pub fn note_refusal(view: &mut View, outline: Outline) {
    let robots = robots_of(view, &outline);
    let all = &mut view.refused.known;
    if all.len() >= limits::REFUSED_REMEMBERED && !all.contains_key(&outline) {
        all.pop_first();
    }
    let known = all.entry(outline).or_default();
    known.times = known.times.saturating_add(1);
    known.robots = robots;
    if known.times >= limits::REFUSALS_UNTIL_ASIDE && !known.is_aside {
        (known.is_aside, known.is_untold) = (true, true);
    }
}

/// The store refused a decision for good: it is noted, and what it was about is looked at again.
pub fn undone(view: &mut View, outline: Outline) {
    view.refused.again.extend(robots_of(view, &outline));
    note_refusal(view, outline);
}

/// Looks again at robots of decisions that were undone, or are not aside any more.
pub(super) fn try_again(view: &mut View) {
    let robots = std::mem::take(&mut view.refused.again);
    view.compared.retain(|robot_id, _| !robots.contains(robot_id));
    view.dirty.extend(robots.iter().cloned());
    view.policy_dirty.extend(robots);
}

/// Tells people of every decision, and of every row of a newer version, that was put aside since.
pub fn open_incidents(view: &mut View, now: Now, plan: &mut Plan) {
    let untold = |known: &mut Known| std::mem::take(&mut known.is_untold);
    let known = view.refused.known.iter_mut();
    let known = known.filter_map(|(o, k)| untold(k).then(|| (reason(o), k.robots.first().cloned())));
    let untold: Vec<_> = known.chain(view.unknown_rows.take_untold()).collect();
    for (reason, robot_id) in untold {
        plan.decide(view, now, "fleet", |tx| incidents::open_once(tx, reason, robot_id.as_ref()));
    }
}

/// Why a robot gets no work, and what the incident says: the same for the same decision.
fn reason(outline: &Outline) -> Reason {
    let first = outline.keys.first().map(|key| format!("{}/{}", key.table.name(), key.id)).unwrap_or_default();
    Reason::from(Code::DecisionPutAside)
        .with("decision", outline.kind)
        .with("first_row", first)
        .with("rows", outline.keys.len())
}

/// Robots that rows are about.
fn robots_of(view: &View, outline: &Outline) -> BTreeSet<RobotId> {
    let robot = |key: &Key| match key.table {
        Table::RobotAuthority | Table::RobotControl | Table::DesiredWork | Table::DesiredPolicy => {
            RobotId::parse(&key.id).ok()
        }
        Table::HoldToken => key.id.split(':').nth(1).and_then(|id| RobotId::parse(id).ok()),
        Table::Attempt => view.attempts.get(&*key.id).map(|a| a.row.robot_id.clone()),
        _ => None,
    };
    outline.keys.iter().filter_map(robot).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::Tx;
    use crate::fleet::rows::{HoldToken, RobotAuthority, RobotHolder};
    use crate::site::{CORRIDOR, text};
    use std::sync::Arc;

    fn view() -> View {
        View::new(Arc::new(text::parse(CORRIDOR).expect("reads")), Now::default(), Now::default())
    }

    fn robot() -> RobotId {
        RobotId::parse("r1").expect("an id")
    }

    /// More rows than an item takes.
    fn too_much(tx: &mut Tx) {
        tx.put(RobotAuthority { robot_id: robot(), holder: RobotHolder::None }, "robot.known");
        for n in 0..limits::ITEM_ROWS_MAX {
            let token = format!("stop:{n}");
            tx.put(HoldToken { robot_id: robot(), token, since: tx.now.utc }, "hold.stopped");
        }
    }

    #[test]
    fn a_decision_that_no_store_takes_leaves_the_picture_as_it_was_and_is_put_aside_at_the_second_time() {
        let (mut view, now, mut plan) = (view(), Now::default(), Plan::default());
        assert!(!plan.decide(&mut view, now, "tests", too_much));
        assert!(view.holds.is_empty() && view.authority.is_empty() && plan.items.is_empty());
        assert_eq!(view.refused.screen(&robot()), Ok(()));
        assert!(!plan.decide(&mut view, now, "tests", too_much));
        let why = view.refused.screen(&robot()).expect_err("it gets no work");
        assert_eq!(why.code, Code::DecisionPutAside);
        open_incidents(&mut view, now, &mut plan);
        open_incidents(&mut view, now, &mut plan);
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
            note_refusal(&mut view, Outline { kind: "tests", keys: vec![Key::new(Table::Incident, n.to_string())] });
        }
        assert_eq!(view.refused.known.len(), limits::REFUSED_REMEMBERED);
    }
}
