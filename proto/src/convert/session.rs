//! The messages of a session.

use super::{At, Parse, WireEnum, from_one, id, list, maybe, need, text, word};
use crate::link::v1;
use crate::session::{
    ClockSample, Close, CloseCode, Downlink, Echo, FromRobot, Heartbeat, Hello, LaneAck, LaneBatch, LanePosition,
    Previous, StatusReplay, ToRobot, Uplink, Welcome,
};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Violations;
use midshift_core::robot::Lane;
use std::collections::BTreeMap;

impl WireEnum for CloseCode {
    fn to_wire(self) -> i32 {
        match self {
            Self::Fenced => 1,
            Self::Protocol => 2,
            Self::Shutdown => 3,
            Self::TooSlow => 4,
            Self::MoveOver => 5,
        }
    }
    fn from_wire(number: i32) -> Option<Self> {
        use v1::CloseCode as W;
        match W::try_from(number).ok()? {
            W::Unspecified => None,
            W::Fenced => Some(Self::Fenced),
            W::Protocol => Some(Self::Protocol),
            W::Shutdown => Some(Self::Shutdown),
            W::TooSlow => Some(Self::TooSlow),
            W::MoveOver => Some(Self::MoveOver),
        }
    }
}

impl From<&ClockSample> for v1::ClockSample {
    fn from(sample: &ClockSample) -> Self {
        Self { t1_us: sample.t1_us, t2_us: sample.t2_us, t3_us: sample.t3_us, t4_us: sample.t4_us }
    }
}

impl Parse<ClockSample> for v1::ClockSample {
    fn parse_at(self, _: At<'_>, _: &mut Violations) -> Option<ClockSample> {
        Some(ClockSample { t1_us: self.t1_us, t2_us: self.t2_us, t3_us: self.t3_us, t4_us: self.t4_us })
    }
}

impl From<&LaneAck> for v1::LaneAck {
    fn from(ack: &LaneAck) -> Self {
        Self { lane: ack.lane.to_wire(), seq: ack.seq, expect: ack.expect }
    }
}

impl Parse<LaneAck> for v1::LaneAck {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<LaneAck> {
        let lane = word(self.lane, at.field("lane"), bad);
        Some(LaneAck { lane: lane?, seq: self.seq, expect: self.expect })
    }
}

impl Parse<(Lane, LanePosition)> for v1::LanePosition {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<(Lane, LanePosition)> {
        let lane = word(self.lane, at.field("lane"), bad);
        let first_seq = from_one(self.first_seq, at.field("first_seq"), bad);
        if self.next_seq < self.first_seq {
            bad.add(at.field("next_seq").to_string(), "must not be below first_seq");
            return None;
        }
        Some((lane?, LanePosition { first_seq: first_seq?, next_seq: self.next_seq }))
    }
}

impl From<&Hello> for v1::Hello {
    fn from(hello: &Hello) -> Self {
        let position = |(lane, p): (&Lane, &LanePosition)| v1::LanePosition {
            lane: lane.to_wire(),
            first_seq: p.first_seq,
            next_seq: p.next_seq,
        };
        Self {
            robot_id: hello.robot_id.to_string(),
            boot_id: hello.boot_id.clone(),
            previous: hello
                .previous
                .as_ref()
                .map(|p| v1::PreviousSession { session_epoch: p.session_epoch, secret: p.secret.reveal().to_owned() }),
            inventory: Some((&hello.inventory).into()),
            reported: Some((&hello.reported).into()),
            ring: hello.ring.clone(),
            lanes: hello.lanes.iter().map(position).collect(),
            store_id: hello.store_id.clone(),
            sent_unix_ms: hello.sent_unix_ms,
            clock_rate_permille: hello.clock_rate_permille,
            protocol_versions: hello.protocol_versions.clone(),
            installed: hello.installed.clone(),
        }
    }
}

impl Parse<Previous> for v1::PreviousSession {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Previous> {
        let session_epoch = from_one(self.session_epoch, at.field("session_epoch"), bad);
        let secret = text(self.secret, 128, at.field("secret"), bad);
        Some(Previous { session_epoch: session_epoch?, secret: secret?.into() })
    }
}

