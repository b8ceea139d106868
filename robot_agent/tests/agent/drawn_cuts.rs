//! Updates while everything happens to the robot's machine, drawn from a seed: the power goes at an effect of the
//! agent, and at the next start the set on trial may be unable to live, the disk full, the wall clock wrong, and a
//! second launcher there.
//!
//! The agent is the one of the bench, over sets on a disk; every start is the real launcher's. Invariant: each start
//! is of a whole, signed set; each update ends; ledger, switch record and report then say the same; the next release
//! is taken. A seed is the same run each time; one that fails says how it is played again. `cargo xtask torture
//! updates` plays more.

use crate::bases::a_day_passes;
use crate::cuts::{opens_with, server_says};
use crate::machine::Machine;
use crate::release::{Bundle, Releases, component};
use crate::rig::Rig;
use crate::updates::{Order, report};
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::switch::FACTORY;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{ComponentKind, Needs};
use midshift_core::robot_events::RobotEvent;
use midshift_core::update::{UpdateEvent, UpdateReport, UpdateState};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Seeds of a plain run: about half a minute of one core.
const SEEDS: u64 = 300;
/// So many seeds must have met everything.
const ENOUGH: u64 = 200;
/// Players at once: some wait for a launcher that pauses.
const PLAYERS: usize = 4;
/// An update is over within this, two seconds of the robot each.
const ROUNDS_MAX: usize = 400;
const HOUR_MS: i64 = 3_600_000;
/// How far the wall clock may be from the truth.
const JUMPS_MS: [i64; 5] = [0, 0, -HOUR_MS, HOUR_MS, 30 * 24 * HOUR_MS];
/// What must have been met, each by evidence.
const MET: [&str; 13] = [
    "power cut",
    "set that cannot live",
    "start that took the power with it",
    "full disk",
    "call that found no room",
    "ledger without room",
    "clock an hour behind",
    "clock an hour ahead",
    "clock thirty days ahead",
    "second launcher refused",
    "set put away",
    "update committed",
    "update rolled back",
];

/// How often something was met.
type Met = BTreeMap<&'static str, u64>;

/// A power cut, and what is wrong when the power is back.
#[derive(Clone, Copy, Debug)]
struct Blow {
    /// When, in parts of an update that nothing happens to.
    at_permille: usize,
    /// The effect at which it goes was done; else it was not.
    last_is_done: bool,
    /// The set on trial never lives again.
    dies: bool,
    is_full: bool,
    ledger_is_full: bool,
    jumped_ms: i64,
    is_doubled: bool,
    /// Rounds until the disk has room again and the clock is right.
    rounds: u32,
}

impl Blow {
    fn draw(rng: &mut StdRng) -> Self {
        let is_full = rng.random_bool(0.3);
        let ledger_is_full = is_full && rng.random_bool(0.4);
        Self {
            at_permille: rng.random_range(0..1_000),
            last_is_done: rng.random_bool(0.5),
            dies: rng.random_bool(0.3),
            is_full,
            ledger_is_full,
            jumped_ms: JUMPS_MS[rng.random_range(0..JUMPS_MS.len())],
            is_doubled: rng.random_bool(0.3),
            rounds: rng.random_range(1..=if ledger_is_full { 2 } else { 6 }),
        }
    }
}

/// What one seed plays.
#[derive(Debug)]
struct Plan {
    /// Releases bring an operating system.
    has_base: bool,
    /// The server wants the second release back once it is on trial.
    back: bool,
    blows: Vec<Blow>,
}

impl Plan {
    fn draw(seed: u64) -> Self {
        let mut rng = StdRng::seed_from_u64(seed);
        let (has_base, back, blows) = (rng.random_bool(0.3), rng.random_bool(0.3), rng.random_range(1..=2));
        Self { has_base, back, blows: (0..blows).map(|_| Blow::draw(&mut rng)).collect() }
    }
}

/// Says how a seed is played again, if it fails.
struct Replay(u64, String);

impl Drop for Replay {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let Self(seed, plan) = self;
            let again = "cargo test -p midshift-agent --test agent drawn_cuts::whatever -- --nocapture";
            let said = format!("seed {seed}, {plan}\nagain: MIDSHIFT_SEED_FROM={seed} MIDSHIFT_SEEDS=1 {again}\n");
            let _ = std::io::stderr().lock().write_all(said.as_bytes());
        }
    }
}

