//! A shut window, a freeze, a pause, a revoke and an abort hold robots that change to something new, at every step, and
//! nobody else.

use super::*;
use crate::policy::Window;

/// What holds a roll-out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Hold {
    Freeze,
    Pause,
    Revoke,
    Abort,
}

impl Hold {
    const ALL: [Self; 4] = [Self::Freeze, Self::Pause, Self::Revoke, Self::Abort];

    /// What a person asks of roll-outs; none: it changes the rules of the area.
    fn command(self) -> Option<Command> {
        let about = |verb| Command::Do { rollout_id: rollout_id("ro"), verb, reason: "because".into() };
        match self {
            Self::Freeze => None,
            Self::Pause => Some(about(Verb::Pause)),
            Self::Revoke => Some(Command::Revoke { bundle: bundle_id(2), reason: "leaks".into() }),
            Self::Abort => Some(about(Verb::Abort)),
        }
    }

    fn set(self, rig: &mut Rig) {
        match self.command() {
            Some(command) => assert!(!rig.ask(&command).expect("it is allowed"), "it was done before"),
            None => rig.rules(|s| s.frozen = true),
        }
    }
}

fn wide() -> RolloutSpec {
    RolloutSpec { waves: vec![Wave::Rest], allow_full_push: true, ..spec() }
}

impl Rig {
    /// Whether the store would take the item as its rows are.
    fn takes(&self, item: &Item) -> bool {
        let found = |key: &Key| self.rows.get(key).map_or(Expect::Absent, |row| Expect::At(row.revision));
        item.rows.iter().all(|change| change.expect == found(&change.key))
    }

    fn waits_for(&self, n: usize) -> Option<Code> {
        let (rollout, r) = (self.rollout("ro"), self.robot_in("ro", n));
        crate::rollout::explain::blocked(&self.ota, &self.board, &self.now, &rollout, &r).map(|blocked| blocked.by.code)
    }
}

/// Twelve robots change, of which one may be out of work: it is, and asks for nothing. The others wait for it.
fn crowded() -> (Rig, usize) {
    let mut rig = Rig::new(12);
    rig.rules(|s| s.off_work_permille = 100);
    rig.fates(Fate::NeverReady);
    rig.start(wide());
    rig.until(30, |r| r.count(Step::Activating) == 1 && r.count(Step::Draining) == 11);
    let first = (0..12).find(|n| rig.step(*n) == Step::Activating).expect("one is out of work");
    (rig, first)
}

/// The area has a window that is open now, and shuts within two minutes.
fn open_for_a_while(rig: &mut Rig) {
    let minute = u16::try_from(rig.now.utc.0 / 60_000 % 1_440).expect("a minute of the day");
    let window = Window { days: BTreeSet::new(), from_minute: minute, to_minute: minute + 2, zone: "UTC".to_owned() };
    rig.rules(|s| s.windows = vec![window]);
}

fn is_open(rig: &Rig) -> bool {
    rig.ota.policy(&hall()).software.is_open(&rig.now)
}

fn waiting(rig: &Rig) -> usize {
    rig.fleet.drains.values().filter(|d| d.row.state == DrainState::Waiting).count()
}

#[test]
fn a_window_that_shuts_in_mid_wave_takes_back_whoever_waits_and_lets_end_what_has_begun() {
    let (mut rig, first) = crowded();
    open_for_a_while(&mut rig);
    rig.ticks(2);
    assert_eq!((rig.count(Step::Draining), waiting(&rig)), (11, 11), "open as long as it is open");
    rig.until(130, |r| !is_open(r));
    rig.ticks(2);
    assert_eq!((rig.count(Step::Staged), waiting(&rig), rig.rollout("ro").in_flight), (11, 0, 1));
    rig.fates(Fate::Good);
    rig.until(60, |r| r.step(first) == Step::Trial);
    rig.ticks(5);
    assert_eq!((rig.count(Step::Staged), rig.rollout("ro").in_flight), (11, 0), "there is room, and nobody begins");
    let other = (0..12).find(|n| *n != first).expect("eleven");
    assert_eq!(rig.waits_for(other), Some(Code::BlockedByWindow));
    rig.rules(|s| {
        s.windows.clear();
        s.off_work_permille = 1_000;
    });
    rig.until(200, |r| r.phase() == Phase::Completed);
}

#[test]
fn fleet_lets_no_drain_begin_behind_a_window_that_has_just_shut() {
    let mut rig = Rig::new(12);
    rig.fleet_sleeps = true;
    open_for_a_while(&mut rig);
    rig.start(wide());
    rig.until(30, |r| r.count(Step::Draining) == 12);
    while is_open(&rig) {
        rig.pass(1_000);
    }
    rig.fleet_turn();
    assert_eq!(waiting(&rig), 12, "the roll-outs have not looked yet");
    assert!(rig.fleet.drains.values().all(|d| d.row.why.as_ref().is_some_and(|w| w.code == Code::BlockedByWindow)));
}