impl Parse<Hello> for v1::Hello {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Hello> {
        let robot_id = id(&self.robot_id, RobotId::parse, at.field("robot_id"), bad);
        let boot_id = text(self.boot_id, 64, at.field("boot_id"), bad);
        let previous = maybe(self.previous, at.field("previous"), bad);
        let inventory = need(self.inventory, at.field("inventory"), bad);
        let reported = need(self.reported, at.field("reported"), bad);
        let ring = text(self.ring, 64, at.field("ring"), bad);
        let length = self.lanes.len();
        let lanes: Option<Vec<(Lane, LanePosition)>> = list(self.lanes, at.field("lanes"), bad);
        let lanes: Option<BTreeMap<Lane, LanePosition>> = lanes.map(|l| l.into_iter().collect());
        let rate = from_one(u64::from(self.clock_rate_permille), at.field("clock_rate_permille"), bad);
        if self.protocol_versions.is_empty() {
            bad.add(at.field("protocol_versions").to_string(), "is required");
        }
        if self.installed.len() > limits::INSTALLED_BYTES_MAX {
            bad.add(
                at.field("installed").to_string(),
                format!("must be at most {} bytes", limits::INSTALLED_BYTES_MAX),
            );
        }
        if lanes.as_ref().is_some_and(|l| l.len() != length) {
            bad.add(at.field("lanes").to_string(), "must name each lane at most once");
            return None;
        }
        Some(Hello {
            robot_id: robot_id?,
            boot_id: boot_id?,
            previous: previous?,
            inventory: inventory?,
            reported: reported?,
            ring: ring?,
            lanes: lanes?,
            store_id: self.store_id,
            sent_unix_ms: self.sent_unix_ms,
            clock_rate_permille: rate? as u32,
            protocol_versions: Some(self.protocol_versions).filter(|v| !v.is_empty())?,
            installed: Some(self.installed).filter(|i| i.len() <= limits::INSTALLED_BYTES_MAX)?,
        })
    }
}

impl From<&Welcome> for v1::Welcome {
    fn from(welcome: &Welcome) -> Self {
        Self {
            session_epoch: welcome.session_epoch,
            session_secret: welcome.session_secret.reveal().to_owned(),
            store_id: welcome.store_id.clone(),
            acks: welcome.acks.iter().map(Into::into).collect(),
            heartbeat_period_ms: welcome.heartbeat_period_ms,
            status_period_ms: welcome.status_period_ms,
            authority_ms: welcome.authority_ms,
            status_credit_bytes: welcome.status_credit_bytes,
            protocol_version: welcome.protocol_version,
            clock_rate_permille: welcome.clock_rate_permille,
            observed: welcome.observed,
        }
    }
}

impl Parse<Welcome> for v1::Welcome {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Welcome> {
        let session_epoch = from_one(self.session_epoch, at.field("session_epoch"), bad);
        let session_secret = text(self.session_secret, 128, at.field("session_secret"), bad);
        let acks = list(self.acks, at.field("acks"), bad);
        let period = from_one(u64::from(self.heartbeat_period_ms), at.field("heartbeat_period_ms"), bad);
        let status_period = from_one(u64::from(self.status_period_ms), at.field("status_period_ms"), bad);
        Some(Welcome {
            session_epoch: session_epoch?,
            session_secret: session_secret?.into(),
            store_id: self.store_id,
            acks: acks?,
            heartbeat_period_ms: period? as u32,
            status_period_ms: status_period? as u32,
            authority_ms: self.authority_ms,
            status_credit_bytes: self.status_credit_bytes,
            protocol_version: self.protocol_version,
            clock_rate_permille: self.clock_rate_permille,
            observed: self.observed,
        })
    }
}

impl From<&Heartbeat> for v1::Heartbeat {
    fn from(heartbeat: &Heartbeat) -> Self {
        Self {
            reported: Some((&heartbeat.reported).into()),
            sent_unix_us: heartbeat.sent_unix_us,
            clock: heartbeat.clock.as_ref().map(Into::into),
        }
    }
}

impl Parse<Heartbeat> for v1::Heartbeat {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Heartbeat> {
        if let Some(reported) = &self.reported {
            from_one(reported.hb, at.field("reported").field("hb"), bad)?;
            from_one(reported.session_epoch, at.field("reported").field("session_epoch"), bad)?;
        }
        let reported = need(self.reported, at.field("reported"), bad);
        let clock = maybe(self.clock, at.field("clock"), bad);
        Some(Heartbeat { reported: reported?, sent_unix_us: self.sent_unix_us, clock: clock? })
    }
}