/// Everything of one seed but the agent.
struct Shift {
    releases: Releases,
    bundles: Vec<Bundle>,
    machine: Machine,
    /// Number of the newest directive.
    directive: u64,
    grants: u64,
    /// What the server heard last of an update, over all sessions.
    heard: Option<UpdateReport>,
    met: Met,
}

impl Shift {
    /// A robot as it came, under its launcher.
    fn begin() -> (Self, Rig) {
        let releases = Releases::new();
        let rig = Rig::updatable(&releases);
        let mut this = Self {
            releases,
            bundles: Vec::new(),
            machine: Machine::new(),
            directive: 0,
            grants: 0,
            heard: None,
            met: Met::new(),
        };
        let rig = this.start_again(rig);
        (this, rig)
    }

    fn meet(&mut self, what: &'static str, times: u64) {
        if times > 0 {
            *self.met.entry(what).or_default() += times;
        }
    }

    /// Signs a release of weights, settings and perhaps an operating system: the launcher's own program stays.
    fn release(&mut self, version: &str, has_base: bool) -> Bundle {
        let base = format!("base {version}").repeat(9_000).into_bytes();
        self.releases.hold(&base);
        let bundle = self.releases.release_as(version, |manifest| {
            manifest.components[0].kind = ComponentKind::Weights;
            if has_base {
                let mut os = component("os", version, ComponentKind::Base, &base);
                os.needs = Needs::Reboot;
                manifest.components.push(os);
            }
        });
        self.bundles.push(bundle.clone());
        bundle
    }

    /// A new order to take a bundle.
    fn order(&mut self, bundle: &Bundle) -> Order {
        self.directive += 1;
        let mut order = Order::new(self.releases.directive(bundle, self.directive));
        order.generation = self.directive * 100_000;
        order
    }

    /// The launcher starts the agent again.
    fn start_again(&mut self, mut rig: Rig) -> Rig {
        self.listen(&mut rig);
        let (is_doubled, killed) = (self.machine.is_doubled, self.machine.killed);
        let disk = self.machine.start(&self.bundles);
        self.meet("second launcher refused", u64::from(is_doubled));
        self.meet("start that took the power with it", self.machine.killed - killed);
        let before = rig.updates.as_mut().expect("has them").disk.replace(disk);
        self.meet("call that found no room", before.map_or(0, |before| before.refused()));
        let mut rig = rig.restart();
        rig.connect();
        rig
    }

    /// Takes in what the robot has told of its update.
    fn listen(&mut self, rig: &mut Rig) {
        for event in rig.events.drain(..) {
            if let RobotEvent::Update(UpdateEvent::Changed(report)) = event {
                self.heard = Some(report);
            }
        }
    }

    /// The power is gone. This is wrong when it comes back.
    fn strike(&mut self, rig: &mut Rig, blow: &Blow) {
        let trial = self.machine.record().trial.map(|trial| trial.set).filter(|_| blow.dies);
        let dies = trial.is_some();
        self.machine.dying = trial.or(self.machine.dying.take());
        (self.machine.is_full, self.machine.is_doubled) = (blow.is_full, blow.is_doubled);
        let updates = rig.updates.as_mut().expect("has them");
        (updates.ledger_is_full, updates.jumped_ms) = (blow.ledger_is_full, blow.jumped_ms);
        for (what, happens) in [
            ("power cut", true),
            ("set that cannot live", dies),
            ("full disk", blow.is_full),
            ("ledger without room", blow.ledger_is_full),
            ("clock an hour behind", blow.jumped_ms == -HOUR_MS),
            ("clock an hour ahead", blow.jumped_ms == HOUR_MS),
            ("clock thirty days ahead", blow.jumped_ms > HOUR_MS),
        ] {
            self.meet(what, u64::from(happens));
        }
    }

    /// The disk has room again and the clock is right.
    fn calm(&mut self, rig: &mut Rig) {
        self.machine.is_full = false;
        let updates = rig.updates.as_mut().expect("has them");
        (updates.ledger_is_full, updates.jumped_ms) = (false, 0);
        if let Some(disk) = &updates.disk {
            disk.make_room();
        }
    }

