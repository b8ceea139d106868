//! How precise a position is kept: as it came for a day, then as a square of the map. Distances and spans are sums that the robot has made before.
//!
//! Invariant: made coarser twice, samples are as made coarser once; nothing but positions changes. Called by the server's upkeep for what is stored, and by
//! `status` for what comes late.

use midshift_core::privacy;
use midshift_core::robot::Pose;
use midshift_core::time::Utc;
use midshift_proto::common::v1 as common;
use midshift_proto::link::v1;
use prost::Message;

/// The samples of one stored frame without their precision; none: they cannot be read.
pub fn coarsen(frame: &[u8]) -> Option<Vec<u8>> {
    let mut batch = v1::LaneBatch::decode(frame).ok()?;
    batch.samples.iter_mut().for_each(coarsen_sample);
    Some(batch.encode_to_vec())
}

/// Samples that a robot took a day ago or earlier and brings only now come in as they would be kept by now. A sample without a stamp is as old as its receipt.
pub fn coarsen_late(batch: &mut v1::LaneBatch, now: Utc) {
    let is_late = |sample: &&mut v1::Sample| {
        sample.robot_unix_ms > 0 && now.ms_since(Utc(sample.robot_unix_ms)) >= privacy::PRECISE_MS
    };
    batch.samples.iter_mut().filter(is_late).for_each(coarsen_sample);
}

fn coarsen_sample(sample: &mut v1::Sample) {
    let Some(v1::sample::Body::Status(vitals)) = &mut sample.body else { return };
    if let Some(common::Pose { x_mm, y_mm, theta_mrad }) = vitals.pose {
        let kept = privacy::coarse(Pose { x_mm, y_mm, theta_mrad });
        vitals.pose = Some(common::Pose { x_mm: kept.x_mm, y_mm: kept.y_mm, theta_mrad: kept.theta_mrad });
    }
    // Waypoints may stand a metre apart: the name of one is a position too.
    vitals.waypoint.clear();
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY_MS: i64 = 86_400_000;

    fn sample(seq: u64, robot_unix_ms: i64) -> v1::Sample {
        let pose = Some(common::Pose { x_mm: 12_345, y_mm: -1, theta_mrad: 1_571 });
        let vitals = v1::Vitals {
            pose,
            waypoint: "A01".into(),
            battery_permille: 812,
            odometer_mm: 99_001,
            ..Default::default()
        };
        v1::Sample { seq, robot_unix_ms, body: Some(v1::sample::Body::Status(vitals)) }
    }
    fn vitals(sample: &v1::Sample) -> &v1::Vitals {
        match &sample.body {
            Some(v1::sample::Body::Status(vitals)) => vitals,
            other => panic!("{other:?}"),
        }
    }
    fn batch(samples: Vec<v1::Sample>) -> v1::LaneBatch {
        v1::LaneBatch { lane: v1::Lane::Status.into(), samples, gaps: Vec::new() }
    }

    #[test]
    fn a_stored_sample_keeps_its_square_and_what_was_driven_and_nothing_more_of_where_it_was() {
        let stored = batch(vec![sample(1, 0), sample(2, 5)]).encode_to_vec();
        let once = coarsen(&stored).expect("read");
        let read = v1::LaneBatch::decode(once.as_slice()).expect("a batch");
        for (kept, seq) in read.samples.iter().zip(1..) {
            let kept = (kept.seq, vitals(kept));
            let square = Some(common::Pose { x_mm: 12_500, y_mm: -2_500, theta_mrad: 0 });
            let wanted = v1::Vitals { pose: square, battery_permille: 812, odometer_mm: 99_001, ..Default::default() };
            assert_eq!(kept, (seq, &wanted));
        }
        assert_eq!(coarsen(&once).as_ref(), Some(&once), "made coarser again it is the same");
        assert_eq!(coarsen(&[255, 255]), None);
    }

    #[test]
    fn the_rule_is_that_of_core() {
        let (stored, kept) = (sample(1, 0), coarsen(&batch(vec![sample(1, 0)]).encode_to_vec()).expect("read"));
        let read = |vitals: &v1::Vitals| {
            midshift_proto::parse::<midshift_core::robot::Vitals, _>(vitals.clone()).expect("vitals")
        };
        let kept = v1::LaneBatch::decode(kept.as_slice()).expect("a batch");
        assert_eq!(read(vitals(&kept.samples[0])), privacy::coarse_vitals(read(vitals(&stored))));
    }

    #[test]
    fn a_sample_that_comes_a_day_late_comes_in_coarse_and_others_as_they_are() {
        let now = Utc(1_800_000_000_000);
        let at = [now.0 - DAY_MS, now.0 - DAY_MS + 1, 0, now.0 + 1];
        let mut late = batch(at.into_iter().zip(1..).map(|(at, seq)| sample(seq, at)).collect());
        coarsen_late(&mut late, now);
        let precise: Vec<bool> = late.samples.iter().map(|s| vitals(s) == vitals(&sample(1, 0))).collect();
        assert_eq!(precise, [false, true, true, true]);
    }
}
