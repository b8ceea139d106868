//! Reads the wall clock beside the monotonic one, tells its jumps, and says what may not follow from one.
//!
//! Invariants:
//! 1. Drift that the kernel slews is no jump; steps add up until they are one ([`limits::CLOCK_JUMP`]).
//! 2. After a large jump ([`limits::CLOCK_JUMP_LARGE`]) no duration is over, and no update window open, because of it
//!    ([`Now::ms_since`], [`Jump::opened`]). What is over at a moment of the wall (tokens, resets, tasks' own times) follows at once.
//! 3. Several large jumps of one run count as one, from before the first to after the last: what follows is stricter than either.
//! 4. A wall that stepped by more than [`limits::CLOCK_DOUBT`], or began more than [`limits::CLOCK_DOUBT_START`] past what was written down, is in doubt until
//!    it is set back, the network sets it, or a person accepts it ([`Clock::doubt`]).

use crate::limits;
use crate::time::{Clock, Doubt, Jump, LinkTime, Now, SiteTime, Utc};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The file of a data folder by which a person says that the wall clock of the machine is right.
pub const ACCEPTED: &str = "clock-accepted";

impl Jump {
    /// Milliseconds that the wall stepped ahead; negative: back.
    pub const fn step_ms(&self) -> i64 {
        self.to.0 - self.from.0
    }

    /// Whether it is larger than what a correction of a running clock is.
    pub const fn is_large(&self) -> bool {
        self.step_ms().unsigned_abs() > limits::CLOCK_JUMP_LARGE.as_ms()
    }

    /// Whether a stretch of time that began at `began` is one into which the wall jumped: it had begun when the wall arrived, and before the jump it
    /// had not. `began_before` is the begin of the stretch in which [`Jump::from`] lies; none: it lies in none.
    pub fn opened(&self, began: Utc, began_before: Option<Utc>) -> bool {
        began <= self.to && began_before != Some(began)
    }

    /// Both as one, `earlier` before `self`.
    fn after(self, earlier: Option<Self>) -> Self {
        let Some(earlier) = earlier else { return self };
        let skipped = earlier.skipped_ms.saturating_add_signed(self.step_ms());
        Self { from: earlier.from, skipped_ms: skipped, ..self }
    }
}

impl Now {
    /// Milliseconds of UTC from `earlier` until now, without what a large jump of the wall skipped between them; zero if `earlier` is later.
    pub fn ms_since(&self, earlier: Utc) -> u64 {
        let all = self.utc.ms_since(earlier);
        let skipped = self.jump.map_or(0, |jump| jump.to.ms_since(jump.from.max(earlier)));
        all.saturating_sub(skipped)
    }

    /// UTC of the wall as if it had made no large jump ahead: by this what is old goes.
    pub fn steady_wall(&self) -> Utc {
        self.steady(self.wall)
    }

    /// UTC on the site clock, likewise.
    pub fn steady_utc(&self) -> Utc {
        self.steady(self.utc)
    }

    fn steady(&self, at: Utc) -> Utc {
        Utc(at.0.saturating_sub_unsigned(self.jump.map_or(0, |jump| jump.skipped_ms)))
    }

    /// The moment at which what stands already is judged: the wall, and for [`limits::CLOCK_JUMP_STANDING`] after a large jump the wall without it.
    pub fn standing_wall(&self) -> Utc {
        let is_fresh = |jump: &Jump| self.link.since(jump.at) < limits::CLOCK_JUMP_STANDING;
        if self.jump.as_ref().is_some_and(is_fresh) { self.steady_wall() } else { self.wall }
    }
}

/// Tells jumps of the wall from readings of both clocks.
#[derive(Clone, Copy, Debug, Default)]
struct Judge {
    /// Microseconds of the monotonic clock and milliseconds of the wall ahead of it, of the reading before.
    before: Option<(u64, i64)>,
    /// The newest jump.
    last: Option<Jump>,
    /// Large jumps as one.
    large: Option<Jump>,
}

impl Judge {
    /// One more reading; the jump that it shows.
    fn read(&mut self, mono_us: u64, wall: Utc) -> Option<Jump> {
        let mono_ms = (mono_us / 1000).cast_signed();
        let ahead = wall.0.saturating_sub(mono_ms);
        let (before_us, expected) = *self.before.get_or_insert((mono_us, ahead));
        let step = ahead.saturating_sub(expected);
        if step.unsigned_abs() <= limits::CLOCK_JUMP.as_ms() {
            // No kernel slews faster than a thousandth; of what is more the rest is kept, so that small steps add up.
            let slewed_us = (mono_us - before_us) / limits::CLOCK_SLEW_PART;
            let slewed = i64::try_from(slewed_us / 1000).unwrap_or(i64::MAX);
            if slewed > 0 {
                self.before = Some((mono_us, expected.saturating_add(step.clamp(-slewed, slewed))));
            }
            return None;
        }
        self.before = Some((mono_us, ahead));
        let skipped_ms = step.max(0).unsigned_abs();
        let jump = Jump { from: Utc(wall.0.saturating_sub(step)), to: wall, at: LinkTime(mono_us / 1000), skipped_ms };
        self.last = Some(jump);
        if jump.is_large() {
            self.large = Some(jump.after(self.large));
        }
        Some(jump)
    }
}

