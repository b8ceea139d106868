//! Plans of the planner as they are shown, and read again to be made once more.

use super::fleet::{encode_planner, parse_planner};
use super::{At, Parse, WireEnum, duration, id, parse_ms, parse_time, timestamp, word};
use crate::fleet::v1;
use midshift_core::fleet::projection::plans::{PlanRecord, Weighed, WeighedPair, WeighedRobot, WeighedTask};
use midshift_core::ids::{RobotId, SiteId, TaskId};
use midshift_core::reason::Violations;
use midshift_core::time::Utc;
use std::collections::BTreeSet;

/// Robots of a plan that is read.
const ROBOTS_MAX: usize = 20_000;
/// Tasks of it.
const TASKS_MAX: usize = 100_000;
/// Its pairs.
const PAIRS_MAX: usize = 200_000;
/// A way is at most so long, millimetres, and takes so much energy, milliwatt-hours: more than any floor has.
const WAY_MAX: u64 = 1 << 40;
/// Faults that are told; a file with more of them is another file.
const FAULTS_TOLD: usize = 32;

/// A plan in numbers.
pub fn encode_summary(plan: &PlanRecord) -> v1::PlanSummary {
    let Weighed { robots, tasks, pairs } = &plan.weighed;
    v1::PlanSummary {
        number: plan.number,
        plan_time: Some(timestamp(plan.at)),
        robots: robots.len() as u32,
        tasks: tasks.len() as u32,
        pairs: pairs.len() as u32,
        decisions: plan.made.len() as u32,
    }
}

/// A plan, whole.
pub fn encode_plan(plan: &PlanRecord) -> v1::Plan {
    let robot = |robot: &WeighedRobot| v1::PlanRobot {
        robot_id: robot.robot_id.to_string(),
        free: robot.free.to_wire(),
        ready: (robot.ready_ms > 0).then(|| duration(robot.ready_ms)),
        charge_loss: (robot.loss_ms > 0).then(|| duration(robot.loss_ms)),
        tasks_given: robot.tasks,
    };
    let task = |task: &WeighedTask| v1::PlanTask {
        task_id: task.task_id.to_string(),
        class: task.class.to_wire(),
        ready_since: Some(timestamp(task.since)),
        deadline: task.deadline.map(timestamp),
    };
    let pair = |pair: &WeighedPair| v1::PlanPair {
        robot: pair.robot as u32,
        task: pair.task as u32,
        way_mm: pair.way_mm,
        energy_mwh: pair.energy_mwh,
        failed_before: pair.has_failed,
        meant_before: pair.is_meant,
    };
    let decision = |(robot, task): &(usize, usize)| v1::PlanDecision { robot: *robot as u32, task: *task as u32 };
    v1::Plan {
        number: plan.number,
        plan_time: Some(timestamp(plan.at)),
        policy: Some(encode_planner(&plan.policy, None)),
        robots: plan.weighed.robots.iter().map(robot).collect(),
        tasks: plan.weighed.tasks.iter().map(task).collect(),
        pairs: plan.weighed.pairs.iter().map(pair).collect(),
        decisions: plan.made.iter().map(decision).collect(),
    }
}

