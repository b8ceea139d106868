//! Twins of roll-outs: each naive rule is led into the situation that it gets wrong, and its law must be seen broken.

use crate::directed::Scene;
use crate::net::LineState;
use crate::orders::Order;
use crate::room::Naive;
use crate::run::steer;
use crate::software::GOOD;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_core::fleet::bugs::{Bugs as FleetBugs, SeededBug as Fleet};
use midshift_core::rollout::bugs::{Bugs as RolloutBugs, SeededBug as Rollouts};
use midshift_core::rollout::rows::Phase;
use midshift_core::update::UpdateState;
use midshift_proto::ota::v1::RolloutSpec;
use midshift_proto::ota::v1::rollout_wave::Size;
use midshift_server::NaiveRules as Server;
use std::panic::{AssertUnwindSafe, catch_unwind};

fn rollouts(bug: Rollouts) -> Naive {
    Naive { server: Server { rollouts: RolloutBugs::seeded(&[bug]), ..Server::default() }, ..Naive::default() }
}

fn agent(bug: SeededBug) -> Naive {
    Naive { agent: Bugs::seeded(&[bug]), ..Naive::default() }
}

/// Leads the twin into its situation, and the real rule too: only the twin breaks the law.
fn breaks(seed: u64, robots: usize, naive: Naive, law: &str, lead: impl Fn(&mut Scene)) {
    for (rule, is_broken) in [(Naive::default(), false), (naive, true)] {
        let mut scene = Scene::from_seed(seed, robots, rule);
        let led = catch_unwind(AssertUnwindSafe(|| lead(&mut scene)));
        let found = scene.findings();
        assert_eq!(found.iter().any(|finding| finding.contains(law)), is_broken, "{law}: {found:#?}");
        assert!(is_broken || (led.is_ok() && found.is_empty()), "the real rule: {found:#?}");
    }
}

fn seconds(seconds: i64) -> Option<prost_types::Duration> {
    Some(prost_types::Duration { seconds, nanos: 0 })
}

fn at_once(spec: &mut RolloutSpec) {
    spec.waves = vec![midshift_proto::ota::v1::RolloutWave { size: Some(Size::Rest(true)) }];
    spec.allow_full_push = true;
}

#[test]
fn a_drain_that_time_releases_gives_work_to_a_robot_on_probation() {
    let law = "I19 nobody is given work on probation";
    breaks(60, 3, rollouts(Rollouts::TimeReleasesDrain), law, |scene| {
        scene.begin("r", GOOD[0], |spec| spec.probation = seconds(120));
        let canary = scene.some_is_in(UpdateState::Switching);
        steer(&mut scene.room, canary, LineState::Cut);
        scene.pass(8_000);
        scene.order(Order::Pause("r".to_owned()));
        scene.pass(4_000);
        scene.work(6);
        steer(&mut scene.room, canary, LineState::Open);
        scene.pass(80_000);
    });
}

#[test]
fn a_pause_that_is_forgotten_lets_robots_change_after_it() {
    let law = "I18 no activation after the word to stand still";
    breaks(61, 3, rollouts(Rollouts::PauseIsForgotten), law, |scene| {
        scene.begin("r", GOOD[0], |_| {});
        scene.comes_to("r", Phase::Applying);
        (0..3).for_each(|robot| steer(&mut scene.room, robot, LineState::Held));
        scene.order(Order::Pause("r".to_owned()));
        scene.pass(8_000);
        (0..3).for_each(|robot| steer(&mut scene.room, robot, LineState::Open));
        scene.pass(60_000);
    });
}

#[test]
fn any_drain_that_will_do_changes_robots_in_the_drain_of_somebody_else() {
    let law = "I19 a robot activates in the drain of its roll-out";
    let naive = Naive { agent: Bugs::seeded(&[SeededBug::AnyDrainWillDo]), ..rollouts(Rollouts::AnyDrainWillDo) };
    breaks(62, 3, naive, law, |scene| {
        for robot in 0..3 {
            let robot_id = scene.room.robot_id(robot).to_string();
            scene.order(Order::Drain(robot_id));
        }
        scene.answered();
        scene.pass(20_000);
        scene.begin("r", GOOD[0], |_| {});
        scene.pass(60_000);
    });
}

#[test]
fn a_robot_that_activates_anyway_does_so_while_it_is_stopped() {
    let law = "I19 no activation with work, load, passage or stop";
    breaks(63, 3, agent(SeededBug::ActivatesAnyway), law, |scene| {
        (0..3).for_each(|robot| scene.room.stop_body(robot, 60_000));
        scene.begin("r", GOOD[0], |_| {});
        scene.pass(50_000);
    });
}

#[test]
fn an_area_whose_budget_is_forgotten_spares_too_many() {
    let law = "I17 no more change than the area spares";
    let fleet = FleetBugs::seeded(&[Fleet::BudgetIsForgotten]);
    let naive = Naive { server: Server { fleet, ..Server::default() }, ..Naive::default() };
    breaks(64, 6, naive, law, |scene| {
        scene.begin("r", GOOD[0], |spec| {
            at_once(spec);
            spec.probation = seconds(20);
        });
        scene.pass(40_000);
    });
}

#[test]
fn a_limit_of_the_wave_that_is_forgotten_changes_too_many() {
    let law = "I17 no more change than the wave has";
    // All robots are of one area, whose budget would hold them back.
    let fleet = FleetBugs::seeded(&[Fleet::BudgetIsForgotten]);
    let rollouts = RolloutBugs::seeded(&[Rollouts::InFlightIsForgotten]);
    let naive = Naive { server: Server { fleet, rollouts, ..Server::default() }, ..Naive::default() };
    breaks(65, 10, naive, law, |scene| {
        scene.begin("r", GOOD[0], |spec| {
            at_once(spec);
            spec.max_in_flight = Some(1);
            spec.probation = seconds(20);
        });
        scene.pass(40_000);
    });
}
