//! What a robot's attempts say of its energy: counted as they end, and used by the filter and by the choice.

use super::rolling::{line, visits};
use super::*;
use crate::energy::fit::{ATTEMPTS_MIN, AttemptWork, EnergySums};
use crate::energy::{EnergyRates, RobotEnergy};
use crate::fleet::assignment::demand::Demand;
use crate::fleet::assignment::{errands, filters};
use crate::fleet::explain;
use crate::fleet::projection::rows::RobotCounter;
use crate::fleet::tasks::errand_reports;
use crate::fleet::tasks::transitions::{News, apply_event};
use crate::reason::Code;
use crate::robot_events::{AttemptReport, WorkStats};
use crate::task::Event;
use crate::task::raw::{RawStep, RawStepKind};
use crate::task::state::Errand;

fn id(robot: &str) -> RobotId {
    RobotId::parse(robot).expect("an id")
}

/// Attempts of a robot that takes so many thousandths of what the model says, all of them different.
fn sums(attempts: u64, permille: u64) -> EnergySums {
    let mut sums = EnergySums::default();
    for nth in 0..attempts {
        let (empty_mm, loaded_mm, actions) = (5_000 + nth * 7_919 % 60_000, nth % 3 * 20_000, nth % 4);
        let duration_ms = empty_mm + loaded_mm + 4_000 * actions + nth * 6_007 % 50_000;
        let usual_nwh = empty_mm * 120_000 + loaded_mm * 156_000 + duration_ms * 400_000 / 18 + actions * 500_000_000;
        let energy_mwh = usual_nwh * permille / 1_000 / 1_000_000;
        assert!(sums.add(&AttemptWork { empty_mm, loaded_mm, duration_ms, actions, energy_mwh }));
    }
    sums
}

fn counter(robot: &str, software: &str, counted: Utc, energy_sums: EnergySums) -> RobotCounter {
    RobotCounter {
        robot_id: id(robot),
        software: software.to_owned(),
        succeeded: 0,
        failures: std::collections::BTreeMap::new(),
        stats: WorkStats::default(),
        errands: WorkStats::default(),
        attached_ms: 0,
        counted,
        energy_sums,
    }
}

impl Rig {
    /// The robot's row says that it has worked and took so much.
    fn took(&mut self, robot: &str, permille: u64) {
        self.absorb(&counter(robot, "1.0.0", self.now.utc, sums(60, permille)));
    }

    /// Its robot ends the task, and says that it did this.
    fn ends(&mut self, task_id: &str, event: Event, stats: WorkStats) {
        let task_id = TaskId::parse(task_id).expect("an id");
        let attempt = self.task(task_id.as_str()).attempt_id().expect("an attempt");
        let steps = self.view.intake(&task_id).expect("a task").spec.steps.len() as u32;
        let (state, step_index) = match event {
            Event::Succeeded => (WorkState::Succeeded, steps),
            _ => (WorkState::Failed, 0),
        };
        let report = AttemptReport { attempt, state, step_index, opened: false, refusal: None, fault: None, stats };
        let now = self.now;
        Plan::default().decide(&mut self.view, now, "r1", |tx| {
            assert!(apply_event(tx, &task_id, News::from_event(Event::Accepted, None)));
            let news = News { event, why: None, report: Some(&report) };
            assert!(apply_event(tx, &task_id, news));
        });
    }

    /// The robot is sent on an errand and says that it is over and took this.
    fn errand(&mut self, robot: &str, errand: Errand, goal: &str, stats: WorkStats) {
        let (now, board, robot_id) = (self.now, self.board.clone(), id(robot));
        let goal = self.view.site.find(&WaypointId::parse(goal).expect("a name")).expect("a waypoint");
        Plan::default().decide(&mut self.view, now, "r1", |tx| {
            errands::begin(tx, &robot_id, errand, goal, &board);
            let attempt = tx.view.held_by(&robot_id).expect("an errand").clone();
            for state in [WorkState::Accepted, WorkState::Executing, WorkState::Succeeded] {
                let attempt = attempt.clone();
                let report =
                    AttemptReport { attempt, state, step_index: 2, opened: false, refusal: None, fault: None, stats };
                errand_reports::apply_report(tx, &robot_id, &report);
            }
        });
    }