/// Reads a plan that was shown before, or says what is wrong with it, a few dozen faults at most.
pub fn parse_plan(wire: v1::Plan) -> Result<PlanRecord, Violations> {
    let mut bad = Violations::default();
    for (name, count, most) in [
        ("robots", wire.robots.len(), ROBOTS_MAX),
        ("tasks", wire.tasks.len(), TASKS_MAX),
        ("pairs", wire.pairs.len(), PAIRS_MAX),
    ] {
        if count == 0 || count > most {
            bad.add(name, format!("must have 1 to {most}"));
        }
    }
    if wire.number == 0 {
        bad.add("number", "must be at least 1");
    }
    let at = need_time(wire.plan_time.as_ref(), At::top("plan_time"), &mut bad);
    let policy = wire.policy.unwrap_or_default();
    // The rules name the site; those of another site are as good.
    let site_id = id(&policy.site_id, SiteId::parse, At::top("policy").field("site_id"), &mut bad);
    let policy = site_id.and_then(|site_id| parse_planner(policy, &site_id, At::top("policy"), &mut bad));
    if !bad.0.is_empty() {
        return Err(bad);
    }
    let (robots, tasks) = (wire.robots.len(), wire.tasks.len());
    let weighed = Weighed {
        robots: read(wire.robots, "robots", &mut bad),
        tasks: read(wire.tasks, "tasks", &mut bad),
        pairs: read(wire.pairs, "pairs", &mut bad),
    };
    let mut known = BTreeSet::new();
    for (nth, pair) in weighed.pairs.iter().enumerate() {
        let is_new = known.insert((pair.robot, pair.task));
        if pair.robot >= robots || pair.task >= tasks || !is_new {
            tell_fault(
                &mut bad,
                At::top("pairs").index(nth),
                "must name a robot and a task of the plan, and each pair once",
            );
        }
    }
    let made: Vec<_> = wire.decisions.iter().map(|made| (made.robot as usize, made.task as usize)).collect();
    let mut taken = BTreeSet::new();
    for (nth, pair) in made.iter().enumerate() {
        let is_in_order = nth == 0 || made[nth - 1].0 < pair.0;
        if !known.contains(pair) || !taken.insert(pair.1) || !is_in_order {
            let fault = "must be one of the pairs, by robot, each robot and task once";
            tell_fault(&mut bad, At::top("decisions").index(nth), fault);
        }
    }
    match at.zip(policy).filter(|_| bad.0.is_empty()) {
        Some((at, policy)) => Ok(PlanRecord { number: wire.number, at, policy, weighed, made }),
        None => Err(bad),
    }
}

/// Reads items up to the first that is wrong.
fn read<T, W: Parse<T>>(wire: Vec<W>, name: &'static str, bad: &mut Violations) -> Vec<T> {
    let at = At::top(name);
    wire.into_iter().enumerate().map_while(|(nth, item)| item.parse_at(at.index(nth), bad)).collect()
}

fn tell_fault(bad: &mut Violations, at: At<'_>, fault: &str) {
    if bad.0.len() < FAULTS_TOLD {
        bad.add(at.to_string(), fault);
    }
}

fn need_time(wire: Option<&prost_types::Timestamp>, at: At<'_>, bad: &mut Violations) -> Option<Utc> {
    if wire.is_none() {
        bad.add(at.to_string(), "is required");
    }
    parse_time(wire, at, bad)
}

/// Milliseconds from none up.
fn span_ms(wire: Option<&prost_types::Duration>, at: At<'_>, bad: &mut Violations) -> u64 {
    let ms = parse_ms(wire, at, bad).unwrap_or(0);
    if ms < 0 {
        bad.add(at.to_string(), "must not be less than 0");
    }
    ms.unsigned_abs()
}

impl Parse<WeighedRobot> for v1::PlanRobot {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<WeighedRobot> {
        let before = bad.0.len();
        let robot_id = id(&self.robot_id, RobotId::parse, at.field("robot_id"), bad);
        let free = word(self.free, at.field("free"), bad);
        let ready_ms = span_ms(self.ready.as_ref(), at.field("ready"), bad);
        let loss_ms = span_ms(self.charge_loss.as_ref(), at.field("charge_loss"), bad);
        let (robot_id, free) = robot_id.zip(free).filter(|_| bad.0.len() == before)?;
        Some(WeighedRobot { robot_id, free, ready_ms, loss_ms, tasks: self.tasks_given })
    }
}

impl Parse<WeighedTask> for v1::PlanTask {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<WeighedTask> {
        let before = bad.0.len();
        let task_id = id(&self.task_id, TaskId::parse, at.field("task_id"), bad);
        let class = word(self.class, at.field("class"), bad);
        let since = need_time(self.ready_since.as_ref(), at.field("ready_since"), bad);
        let deadline = parse_time(self.deadline.as_ref(), at.field("deadline"), bad);
        let ((task_id, class), since) = task_id.zip(class).zip(since).filter(|_| bad.0.len() == before)?;
        Some(WeighedTask { task_id, class, since, deadline })
    }
}

