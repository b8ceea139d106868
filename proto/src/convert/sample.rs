//! Samples, gaps and events of the lanes. A sample that cannot be read becomes a poison entry: recorded, acknowledged, never looped on.

use super::stop::{names, stop_ids};
use super::{At, Parse, WireEnum, from_one, id, maybe, need, permille, text, word};
use crate::link::v1;
use crate::session::LaneBatch;
use midshift_core::ids::PlaceId;
use midshift_core::limits;
use midshift_core::reason::{Reason, Violations};
use midshift_core::robot::Lane;
use midshift_core::robot_events::{AttemptReport, Gap, InboxItem, RobotEvent, Sample, SampleBody};

impl From<&AttemptReport> for v1::AttemptReport {
    fn from(report: &AttemptReport) -> Self {
        Self {
            attempt: Some((&report.attempt).into()),
            state: report.state.to_wire(),
            step_index: report.step_index,
            opened: report.opened,
            refusal: report.refusal.as_ref().map(Into::into),
            fault: report.fault.as_ref().map(Into::into),
            stats: Some((&report.stats).into()),
        }
    }
}

impl Parse<AttemptReport> for v1::AttemptReport {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<AttemptReport> {
        let attempt = need(self.attempt, at.field("attempt"), bad);
        let state = word(self.state, at.field("state"), bad);
        let refusal = maybe(self.refusal, at.field("refusal"), bad);
        let fault = maybe(self.fault, at.field("fault"), bad);
        Some(AttemptReport {
            attempt: attempt?,
            state: state?,
            step_index: self.step_index,
            opened: self.opened,
            refusal: refusal?,
            fault: fault?,
            stats: self.stats.map(Into::into).unwrap_or_default(),
        })
    }
}

impl From<&RobotEvent> for v1::RobotEvent {
    fn from(event: &RobotEvent) -> Self {
        use v1::robot_event::Event as W;
        let event = match event {
            RobotEvent::Attempt(report) => W::Attempt(report.into()),
            RobotEvent::Place { place_id, grant_id, news } => {
                W::Place(v1::PlaceReport { place_id: place_id.to_string(), grant_id: *grant_id, news: news.to_wire() })
            }
            RobotEvent::Fault { fault, cleared } => {
                W::Fault(v1::FaultReport { fault: Some(fault.into()), cleared: *cleared })
            }
            RobotEvent::Mode(mode) => W::Mode(v1::ModeReport { mode: mode.to_wire() }),
            RobotEvent::HardwareStop(stop) => W::HardwareStop(v1::HardwareStopReport { hardware_stop: stop.to_wire() }),
            RobotEvent::Load(load) => W::Load(v1::LoadReport { load: load.as_ref().map(Into::into) }),
            RobotEvent::StaleAuthority { what, detail } => {
                W::StaleAuthority(v1::StaleAuthorityReport { what: what.clone(), detail: detail.clone() })
            }
            RobotEvent::FleetStop { level, stops, awaiting_resume } => W::FleetStop(v1::FleetStopReport {
                level: level.to_wire(),
                stops: names(stops),
                awaiting_resume: names(awaiting_resume),
            }),
            RobotEvent::Update(event) => W::Update(event.into()),
            RobotEvent::BatteryCritical { battery_permille } => {
                W::BatteryCritical(v1::BatteryCriticalReport { battery_permille: u32::from(*battery_permille) })
            }
        };
        Self { event: Some(event) }
    }
}

impl Parse<RobotEvent> for v1::RobotEvent {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<RobotEvent> {
        use v1::robot_event::Event as W;
        let Some(event) = self.event else {
            bad.add(at.to_string(), "is required, of a known kind");
            return None;
        };
        match event {
            W::Attempt(report) => report.parse_at(at.field("attempt"), bad).map(RobotEvent::Attempt),
            W::Place(report) => {
                let at = at.field("place");
                let place_id = id(&report.place_id, PlaceId::parse, at.field("place_id"), bad);
                let news = word(report.news, at.field("news"), bad);
                Some(RobotEvent::Place { place_id: place_id?, grant_id: report.grant_id, news: news? })
            }
            W::Fault(report) => {
                let fault = need(report.fault, at.field("fault").field("fault"), bad);
                Some(RobotEvent::Fault { fault: fault?, cleared: report.cleared })
            }
            W::Mode(report) => word(report.mode, at.field("mode").field("mode"), bad).map(RobotEvent::Mode),
            W::HardwareStop(report) => {
                word(report.hardware_stop, at.field("hardware_stop").field("hardware_stop"), bad)
                    .map(RobotEvent::HardwareStop)
            }
            W::Load(report) => maybe(report.load, at.field("load").field("load"), bad).map(RobotEvent::Load),
            W::StaleAuthority(report) => {
                let what = text(report.what, 64, at.field("stale_authority").field("what"), bad);
                Some(RobotEvent::StaleAuthority { what: what?, detail: report.detail })
            }
            W::FleetStop(report) => {
                let at = at.field("fleet_stop");
                let level = word(report.level, at.field("level"), bad);
                let stops = stop_ids(&report.stops, at.field("stops"), bad);
                let awaiting_resume = stop_ids(&report.awaiting_resume, at.field("awaiting_resume"), bad);
                Some(RobotEvent::FleetStop { level: level?, stops: stops?, awaiting_resume: awaiting_resume? })
            }
            W::Update(news) => news.parse_at(at.field("update"), bad).map(RobotEvent::Update),
            W::BatteryCritical(report) => {
                let value =
                    permille(report.battery_permille, at.field("battery_critical").field("battery_permille"), bad);
                Some(RobotEvent::BatteryCritical { battery_permille: value? })
            }
        }
    }
}

