//! The governor: how fast the body may drive at each point, and which distance it keeps. The lowest of all layers wins,
//! whatever came last.
//!
//! Invariant: a pure function of the newest values of each layer; no order of messages can raise a limit. Called by the
//! core for every path, and again when a policy changes.

use crate::body::BodyLimits;
use midshift_core::desired_state::{AreaRules, RoutePoint};
use midshift_core::ids::AreaId;
use midshift_core::limits;
use midshift_core::robot::StopLevel;

/// Speed on the way to `point`, millimetres per second: the lowest of maker, area, lane, task and stop, but never below
/// the floor of the body, which must be able to clear a lane.
pub fn speed_mm_s(
    body: &BodyLimits,
    areas: &[AreaRules],
    task_mm_s: Option<u32>,
    stop: StopLevel,
    point: &RoutePoint,
) -> u32 {
    let area = policy_of(areas, &point.area_id).and_then(|p| p.speed_limit_mm_s);
    let stop = (stop > StopLevel::None).then_some(limits::STOP_SLOW_MM_S);
    let layers = [area, point.speed_limit_mm_s, task_mm_s, stop];
    let lowest = layers.into_iter().flatten().fold(body.speed_mm_s, u32::min);
    lowest.max(body.floor_speed_mm_s.min(body.speed_mm_s))
}

/// The fastest that a stop or a silence of level SLOW lets it go anywhere, millimetres per second.
pub fn slowed_mm_s(body: &BodyLimits) -> u32 {
    limits::STOP_SLOW_MM_S.min(body.speed_mm_s).max(body.floor_speed_mm_s.min(body.speed_mm_s))
}

/// Distance to keep on the way to `point`, millimetres, as its area asks for; none: the body's own.
pub fn keep_off_mm(areas: &[AreaRules], point: &RoutePoint) -> Option<u32> {
    policy_of(areas, &point.area_id).and_then(|p| p.avoidance_distance_mm)
}

/// The rules of one area, if any were pushed.
pub fn policy_of<'a>(areas: &'a [AreaRules], area_id: &AreaId) -> Option<&'a AreaRules> {
    areas.iter().find(|p| p.area_id == *area_id)
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::WaypointId;
    use midshift_core::policy::AreaPolicy;

    #[test]
    fn the_lowest_layer_wins_and_the_floor_stands() {
        let body = BodyLimits { speed_mm_s: 1_500, floor_speed_mm_s: 100, battery_critical_permille: 50 };
        let area_id = AreaId::parse("people").expect("a name");
        let point = RoutePoint {
            waypoint: WaypointId::parse("A").expect("a name"),
            x_mm: 0,
            y_mm: 0,
            ends_step: None,
            standing: None,
            passages: Vec::new(),
            speed_limit_mm_s: Some(1_000),
            area_id: area_id.clone(),
        };
        assert_eq!(speed_mm_s(&body, &[], None, StopLevel::None, &point), 1_000);
        assert_eq!(speed_mm_s(&body, &[], Some(700), StopLevel::None, &point), 700);
        for stop in [StopLevel::Slow, StopLevel::Halt] {
            assert_eq!(speed_mm_s(&body, &[], Some(700), stop, &point), 300);
            assert_eq!(slowed_mm_s(&body), 300);
            let strong = BodyLimits { floor_speed_mm_s: 400, ..body };
            assert_eq!((speed_mm_s(&strong, &[], None, stop, &point), slowed_mm_s(&strong)), (400, 400));
        }
        let slow = |v| [AreaRules { speed_limit_mm_s: Some(v), ..AreaPolicy::default_of(area_id.clone()).into() }];
        assert_eq!(speed_mm_s(&body, &slow(300), Some(700), StopLevel::None, &point), 300);
        assert_eq!(speed_mm_s(&body, &slow(200), None, StopLevel::Slow, &point), 200);
        assert_eq!(speed_mm_s(&body, &slow(60), None, StopLevel::None, &point), 100);
        assert_eq!(
            speed_mm_s(&body, &slow(5_000), None, StopLevel::None, &RoutePoint { speed_limit_mm_s: None, ..point }),
            1_500
        );
    }
}