impl From<&Uplink> for v1::Uplink {
    fn from(uplink: &Uplink) -> Self {
        Self {
            heartbeat: uplink.heartbeat.as_ref().map(Into::into),
            batches: uplink.batches.iter().map(Into::into).collect(),
        }
    }
}

impl Parse<Uplink> for v1::Uplink {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Uplink> {
        let samples: usize = self.batches.iter().map(|b| b.samples.len() + b.gaps.len()).sum();
        if samples > limits::SAMPLES_PER_MESSAGE {
            bad.add(at.field("batches").to_string(), "must be at most 256 samples and gaps in all");
            return None;
        }
        let heartbeat = maybe(self.heartbeat, at.field("heartbeat"), bad);
        let batches = list(self.batches, at.field("batches"), bad);
        Some(Uplink { heartbeat: heartbeat?, batches: batches? })
    }
}

/// Takes a heartbeat with a list that is too long out of a message, unread, and names the list: what else the message brings is read.
pub fn drop_long_heartbeat(message: &mut v1::SessionRequest) -> Option<&'static str> {
    let Some(v1::session_request::Message::Uplink(uplink)) = &mut message.message else { return None };
    let list = uplink.heartbeat.as_ref()?.reported.as_ref().and_then(super::robot::long_list)?;
    uplink.heartbeat = None;
    Some(list)
}

impl From<&StatusReplay> for v1::ReplayStatusRequest {
    fn from(replay: &StatusReplay) -> Self {
        Self {
            robot_id: replay.robot_id.to_string(),
            session_epoch: replay.session_epoch,
            session_secret: replay.session_secret.reveal().to_owned(),
            batch: Some((&replay.batch).into()),
        }
    }
}

impl Parse<StatusReplay> for v1::ReplayStatusRequest {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<StatusReplay> {
        let robot_id = id(&self.robot_id, RobotId::parse, at.field("robot_id"), bad);
        let session_epoch = from_one(self.session_epoch, at.field("session_epoch"), bad);
        let session_secret = text(self.session_secret, 128, at.field("session_secret"), bad);
        let items = self.batch.as_ref().map(|b| b.samples.len() + b.gaps.len());
        if items.is_some_and(|n| !(1..=limits::SAMPLES_PER_MESSAGE).contains(&n)) {
            bad.add(at.field("batch").to_string(), "must be 1-256 samples and gaps in all");
            return None;
        }
        let batch: Option<LaneBatch> = need(self.batch, at.field("batch"), bad);
        if batch.as_ref().is_some_and(|b| b.lane != Lane::Status) {
            bad.add(at.field("batch").field("lane").to_string(), "must be STATUS");
            return None;
        }
        Some(StatusReplay {
            robot_id: robot_id?,
            session_epoch: session_epoch?,
            session_secret: session_secret?.into(),
            batch: batch?,
        })
    }
}

impl From<&LaneAck> for v1::ReplayStatusResponse {
    fn from(ack: &LaneAck) -> Self {
        Self { ack: Some(ack.into()) }
    }
}

impl Parse<LaneAck> for v1::ReplayStatusResponse {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<LaneAck> {
        let ack: LaneAck = need(self.ack, at.field("ack"), bad)?;
        if ack.lane != Lane::Status {
            bad.add(at.field("ack").field("lane").to_string(), "must be STATUS");
            return None;
        }
        Some(ack)
    }
}

impl From<&Downlink> for v1::Downlink {
    fn from(downlink: &Downlink) -> Self {
        Self {
            echo: downlink.echo.as_ref().map(|e| v1::HeartbeatEcho {
                hb: e.hb,
                clock: Some((&e.clock).into()),
                is_clock_doubted: e.is_clock_doubted,
            }),
            acks: downlink.acks.iter().map(Into::into).collect(),
            work: downlink.work.as_ref().map(Into::into),
            policy: downlink.policy.as_ref().map(Into::into),
            update: downlink.update.as_ref().map(Into::into),
            status_credit_bytes: downlink.status_credit_bytes,
            stops: downlink.stops.as_ref().map(Into::into),
        }
    }
}

