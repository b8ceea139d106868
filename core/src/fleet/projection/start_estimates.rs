//! When a ready task will get a robot, as far as tasks tell that got one lately: from the robot that it is meant for, or from its place in the
//! queue and how fast robots are given away, with the spread that such reckonings had.
//!
//! A sample of the tasks that a plan left waiting is noted, and again while they wait; once such a task is given, what was reckoned for it
//! stands beside how long it took. Memory of this process: no row, no promise, and gone with a start. Nothing is decided by it.

use crate::ids::TaskId;
use crate::time::Utc;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Tasks that are noted at once.
const NOTED_MAX: usize = 512;
/// Tasks that are noted anew in one turn: looking for their places costs.
const NOTED_PER_TURN: usize = 8;
/// Starts that the pace is taken of.
const STARTS_MAX: usize = 256;
/// Older starts say nothing of the pace, milliseconds.
const STARTS_FOR_MS: u64 = 600_000;
/// With fewer starts, or fewer reckonings, nothing is told.
const LEAST: usize = 16;
/// Reckonings that are remembered of each age.
const RECKONED_MAX: usize = 256;
/// A task is noted again when it has waited so long, milliseconds, then twice as long more, and so on.
const AGAIN_MS: u64 = 1_000;
/// A shorter wait than this is reckoned as this, milliseconds: ratios of nothing say nothing.
const SHORTEST_MS: u64 = 500;

/// Between when and when a task will probably get a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StartEstimate {
    /// UTC: a tenth of such tasks got one before.
    pub p10: Utc,
    /// UTC: half of them did.
    pub p50: Utc,
    /// UTC: nine tenths of them did.
    pub p90: Utc,
}

/// What a start is reckoned from.
#[derive(Clone, Copy, Debug)]
pub struct Outlook {
    /// Ready tasks that are served up to it, itself included.
    pub position: usize,
    /// UTC, since when it is ready.
    pub since: Utc,
    /// UTC, when the robot is free that it is meant for. None: it is meant for nobody.
    pub meant_free: Option<Utc>,
}

/// Reckonings that are alike.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Likeness {
    /// From the robot that the task was meant for, not from the queue.
    is_meant: bool,
    /// How often the task was noted again that had waited so long.
    age: usize,
}

/// What was reckoned of a task at one moment.
#[derive(Clone, Copy, Debug)]
struct Reckoned {
    at: Utc,
    likeness: Likeness,
    usual_ms: u64,
}

/// What was given lately, and of some tasks that wait what was reckoned.
#[derive(Clone, Debug, Default)]
pub struct Starts {
    /// When tasks got a robot, the newest last.
    given: VecDeque<Utc>,
    noted: BTreeMap<TaskId, Vec<Reckoned>>,
    /// When tasks that are noted are reckoned again.
    due: BTreeSet<(Utc, TaskId)>,
    /// How long tasks waited on, thousandths of what was reckoned.
    ratios: BTreeMap<Likeness, VecDeque<u64>>,
}

impl Starts {
    /// A ready task got a robot.
    pub(in crate::fleet) fn note_start(&mut self, task_id: &TaskId, now: Utc) {
        // A clock that was put back makes all that was noted worthless.
        if self.given.back().is_some_and(|newest| *newest > now) {
            (self.given, self.noted, self.due) = Default::default();
        }
        self.given.push_back(now);
        if self.given.len() > STARTS_MAX {
            self.given.pop_front();
        }
        for Reckoned { at, likeness, usual_ms } in self.noted.remove(task_id).into_iter().flatten() {
            let ratios = self.ratios.entry(likeness).or_default();
            ratios.push_back(now.ms_since(at) * 1_000 / usual_ms);
            if ratios.len() > RECKONED_MAX {
                ratios.pop_front();
            }
        }
    }

    /// A task waits for a robot no more, and got none.
    pub(in crate::fleet) fn forget_task(&mut self, task_id: &TaskId) {
        self.noted.remove(task_id);
    }

