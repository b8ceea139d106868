//! Stops, resets and what a robot says of them.

use super::{At, Parse, WireEnum, counted, id, list, need, text, word};
use crate::session::StopFacts;
use crate::stop::v1;
use midshift_core::ids::{AreaId, PlaceId, RobotId, StopId};
use midshift_core::limits;
use midshift_core::reason::Violations;
use midshift_core::robot::StopLevel;
use midshift_core::stop::ladder::{Around, Stage};
use midshift_core::stop::region::Bounds;
use midshift_core::stop::{Region, Reset, Scope, Stop};
use midshift_core::time::Utc;
use prost::Message;
use std::collections::VecDeque;

/// The name of who engaged or reset one, bytes.
const ACTOR_BYTES_MAX: usize = 128;

/// Names of stops, as they are written.
pub fn names<'a>(stop_ids: impl IntoIterator<Item = &'a StopId>) -> Vec<String> {
    stop_ids.into_iter().map(ToString::to_string).collect()
}

/// Reads names of stops, at most [`limits::STOPS_MAX`].
pub(crate) fn stop_ids(names: &[String], at: At<'_>, bad: &mut Violations) -> Option<Vec<StopId>> {
    if names.len() > limits::STOPS_MAX {
        bad.add(at.to_string(), format!("must be at most {}", limits::STOPS_MAX));
        return None;
    }
    names.iter().enumerate().map(|(i, name)| id(name, StopId::parse, at.index(i), bad)).collect()
}

impl From<&Scope> for v1::Scope {
    fn from(scope: &Scope) -> Self {
        use v1::scope::Scope as W;
        let scope = match scope {
            Scope::Robot(id) => W::RobotId(id.to_string()),
            Scope::Zone(id) => W::Zone(id.to_string()),
            Scope::Area(id) => W::AreaId(id.to_string()),
            Scope::Fleet => W::Fleet(v1::Fleet {}),
        };
        Self { scope: Some(scope) }
    }
}

impl Parse<Scope> for v1::Scope {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Scope> {
        use v1::scope::Scope as W;
        match self.scope {
            Some(W::RobotId(robot)) => id(&robot, RobotId::parse, at.field("robot_id"), bad).map(Scope::Robot),
            Some(W::Zone(zone)) => id(&zone, PlaceId::parse, at.field("zone"), bad).map(Scope::Zone),
            Some(W::AreaId(area)) => id(&area, AreaId::parse, at.field("area_id"), bad).map(Scope::Area),
            Some(W::Fleet(v1::Fleet {})) => Some(Scope::Fleet),
            None => {
                bad.add(at.to_string(), "is required: a robot, a zone, an area or the fleet");
                None
            }
        }
    }
}

impl From<&Bounds> for v1::Box {
    fn from(b: &Bounds) -> Self {
        Self { x0_mm: b.x0_mm, y0_mm: b.y0_mm, x1_mm: b.x1_mm, y1_mm: b.y1_mm }
    }
}

impl From<&Stop> for v1::Stop {
    fn from(stop: &Stop) -> Self {
        Self {
            stop_id: stop.stop_id.to_string(),
            scope: Some((&stop.scope).into()),
            level: stop.level.to_wire(),
            engaged_unix_ms: stop.engaged_unix_ms.0,
            actor: stop.actor.clone(),
            reason: stop.reason.clone(),
            boxes: stop.region.iter().flat_map(|region| region.boxes().iter().map(Into::into)).collect(),
            proof: stop.proof.clone(),
        }
    }
}

impl Parse<Stop> for v1::Stop {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Stop> {
        let before = bad.0.len();
        let stop_id = id(&self.stop_id, StopId::parse, at.field("stop_id"), bad);
        let scope = need(self.scope, at.field("scope"), bad);
        let level = word(self.level, at.field("level"), bad).filter(|level| {
            let is_one = *level != StopLevel::None;
            if !is_one {
                bad.add(at.field("level").to_string(), "NONE stops nobody");
            }
            is_one
        });
        let lengths = [
            ("actor", self.actor.len(), ACTOR_BYTES_MAX),
            ("reason", self.reason.len(), limits::REASON_BYTES_MAX),
            ("proof", self.proof.len(), limits::STOP_PROOF_BYTES),
            ("boxes", self.boxes.len(), limits::REGION_BOXES_MAX),
        ];
        for (name, length, max) in lengths.into_iter().filter(|(_, length, max)| length > max) {
            bad.add(at.field(name).to_string(), format!("must be at most {max}, not {length}"));
        }
        let boxes =
            self.boxes.iter().map(|b| Bounds { x0_mm: b.x0_mm, y0_mm: b.y0_mm, x1_mm: b.x1_mm, y1_mm: b.y1_mm });
        let region = (!self.boxes.is_empty() && bad.0.len() == before).then(|| Region::new(boxes));
        let stop = Stop {
            stop_id: stop_id?,
            scope: scope?,
            level: level?,
            engaged_unix_ms: Utc(self.engaged_unix_ms),
            actor: self.actor,
            reason: self.reason,
            region,
            proof: self.proof,
            token_id: None,
        };
        (bad.0.len() == before).then_some(stop)
    }
}

