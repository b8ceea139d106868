//! Closed-form motion: where a body is on one leg of its path follows from where and when it set out, and from when it
//! was told to brake.
//!
//! Invariant: nothing here is integrated over ticks, so a leg looks the same however often it is asked.
//! Called by [`crate::body`].

use midshift_core::time::{SiteDuration, SiteTime};
use nalgebra::{Isometry2, Rotation2, Translation2, UnitComplex, Vector2};

/// How fast a body turns on the spot, radians per second.
pub const TURN_RAD_S: f64 = 2.0;
/// How a body brakes that is told to stand, millimetres per second squared: from 1.5 m/s it stands after a second and
/// 750 mm.
pub const BRAKES_MM_S2: f64 = 1_500.0;
/// The same, millimetres per millisecond squared.
const BRAKES_MM_MS2: f64 = BRAKES_MM_S2 / 1e6;
/// A smaller change of heading is driven through, radians.
const TURN_IGNORED_RAD: f64 = 0.02;

/// One straight leg with the turn on the spot before it. Metres and radians inside, millimetres at the border.
#[derive(Clone, Debug, PartialEq)]
pub struct Leg {
    from: Isometry2<f64>,
    turn: f64,
    start: SiteTime,
    turn_ms: u64,
    drive_ms: u64,
    length_mm: f64,
    speed_mm_s: u32,
    /// Milliseconds that it had driven when it was told to brake.
    brakes_ms: Option<u64>,
}

