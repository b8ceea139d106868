//! Plans that the planner made: listed, shown, and made once more from a file.

use super::rules::Rules;
use crate::client::Exit;
use crate::out::Out;
use midshift_core::fleet::assignment::rolling::matching;
use midshift_core::fleet::projection::chosen::PairCost;
use midshift_core::fleet::projection::plans::{Free, PlanRecord};
use midshift_core::planner_policy::{AssignmentPolicy, PlannerPolicy};
use midshift_core::reason::Violations;
use midshift_proto::convert::fleet::{encode_planner, parse_planner};
use midshift_proto::convert::plan::{encode_plan, parse_plan};
use midshift_proto::convert::{At, time_of};
use midshift_proto::fleet::v1;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

/// A plan of ten thousand robots has some 20 MB.
const FILE_MAX: u64 = 64 << 20;

const HEADER: &[&str] = &["PLAN", "TIME", "ROBOTS", "TASKS", "PAIRS", "MADE"];

/// Lists plans in numbers.
pub fn list(plans: &v1::ListPlansResponse, out: &Out) -> Result<(), Exit> {
    let name = |plan: &v1::PlanSummary| plan.number.to_string();
    let row = |plan: &v1::PlanSummary| {
        let time = plan.plan_time.as_ref().map(|time| time_of(time).rfc3339()).unwrap_or_default();
        let counts = [plan.robots, plan.tasks, plan.pairs, plan.decisions].map(|count| count.to_string());
        [name(plan), time].into_iter().chain(counts).collect()
    };
    out.many(plans, &plans.plans, name, HEADER, row)?;
    Ok(())
}

/// Shows one plan.
pub fn show(plan: &v1::Plan, out: &Out) -> Result<(), Exit> {
    // What a newer server says and this version cannot read goes to whoever asks for all of it.
    let told = || match parse_plan(plan.clone()) {
        Ok(record) => describe(&record),
        Err(_) => format!("plan {} of a newer version: `--output json` shows it", plan.number),
    };
    out.one(plan, &plan.number.to_string(), told)?;
    Ok(())
}

/// Makes the decision of a plan once more, by its own rules or with some changed.
pub fn run(file: &Path, rules: Rules, out: &Out) -> Result<(), Exit> {
    let was = read(from_file(file)?)?;
    let policy = change(&was.policy, rules)?;
    let made = matching::choose_pairs(&policy, was.at, &was.weighed);
    let is_by_own = policy == was.policy;
    let now = PlanRecord { policy, made, ..was.clone() };
    out.one(&encode_plan(&now), &now.number.to_string(), || compare(&was, &now))?;
    if is_by_own && now.made != was.made {
        return Err(Exit::new(1, "by the same rules this version decides otherwise: the plan is of another version"));
    }
    Ok(())
}

/// The rules of a plan with some changed.
fn change(was: &PlannerPolicy, rules: Rules) -> Result<PlannerPolicy, Exit> {
    let mut bad = Violations::default();
    let policy = parse_planner(rules.over(encode_planner(was, None)), &was.site_id, At::top("policy"), &mut bad);
    let policy = policy.ok_or_else(|| wrong("these rules", &bad))?;
    if policy.policy != AssignmentPolicy::Rolling {
        return Err(Exit::usage("fifo-nearest weighs no pairs: a plan can be made once more by rolling alone"));
    }
    if policy.horizon_ms != was.horizon_ms {
        return Err(Exit::usage("which robots are weighed is part of the plan: another horizon changes nothing of it"));
    }
    Ok(policy)
}