    /// Tasks to reckon in this turn: some of those that are `new`, and those that have waited for long.
    pub(in crate::fleet) fn pick_tasks<'t>(
        &mut self,
        new: impl ExactSizeIterator<Item = &'t TaskId>,
        now: Utc,
    ) -> Vec<TaskId> {
        let room = NOTED_MAX.saturating_sub(self.noted.len()).min(NOTED_PER_TURN);
        let every = new.len().div_ceil(room.max(1)).max(1);
        let mut picked: Vec<TaskId> = new.step_by(every).take(room).cloned().collect();
        while let Some((at, task_id)) =
            self.due.first().filter(|(at, _)| *at <= now && picked.len() < 2 * NOTED_PER_TURN).cloned()
        {
            self.due.remove(&(at, task_id.clone()));
            picked.extend(self.noted.contains_key(&task_id).then_some(task_id));
        }
        picked
    }

    /// Notes what a ready task has before it.
    pub(in crate::fleet) fn reckon_task(&mut self, task_id: &TaskId, outlook: &Outlook, now: Utc) {
        let age = outlook.age(now);
        let reckoned = match Self::meant_ms(outlook, now) {
            Some(usual_ms) => Some((usual_ms, true)),
            None => self.usual_ms(outlook.position, now).map(|usual_ms| (usual_ms, false)),
        };
        let Some((usual_ms, is_meant)) = reckoned else { return self.forget_task(task_id) };
        let noted = self.noted.entry(task_id.clone()).or_default();
        if noted.last().is_none_or(|last| last.likeness.age < age) {
            noted.push(Reckoned { at: now, likeness: Likeness { is_meant, age }, usual_ms });
        }
        self.due.insert((outlook.since.plus_ms(AGAIN_MS * ((2 << age) - 1)), task_id.clone()));
    }

    /// When such a task will probably get a robot. None: too little is known.
    pub fn estimate(&self, outlook: &Outlook, now: Utc) -> Option<StartEstimate> {
        let (age, is_meant) = (outlook.age(now), true);
        let of_meant = || Some((Self::meant_ms(outlook, now)?, self.ratios(Likeness { is_meant, age })?));
        let of_queue =
            || Some((self.usual_ms(outlook.position, now)?, self.ratios(Likeness { is_meant: false, age })?));
        let (usual_ms, ratios) = of_meant().or_else(of_queue)?;
        let at =
            |percent: usize| now.plus_ms(ratios[(ratios.len() - 1) * percent / 100].saturating_mul(usual_ms) / 1_000);
        Some(StartEstimate { p10: at(10), p50: at(50), p90: at(90) })
    }

    /// Ratios of such reckonings, in order; of all ages, if too few had the same. None: too few had any.
    fn ratios(&self, likeness: Likeness) -> Option<Vec<u64>> {
        let of_age = self.ratios.get(&likeness).filter(|ratios| ratios.len() >= LEAST);
        let mut ratios: Vec<u64> = match of_age {
            Some(ratios) => ratios.iter().copied().collect(),
            None => {
                let alike = self.ratios.iter().filter(|(known, _)| known.is_meant == likeness.is_meant);
                alike.flat_map(|(_, ratios)| ratios).copied().collect()
            }
        };
        ratios.sort_unstable();
        (ratios.len() >= LEAST).then_some(ratios)
    }

    /// In how many milliseconds the robot is free that the task is meant for.
    fn meant_ms(outlook: &Outlook, now: Utc) -> Option<u64> {
        outlook.meant_free.map(|free| free.ms_since(now).max(SHORTEST_MS))
    }

    /// How long the task at this position would wait if they were served in order and as fast as lately, milliseconds.
    fn usual_ms(&self, position: usize, now: Utc) -> Option<u64> {
        let lately = self.given.iter().filter(|at| now.ms_since(**at) < STARTS_FOR_MS);
        let (count, first) = (lately.clone().count(), lately.copied().next()?);
        (count >= LEAST).then(|| (position as u64 * now.ms_since(first) / count as u64).max(SHORTEST_MS))
    }
}

