//! Closed-form motion: where a body is on one leg of its path follows from where and when it set out.
//!
//! Invariant: nothing here is integrated over ticks, so a leg looks the same however often it is asked.
//! Called by [`crate::body`].

use midshift_core::time::{SiteDuration, SiteTime};
use nalgebra::{Isometry2, Rotation2, Translation2, UnitComplex, Vector2};

/// How fast a body turns on the spot, radians per second.
pub const TURN_RAD_S: f64 = 2.0;
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
        Self { from, turn, start, turn_ms, drive_ms, length_mm, speed_mm_s }
    }
    /// When it arrives.
    pub fn end(&self) -> SiteTime {
        self.start + SiteDuration(self.turn_ms + self.drive_ms)
    }
    /// Millimetres of the whole leg.
    pub fn length_mm(&self) -> f64 {
        self.length_mm
    }
    /// Millimetres driven at `now`, 0 before and the whole length after.
    pub fn driven_mm(&self, now: SiteTime) -> f64 {
        let driving_ms = now.since(self.start).as_ms().saturating_sub(self.turn_ms);
        if driving_ms >= self.drive_ms {
            return self.length_mm;
        }
        self.length_mm * driving_ms as f64 / self.drive_ms as f64
    }
    /// The first whole millisecond at which `mm` are driven.
    pub fn when_driven(&self, mm: f64) -> SiteTime {
        let share = if self.length_mm > 0.0 { (mm / self.length_mm).clamp(0.0, 1.0) } else { 1.0 };
        let drive_ms = (share * self.drive_ms as f64).ceil() as u64;
        self.start + SiteDuration(self.turn_ms + drive_ms.min(self.drive_ms))
    }
    /// Millimetres per second at `now`: none while it turns and after its end.
    pub fn speed_mm_s(&self, now: SiteTime) -> u32 {
        let gone_ms = now.since(self.start).as_ms();
        let drives = gone_ms >= self.turn_ms && gone_ms < self.turn_ms + self.drive_ms;
        if drives { self.speed_mm_s } else { 0 }
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
}
