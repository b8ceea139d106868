//! What is engaged and reset, in memory: the latch with its generation, and what of it waits for the disk.
//!
//! Invariant: held behind one lock for moments, never while anything is waited for. A stop counts as soon as it is engaged here; a reset counts only when the
//! disk has had its turn with it, so that an end in between never leaves robots without a stop that the service still shows.

use crate::audit::Tail;
use crate::frames;
use bytes::Bytes;
use midshift_core::ids::{RequestId, StopId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::robot::StopLevel;
use midshift_core::stop::{Latch, Reset, Scope, Stop};
use midshift_core::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The state that survives the end of the service, as its latch file holds it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SavedState {
    /// Stops and resets.
    pub latch: Latch,
    /// State of the latch.
    pub generation: u64,
    /// Which request engaged which stop.
    #[serde(default)]
    pub requests: BTreeMap<RequestId, EngagedByRequest>,
    /// The last record of the audit.
    #[serde(default)]
    pub audit: Tail,
}

/// The stop that one request engaged.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EngagedByRequest {
    /// The stop.
    pub stop_id: StopId,
    /// SHA-256 of the request, hexadecimal.
    pub hash: String,
    /// When it was asked, UTC of the stop service's wall.
    pub at: Utc,
}

/// A reset that the disk has not had its turn with.
#[derive(Clone, Debug)]
struct Pending {
    version: u64,
    reset: Reset,
}

/// What became of a reset.
#[derive(Clone, Debug)]
pub struct Resetting {
    /// The reset that counts: the first one.
    pub reset: Reset,
    /// It was engaged until now.
    pub was_engaged: bool,
    /// There was none before.
    pub is_new: bool,
    /// The stop is known here, or was reset here before.
    pub is_known: bool,
    /// What the disk must have had its turn with.
    pub version: u64,
}

/// The latch at work.
pub struct EngagedStops {
    latch: Latch,
    generation: u64,
    since: BTreeMap<StopId, u64>,
    requests: BTreeMap<RequestId, EngagedByRequest>,
    pending: Vec<Pending>,
    version: u64,
    everything: Option<Arc<[Bytes]>>,
}

impl EngagedStops {
    /// Begins with the saved state. Generations go on rising, also if the last of them were not saved.
    pub fn begin(saved: SavedState, now: Utc) -> Self {
        let generation = now.0.max(0).cast_unsigned().max(saved.generation + 1);
        let since = saved.latch.effective().map(|stop| (stop.stop_id.clone(), generation)).collect();
        let (latch, requests) = (saved.latch, saved.requests);
        // The new generation is kept too.
        Self { latch, generation, since, requests, pending: Vec::new(), version: 1, everything: None }
    }

    /// The latch.
    pub fn latch(&self) -> &Latch {
        &self.latch
    }

    /// Its state.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// Number of the newest state that is to be saved.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Effective stops, each with the generation it came with.
    pub fn effective(&self) -> impl Iterator<Item = (&Stop, u64)> {
        self.latch.effective().map(|stop| (stop, self.since.get(&stop.stop_id).copied().unwrap_or(self.generation)))
    }

    /// The stop that a request engaged before; none: it engaged none.
    pub fn engaged_by(&self, request_id: &RequestId) -> Option<&EngagedByRequest> {
        self.requests.get(request_id)
    }

    /// Whether there is room for one more stop. For one of the whole fleet there always is, unless the fleet obeys one already that stops it at least as much: whoever
    /// fills the latch keeps nobody from more.
    ///
    /// # Errors
    /// As many as there may be are engaged.
    pub fn room(&self, scope: &Scope, level: StopLevel) -> Result<(), Refusal> {
        let is_fleet = *scope == Scope::Fleet;
        let room = if is_fleet { limits::STOPS_MAX } else { limits::STOPS_MAX - limits::STOPS_FOR_FLEET };
        let engaged = self.latch.effective().count();
        let of_fleet = || self.latch.effective().filter(|stop| stop.scope == Scope::Fleet).map(|stop| stop.level).max();
        if engaged < room || is_fleet && of_fleet().is_none_or(|most| most < level) {
            return Ok(());
        }
        let help = if is_fleet {
            "the whole fleet is stopped already by one that stops it at least as much; reset what is over"
        } else {
            "the last ones are kept for the whole fleet: engage the fleet, or reset what is over"
        };
        let text = format!("{engaged} stops are engaged and nothing more was stopped: {help}");
        Err(Refusal::new(Kind::Exhausted, Reason::new(Code::StopsFull, text).with("engaged", engaged)))
    }