    /// Plays an update to its end and a last start, with these blows on its way. `effects`: those of one that nothing
    /// happens to.
    fn update(&mut self, mut rig: Rig, bundle: &Bundle, back: bool, blows: &[Blow], effects: usize) -> Rig {
        let (mut blows, mut order, mut left) = (blows.iter(), self.order(bundle), 0_u32);
        let mut blow = blows.next();
        aim(&mut rig, blow, effects);
        for _ in 0..ROUNDS_MAX {
            if has_ended(&rig) {
                if let Some(struck) = blow.filter(|_| is_struck(&rig)) {
                    self.strike(&mut rig, struck);
                    left = struck.rounds;
                    blow = blows.next();
                    aim(&mut rig, blow, effects);
                }
                rig = self.start_again(rig);
            }
            let was_wrong = left > 0;
            left = left.saturating_sub(1);
            let is_calm = left == 0;
            if was_wrong && is_calm {
                self.calm(&mut rig);
            }
            let state = told(&rig, bundle).map(|told| told.state);
            if is_calm && (state == Some(UpdateState::Refused) || was_wrong && state.is_none()) {
                // What was refused for what was wrong then is ordered again.
                order = self.order(bundle);
            }
            server_says(&mut rig, &mut order, &mut self.grants, back);
            rig.pass(2_000);
            if is_calm && !has_ended(&rig) && told(&rig, bundle).is_some_and(|told| is_end(told.state)) {
                aim(&mut rig, None, effects);
                rig = self.start_again(rig);
                rig.pass(2_000);
                if !has_ended(&rig) && self.machine.record().trial.is_none() {
                    return rig;
                }
            }
        }
        panic!("never ended: {:?}, {:?}", report(&rig), self.machine.record());
    }

    /// What runs, the switch record, the ledger and all that the server is told say the same of an update that is
    /// over; how it ended.
    fn agree(&mut self, rig: &mut Rig, bundle: &Bundle, good: &str) -> UpdateState {
        let ledger = rig.store.memory().expect("loaded").ledger.software.update.expect("an update");
        let set = ledger.set_name().expect("a set");
        let is_kept = ledger.state == UpdateState::Committed;
        let runs = if is_kept { set.as_str() } else { good };
        let record = self.machine.record();
        assert_eq!((self.machine.started.as_str(), record.running(), &record.trial), (runs, runs, &None), "{ledger:?}");
        assert!(self.machine.is_on_its_base(), "{runs} runs on another base: {ledger:?}");
        if is_kept {
            assert_eq!(record.kept(), Some(good), "the way back is to the set committed before");
        }
        self.listen(rig);
        let said = [self.heard.clone(), opens_with(rig)].map(|report| report.expect("it says how the update ended"));
        for report in said {
            let its_set = report.set.as_ref().map(ToString::to_string);
            assert_eq!((report.state, its_set.as_deref()), (ledger.state, Some(set.as_str())));
            assert_eq!(report.bundle.as_str(), bundle.digest.to_string());
        }
        ledger.state
    }
}

/// The power goes at this blow's moment, counted from now.
fn aim(rig: &mut Rig, blow: Option<&Blow>, effects: usize) {
    let updates = rig.updates.as_mut().expect("has them");
    updates.cut_at = blow.map(|blow| updates.effects + 1 + effects * blow.at_permille / 1_000);
    updates.last_is_done = blow.is_some_and(|blow| blow.last_is_done);
}

/// The power went at the moment that was aimed at.
fn is_struck(rig: &Rig) -> bool {
    let updates = rig.updates.as_ref().expect("has them");
    updates.dark && updates.cut_at == Some(updates.effects)
}

/// The agent's process is over.
fn has_ended(rig: &Rig) -> bool {
    rig.exit.is_some() || rig.updates.as_ref().is_some_and(|updates| updates.dark)
}

fn is_end(state: UpdateState) -> bool {
    matches!(state, UpdateState::Committed | UpdateState::RolledBack)
}

