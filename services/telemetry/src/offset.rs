//! Estimates a robot's clock against ours from four timestamps: the sample with the smallest delay of the last eight wins.
//!
//! Only shown, and used to flag stamps from the future; nothing is ordered by it.

use midshift_core::heartbeat::ClockOffset;
use midshift_proto::session::ClockSample;
use std::collections::VecDeque;

/// Samples remembered.
const SAMPLES: usize = 8;

/// The newest samples of one session.
#[derive(Debug, Default)]
pub struct Offset {
    samples: VecDeque<ClockSample>,
}

impl Offset {
    /// Takes a complete sample; one that says that time ran backwards on the wire is passed over.
    pub fn add(&mut self, sample: ClockSample) {
        if sample.delay_us() < 0 || sample.t4_us == 0 {
            return;
        }
        if self.samples.len() == SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
    }
    /// Robot clock minus server clock, and the bound of its error. None: there is no sample.
    pub fn estimate(&self) -> Option<ClockOffset> {
        let best = self.samples.iter().min_by_key(|s| s.delay_us())?;
        Some(ClockOffset {
            clock_offset_ms: best.offset_us() / 1000,
            clock_error_ms: best.delay_us().unsigned_abs() / 2000 + 1,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quickest_exchange_is_believed() {
        let mut offset = Offset::default();
        offset.add(ClockSample { t1_us: 0, t2_us: 900_000, t3_us: 900_000, t4_us: 1_000_000 });
        offset.add(ClockSample { t1_us: 5_000_000, t2_us: 4_801_000, t3_us: 4_801_000, t4_us: 5_002_000 });
        assert_eq!(offset.estimate(), Some(ClockOffset { clock_offset_ms: 200, clock_error_ms: 2 }));
        for _ in 0..SAMPLES {
            offset.add(ClockSample { t1_us: 0, t2_us: 10_000, t3_us: 10_000, t4_us: 20_000 });
        }
        assert_eq!(offset.estimate(), Some(ClockOffset { clock_offset_ms: 0, clock_error_ms: 11 }));
    }

    #[test]
    fn an_exchange_that_took_less_than_no_time_is_passed_over() {
        let mut offset = Offset::default();
        offset.add(ClockSample { t1_us: 100, t2_us: 0, t3_us: 500, t4_us: 101 });
        assert_eq!(offset.estimate(), None);
    }
}