    fn sums_of(&self, robot: &str) -> EnergySums {
        let mut sums = EnergySums::default();
        self.view.counters_of(&id(robot)).for_each(|counter| sums.merge(&counter.energy_sums));
        sums
    }
}

/// Half a minute of driving, picking and placing.
fn work() -> WorkStats {
    WorkStats {
        path_mm: 30_000,
        loaded_path_mm: 10_000,
        duration_ms: 40_000,
        energy_mwh: 6_000,
        ..WorkStats::default()
    }
}

#[test]
fn an_attempt_that_is_done_counts_with_its_actions_and_one_that_failed_or_charged_does_not() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Wake);
    rig.ends("T1", Event::Succeeded, work());
    let mut expected = EnergySums::default();
    let done = AttemptWork { empty_mm: 20_000, loaded_mm: 10_000, duration_ms: 40_000, actions: 2, energy_mwh: 6_000 };
    assert!(expected.add(&done));
    assert_eq!(rig.sums_of("r1"), expected);
    rig.errand("r1", Errand::Charge, "charge", work());
    assert_eq!(rig.sums_of("r1"), expected, "what it takes at a charger is no work");
    rig.errand("r1", Errand::Park, "park-b", work());
    assert!(expected.add(&AttemptWork { actions: 0, ..done }));
    assert_eq!(rig.sums_of("r1"), expected);
    rig.submit("T2", |_| {});
    rig.cycle(Pace::Wake);
    rig.ends("T2", Event::FailedRecoverable, work());
    assert_eq!(rig.sums_of("r1"), expected, "half an action may be in it");
    rig.submit("T3", |_| {});
    rig.cycle(Pace::Wake);
    rig.ends("T3", Event::Succeeded, WorkStats { loaded_path_mm: 30_001, ..work() });
    rig.submit("T4", |_| {});
    rig.cycle(Pace::Wake);
    rig.ends("T4", Event::Succeeded, WorkStats { path_mm: u64::MAX, energy_mwh: u64::MAX, ..work() });
    assert_eq!(rig.sums_of("r1"), expected, "what cannot be is counted nowhere");
}

#[test]
fn rates_are_the_same_when_they_follow_attempts_as_they_end_and_when_they_are_built_from_rows() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    for nth in 0..ATTEMPTS_MIN {
        rig.submit(&format!("T{nth}"), |_| {});
        rig.cycle(Pace::Wake);
        let more = nth * 977 % 20_000;
        let stats = WorkStats { path_mm: 30_000 + more, energy_mwh: 9_000 + more / 4, ..work() };
        rig.ends(&format!("T{nth}"), Event::Succeeded, stats);
    }
    let kept = *rig.view.energy_of(&id("r1"));
    assert!(kept.error_permille.is_some() && kept.rates.empty_mwh_per_km > 120_000, "{kept:?}");
    let mut built = Rig::new();
    rig.view.counters.values().for_each(|counter| built.absorb(&counter.row));
    assert_eq!(built.view.energy, rig.view.energy);
    let key = rig.view.counters.values().next().expect("a row").row.key();
    rig.view.absorb(&key, Revision(u64::MAX), None).expect("a row that is gone");
    assert_eq!(*rig.view.energy_of(&id("r1")), RobotEnergy::MODEL);
}

#[test]
fn a_robot_moves_nobodys_rates_but_its_own_and_its_newest_software_goes_before_older() {
    let mut rig = Rig::new();
    rig.took("r1", 1_000);
    let before = *rig.view.energy_of(&id("r1"));
    rig.took("r1-b", 9_000);
    rig.took("r10", 110);
    assert_eq!(*rig.view.energy_of(&id("r1")), before);
    let bounds = |robot: &str| {
        let EnergyRates { empty_mwh_per_km, loaded_mwh_per_km, idle_mw, action_mwh } =
            rig.view.energy_of(&id(robot)).rates;
        [empty_mwh_per_km / 1_200, loaded_mwh_per_km / 1_560, idle_mw / 800, action_mwh / 5]
    };
    assert_eq!((bounds("r1-b"), bounds("r10")), ([400; 4], [25; 4]), "percent of the model's");
    let (older, newer) = (rig.now.utc.plus_ms(1), rig.now.utc.plus_ms(2));
    rig.absorb(&counter("r1", "2.0.0", newer, sums(60, 2_000)));
    rig.absorb(&counter("r1", "0.9.0", older, sums(60, 3_000)));
    let energy = rig.view.energy_of(&id("r1"));
    assert!((235_000..245_000).contains(&energy.rates.empty_mwh_per_km), "{energy:?}");
}