fn from_file(file: &Path) -> Result<v1::Plan, Exit> {
    let mut text = String::new();
    let read = if file == Path::new("-") {
        std::io::stdin().take(FILE_MAX).read_to_string(&mut text)
    } else {
        std::fs::File::open(file).and_then(|opened| opened.take(FILE_MAX).read_to_string(&mut text))
    };
    let told = |why: String| {
        Exit::usage(format!("{}: {why}\n  a plan is what `midshift planner plan -o json` writes", file.display()))
    };
    read.map_err(|error| told(error.to_string()))?;
    if text.len() as u64 >= FILE_MAX {
        return Err(told(format!("has {} MiB or more", FILE_MAX >> 20)));
    }
    let value = serde_json::from_str(&text).map_err(|error| told(error.to_string()))?;
    midshift_proto::json::from_json(value).map_err(|error| told(error.to_string()))
}

fn read(plan: v1::Plan) -> Result<PlanRecord, Exit> {
    parse_plan(plan).map_err(|bad| wrong("the plan", &bad))
}

fn wrong(what: &str, bad: &Violations) -> Exit {
    let faults: Vec<_> = bad.0.iter().map(|fault| format!("\n  {}: {}", fault.field, fault.description)).collect();
    Exit::usage(format!("{what} cannot be read:{}", faults.concat()))
}

/// A head, and a line for each pair that was made.
fn describe(plan: &PlanRecord) -> String {
    let weighed = &plan.weighed;
    let mut lines = format!(
        "plan {} of {}: {} robots and {} tasks weighed in {} pairs, {} made\n",
        plan.number,
        plan.at.rfc3339(),
        weighed.robots.len(),
        weighed.tasks.len(),
        weighed.pairs.len(),
        plan.made.len()
    );
    let weights = weights(plan);
    for (robot, task) in &plan.made {
        let robot_is = &weighed.robots[*robot];
        let when = match robot_is.free {
            Free::Now => "goes to",
            Free::AfterErrand => "calls from its errand",
            Free::Soon => "is meant for",
        };
        let (task_id, robot_id) = (&weighed.tasks[*task].task_id, &robot_is.robot_id);
        lines += &format!("  {task_id}  {when} {robot_id}: weighs {}\n", weights[&(*robot, *task)]);
    }
    lines
}

/// What became of each task in either plan, and of how many it is something else.
fn compare(was: &PlanRecord, now: &PlanRecord) -> String {
    let by_task = |plan: &PlanRecord| plan.made.iter().map(|(robot, task)| (*task, *robot)).collect::<BTreeMap<_, _>>();
    let (before, after) = (by_task(was), by_task(now));
    let tasks: BTreeSet<_> = before.keys().chain(after.keys()).collect();
    let count = tasks.len();
    let (old, new) = (weights(was), weights(now));
    let robot_id = |robot: usize| &now.weighed.robots[robot].robot_id;
    let (mut lines, mut moved) = (String::new(), 0);
    for task in tasks {
        let task_id = &now.weighed.tasks[*task].task_id;
        let told = |robot: usize, weights: &BTreeMap<_, String>| {
            format!("{} (weighs {})", robot_id(robot), weights[&(robot, *task)])
        };
        lines += &match (before.get(task), after.get(task)) {
            (Some(was), Some(now)) if was == now => format!("  {task_id}  {}, as it was\n", told(*now, &new)),
            (was, now) => {
                moved += 1;
                let now = now.map_or_else(|| "nobody".to_owned(), |robot| told(*robot, &new));
                let was = was.map_or_else(|| "nobody".to_owned(), |robot| told(*robot, &old));
                format!("  {task_id}  {now}, where it was {was}\n")
            }
        };
    }
    let verdict = match moved {
        0 => format!("the same {} pairs", now.made.len()),
        moved => format!("{moved} of {count} tasks go elsewhere"),
    };
    format!("plan {} of {}: {verdict}\n{lines}", now.number, now.at.rfc3339())
}

