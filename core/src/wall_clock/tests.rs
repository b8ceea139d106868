//! A wall that is set, slewed and stepped, read beside a monotonic clock that is not.

use super::*;
use crate::time::LinkDuration;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering::Relaxed};

const HOUR_MS: u64 = 3_600_000;
const HOUR: i64 = HOUR_MS.cast_signed();
const BEGIN: i64 = 1_800_000_000_000;

/// A machine with both clocks, and what its clock told.
struct Machine {
    us: Arc<AtomicU64>,
    ahead_ms: Arc<AtomicI64>,
    told: Arc<Mutex<Vec<i64>>>,
    /// When the network set the wall last; 0: never.
    synced_ms: Arc<AtomicI64>,
    clock: Box<dyn Clock>,
}

impl Machine {
    fn new() -> Self {
        let (us, ahead_ms) = (Arc::<AtomicU64>::default(), Arc::new(AtomicI64::new(BEGIN)));
        let told = Arc::<Mutex<Vec<i64>>>::default();
        let (mono, beside, ahead, heard) = (us.clone(), us.clone(), ahead_ms.clone(), told.clone());
        let wall = move || Utc(ahead.load(Relaxed)).plus_ms(beside.load(Relaxed) / 1000);
        let hear = move |jump: &Jump| heard.lock().expect("not poisoned").push(jump.step_ms());
        let synced_ms = Arc::<AtomicI64>::default();
        let set = synced_ms.clone();
        let synced = move || Some(Utc(set.load(Relaxed))).filter(|at| at.0 > 0);
        let clock = Box::new(WallClock::new(move || mono.load(Relaxed), wall, hear).with_synced(synced));
        Self { us, ahead_ms, told, synced_ms, clock }
    }
    fn pass(&self, ms: u64) -> Now {
        self.us.fetch_add(ms * 1000, Relaxed);
        self.clock.now()
    }
    fn step(&self, ms: i64) -> Now {
        self.ahead_ms.fetch_add(ms, Relaxed);
        self.clock.now()
    }
    fn is_doubted(&self) -> bool {
        self.clock.doubt().is_some()
    }
    fn told(&self) -> Vec<i64> {
        self.told.lock().expect("not poisoned").clone()
    }
}

#[test]
fn the_wall_is_read_at_each_reading_and_the_link_clock_never_follows_it() {
    let machine = Machine::new();
    machine.pass(1_000);
    let now = machine.step(3_000);
    assert_eq!(
        (now.link, now.site, now.wall, now.utc),
        (LinkTime(1_000), SiteTime(1_000), Utc(BEGIN + 4_000), now.wall)
    );
    let now = machine.step(-2 * HOUR);
    assert_eq!((now.link, now.wall), (LinkTime(1_000), Utc(BEGIN + 4_000 - 2 * HOUR)));
}

#[test]
fn a_jump_is_told_once_and_what_the_kernel_slews_is_none() {
    let machine = Machine::new();
    for _ in 0..2_000 {
        machine.ahead_ms.fetch_add(50, Relaxed);
        machine.pass(100_000);
    }
    assert_eq!(machine.told(), Vec::<i64>::new(), "100 s in two days, 500 ppm");
    machine.step(5_000);
    assert_eq!(machine.told(), Vec::<i64>::new());
    machine.step(1);
    assert_eq!(machine.told(), [5_001], "two steps add up");
    machine.pass(1_000);
    machine.step(-6_000);
    assert_eq!(machine.told(), [5_001, -6_000]);
    assert_eq!(machine.clock.last_jump().map(|jump| jump.step_ms()), Some(-6_000));
    assert_eq!(machine.clock.now().jump, None, "neither is large");
}

#[test]
fn readings_close_together_hide_no_drift_and_no_step() {
    let machine = Machine::new();
    for _ in 0..20_000 {
        machine.pass(1);
    }
    assert_eq!(machine.told(), Vec::<i64>::new());
    for _ in 0..6 {
        machine.ahead_ms.fetch_add(1_000, Relaxed);
        machine.pass(1);
    }
    assert_eq!(machine.told(), [6_000]);
}

#[test]
fn a_large_jump_makes_no_duration_longer_and_a_small_one_is_followed() {
    let machine = Machine::new();
    let began = machine.pass(0).utc;
    machine.pass(60_000);
    let now = machine.step(HOUR);
    assert_eq!(now.ms_since(began), HOUR_MS + 60_000, "a correction of an hour is believed");
    let before = now.utc;
    let now = machine.step(10 * HOUR);
    assert_eq!((now.ms_since(began), now.ms_since(before)), (HOUR_MS + 60_000, 0));
    let after = now.utc;
    let now = machine.pass(5_000);
    assert_eq!((now.ms_since(before), now.ms_since(after), now.ms_since(now.utc.plus_ms(1))), (5_000, 5_000, 0));
    assert_eq!(now.steady_wall(), Utc(now.wall.0 - 10 * HOUR));
}