impl From<&Reset> for v1::Reset {
    fn from(reset: &Reset) -> Self {
        Self {
            stop_id: reset.stop_id.to_string(),
            at_unix_ms: reset.reset_unix_ms.0,
            actor: reset.actor.clone(),
            reason: reset.reason.clone(),
            proof: reset.proof.clone(),
        }
    }
}

/// What the stop service signs of a reset: all of it but the mark itself.
pub fn signed_reset(reset: &Reset) -> Vec<u8> {
    let wire = v1::Reset { proof: Vec::new(), ..reset.into() };
    let mut bytes = b"midshift reset 1\0".to_vec();
    bytes.extend(wire.encode_to_vec());
    bytes
}

impl Parse<Reset> for v1::Reset {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Reset> {
        let stop_id = id(&self.stop_id, StopId::parse, at.field("stop_id"), bad);
        let actor = text(self.actor, ACTOR_BYTES_MAX, at.field("actor"), bad);
        let reason = text(self.reason, limits::REASON_BYTES_MAX, at.field("reason"), bad);
        let is_mark = self.proof.len() <= limits::STOP_PROOF_BYTES;
        if !is_mark {
            bad.add(at.field("proof").to_string(), format!("must be at most {}", limits::STOP_PROOF_BYTES));
        }
        let proof = is_mark.then_some(self.proof);
        Some(Reset {
            stop_id: stop_id?,
            reset_unix_ms: Utc(self.at_unix_ms),
            actor: actor?,
            reason: reason?,
            proof: proof?,
            token_id: None,
        })
    }
}

impl From<&StopFacts> for v1::StopFacts {
    fn from(facts: &StopFacts) -> Self {
        Self {
            stops: facts.stops.iter().map(Into::into).collect(),
            resets: facts.resets.iter().map(Into::into).collect(),
        }
    }
}

impl StopFacts {
    /// All of these, in as many parts as they need: none of more than [`limits::STOP_TOLD_BYTES`] or [`limits::STOPS_MAX`] of a kind.
    pub fn parts<'a>(
        stops: impl IntoIterator<Item = &'a Stop>,
        resets: impl IntoIterator<Item = &'a Reset>,
    ) -> VecDeque<Self> {
        // A tag and a length come before each.
        const FRAME: usize = 8;
        let (mut full, mut part, mut room) = (VecDeque::new(), Self::default(), limits::STOP_TOLD_BYTES);
        let mut room_for = |bytes: usize, part: &mut Self| {
            if bytes + FRAME > room || part.stops.len().max(part.resets.len()) == limits::STOPS_MAX {
                full.push_back(std::mem::take(part));
                room = limits::STOP_TOLD_BYTES;
            }
            room = room.saturating_sub(bytes + FRAME);
        };
        for stop in stops {
            room_for(v1::Stop::from(stop).encoded_len(), &mut part);
            part.stops.push(stop.clone());
        }
        for reset in resets {
            room_for(v1::Reset::from(reset).encoded_len(), &mut part);
            part.resets.push(reset.clone());
        }
        full.extend((part != Self::default()).then_some(part));
        full
    }
}

impl Parse<StopFacts> for v1::StopFacts {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<StopFacts> {
        let lengths = [("stops", self.stops.len()), ("resets", self.resets.len())];
        let mut is_short = true;
        for (name, length) in lengths.into_iter().filter(|(_, length)| *length > limits::STOPS_MAX) {
            bad.add(at.field(name).to_string(), format!("must be at most {}, not {length}", limits::STOPS_MAX));
            is_short = false;
        }
        if !is_short {
            return None;
        }
        let stops = list(self.stops, at.field("stops"), bad);
        let resets = list(self.resets, at.field("resets"), bad);
        Some(StopFacts { stops: stops?, resets: resets? })
    }
}