/// What the ledger says of the update to this bundle.
fn told(rig: &Rig, bundle: &Bundle) -> Option<UpdateReport> {
    report(rig).filter(|told| told.bundle.as_str() == bundle.digest.to_string())
}

fn effects(rig: &Rig) -> usize {
    rig.updates.as_ref().map_or(0, |updates| updates.effects)
}

/// Three releases: one in peace, one with all that was drawn, and one in peace again. What was met.
fn play(seed: u64) -> Met {
    let plan = Plan::draw(seed);
    let _replay = Replay(seed, format!("{plan:?}"));
    let (mut shift, rig) = Shift::begin();
    let first = shift.release("1.1.0", plan.has_base);
    let before = effects(&rig);
    let mut rig = shift.update(rig, &first, false, &[], 0);
    assert_eq!(shift.agree(&mut rig, &first, FACTORY), UpdateState::Committed);
    let (undisturbed, good) = (effects(&rig) - before, shift.machine.started.clone());
    if plan.has_base {
        a_day_passes(&mut rig, &shift.releases);
    }
    let second = shift.release("1.2.0", plan.has_base);
    let mut rig = shift.update(rig, &second, plan.back, &plan.blows, undisturbed);
    let end = shift.agree(&mut rig, &second, &good);
    let died = shift.machine.dying.take().is_some();
    let was_put_away = std::mem::take(&mut shift.machine.put_away);
    if plan.back || died {
        assert_eq!(end, UpdateState::RolledBack);
    } else if !was_put_away {
        assert_eq!(end, UpdateState::Committed);
    }
    shift.meet("set put away", u64::from(was_put_away));
    shift.meet(if end == UpdateState::Committed { "update committed" } else { "update rolled back" }, 1);
    let good = shift.machine.started.clone();
    let third = shift.release("1.3.0", false);
    let mut rig = shift.update(rig, &third, false, &[], 0);
    assert_eq!(shift.agree(&mut rig, &third, &good), UpdateState::Committed, "it takes the next release");
    shift.met
}

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok()?.parse().ok()
}

#[test]
fn whatever_happens_to_its_machine_a_robot_runs_whole_signed_sets_and_ledger_switch_and_report_agree() {
    let first = number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    let many = number("MIDSHIFT_SEEDS").unwrap_or(SEEDS);
    let next = AtomicU64::new(first);
    let play_on = || {
        let mut met = Met::new();
        loop {
            let seed = next.fetch_add(1, Relaxed);
            if seed >= first.saturating_add(many) {
                return met;
            }
            play(seed).into_iter().for_each(|(what, times)| *met.entry(what).or_default() += times);
        }
    };
    let mut met = Met::new();
    std::thread::scope(|scope| {
        let players: Vec<_> = (0..PLAYERS).map(|_| scope.spawn(play_on)).collect();
        for player in players {
            let theirs = player.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            theirs.into_iter().for_each(|(what, times)| *met.entry(what).or_default() += times);
        }
    });
    println!("{many} seeds from {first}: {met:?}");
    let never: Vec<_> = MET.into_iter().filter(|what| !met.contains_key(what)).collect();
    assert!(never.is_empty() || many < ENOUGH, "{many} seeds and never: {never:?}");
}

#[test]
fn a_set_with_another_byte_or_of_a_bundle_that_nobody_signed_is_found_at_its_start() {
    let (mut shift, rig) = Shift::begin();
    let bundle = shift.release("1.1.0", false);
    let _rig = shift.update(rig, &bundle, false, &[], 0);
    let set = shift.machine.started.clone();
    assert_eq!(shift.machine.judge(&set, &shift.bundles), Ok(()));
    let stranger = Releases::new().release("1.1.0");
    let found = shift.machine.judge(&set, &[stranger]).expect_err("nobody signed it");
    assert!(found.contains("nobody signed"), "{found}");
    let sets = DiskSets::open(&shift.machine.sets()).expect("opens").holdings().expect("tells").sets;
    let id: Digest = set.parse().expect("a set");
    let content = sets[&id].components["behaviour"].digest.to_string();
    fs::write(shift.machine.sets().join("content").join(content), "other settings").expect("writes");
    let found = shift.machine.judge(&set, &shift.bundles).expect_err("a byte is another");
    assert!(found.contains("is not whole"), "{found}");
}