    /// A name that was never used.
    pub fn draw(&self, now: Utc) -> StopId {
        draw_unused(&self.latch, "STOP-", now)
    }

    /// Adds a stop. The state of the latch with it; none: it was known.
    pub fn engage(&mut self, stop: Stop, request: Option<(RequestId, EngagedByRequest)>) -> Option<u64> {
        let stop_id = stop.stop_id.clone();
        if !self.latch.engage(stop) {
            return None;
        }
        if let Some((request_id, engaged)) = request {
            self.requests.insert(request_id, engaged);
            if self.requests.len() > limits::STOP_REQUESTS_MAX {
                let oldest = self.requests.iter().min_by_key(|(_, engaged)| engaged.at).map(|(id, _)| id.clone());
                oldest.map(|id| self.requests.remove(&id));
            }
        }
        self.change();
        self.since.insert(stop_id, self.generation);
        Some(self.generation)
    }

    /// Notes a reset, which counts after the disk's turn. The first reset of a stop is the one that counts.
    pub fn reset(&mut self, reset: Reset) -> Resetting {
        let stop_id = &reset.stop_id;
        let known = self.latch.reset_of(stop_id).cloned();
        let pending = self.pending.iter().find(|p| p.reset.stop_id == *stop_id);
        if let Some(known) = known.or_else(|| pending.map(|p| p.reset.clone())) {
            let version = pending.map_or(self.version, |p| p.version);
            return Resetting { reset: known, was_engaged: false, is_new: false, is_known: true, version };
        }
        let (was_engaged, is_known) = (self.latch.is_effective(stop_id), self.latch.stop(stop_id).is_some());
        self.version += 1;
        self.pending.push(Pending { version: self.version, reset: reset.clone() });
        Resetting { reset, was_engaged, is_new: true, is_known, version: self.version }
    }

    /// Whether a reset of it waits for the disk.
    pub fn is_resetting(&self, stop_id: &StopId) -> bool {
        self.pending.iter().any(|pending| pending.reset.stop_id == *stop_id)
    }

    /// The disk had its turn with all up to `version`: resets among them count now. Each comes back with the state of the latch that has it.
    pub fn settle(&mut self, version: u64, now: Utc) -> Vec<(Reset, u64)> {
        let settled: Vec<Pending> = self.pending.extract_if(.., |p| p.version <= version).collect();
        let mut counted = Vec::new();
        for Pending { reset, .. } in settled {
            self.latch.reset(reset.clone());
            self.since.remove(&reset.stop_id);
            self.generation += 1;
            counted.push((reset, self.generation));
        }
        if !counted.is_empty() {
            self.latch.forget(now, limits::RESETS_MAX);
            self.everything = None;
        }
        counted
    }

    /// Forgets what was reset long ago, and by which request it was engaged. What is to be kept is another then, so that all copies of it go too.
    pub fn forget(&mut self, now: Utc) {
        if self.latch.forget(now, limits::RESETS_MAX) {
            let latch = &self.latch;
            self.requests.retain(|_, engaged| latch.stop(&engaged.stop_id).is_some());
            self.version += 1;
        }
    }

    /// The state to save, with the resets that wait for it.
    pub fn state_to_save(&self, audit: Tail) -> SavedState {
        let mut latch = self.latch.clone();
        for pending in &self.pending {
            latch.reset(pending.reset.clone());
        }
        SavedState { latch, generation: self.generation, requests: self.requests.clone(), audit }
    }

    /// It does not fit the file: the older half of the resets is forgotten.
    pub fn shorten(&mut self, now: Utc) {
        let half = self.latch.resets().count() / 2;
        self.latch.forget(now, half);
        self.version += 1;
    }

