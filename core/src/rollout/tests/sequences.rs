//! Any order of reports, heartbeats, commands and time: the laws of [`Rig::assert_laws`] hold, items find their rows,
//! nothing panics.

use super::*;
use proptest::prelude::*;

#[derive(Clone, Debug)]
enum Deed {
    Tick,
    Wait(u64),
    Off(usize),
    On(usize),
    Fate(usize, u8),
    Report(usize, usize),
    Ready(usize),
    Fault(usize),
    Stop(usize, bool),
    Retire(usize),
    Pin(usize),
    Verb(u8),
    Restart,
    Fleet(bool),
    Revoke,
}

fn deed() -> impl Strategy<Value = Deed> {
    let robot = 0usize..6;
    prop_oneof![
        30 => Just(Deed::Tick),
        3 => prop_oneof![Just(12_000u64), Just(130_000), Just(4_000_000)].prop_map(Deed::Wait),
        3 => robot.clone().prop_map(Deed::Off),
        4 => robot.clone().prop_map(Deed::On),
        4 => (robot.clone(), 0u8..8).prop_map(|(n, f)| Deed::Fate(n, f)),
        4 => (robot.clone(), 0usize..12).prop_map(|(n, s)| Deed::Report(n, s)),
        2 => robot.clone().prop_map(Deed::Ready),
        1 => robot.clone().prop_map(Deed::Fault),
        1 => (robot.clone(), any::<bool>()).prop_map(|(n, s)| Deed::Stop(n, s)),
        1 => robot.clone().prop_map(Deed::Retire),
        1 => robot.prop_map(Deed::Pin),
        5 => (0u8..7).prop_map(Deed::Verb),
        2 => Just(Deed::Restart),
        2 => any::<bool>().prop_map(Deed::Fleet),
        1 => Just(Deed::Revoke),
    ]
}

fn fate(number: u8) -> Fate {
    [
        Fate::Good,
        Fate::BadAtStart,
        Fate::Silent,
        Fate::Probation,
        Fate::NeverReady,
        Fate::NoBytes,
        Fate::Unfit,
        Fate::Dawdles,
    ][usize::from(number)]
}

fn verb(number: u8) -> Verb {
    match number {
        0 => Verb::Pause,
        1 => Verb::Resume,
        2 => Verb::Promote,
        3 => Verb::Abort,
        4 => Verb::RetryFailed,
        5 => Verb::Exclude(robot_id(3)),
        _ => Verb::Start { supersede: true },
    }
}

fn play(rig: &mut Rig, deed: &Deed) {
    match deed {
        Deed::Tick => rig.tick(),
        Deed::Wait(ms) => {
            rig.pass(*ms);
            rig.turn();
        }
        Deed::Off(n) => rig.robots[*n].is_off = true,
        Deed::On(n) => rig.robots[*n].is_off = false,
        Deed::Fate(n, f) => rig.robots[*n].fate = fate(*f),
        Deed::Report(n, state) => {
            if rig.robots[*n].report.is_some() {
                rig.report(*n, UpdateState::ALL[*state]);
            }
        }
        Deed::Ready(n) => {
            let set = crate::ids::SetId::parse("factory").expect("an id");
            let drain_id = rig.ota.robots.values().find_map(|r| r.row.drain_id.clone());
            if let Some(drain_id) = drain_id {
                rig.say_event(*n, RobotEvent::Update(UpdateEvent::Ready { drain_id, set }));
            }
        }
        Deed::Fault(n) => {
            let class = crate::robot::FaultClass::Recoverable;
            rig.say_event(
                *n,
                RobotEvent::Fault { fault: Fault { code: 66, class, message: String::new() }, cleared: false },
            );
        }
        Deed::Stop(n, stopped) => {
            let stop = if *stopped { HardwareStop::Manual } else { HardwareStop::None };
            rig.robots[*n].stop = stop;
            rig.say_event(*n, RobotEvent::HardwareStop(stop));
        }
        Deed::Retire(n) => rig.retire(*n),
        Deed::Pin(n) => drop(rig.ask(&Command::Pin { robot_id: robot_id(*n), reason: String::new() })),
        Deed::Verb(number) => drop(rig.verb("ro", verb(*number))),
        Deed::Restart => rig.restart(),
        Deed::Fleet(sleeps) => rig.fleet_sleeps = *sleeps,
        Deed::Revoke => drop(rig.ask(&Command::Revoke { bundle: bundle_id(2), reason: String::new() })),
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, max_shrink_iters: 200, ..ProptestConfig::default() })]
    #[test]
    fn whatever_happens_the_laws_hold_and_an_abort_stands(deeds in proptest::collection::vec(deed(), 1..120)) {
        let mut rig = Rig::new(6);
        rig.start(RolloutSpec { waves: vec![Wave::Count(1), Wave::Count(2), Wave::Rest], allow_full_push: true, ..spec() });
        let mut abort = None;
        for deed in &deeds {
            play(&mut rig, deed);
            rig.ota_turn();
            let rollout = rig.rollout("ro");
            prop_assert!(abort.is_none() || rollout.abort == abort, "an abort was taken back");
            abort.clone_from(&rollout.abort);
            for r in rig.ota.robots_of(&rollout.rollout_id) {
                let none_left = r.step.is_over() && r.drain_id.is_some();
                prop_assert!(!none_left, "{} is over and holds a drain", r.robot_id);
                let blocked = crate::rollout::explain::blocked(&rig.ota, &rig.board, &rig.now, &rollout, r);
                prop_assert_eq!(blocked.is_none(), r.step.is_over());
            }
        }
    }
}