impl Parse<WeighedPair> for v1::PlanPair {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<WeighedPair> {
        if self.way_mm > WAY_MAX || self.energy_mwh.unsigned_abs() > WAY_MAX {
            bad.add(at.to_string(), format!("way_mm and energy_mwh must be within {WAY_MAX}"));
            return None;
        }
        Some(WeighedPair {
            robot: self.robot as usize,
            task: self.task as usize,
            way_mm: self.way_mm,
            energy_mwh: self.energy_mwh,
            has_failed: self.failed_before,
            is_meant: self.meant_before,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::fleet::projection::plans::Free;
    use midshift_core::planner_policy::PlannerPolicy;
    use midshift_core::task::spec::Class;

    fn plan() -> PlanRecord {
        let robot = |n: u64, free| WeighedRobot {
            robot_id: RobotId::parse(&format!("rbt-{n}")).expect("an id"),
            free,
            ready_ms: 1_500 * n,
            loss_ms: 100 * n,
            tasks: n,
        };
        let task = |n: i64, class, deadline| WeighedTask {
            task_id: TaskId::parse(&format!("T{n}")).expect("an id"),
            class,
            since: Utc(1_800_000_000_000 + n),
            deadline,
        };
        let pair = |robot, task| WeighedPair {
            robot,
            task,
            way_mm: 12_000,
            energy_mwh: -40,
            has_failed: robot == 1,
            is_meant: task == 1,
        };
        let weighed = Weighed {
            robots: vec![robot(0, Free::Now), robot(1, Free::AfterErrand), robot(2, Free::Soon)],
            tasks: vec![task(0, Class::Urgent, Some(Utc(1_800_000_060_000))), task(1, Class::Background, None)],
            pairs: vec![pair(0, 0), pair(1, 1), pair(2, 1)],
        };
        let policy = PlannerPolicy::default_of(SiteId::parse("hall").expect("an id"));
        PlanRecord { number: 7, at: Utc(1_800_000_000_500), policy, weighed, made: vec![(0, 0), (2, 1)] }
    }

    #[test]
    fn a_plan_is_read_as_it_was_shown() {
        assert_eq!(parse_plan(encode_plan(&plan())).map_err(|bad| bad.0), Ok(plan()));
        let v1::PlanSummary { number, robots, tasks, pairs, decisions, .. } = encode_summary(&plan());
        assert_eq!((number, robots, tasks, pairs, decisions), (7, 3, 2, 3, 2));
    }

    #[test]
    fn all_that_is_wrong_with_a_plan_is_told() {
        let faults = |change: &dyn Fn(&mut v1::Plan)| {
            let mut wire = encode_plan(&plan());
            change(&mut wire);
            parse_plan(wire).expect_err("wrong").0.into_iter().map(|v| v.field).collect::<Vec<_>>()
        };
        assert_eq!(
            parse_plan(v1::Plan::default()).expect_err("nothing").0.into_iter().map(|v| v.field).collect::<Vec<_>>(),
            ["robots", "tasks", "pairs", "number", "plan_time", "policy.site_id"]
        );
        let items = faults(&|wire| {
            wire.robots[1].free = 0;
            wire.robots[1].ready = Some(prost_types::Duration { seconds: -1, nanos: 0 });
            wire.tasks[0].ready_since = None;
            wire.pairs[2].way_mm = u64::MAX;
        });
        let expected = ["robots[1].free", "robots[1].ready", "tasks[0].ready_since", "pairs[2]", "decisions[1]"];
        assert_eq!(items, expected);
        let indices = faults(&|wire| {
            wire.pairs[0].robot = 3;
            wire.pairs[1] = wire.pairs[2];
        });
        assert_eq!(indices, ["pairs[0]", "pairs[2]", "decisions[0]"]);
        assert_eq!(faults(&|wire| wire.decisions.swap(0, 1)), ["decisions[1]"], "they stand by robot");
        let twice = faults(&|wire| {
            wire.pairs.push(v1::PlanPair { robot: 1, task: 0, ..wire.pairs[0] });
            wire.decisions.insert(1, v1::PlanDecision { robot: 1, task: 0 });
        });
        assert_eq!(twice, ["decisions[1]"], "a task goes to one robot");
    }
}