    /// All that is effective, as messages to a robot.
    pub fn everything(&mut self) -> Arc<[Bytes]> {
        let latch = &self.latch;
        self.everything.get_or_insert_with(|| frames::encode_changes(latch.effective(), [], 0).into()).clone()
    }

    fn change(&mut self) {
        self.generation += 1;
        self.version += 1;
        self.everything = None;
    }
}

/// A name with this beginning that this latch has never used.
pub fn draw_unused(latch: &Latch, begins: &str, now: Utc) -> StopId {
    loop {
        let id = draw_id(begins, now, rand::random());
        if latch.stop(&id).is_none() && latch.reset_of(&id).is_none() {
            return id;
        }
    }
}

/// The beginning, `YYYYMMDD-` and 10 base-32 characters.
fn draw_id(begins: &str, utc: Utc, drawn: u64) -> StopId {
    const BASE32: &[u8; 32] = b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";
    let day = utc.rfc3339().get(..10).unwrap_or_default().replace('-', "");
    let tail: String = (0..10).map(|i| char::from(BASE32[(drawn >> (i * 5)) as usize & 31])).collect();
    // Letters, digits and hyphens only, 29 of them at most.
    StopId::parse(&format!("{begins}{day}-{tail}")).unwrap_or_else(|e| unreachable!("drawn id: {e}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::RobotId;

    fn stop(id: StopId, scope: Scope) -> Stop {
        Stop::new(id, scope, StopLevel::Halt, Utc(1))
    }

    fn reset(stop_id: &StopId) -> Reset {
        Reset { actor: "a".to_owned(), reason: "over".to_owned(), ..Reset::new(stop_id.clone(), Utc(2)) }
    }

    #[test]
    fn a_reset_counts_after_the_turn_of_the_disk_and_what_is_kept_has_it_before() {
        let mut engaged_stops = EngagedStops::begin(SavedState::default(), Utc(1_000));
        let id = engaged_stops.draw(Utc(0));
        engaged_stops.engage(stop(id.clone(), Scope::Fleet), None).unwrap();
        let resetting = engaged_stops.reset(reset(&id));
        assert!(resetting.was_engaged && engaged_stops.latch().is_effective(&id), "robots still obey it");
        assert!(!engaged_stops.state_to_save(Tail::default()).latch.is_effective(&id));
        assert!(engaged_stops.settle(resetting.version - 1, Utc(2)).is_empty());
        assert_eq!(engaged_stops.settle(resetting.version, Utc(2)), [(reset(&id), engaged_stops.generation())]);
        assert!(!engaged_stops.latch().is_effective(&id));
        let again = engaged_stops.reset(Reset { reason: "again".to_owned(), ..reset(&id) });
        assert_eq!((again.was_engaged, again.is_new, again.reset.reason.as_str()), (false, false, "over"));
    }

    #[test]
    fn what_was_reset_long_ago_goes_by_itself_and_what_is_kept_is_another_then() {
        let mut engaged_stops = EngagedStops::begin(SavedState::default(), Utc(0));
        let (old, engaged) = (engaged_stops.draw(Utc(0)), engaged_stops.draw(Utc(0)));
        let asked = EngagedByRequest { stop_id: old.clone(), hash: String::new(), at: Utc(1) };
        engaged_stops
            .engage(stop(old.clone(), Scope::Fleet), Some((RequestId::parse("once").unwrap(), asked)))
            .unwrap();
        engaged_stops.engage(stop(engaged.clone(), Scope::Fleet), None).unwrap();
        let resetting = engaged_stops.reset(reset(&old));
        engaged_stops.settle(resetting.version, Utc(2));
        let (version, age) = (engaged_stops.version(), limits::RESETS_KEPT.as_ms());
        engaged_stops.forget(Utc(2).plus_ms(age));
        assert_eq!(engaged_stops.version(), version, "nothing is old yet");
        engaged_stops.forget(Utc(3).plus_ms(age));
        assert_eq!(engaged_stops.version(), version + 1);
        let saved = engaged_stops.state_to_save(Tail::default());
        assert!(saved.latch.stop(&old).is_none() && saved.requests.is_empty(), "{saved:?}");
        assert!(saved.latch.is_effective(&engaged), "what is engaged has no age");
    }

    #[test]
    fn generations_rise_over_restarts_whatever_the_wall_says() {
        let engaged_stops = EngagedStops::begin(SavedState { generation: 5_000, ..SavedState::default() }, Utc(1_000));
        assert_eq!(engaged_stops.generation(), 5_001);
        assert_eq!(EngagedStops::begin(SavedState::default(), Utc(1_000)).generation(), 1_000);
    }

    #[test]
    fn the_last_stops_are_kept_for_the_fleet_and_the_refusal_says_so() {
        let mut engaged_stops = EngagedStops::begin(SavedState::default(), Utc(0));
        let robot = Scope::Robot(RobotId::parse("r1").unwrap());
        let halt = StopLevel::Halt;
        for _ in 0..limits::STOPS_MAX - limits::STOPS_FOR_FLEET {
            engaged_stops.room(&robot, halt).unwrap();
            let id = engaged_stops.draw(Utc(0));
            engaged_stops.engage(stop(id, robot.clone()), None).unwrap();
        }
        let refusal = engaged_stops.room(&robot, halt).unwrap_err();
        assert_eq!((refusal.kind(), refusal.reason.code), (Kind::Exhausted, Code::StopsFull));
        assert!(refusal.reason.text().contains("engage the fleet"), "{refusal}");
        for _ in 0..limits::STOPS_FOR_FLEET {
            engaged_stops.room(&Scope::Fleet, halt).unwrap();
            let id = engaged_stops.draw(Utc(0));
            engaged_stops.engage(stop(id, Scope::Fleet), None).unwrap();
        }
        let refusal = engaged_stops.room(&Scope::Fleet, halt).unwrap_err();
        assert!(refusal.reason.text().contains("stopped already"), "{refusal}");
    }

    #[test]
    fn whoever_fills_the_latch_with_slow_ones_keeps_nobody_from_halting_the_fleet() {
        let mut engaged_stops = EngagedStops::begin(SavedState::default(), Utc(0));
        let mut engage = |level, times: usize| {
            (0..times).find_map(|_| {
                engaged_stops.room(&Scope::Fleet, level).err().or_else(|| {
                    let id = engaged_stops.draw(Utc(0));
                    engaged_stops.engage(Stop { level, ..stop(id, Scope::Fleet) }, None).unwrap();
                    None
                })
            })
        };
        assert!(engage(StopLevel::Slow, limits::STOPS_MAX).is_none());
        assert!(engage(StopLevel::Slow, 1).is_some(), "the fleet is slow already");
        assert!(engage(StopLevel::Halt, 1).is_none() && engage(StopLevel::Halt, 1).is_some());
        assert!(engage(StopLevel::ControlledStopPosture, 1).is_none() && engage(StopLevel::Halt, 1).is_some());
        assert_eq!(engaged_stops.latch().effective().count(), limits::STOPS_MAX + 2);
    }

    #[test]
    fn the_fullest_latch_fits_its_slot() {
        let boxes = (0..limits::REGION_BOXES_MAX as i32).map(|i| midshift_core::stop::region::Bounds {
            x0_mm: -i * 1_000_000,
            y0_mm: i * 1_000_000 - i32::MAX,
            x1_mm: -i * 1_000_000 + 1,
            y1_mm: i32::MAX - i * 10,
        });
        let region = Some(midshift_core::stop::Region::new(boxes));
        let mut latch = Latch::default();
        for n in 0..limits::STOPS_MAX + limits::RESETS_MAX {
            let (actor, reason) = ("a".repeat(128), "r".repeat(limits::REASON_BYTES_MAX));
            let id = draw_id("STOP-", Utc(0), n as u64);
            let (region, proof) = (region.clone(), vec![255; 64]);
            let stop = Stop { actor: actor.clone(), reason: reason.clone(), region, proof, ..stop(id, Scope::Fleet) };
            if n < limits::RESETS_MAX {
                latch.reset(Reset { actor, reason, proof: vec![255; 64], ..reset(&stop.stop_id) });
            }
            latch.engage(stop);
        }
        let bytes = serde_json::to_vec(&SavedState { latch, ..SavedState::default() }).unwrap().len();
        assert!(bytes < limits::STOP_LATCH_BYTES * 3 / 4, "{bytes}");
    }
}