#[test]
fn a_window_that_shuts_during_an_abort_keeps_nobody_on_what_was_aborted() {
    let mut rig = Rig::new(8);
    rig.start(wide());
    rig.until(60, |r| r.count(Step::Trial) == 8);
    open_for_a_while(&mut rig);
    rig.rules(|s| s.off_work_permille = 100);
    rig.must("ro", Verb::Abort);
    rig.ticks(2);
    rig.rules(|s| {
        s.windows.iter_mut().for_each(|w| (w.from_minute, w.to_minute) = (0, 1));
        s.frozen = true;
    });
    assert!(rig.count(Step::Reverting) > 0, "some are still to go");
    rig.until(300, |r| r.phase() == Phase::Aborted);
    assert_eq!(rig.count(Step::RolledBack), 8);
}

#[test]
fn a_completed_roll_out_is_taken_back_also_while_the_area_is_frozen() {
    let mut rig = Rig::new(5);
    rig.start(wide());
    rig.until(200, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    rig.rules(|s| s.frozen = true);
    rig.ask(&Command::Rollback { of: rollout_id("ro"), rollout_id: rollout_id("back") }).expect("it is allowed");
    for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede: false }] {
        rig.must("back", verb);
    }
    rig.until(200, |r| r.rollout("back").phase == Phase::Completed);
    assert!(rig.robots.iter().all(|r| r.version == "0.9.0"));
}

#[test]
fn a_frozen_area_keeps_no_person_from_taking_a_robot_out_of_work() {
    let mut rig = Rig::new(2);
    rig.rules(|s| s.frozen = true);
    let mut plan = fleet::Plan::default();
    plan.decide(&mut rig.fleet, rig.now, "ana", |tx| drain::request_drain(tx, &robot_id(0), "oil", "ana", 60_000));
    rig.commit(plan.items);
    rig.ticks(3);
    assert!(rig.fleet.drains.values().all(|d| d.row.state == DrainState::Held) && rig.fleet.drains.len() == 1);
}

#[test]
fn nobody_starts_the_bundle_first_after_a_freeze_a_pause_a_revoke_or_an_abort() {
    for hold in Hold::ALL {
        let (mut rig, first) = crowded();
        hold.set(&mut rig);
        rig.fates(Fate::Good);
        rig.ticks(60);
        assert!(rig.robots.iter().all(|r| r.seen_grant == 0), "{hold:?}");
        assert_eq!(rig.rollout("ro").in_flight, 0, "{hold:?}");
        let stands = if hold == Hold::Abort { Step::Skipped } else { Step::Staged };
        assert_eq!((rig.step(first), rig.count(stands)), (stands, 12), "{hold:?}");
        assert!(rig.fleet.drains.is_empty(), "{hold:?}");
    }
}

#[test]
fn a_drain_that_fleet_lets_begin_in_the_same_moment_does_not_begin() {
    for hold in Hold::ALL {
        let mut rig = Rig::new(12);
        rig.fleet_sleeps = true;
        rig.start(wide());
        rig.until(30, |r| r.count(Step::Draining) == 12);
        let mut items = rig.fleet_plan();
        let begins = |item: &Item| item.rows.iter().any(|row| row.kind == "drain.begun");
        let at = items.iter().position(begins).expect("a drain begins");
        let late = items.split_off(at);
        rig.commit(items);
        assert!(rig.takes(&late[0]), "{hold:?}: nothing stands in its way");
        hold.set(&mut rig);
        assert!(!rig.takes(&late[0]), "{hold:?}: it would begin behind it");
    }
}

#[test]
fn what_was_asked_of_fleet_is_taken_back_in_the_item_that_ends_it_as_far_as_one_holds() {
    for hold in Hold::ALL {
        let Some(command) = hold.command() else { continue };
        let mut rig = Rig::new(80);
        rig.checks_rebuild = false;
        rig.fleet_sleeps = true;
        rig.start(wide());
        rig.until(30, |r| r.count(Step::Draining) == 80);
        rig.ota_turn();
        let mut plan = Plan::default();
        carry_out(&mut rig.ota, &rig.board, rig.now, &command, &"ana".into(), &mut plan);
        let [item] = &plan.items[..] else { panic!("{hold:?}: one item") };
        let taken_back = item.rows.iter().filter(|row| row.kind == "drain.release").count();
        assert!((60..80).contains(&taken_back), "{hold:?}: {taken_back}");
        rig.commit(plan.items);
        rig.ticks(1);
        assert_eq!((rig.count(Step::Draining), rig.rollout("ro").in_flight), (0, 0), "{hold:?}: the others follow");
    }
}