impl Outlook {
    /// How often such a task has been noted again.
    fn age(&self, now: Utc) -> usize {
        (now.ms_since(self.since) / AGAIN_MS + 1).ilog2() as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn task(n: u64) -> TaskId {
        TaskId::parse(&format!("T{n}")).expect("an id")
    }

    fn outlook(since: Utc, meant_free: Option<Utc>) -> Outlook {
        Outlook { position: 30, since, meant_free }
    }

    /// A robot is given away each second; each task stands at 30 when it comes, is meant for a robot that is free in `meant_s(n)`, and waits
    /// `wait_s(n)`.
    fn after(tasks: u64, meant_s: impl Fn(u64) -> Option<u64>, wait_s: impl Fn(u64) -> u64) -> (Starts, Utc) {
        let mut starts = Starts::default();
        for s in 0..tasks {
            let now = Utc(1_000 * s as i64);
            for picked in starts.pick_tasks([task(s)].iter(), now) {
                let n: u64 = picked.as_str()[1..].parse().expect("a number");
                let since = Utc(1_000 * n as i64);
                let meant_free = meant_s(n).map(|in_s| since.plus_ms(1_000 * in_s));
                starts.reckon_task(&picked, &outlook(since, meant_free), now);
            }
            starts.note_start(&task(1_000_000 + s), now);
            (0..tasks).filter(|n| n + wait_s(*n) == s).for_each(|n| starts.note_start(&task(n), now));
        }
        (starts, Utc(1_000 * tasks as i64))
    }

    #[test]
    fn an_estimate_has_the_spread_of_those_before() {
        let (starts, now) = after(600, |_| None, |n| 20 + n % 11);
        let told = starts.estimate(&outlook(now, None), now).expect("enough is known");
        let s = |at: Utc| at.ms_since(now) as f64 / 1_000.0;
        assert!((19.0..24.0).contains(&s(told.p10)) && (28.0..33.0).contains(&s(told.p90)), "{told:?}");
        assert!(told.p10 < told.p50 && told.p50 < told.p90);
        let twice = Outlook { position: 60, ..outlook(now, None) };
        let twice = starts.estimate(&twice, now).expect("enough is known");
        assert_eq!(twice.p90.ms_since(now).div_ceil(2), told.p90.ms_since(now));
    }

    #[test]
    fn who_has_waited_for_long_is_told_of_those_that_had_too() {
        let (starts, now) = after(600, |_| None, |n| if n % 4 == 0 { 100 } else { 5 });
        let told = |waited_s: i64| {
            starts.estimate(&outlook(Utc(now.0 - 1_000 * waited_s), None), now).expect("enough is known")
        };
        assert!(told(0).p50.ms_since(now) < 10_000, "most wait 5 s");
        assert!(told(10).p10.ms_since(now) > 70_000, "those that waited 10 s are of the other kind: {:?}", told(10));
    }

    #[test]
    fn a_task_that_is_meant_for_a_robot_is_told_of_that_robot_whatever_the_queue_does() {
        // Every second task is meant for a robot that is free in 10 s, which takes 12 s to come; the others wait for a minute.
        let meant = |n: u64| n.is_multiple_of(2).then_some(10);
        let (starts, now) = after(600, meant, |n| if n.is_multiple_of(2) { 12 } else { 60 });
        let told = |meant_free| starts.estimate(&outlook(now, meant_free), now).expect("enough is known");
        let s = |told: StartEstimate| told.p50.ms_since(now) / 1_000;
        assert_eq!(
            [s(told(Some(now.plus_ms(10_000)))), s(told(Some(now.plus_ms(20_000)))), s(told(None))],
            [12, 24, 60]
        );
    }

    #[test]
    fn without_enough_to_go_by_nothing_is_told() {
        let (starts, now) = after(10, |_| None, |_| 5);
        assert_eq!(starts.estimate(&outlook(now, None), now), None);
        assert_eq!(starts.estimate(&outlook(now, Some(now)), now), None);
        let (starts, now) = after(600, |_| None, |_| 5);
        assert!(starts.estimate(&outlook(now, None), now).is_some());
        assert!(starts.estimate(&outlook(now, Some(now)), now).is_some(), "none was meant: by the queue");
        let later = now.plus_ms(2 * STARTS_FOR_MS);
        assert_eq!(starts.estimate(&outlook(now, None), later), None, "nothing was given lately");
    }

    #[test]
    fn a_flood_of_tasks_is_sampled_from_its_beginning_to_its_end() {
        let mut starts = Starts::default();
        let many: Vec<TaskId> = (10_000..20_000).map(task).collect();
        let picked = starts.pick_tasks(many.iter(), Utc(0));
        assert!(picked.len() <= NOTED_PER_TURN && picked[0] == many[0] && *picked.last().expect("some") > many[8_000]);
    }
}