/// What the wall stepped since it was last known to be right.
#[derive(Clone, Copy, Debug, Default)]
struct Steps {
    /// Milliseconds, as one.
    off_ms: i64,
    doubted: Option<DoubtedWall>,
}

/// A wall in doubt.
#[derive(Clone, Copy, Debug)]
struct DoubtedWall {
    doubt: Doubt,
    /// It is over when the wall is no further off than this, milliseconds.
    most_ms: u64,
    /// When the network had set the wall last at that time.
    synced: Option<Utc>,
}

impl Steps {
    /// The wall is `step_ms` further ahead than it should be.
    fn add(&mut self, step_ms: i64, most_ms: u64, at: Utc, synced: impl FnOnce() -> Option<Utc>) {
        self.off_ms = self.off_ms.saturating_add(step_ms);
        let most_ms = self.doubted.map_or(most_ms, |doubted| doubted.most_ms);
        if self.off_ms.unsigned_abs() > most_ms {
            let doubt = Doubt { step_ms: self.off_ms, at };
            let synced = self.doubted.map_or_else(synced, |doubted| doubted.synced);
            self.doubted = Some(DoubtedWall { doubt, most_ms, synced });
        } else if self.doubted.is_some() {
            *self = Self::default();
        }
    }

    /// Why the wall is in doubt; over if the network has set it since.
    fn doubt(&mut self, synced: impl FnOnce() -> Option<Utc>) -> Option<Doubt> {
        let doubted = self.doubted?;
        if synced().is_some_and(|at| doubted.synced != Some(at)) {
            *self = Self::default();
            return None;
        }
        Some(doubted.doubt)
    }
}

/// What was read so far.
#[derive(Clone, Copy, Debug, Default)]
struct State {
    mono_us: u64,
    judge: Judge,
    steps: Steps,
}

/// When the network set the wall last, by the wall; none: not since the machine started.
type Synced = Box<dyn Fn() -> Option<Utc> + Send + Sync>;

/// Clocks at real rate: the link clock from a monotonic source, and UTC from the wall at each reading.
pub struct WallClock<M, W, T> {
    monotonic_us: M,
    wall: W,
    told: T,
    synced: Synced,
    state: Mutex<State>,
}

impl<M, W, T> WallClock<M, W, T>
where
    M: Fn() -> u64 + Send + Sync + 'static,
    W: Fn() -> Utc + Send + Sync + 'static,
    T: Fn(&Jump) + Send + Sync + 'static,
{
    /// `monotonic_us` counts microseconds from an arbitrary start; `wall` is the machine's UTC; `told` hears each jump once.
    pub fn new(monotonic_us: M, wall: W, told: T) -> Self {
        let clock = Self { monotonic_us, wall, told, synced: Box::new(|| None), state: Mutex::default() };
        // What a jump is measured against.
        clock.now();
        clock
    }

    /// `synced` says when the network set the wall last, by the wall; none: not since the machine started, or nobody knows.
    #[must_use]
    pub fn with_synced(self, synced: impl Fn() -> Option<Utc> + Send + Sync + 'static) -> Self {
        Self { synced: Box::new(synced), ..self }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads both clocks, and gives what `of` makes of that before anybody reads them again.
    fn reading<R>(&self, of: impl FnOnce(Now, &mut Steps) -> R) -> R {
        let (made, jump) = {
            let mut state = self.state();
            let mono_us = (self.monotonic_us)().max(state.mono_us);
            let wall = (self.wall)();
            let jump = state.judge.read(mono_us, wall);
            if let Some(jump) = &jump {
                state.steps.add(jump.step_ms(), limits::CLOCK_DOUBT.as_ms(), wall, &self.synced);
            }
            state.mono_us = mono_us;
            let ms = mono_us / 1000;
            let now = Now { site: SiteTime(ms), link: LinkTime(ms), utc: wall, wall, jump: state.judge.large };
            (of(now, &mut state.steps), jump)
        };
        if let Some(jump) = jump {
            (self.told)(&jump);
        }
        made
    }
}

impl<M, W, T> Clock for WallClock<M, W, T>
where
    M: Fn() -> u64 + Send + Sync + 'static,
    W: Fn() -> Utc + Send + Sync + 'static,
    T: Fn(&Jump) + Send + Sync + 'static,
{
    fn now(&self) -> Now {
        self.reading(|now, _| now)
    }

    fn rate_permille(&self) -> u32 {
        1000
    }

    fn last_jump(&self) -> Option<Jump> {
        self.state().judge.last
    }

    fn doubt(&self) -> Option<Doubt> {
        // A step that nobody has read yet counts too.
        self.undoubted().err()
    }

    fn undoubted(&self) -> Result<Now, Doubt> {
        self.reading(|now, steps| steps.doubt(&self.synced).map_or(Ok(now), Err))
    }

    fn check_start(&self, newest: Utc) {
        let (wall, most_ms) = (self.now().wall, limits::CLOCK_DOUBT_START.as_ms());
        let ahead_ms = wall.ms_since(newest);
        if ahead_ms > most_ms && (self.synced)().is_none() {
            let ahead_ms = i64::try_from(ahead_ms).unwrap_or(i64::MAX);
            self.state().steps.add(ahead_ms, most_ms, wall, || None);
        }
    }

    fn accept_wall(&self) {
        self.state().steps = Steps::default();
    }
}

#[cfg(test)]
mod tests;