/// What comes up a robot's line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ToStop {
    /// Who comes, and which stops it keeps.
    Attend {
        /// The robot that comes.
        robot_id: RobotId,
        /// New for each start of its agent.
        boot_id: String,
        /// Engaged and not reset, as far as it knows.
        stops: Vec<Stop>,
        /// Names of the rest.
        more: Vec<StopId>,
    },
    /// What it does now.
    CheckIn(CheckIn),
}

/// What a robot says of itself, and the number that proves that both still think.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckIn {
    /// Never used before by this robot.
    pub nonce: u64,
    /// Newest state of the latch that it has taken over.
    pub generation: u64,
    /// What it took over survives its own end.
    pub is_durable: bool,
    /// What it obeys.
    pub level: StopLevel,
    /// It stands and will not move by itself.
    pub is_still: bool,
    /// Effective stops that it lies inside of.
    pub inside: Vec<StopId>,
    /// What waits for a person's resume.
    pub awaiting: Vec<StopId>,
    /// How far its silence had come.
    pub stage: Stage,
    /// Whom it has around itself.
    pub around: Around,
}

/// How long the name of a start of an agent may be, bytes.
const BOOT_BYTES_MAX: usize = 64;

impl From<&ToStop> for v1::AttendRequest {
    fn from(said: &ToStop) -> Self {
        use v1::attend_request::Message as W;
        let message = match said {
            ToStop::Attend { robot_id, boot_id, stops, more } => W::Attend(v1::Attend {
                robot_id: robot_id.to_string(),
                boot_id: boot_id.clone(),
                stops: stops.iter().map(Into::into).collect(),
                more_stop_ids: names(more),
            }),
            ToStop::CheckIn(said) => W::CheckIn(v1::CheckIn {
                nonce: said.nonce,
                generation: said.generation,
                durable: said.is_durable,
                obeys: said.level.to_wire(),
                standstill: said.is_still,
                inside: names(&said.inside),
                awaiting_resume: names(&said.awaiting),
                silence: said.stage.to_wire(),
                without_people: said.around == Around::Robots,
            }),
        };
        Self { message: Some(message) }
    }
}

impl Parse<ToStop> for v1::AttendRequest {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<ToStop> {
        use v1::attend_request::Message as W;
        match self.message {
            Some(W::Attend(attend)) => {
                let at = at.field("attend");
                let robot_id = id(&attend.robot_id, RobotId::parse, at.field("robot_id"), bad);
                let boot_id = text(attend.boot_id, BOOT_BYTES_MAX, at.field("boot_id"), bad);
                if attend.stops.len() > limits::STOPS_MAX {
                    bad.add(at.field("stops").to_string(), format!("must be at most {}", limits::STOPS_MAX));
                    return None;
                }
                let stops = list(attend.stops, at.field("stops"), bad);
                let more = stop_ids(&attend.more_stop_ids, at.field("more_stop_ids"), bad);
                Some(ToStop::Attend { robot_id: robot_id?, boot_id: boot_id?, stops: stops?, more: more? })
            }
            Some(W::CheckIn(said)) => said.parse_at(at.field("check_in"), bad).map(ToStop::CheckIn),
            None => {
                bad.add(at.field("message").to_string(), "is required");
                None
            }
        }
    }
}

impl Parse<CheckIn> for v1::CheckIn {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<CheckIn> {
        let generation = counted(self.generation, at.field("generation"), bad);
        let level = word(self.obeys, at.field("obeys"), bad);
        let inside = stop_ids(&self.inside, at.field("inside"), bad);
        let awaiting = stop_ids(&self.awaiting_resume, at.field("awaiting_resume"), bad);
        let stage = word(self.silence, at.field("silence"), bad);
        Some(CheckIn {
            nonce: self.nonce,
            generation: generation?,
            is_durable: self.durable,
            level: level?,
            is_still: self.standstill,
            inside: inside?,
            awaiting: awaiting?,
            stage: stage?,
            around: if self.without_people { Around::Robots } else { Around::People },
        })
    }
}

/// What comes down a robot's line.
#[derive(Clone, Debug, PartialEq)]
pub enum FromStop {
    /// Facts to add.
    Facts {
        /// Stops that are engaged.
        stops: Vec<Stop>,
        /// Resets, each of one stop by its id.
        resets: Vec<Reset>,
        /// State of the latch with them.
        generation: u64,
    },
    /// All that is effective was said.
    Synced {
        /// State of the latch.
        generation: u64,
        /// Public key of the service's marks. Empty: the one that was said before.
        key: Vec<u8>,
    },
    /// The answer to a check-in.
    CheckInAnswer {
        /// Its number.
        nonce: u64,
        /// State of the latch.
        generation: u64,
    },
    /// Dial again before this line closes.
    MoveOver,
}