#[test]
fn a_jump_that_is_taken_back_leaves_nothing_and_a_second_one_is_no_way_around() {
    let machine = Machine::new();
    let began = machine.pass(0).utc;
    machine.step(10 * HOUR);
    machine.pass(60_000);
    let now = machine.step(10 * HOUR);
    assert_eq!(now.steady_wall(), Utc(BEGIN + 60_000));
    assert_eq!(now.ms_since(began), 0, "what lies between counts for nothing, which only makes it wait longer");
    let now = machine.step(-20 * HOUR);
    assert_eq!((now.steady_wall(), now.wall), (Utc(BEGIN + 60_000), Utc(BEGIN + 60_000)));
}

#[test]
fn what_stands_is_judged_without_a_large_jump_for_ten_minutes() {
    let machine = Machine::new();
    let jumped = machine.step(2 * HOUR);
    assert_eq!(jumped.standing_wall(), Utc(BEGIN));
    let LinkDuration(standing) = limits::CLOCK_JUMP_STANDING;
    assert_eq!(machine.pass(standing - 1).standing_wall(), Utc(BEGIN).plus_ms(standing - 1));
    let over = machine.pass(1);
    assert_eq!(over.standing_wall(), over.wall);
    let back = machine.step(-HOUR - 1);
    assert_eq!(back.standing_wall(), Utc(back.wall.0 - HOUR + 1), "half of it was taken back");
}

#[test]
fn a_wall_that_stepped_more_than_five_minutes_is_in_doubt_until_it_is_set_back() {
    let machine = Machine::new();
    machine.step(5 * 60_000);
    assert!(!machine.is_doubted());
    machine.ahead_ms.fetch_add(6_000, Relaxed);
    assert_eq!(machine.clock.doubt(), Some(Doubt { step_ms: 306_000, at: Utc(BEGIN + 306_000) }), "steps add up");
    machine.step(30 * 24 * HOUR);
    machine.pass(60_000);
    assert!(machine.is_doubted());
    machine.step(-30 * 24 * HOUR);
    assert!(machine.is_doubted(), "what it stepped before is not taken back");
    machine.step(-306_000);
    assert!(!machine.is_doubted());
    machine.step(-HOUR);
    assert_eq!(machine.clock.doubt().map(|doubt| doubt.step_ms), Some(-HOUR));
}

#[test]
fn a_time_to_sign_by_and_that_nobody_doubts_it_come_of_one_reading() {
    let machine = Machine::new();
    let doubt = Doubt { step_ms: HOUR, at: Utc(BEGIN + HOUR) };
    machine.ahead_ms.fetch_add(HOUR, Relaxed);
    assert_eq!(machine.clock.undoubted(), Err(doubt), "though nobody has read the step before");
    assert_eq!(machine.told(), [HOUR]);
    machine.ahead_ms.fetch_sub(HOUR, Relaxed);
    assert_eq!(machine.clock.undoubted().map(|now| now.wall), Ok(Utc(BEGIN)));
}

#[test]
fn a_doubt_is_over_once_the_network_sets_the_wall_or_a_person_accepts_it() {
    let machine = Machine::new();
    machine.synced_ms.store(BEGIN - 1_000, Relaxed);
    machine.step(HOUR);
    assert!(machine.is_doubted(), "it was set before that step");
    machine.synced_ms.store(BEGIN + HOUR + 1_000, Relaxed);
    assert!(!machine.is_doubted());
    machine.step(HOUR);
    assert!(machine.is_doubted());
    machine.clock.accept_wall();
    assert!(!machine.is_doubted());
    machine.step(HOUR);
    assert!(machine.is_doubted(), "a word counts for what was before it");
}

#[test]
fn a_start_far_past_what_was_written_down_is_in_doubt_unless_the_network_set_the_wall() {
    let newest = Utc(BEGIN - 30 * 24 * HOUR);
    let begins = |synced_ms: i64, newest: Utc| {
        let machine = Machine::new();
        machine.synced_ms.store(synced_ms, Relaxed);
        machine.clock.check_start(newest);
        machine
    };
    assert!(!begins(0, Utc(BEGIN - 7 * 24 * HOUR)).is_doubted(), "a week of holidays");
    assert!(!begins(BEGIN - 1_000, newest).is_doubted(), "the network says so");
    assert!(!begins(0, Utc(BEGIN + HOUR)).is_doubted(), "behind what was written down");
    let machine = begins(0, newest);
    assert!(machine.is_doubted());
    machine.step(-29 * 24 * HOUR);
    assert!(!machine.is_doubted(), "as one that starts so");
    let machine = begins(0, newest);
    machine.synced_ms.store(BEGIN, Relaxed);
    assert!(!machine.is_doubted());
}