impl From<&Sample> for v1::Sample {
    fn from(sample: &Sample) -> Self {
        let body = match &sample.body {
            SampleBody::Event(event) => v1::sample::Body::Event(event.into()),
            SampleBody::Status(vitals) => v1::sample::Body::Status(vitals.into()),
        };
        Self { seq: sample.seq, robot_unix_ms: sample.robot_unix_ms, body: Some(body) }
    }
}

impl Parse<Sample> for v1::Sample {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Sample> {
        let seq = from_one(self.seq, at.field("seq"), bad);
        let body = match self.body {
            Some(v1::sample::Body::Event(event)) => event.parse_at(at.field("event"), bad).map(SampleBody::Event),
            Some(v1::sample::Body::Status(vitals)) => vitals.parse_at(at.field("status"), bad).map(SampleBody::Status),
            None => {
                bad.add(at.field("body").to_string(), "is required, event or status");
                None
            }
        };
        Some(Sample { seq: seq?, robot_unix_ms: self.robot_unix_ms, body: body? })
    }
}

impl From<&Gap> for v1::Gap {
    fn from(gap: &Gap) -> Self {
        Self { from_seq: gap.from_seq, to_seq: gap.to_seq, reason: Some((&gap.reason).into()) }
    }
}

/// Reads a number in a lane. The next one must be one too: the next Hello says it.
fn followed(seq: u64, at: At<'_>, bad: &mut Violations) -> Option<u64> {
    if seq >= limits::COUNTED_MAX {
        bad.add(at.to_string(), format!("must be below {}", limits::COUNTED_MAX));
        return None;
    }
    from_one(seq, at, bad)
}

/// A gap has its lane from the batch it stands in.
impl Parse<(u64, u64, Reason)> for v1::Gap {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<(u64, u64, Reason)> {
        let from_seq = from_one(self.from_seq, at.field("from_seq"), bad);
        let to_seq = followed(self.to_seq, at.field("to_seq"), bad);
        let reason = need(self.reason, at.field("reason"), bad);
        if self.to_seq < self.from_seq {
            bad.add(at.field("to_seq").to_string(), "must not be below from_seq");
            return None;
        }
        Some((from_seq?, to_seq?, reason?))
    }
}

/// First number of an item.
fn first_seq(item: &InboxItem) -> u64 {
    match item {
        InboxItem::Sample(sample) => sample.seq,
        InboxItem::Gap(gap) => gap.from_seq,
        InboxItem::Poison { seq, .. } => *seq,
    }
}

/// A sample as the inbox takes it. None: it has no number, which is a fault of the session and not of the sample.
fn readable(sample: v1::Sample, lane: Lane, at: At<'_>, bad: &mut Violations) -> Option<InboxItem> {
    let seq = followed(sample.seq, at.field("seq"), bad)?;
    let mut wrong = Violations::default();
    let parsed = sample.parse_at(At::top("sample"), &mut wrong);
    let status = matches!(parsed, Some(Sample { body: SampleBody::Status(_), .. }));
    if parsed.is_some() && status != (lane == Lane::Status) {
        wrong.add("sample.body", "must be status in lane STATUS and event in the others");
    }
    match (parsed, wrong.finish()) {
        (Some(sample), Ok(())) => Some(InboxItem::Sample(sample)),
        (_, Err(refusal)) => Some(InboxItem::Poison { seq, detail: refusal.reason.message }),
        (None, Ok(())) => Some(InboxItem::Poison { seq, detail: "cannot be read".to_owned() }),
    }
}

impl From<&LaneBatch> for v1::LaneBatch {
    fn from(batch: &LaneBatch) -> Self {
        let mut wire = Self { lane: batch.lane.to_wire(), samples: Vec::new(), gaps: Vec::new() };
        for item in &batch.items {
            match item {
                InboxItem::Sample(sample) => wire.samples.push(sample.into()),
                InboxItem::Gap(gap) => wire.gaps.push(gap.into()),
                InboxItem::Poison { seq, .. } => {
                    wire.samples.push(v1::Sample { seq: *seq, robot_unix_ms: 0, body: None })
                }
            }
        }
        wire
    }
}

impl Parse<LaneBatch> for v1::LaneBatch {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<LaneBatch> {
        let before = bad.0.len();
        let lane: Lane = word(self.lane, at.field("lane"), bad)?;
        let mut items = Vec::with_capacity(self.samples.len() + self.gaps.len());
        for (i, sample) in self.samples.into_iter().enumerate() {
            items.extend(readable(sample, lane, at.field("samples").index(i), bad));
        }
        for (i, gap) in self.gaps.into_iter().enumerate() {
            let parsed = gap.parse_at(at.field("gaps").index(i), bad);
            items.extend(
                parsed.map(|(from_seq, to_seq, reason)| InboxItem::Gap(Gap { lane, from_seq, to_seq, reason })),
            );
        }
        items.sort_by_key(first_seq);
        (bad.0.len() == before).then_some(LaneBatch { lane, items })
    }
}