/// Whether a robot with so much charge, of so many thousandths of the model's rates, may be given two hours of standing at B.
fn why_not(battery_permille: u16, takes_permille: Option<u64>) -> Option<Code> {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    Arc::make_mut(rig.board.get_mut(&id("r1")).expect("a robot")).report.vitals.battery_permille = battery_permille;
    takes_permille.into_iter().for_each(|permille| rig.took("r1", permille));
    let step = |kind| RawStep { kind: Some(kind), ..RawStep::default() };
    let steps = vec![step(RawStepKind::Goto("B".into())), step(RawStepKind::Wait(7_200_000))];
    rig.submit("T1", |raw| (raw.steps, raw.timeout_ms) = (steps, Some(10_000_000)));
    let task_id = TaskId::parse("T1").expect("an id");
    let (task, intake) = rig.view.task(&task_id).zip(rig.view.intake(&task_id)).expect("a task");
    let demand = Demand::new(&rig.view, task, intake);
    filters::pair(&rig.view, &rig.board, &id("r1"), &demand, &rig.now).err().map(|why| why.code)
}

#[test]
fn charge_is_asked_for_by_the_robots_own_rates_and_by_the_model_where_they_are_unknown() {
    assert_eq!((why_not(300, None), why_not(300, Some(1_000))), (None, None));
    assert_eq!(why_not(300, Some(2_000)), Some(Code::BatteryLow), "it would be empty before it is at a charger");
    assert_eq!((why_not(230, None), why_not(230, Some(1_000))), (Some(Code::BatteryLow), Some(Code::BatteryLow)));
    assert_eq!(why_not(230, Some(500)), None);
}

/// Two robots equally far from a task, of which the first takes double. What the plan chose.
fn between_two(energy_ms_per_wh: u32) -> crate::fleet::projection::chosen::PlanChoice {
    let mut rig = line();
    let site_id = rig.view.site.site_id().clone();
    rig.absorb(&PlannerPolicy { energy_ms_per_wh, ..PlannerPolicy::default_of(site_id) });
    rig.robot("left", "c0");
    rig.robot("right", "c80");
    rig.took("left", 2_000);
    rig.submit("T1", visits(&[40]));
    rig.cycle(Pace::Wake);
    let task_id = TaskId::parse("T1").expect("an id");
    explain::task(&rig.view, &rig.board, &rig.now, &task_id).and_then(|told| told.choice).expect("a plan gave it")
}

#[test]
fn of_two_robots_that_are_as_near_the_one_that_takes_less_is_chosen_and_the_term_is_told() {
    let choice = between_two(100);
    assert_eq!((choice.robot_id.as_str(), choice.cost.energy), ("right", 0));
    let other = &choice.next[0];
    // 40 m take some 5.7 Wh by the model, and so many more.
    assert!((560_000..580_000).contains(&other.cost.energy), "{:?}", other.cost);
    assert_eq!(other.cost.sum() - other.cost.energy, choice.cost.sum());
    let off = between_two(0);
    assert_eq!((off.robot_id.as_str(), off.next[0].cost.energy), ("left", 0), "the tie is of the first");
}

#[test]
fn a_robot_is_explained_with_the_rates_by_which_its_work_is_planned() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    let told = |rig: &Rig| explain::robot(&rig.view, &rig.board, &rig.now, &id("r1")).expect("a robot").energy;
    assert_eq!(told(&rig), RobotEnergy::MODEL);
    rig.absorb(&counter("r1", "1.0.0", rig.now.utc, sums(ATTEMPTS_MIN - 1, 2_000)));
    assert_eq!(told(&rig), RobotEnergy { attempts: ATTEMPTS_MIN - 1, ..RobotEnergy::MODEL });
    rig.absorb(&counter("r1", "2.0.0", rig.now.utc, sums(60, 2_000)));
    let energy = told(&rig);
    assert_eq!((energy.attempts, energy.error_permille.is_some_and(|error| error < 20)), (60, true), "{energy:?}");
}