impl Leg {
    /// From a frame to a point at a speed of at least 1 mm/s, setting out at `start`.
    pub fn new(from: Isometry2<f64>, to_mm: (i32, i32), speed_mm_s: u32, start: SiteTime) -> Self {
        let to = Vector2::new(f64::from(to_mm.0), f64::from(to_mm.1)) / 1000.0;
        let way = to - from.translation.vector;
        let length_mm = way.norm() * 1000.0;
        let speed_mm_s = speed_mm_s.max(1);
        let heading = if length_mm < 0.5 { from.rotation } else { UnitComplex::new(way.y.atan2(way.x)) };
        let turn = from.rotation.angle_to(&heading);
        let turn_ms = if turn.abs() < TURN_IGNORED_RAD { 0 } else { (turn.abs() / TURN_RAD_S * 1000.0).ceil() as u64 };
        let drive_ms = (length_mm * 1000.0 / f64::from(speed_mm_s)).ceil() as u64;
        Self { from, turn, start, turn_ms, drive_ms, length_mm, speed_mm_s, brakes_ms: None }
    }
    /// The same leg of a body that faces its way in no time.
    #[must_use]
    pub fn without_turn(self) -> Self {
        Self { turn_ms: 0, ..self }
    }
    /// From now on it brakes, if it did not before. One that only turns has nothing to brake.
    pub fn brake(&mut self, now: SiteTime) {
        self.brakes_ms = self.brakes_ms.or(Some(self.driving_ms(now)));
    }
    /// It was told to brake: its end is where it stands, short of the end of its way or there.
    pub fn is_braking(&self) -> bool {
        self.brakes_ms.is_some()
    }
    /// When it arrives, or stands because it brakes.
    pub fn end(&self) -> SiteTime {
        let stands_ms = self.brakes_ms.map_or(self.drive_ms, |from| from + self.ramp_ms().ceil() as u64);
        self.when_driven(self.length_mm).unwrap_or(self.start + SiteDuration(self.turn_ms + stands_ms))
    }
    /// Millimetres of the whole leg.
    pub fn length_mm(&self) -> f64 {
        self.length_mm
    }
    /// Millimetres driven at `now`, 0 before. It goes no further than the whole length, also where it is still braking
    /// there: the way beyond may not be its own.
    pub fn driven_mm(&self, now: SiteTime) -> f64 {
        let driving_ms = self.driving_ms(now);
        let Some(from_ms) = self.brakes_ms.filter(|from| *from < driving_ms) else {
            return self.cruised_mm(driving_ms);
        };
        let ramp_ms = ((driving_ms - from_ms) as f64).min(self.ramp_ms());
        let ramp_mm = ramp_ms * (self.cruise_mm_ms() - BRAKES_MM_MS2 * ramp_ms / 2.0);
        (self.cruised_mm(from_ms) + ramp_mm).min(self.length_mm)
    }
    /// The first whole millisecond at which `mm` are driven. None: it brakes and stands before.
    pub fn when_driven(&self, mm: f64) -> Option<SiteTime> {
        let share = if self.length_mm > 0.0 { (mm / self.length_mm).clamp(0.0, 1.0) } else { 1.0 };
        let drive_ms = ((share * self.drive_ms as f64).ceil() as u64).min(self.drive_ms);
        let drive_ms = match self.brakes_ms.filter(|from| *from < drive_ms) {
            None => drive_ms,
            Some(from_ms) => {
                let cruise = self.cruise_mm_ms();
                let rest = cruise * cruise - 2.0 * BRAKES_MM_MS2 * (mm - self.cruised_mm(from_ms));
                from_ms + ((cruise - (rest >= 0.0).then(|| rest.sqrt())?) / BRAKES_MM_MS2).ceil() as u64
            }
        };
        Some(self.start + SiteDuration(self.turn_ms + drive_ms))
    }
    /// Millimetres per second at `now`: none while it turns and after its end.
    pub fn speed_mm_s(&self, now: SiteTime) -> u32 {
        let drives = now.since(self.start).as_ms() >= self.turn_ms && now < self.end();
        let ramp_ms = self.driving_ms(now).saturating_sub(self.brakes_ms.unwrap_or(u64::MAX));
        let lost_mm_s = (ramp_ms as f64 * BRAKES_MM_MS2 * 1000.0).round() as u32;
        if drives { self.speed_mm_s.saturating_sub(lost_mm_s) } else { 0 }
    }
    fn driving_ms(&self, now: SiteTime) -> u64 {
        now.since(self.start).as_ms().saturating_sub(self.turn_ms)
    }
    /// Millimetres driven after so long without braking.
    fn cruised_mm(&self, driving_ms: u64) -> f64 {
        if driving_ms >= self.drive_ms {
            return self.length_mm;
        }
        self.length_mm * driving_ms as f64 / self.drive_ms as f64
    }
    fn cruise_mm_ms(&self) -> f64 {
        if self.drive_ms == 0 { 0.0 } else { self.length_mm / self.drive_ms as f64 }
    }
    /// Milliseconds from its speed to standing.
    fn ramp_ms(&self) -> f64 {
        self.cruise_mm_ms() / BRAKES_MM_MS2
    }
    /// Where the body is and how it is turned.
    pub fn frame(&self, now: SiteTime) -> Isometry2<f64> {
        let gone_ms = now.since(self.start).as_ms();
        let share = if self.turn_ms == 0 { 1.0 } else { (gone_ms as f64 / self.turn_ms as f64).min(1.0) };
        let rotation = self.from.rotation * UnitComplex::from_rotation_matrix(&Rotation2::new(self.turn * share));
        let heading = self.from.rotation * UnitComplex::new(self.turn);
        let gone = heading * Vector2::new(self.driven_mm(now) / 1000.0, 0.0);
        Isometry2::from_parts(Translation2::from(self.from.translation.vector + gone), rotation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halfway_in_time_is_halfway_on_the_way_and_the_turn_comes_first() {
        let leg = Leg::new(Isometry2::new(Vector2::new(1.0, 1.0), 0.0), (1_000, 5_000), 1_000, SiteTime(500));
        let turn_ms = (std::f64::consts::FRAC_PI_2 / TURN_RAD_S * 1000.0).ceil() as u64;
        assert_eq!(leg.end(), SiteTime(500 + turn_ms + 4_000));
        assert_eq!(leg.driven_mm(SiteTime(500 + turn_ms)), 0.0);
        let half = leg.frame(SiteTime(500 + turn_ms + 2_000));
        assert!((half.translation.y - 3.0).abs() < 1e-9 && (half.translation.x - 1.0).abs() < 1e-9);
        assert!((half.rotation.angle() - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
    }

    #[test]
    fn a_leg_of_no_length_ends_as_it_begins() {
        let leg = Leg::new(Isometry2::new(Vector2::new(1.0, 1.0), 0.3), (1_000, 1_000), 900, SiteTime(7));
        assert_eq!((leg.end(), leg.driven_mm(SiteTime(7))), (SiteTime(7), leg.length_mm()));
    }

    /// Six metres straight ahead.
    fn ahead(speed_mm_s: u32) -> Leg {
        Leg::new(Isometry2::identity(), (6_000, 0), speed_mm_s, SiteTime(500))
    }

    #[test]
    fn a_body_that_brakes_stands_after_its_speed_over_the_deceleration() {
        for (speed_mm_s, ramp_ms, ramp_mm) in [(1_500, 1_000, 750.0), (1_000, 667, 1_000.0 / 3.0), (300, 200, 30.0)] {
            let mut leg = ahead(speed_mm_s);
            let told = SiteTime(2_500);
            leg.brake(told);
            let told_mm = leg.driven_mm(told);
            leg.brake(told + SiteDuration(50));
            assert_eq!(leg.end(), told + SiteDuration(ramp_ms), "{speed_mm_s} mm/s: told once or twice");
            let stands_mm = leg.driven_mm(leg.end());
            assert!((stands_mm - told_mm - ramp_mm).abs() < 1e-6, "{speed_mm_s} mm/s: {stands_mm} mm");
            assert_eq!(leg.driven_mm(leg.end() + SiteDuration(9_000)), stands_mm);
            assert_eq!((leg.speed_mm_s(told), leg.speed_mm_s(leg.end())), (speed_mm_s, 0));
            assert_eq!((leg.when_driven(stands_mm + 1.0), leg.when_driven(told_mm - 10.0) < Some(told)), (None, true));
        }
        let mut leg = ahead(1_500);
        leg.brake(SiteTime(2_500));
        assert_eq!((leg.speed_mm_s(SiteTime(3_000)), leg.driven_mm(SiteTime(3_000))), (750, 3_562.5));
        assert_eq!(leg.when_driven(3_562.5), Some(SiteTime(3_000)));
    }

    #[test]
    fn a_body_that_brakes_goes_no_further_than_the_end_of_its_leg() {
        let mut leg = ahead(1_500);
        leg.brake(SiteTime(500 + 3_900));
        assert!(leg.end() > SiteTime(500 + 4_000) && leg.end() < SiteTime(500 + 4_020), "{:?}", leg.end());
        assert_eq!((leg.driven_mm(leg.end()), leg.speed_mm_s(leg.end())), (6_000.0, 0));
    }
}