impl Parse<Echo> for v1::HeartbeatEcho {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Echo> {
        let hb = from_one(self.hb, at.field("hb"), bad);
        let clock = need(self.clock, at.field("clock"), bad);
        Some(Echo { hb: hb?, clock: clock?, is_clock_doubted: self.is_clock_doubted })
    }
}

impl Parse<Downlink> for v1::Downlink {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Downlink> {
        let echo = maybe(self.echo, at.field("echo"), bad);
        let acks = list(self.acks, at.field("acks"), bad);
        // A robot that cannot read its work must hear the rest all the same: echoes, acks, and what ends by them.
        let (work, unreadable_work) = apart(self.work, at.field("work"));
        let (stops, unreadable_stops) = apart(self.stops, at.field("stops"));
        let policy = maybe(self.policy, at.field("policy"), bad);
        let update = maybe(self.update, at.field("update"), bad);
        Some(Downlink {
            echo: echo?,
            acks: acks?,
            work,
            unreadable_work,
            policy: policy?,
            update: update?,
            status_credit_bytes: self.status_credit_bytes,
            stops,
            unreadable_stops,
        })
    }
}

/// A part of a message that is refused by itself, with why; the rest of the message is read.
fn apart<T, W: Parse<T>>(part: Option<W>, at: At<'_>) -> (Option<T>, Option<String>) {
    let mut bad = Violations::default();
    let read = maybe(part, at, &mut bad).unwrap_or_default();
    (read, bad.finish().err().map(|refusal| refusal.to_string()))
}

impl From<&Close> for v1::Close {
    fn from(close: &Close) -> Self {
        Self { code: close.code.to_wire(), reason: Some((&close.reason).into()), retry_after_ms: close.retry_after_ms }
    }
}

impl Parse<Close> for v1::Close {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Close> {
        let code = word(self.code, at.field("code"), bad);
        let reason = need(self.reason, at.field("reason"), bad);
        Some(Close { code: code?, reason: reason?, retry_after_ms: self.retry_after_ms })
    }
}

impl From<&FromRobot> for v1::SessionRequest {
    fn from(message: &FromRobot) -> Self {
        use v1::session_request::Message as W;
        let message = match message {
            FromRobot::Hello(hello) => W::Hello(hello.as_ref().into()),
            FromRobot::Uplink(uplink) => W::Uplink(uplink.into()),
        };
        Self { message: Some(message) }
    }
}

impl Parse<FromRobot> for v1::SessionRequest {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<FromRobot> {
        use v1::session_request::Message as W;
        match self.message {
            Some(W::Hello(hello)) => hello.parse_at(at.field("hello"), bad).map(|h| FromRobot::Hello(Box::new(h))),
            Some(W::Uplink(uplink)) => uplink.parse_at(at.field("uplink"), bad).map(FromRobot::Uplink),
            None => {
                bad.add(at.field("message").to_string(), "is required, of a known kind");
                None
            }
        }
    }
}

impl From<&ToRobot> for v1::SessionResponse {
    fn from(message: &ToRobot) -> Self {
        use v1::session_response::Message as W;
        let message = match message {
            ToRobot::Welcome(welcome) => W::Welcome(welcome.into()),
            ToRobot::Downlink(downlink) => W::Downlink(downlink.as_ref().into()),
            ToRobot::Close(close) => W::Close(close.into()),
            ToRobot::MoveOver { within_ms } => W::MoveOver(v1::MoveOver { within_ms: *within_ms }),
        };
        Self { message: Some(message) }
    }
}

impl Parse<ToRobot> for v1::SessionResponse {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<ToRobot> {
        use v1::session_response::Message as W;
        match self.message {
            Some(W::Welcome(welcome)) => welcome.parse_at(at.field("welcome"), bad).map(ToRobot::Welcome),
            Some(W::Downlink(downlink)) => {
                downlink.parse_at(at.field("downlink"), bad).map(|d| ToRobot::Downlink(Box::new(d)))
            }
            Some(W::Close(close)) => close.parse_at(at.field("close"), bad).map(ToRobot::Close),
            Some(W::MoveOver(m)) => Some(ToRobot::MoveOver { within_ms: m.within_ms }),
            None => {
                bad.add(at.field("message").to_string(), "is required, of a known kind");
                None
            }
        }
    }
}