/// What each pair that a plan made weighs by its rules, as seconds on the way.
fn weights(plan: &PlanRecord) -> BTreeMap<(usize, usize), String> {
    let seconds = |units: i64| units as f64 / PairCost::UNITS_PER_MS as f64 / 1_000.0;
    let made: BTreeSet<_> = plan.made.iter().copied().collect();
    let pairs = plan.weighed.pairs.iter().filter(|pair| made.contains(&(pair.robot, pair.task)));
    pairs
        .map(|pair| {
            let cost = matching::cost_of(&plan.policy, plan.at, &plan.weighed, pair).sum();
            ((pair.robot, pair.task), format!("{:.1} s", seconds(cost)))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::fleet::projection::plans::{Weighed, WeighedPair, WeighedRobot, WeighedTask};
    use midshift_core::ids::{RobotId, SiteId, TaskId};
    use midshift_core::task::spec::Class;
    use midshift_core::time::Utc;

    /// One robot between a task that is near and one that has waited for ten minutes.
    fn plan() -> PlanRecord {
        let at = Utc(1_800_000_600_000);
        let robot = WeighedRobot {
            robot_id: RobotId::parse("r1").expect("an id"),
            free: Free::Now,
            ready_ms: 0,
            loss_ms: 0,
            tasks: 0,
        };
        let task = |id: &str, since| WeighedTask {
            task_id: TaskId::parse(id).expect("an id"),
            class: Class::Normal,
            since,
            deadline: None,
        };
        let pair =
            |task, way_mm| WeighedPair { robot: 0, task, way_mm, energy_mwh: 0, has_failed: false, is_meant: false };
        let weighed = Weighed {
            robots: vec![robot],
            tasks: vec![task("near", at), task("old", Utc(1_800_000_000_000))],
            pairs: vec![pair(0, 5_000), pair(1, 50_000)],
        };
        let policy = PlannerPolicy::default_of(SiteId::parse("hall").expect("an id"));
        let made = matching::choose_pairs(&policy, at, &weighed);
        PlanRecord { number: 3, at, policy, weighed, made }
    }

    #[test]
    fn a_plan_is_told_by_what_it_made() {
        let told = "plan 3 of 2027-01-15T08:10:00.000Z: 1 robots and 2 tasks weighed in 2 pairs, 1 made\n  \
                    old  goes to r1: weighs -20.0 s\n";
        assert_eq!(describe(&plan()), told);
    }

    #[test]
    fn rules_that_are_wrong_or_weigh_nothing_are_refused() {
        let policy = plan().policy;
        assert_eq!(change(&policy, Rules::default()).expect("its own"), policy);
        let refused = |rules| change(&policy, rules).expect_err("refused").to_string();
        let wrong = refused(Rules { ageing: Some(10_001), urgent_weight: Some(0), ..Rules::default() });
        assert!(wrong.contains("policy.ageing_permille") && wrong.contains("policy.urgent_travel_weight"), "{wrong}");
        let fifo = refused(Rules { policy: Some(crate::planner::rules::Policy::FifoNearest), ..Rules::default() });
        assert!(fifo.contains("rolling alone"), "{fifo}");
        let farther = refused(Rules { horizon: Some(std::time::Duration::from_secs(1)), ..Rules::default() });
        assert!(farther.contains("part of the plan"), "{farther}");
    }

    #[test]
    fn a_replay_says_what_other_rules_would_have_chosen() {
        let was = plan();
        let same = PlanRecord { made: matching::choose_pairs(&was.policy, was.at, &was.weighed), ..was.clone() };
        let told = compare(&was, &same);
        assert!(
            told.contains(": the same 1 pairs\n") && told.contains("old  r1 (weighs -20.0 s), as it was"),
            "{told}"
        );
        let policy = PlannerPolicy { ageing_permille: 0, ..was.policy.clone() };
        let made = matching::choose_pairs(&policy, was.at, &was.weighed);
        let told = compare(&was, &PlanRecord { policy, made, ..was.clone() });
        assert!(told.contains(": 2 of 2 tasks go elsewhere\n"), "{told}");
        assert!(told.contains("near  r1 (weighs 10.0 s), where it was nobody"), "{told}");
        assert!(told.contains("old  nobody, where it was r1 (weighs -20.0 s)"), "{told}");
    }
}
