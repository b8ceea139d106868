//! The power goes at every effect of an update, and the set on trial may die when it comes back.

use crate::bases::{a_day_passes, migrations};
use crate::rig::{Rig, now_at};
use crate::updates::{Order, committed, connected, drain, maintain, name_of, report, state, switch, want};
use midshift_agent::core::{ExitReason, Input};
use midshift_agent::sets::Sets;
use midshift_core::update::{ActivationGrant, Goal, UpdateReport, UpdateState};

/// What the server would say now, whatever was lost: level-triggered.
pub fn server_says(rig: &mut Rig, order: &mut Order, grants: &mut u64, back: bool) {
    let at = state(rig);
    order.generation += 10;
    let idle = matches!(at, Some(UpdateState::Trial | UpdateState::Committed | UpdateState::RolledBack));
    order.drain_id = Some(drain("drain-1"));
    maintain(rig, order.drain_id.as_ref().filter(|_| !idle));
    let goal = match at {
        Some(UpdateState::Trial) if back => Goal::Revert,
        Some(UpdateState::RollingBack) => Goal::Revert,
        Some(UpdateState::Trial | UpdateState::Committing) => Goal::Commit,
        _ => Goal::Activate,
    };
    let mut desired = order.to(goal);
    if at == Some(UpdateState::Staged) {
        *grants += 1;
        let (grant_id, authority) = (*grants, rig.authority(5_000));
        desired.grant = Some(ActivationGrant { grant_id, drain_id: drain("drain-1"), authority });
    }
    want(rig, desired);
}

/// What happens to one update on its way.
#[derive(Clone, Copy, Debug)]
struct Course {
    /// The server wants it back once it is on trial.
    back: bool,
    /// It brings an operating system, and a program that migrates data.
    bases: bool,
    /// A set that is on trial when the power comes again never lives: the launcher puts it away.
    dies: bool,
}

impl Course {
    fn all() -> impl Iterator<Item = Self> {
        (0..8).map(|n| Self { back: n & 1 != 0, bases: n & 2 != 0, dies: n & 4 != 0 })
    }
}

/// How an update ended.
struct Ended {
    state: UpdateState,
    /// Effects that it took.
    effects: usize,
    /// The launcher put its set away.
    fell: bool,
}

/// One update to its end, with the power going at one of its effects.
fn with_power_cut(at: Option<usize>, last_is_done: bool, course: Course) -> Ended {
    let (rig, releases) = connected();
    let release = |version| if course.bases { releases.release_base(version) } else { releases.release(version) };
    let first = release("1.1.0");
    let mut rig = committed(rig, &releases, &first, 1);
    a_day_passes(&mut rig, &releases);
    let second = release("1.2.0");
    let (good, mut grants, mut fell) = (name_of(&rig), 1_000_000, false);
    let mut order = Order::new(releases.directive(&second, 2));
    order.generation = 10_000;
    let updates = rig.updates.as_mut().expect("has them");
    let before = updates.effects;
    (updates.cut_at, updates.last_is_done) = (at.map(|at| before + at), last_is_done);
    for _ in 0..200 {
        server_says(&mut rig, &mut order, &mut grants, course.back);
        rig.pass(2_000);
        let updates = rig.updates.as_ref().expect("has them");
        if updates.dark {
            updates.sets.lose_power();
            if course.dies && switch(&rig).trial.is_some() {
                updates.sets.fall_back(2);
                fell = true;
            }
        }
        if updates.dark || rig.exit == Some(ExitReason::Switched) {
            boots_something_whole(&rig, &good);
            rig = rig.restart();
            rig.connect();
        }
        let told = report(&rig).filter(|r| r.bundle.as_str() == second.digest.to_string());
        let ended = |r: &UpdateReport| matches!(r.state, UpdateState::Committed | UpdateState::RolledBack);
        let migrates = !rig.store.memory().expect("loaded").ledger.software.due.is_empty();
        if let Some(told) = told.filter(ended).filter(|_| !migrates) {
            let is_committed = told.state == UpdateState::Committed;
            let migrated = migrations(&rig);
            assert_eq!(migrated.contains(&"1.2.0".to_owned()), course.bases && is_committed, "{migrated:?}");
            boots_something_whole(&rig, &good);
            let effects = rig.updates.as_ref().map_or(0, |u| u.effects) - before;
            all_agree(&mut rig, &told, &good);
            return Ended { state: told.state, effects, fell };
        }
    }
    panic!("never ended: power went at {at:?} of {course:?}, {:?}", report(&rig));
}

/// Ledger, switch record and what the server is told say the same of an update that is over.
fn all_agree(rig: &mut Rig, told: &UpdateReport, good: &str) {
    rig.pass(2_000);
    let set = told.set.as_ref().map(ToString::to_string).expect("a set");
    let runs = if told.state == UpdateState::Committed { set.as_str() } else { good };
    let record = switch(rig);
    assert_eq!((record.running(), record.trial.as_ref()), (runs, None), "{told:?}");
    let ledger = rig.store.memory().expect("loaded").ledger.software.update.expect("an update");
    assert_eq!((ledger.state, ledger.set_name().as_deref()), (told.state, Some(set.as_str())));
    let heard = opens_with(rig).expect("a session begins with it");
    assert_eq!((heard.state, &heard.set), (told.state, &told.set));
}

/// What a session of the robot begins with saying of its update: heartbeats leave out what is over. It is connected
/// then.
pub fn opens_with(rig: &mut Rig) -> Option<UpdateReport> {
    rig.give(Input::Disconnected);
    let hello = rig.core.reported(&now_at(rig.ms));
    rig.connect();
    hello.update
}

/// Whatever the launcher would start now is whole.
fn boots_something_whole(rig: &Rig, good: &str) {
    let mut sets = rig.updates.as_ref().expect("has them").sets.clone();
    let record = sets.holdings().expect("a record").switch;
    let running = record.running().parse().expect("a set, not the factory's");
    sets.verify(&running).expect("is whole");
    if record.trial.is_some() {
        assert_eq!(record.current, good, "what is gone back to is the set committed last");
        sets.verify(&good.parse().expect("a set")).expect("is whole");
    }
}

#[test]
fn the_power_may_go_at_every_effect_of_an_update_and_its_set_may_die_after_it_and_it_still_ends() {
    for course in Course::all() {
        let wanted = if course.back { UpdateState::RolledBack } else { UpdateState::Committed };
        let undisturbed = with_power_cut(None, false, course);
        assert_eq!((undisturbed.state, undisturbed.fell), (wanted, false));
        assert!(undisturbed.effects > 20, "only {} effects", undisturbed.effects);
        let mut fell = 0;
        for at in 1..=undisturbed.effects {
            for last_is_done in [false, true] {
                let ended = with_power_cut(Some(at), last_is_done, course);
                let end = if ended.fell { UpdateState::RolledBack } else { wanted };
                assert_eq!(ended.state, end, "the power went at {at}, done: {last_is_done}, {course:?}");
                fell += usize::from(ended.fell);
            }
        }
        assert_eq!(fell > 4, course.dies, "{fell} sets fell: {course:?}");
    }
}