impl Parse<FromStop> for v1::AttendResponse {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<FromStop> {
        use v1::attend_response::Message as W;
        match self.message {
            Some(W::Facts(facts)) => {
                let generation = counted(self.facts_generation, at.field("facts_generation"), bad);
                let at = at.field("facts");
                let stops = list(facts.stops, at.field("stops"), bad);
                let resets = list(facts.resets, at.field("resets"), bad);
                Some(FromStop::Facts { stops: stops?, resets: resets?, generation: generation? })
            }
            Some(W::Synced(synced)) => {
                let at = at.field("synced");
                let generation = counted(synced.generation, at.field("generation"), bad);
                if !matches!(synced.key.len(), 0 | limits::STOP_KEY_BYTES) {
                    bad.add(at.field("key").to_string(), format!("must be {} bytes", limits::STOP_KEY_BYTES));
                    return None;
                }
                Some(FromStop::Synced { generation: generation?, key: synced.key })
            }
            Some(W::CheckInAnswer(answer)) => {
                let generation = counted(answer.generation, at.field("check_in_answer").field("generation"), bad)?;
                Some(FromStop::CheckInAnswer { nonce: answer.nonce, generation })
            }
            Some(W::MoveOver(v1::MoveOver {})) => Some(FromStop::MoveOver),
            None => {
                bad.add(at.field("message").to_string(), "is required");
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse;

    fn stop() -> Stop {
        let stop_id = StopId::parse("STOP-20260601-ABCDEFGHJK").expect("an id");
        let hall = Scope::Area(AreaId::parse("hall").expect("an id"));
        Stop {
            actor: "anna".to_owned(),
            reason: "a pallet fell".to_owned(),
            region: Some(Region::of_box(0, 0, 10, 10)),
            proof: vec![1, 2],
            ..Stop::new(stop_id, hall, StopLevel::Halt, Utc(5))
        }
    }

    #[test]
    fn a_stop_and_its_reset_read_back() {
        assert_eq!(parse::<Stop, _>(v1::Stop::from(&stop())), Ok(stop()));
        let (actor, reason) = ("bert".to_owned(), "clear".to_owned());
        let reset = Reset { actor, reason, ..Reset::new(stop().stop_id, Utc(7)) };
        assert_eq!(parse::<Reset, _>(v1::Reset::from(&reset)), Ok(reset));
        for scope in [Scope::Fleet, Scope::Robot(RobotId::parse("r1").expect("an id"))] {
            assert_eq!(parse::<Scope, _>(v1::Scope::from(&scope)), Ok(scope));
        }
    }

    #[test]
    fn what_a_robot_says_reads_back_and_a_wrong_word_of_it_is_told() {
        let check_in = CheckIn {
            nonce: 9,
            generation: 5,
            is_durable: true,
            level: StopLevel::Halt,
            is_still: true,
            inside: vec![stop().stop_id],
            awaiting: vec![stop().stop_id],
            stage: Stage::Slow,
            around: Around::Robots,
        };
        let robot_id = RobotId::parse("r1").expect("an id");
        let more = vec![StopId::parse("STOP-20260601-ABCDEFGHJL").expect("an id")];
        let said = [
            ToStop::CheckIn(check_in),
            ToStop::Attend { robot_id, boot_id: "b".to_owned(), stops: vec![stop()], more },
        ];
        for said in said {
            assert_eq!(parse::<ToStop, _>(v1::AttendRequest::from(&said)), Ok(said));
        }
        let message = Some(v1::attend_request::Message::CheckIn(v1::CheckIn::default()));
        let refusal = parse::<ToStop, _>(v1::AttendRequest { message }).expect_err("neither level nor stage");
        let fields: Vec<_> = refusal.violations.iter().map(|violation| violation.field.as_str()).collect();
        assert_eq!(fields, ["check_in.obeys", "check_in.silence"]);
    }

    #[test]
    fn a_stop_hears_every_rule_it_breaks() {
        for level in [0, StopLevel::None.to_wire()] {
            let (stop_id, reason) = ("?".to_owned(), "x".repeat(300));
            let wire = v1::Stop { stop_id, scope: None, level, reason, ..(&stop()).into() };
            let refusal = parse::<Stop, _>(wire).expect_err("it breaks four rules");
            let said = format!("{refusal:?}");
            for field in ["stop_id", "scope", "level", "reason"] {
                assert!(said.contains(field), "{field}: {said}");
            }
        }
    }
}
