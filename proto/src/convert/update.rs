//! Software of a robot: section update and what the robot says of it.

use super::{At, Parse, WireEnum, counted, from_one, id, maybe, maybe_id, need, permille, word};
use crate::link::v1;
use midshift_core::ids::{BundleId, DrainId, RobotId, SetId};
use midshift_core::reason::Violations;
use midshift_core::update::{ActivationGrant, DesiredUpdate, UpdateEvent, UpdateReport};

/// Bytes of a directive's envelope.
const DIRECTIVE_BYTES_MAX: usize = 16 * 1024;

fn text(id: Option<&impl ToString>) -> String {
    id.map(ToString::to_string).unwrap_or_default()
}

impl From<&DesiredUpdate> for v1::DesiredUpdate {
    fn from(update: &DesiredUpdate) -> Self {
        Self {
            robot_id: update.robot_id.to_string(),
            generation: update.generation,
            goal: update.goal.to_wire(),
            directive: update.directive.clone(),
            drain_id: text(update.drain_id.as_ref()),
            grant: update.grant.as_ref().map(|grant| v1::ActivationGrant {
                grant_id: grant.grant_id,
                drain_id: grant.drain_id.to_string(),
                authority: Some((&grant.authority).into()),
            }),
            rate_bytes_s: update.rate_bytes_s,
            probation_ms: update.probation_ms,
        }
    }
}

impl Parse<ActivationGrant> for v1::ActivationGrant {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<ActivationGrant> {
        let grant_id = from_one(self.grant_id, at.field("grant_id"), bad);
        let drain_id = id(&self.drain_id, DrainId::parse, at.field("drain_id"), bad);
        let authority = need(self.authority, at.field("authority"), bad);
        Some(ActivationGrant { grant_id: grant_id?, drain_id: drain_id?, authority: authority? })
    }
}

impl Parse<DesiredUpdate> for v1::DesiredUpdate {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<DesiredUpdate> {
        let robot_id = id(&self.robot_id, RobotId::parse, at.field("robot_id"), bad);
        let generation = from_one(self.generation, at.field("generation"), bad);
        let goal = word(self.goal, at.field("goal"), bad);
        if self.directive.len() > DIRECTIVE_BYTES_MAX {
            bad.add(at.field("directive").to_string(), "must be at most 16384 bytes");
            return None;
        }
        let drain_id = maybe_id(&self.drain_id, DrainId::parse, at.field("drain_id"), bad);
        let grant = maybe(self.grant, at.field("grant"), bad);
        Some(DesiredUpdate {
            robot_id: robot_id?,
            generation: generation?,
            goal: goal?,
            directive: self.directive,
            drain_id: drain_id?,
            grant: grant?,
            rate_bytes_s: self.rate_bytes_s,
            probation_ms: self.probation_ms,
        })
    }
}

impl From<&UpdateReport> for v1::UpdateReport {
    fn from(report: &UpdateReport) -> Self {
        Self {
            state: report.state.to_wire(),
            directive_generation: report.directive_generation,
            bundle: report.bundle.to_string(),
            set: text(report.set.as_ref()),
            drain_id: text(report.drain_id.as_ref()),
            grant_id: report.grant_id,
            tries: report.tries,
            progress_permille: u32::from(report.progress_permille),
            reason: report.reason.as_ref().map(Into::into),
        }
    }
}

impl Parse<UpdateReport> for v1::UpdateReport {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<UpdateReport> {
        let state = word(self.state, at.field("state"), bad);
        let bundle = id(&self.bundle, BundleId::parse, at.field("bundle"), bad);
        let set = maybe_id(&self.set, SetId::parse, at.field("set"), bad);
        let drain_id = maybe_id(&self.drain_id, DrainId::parse, at.field("drain_id"), bad);
        let grant_id = counted(self.grant_id, at.field("grant_id"), bad);
        let progress_permille = permille(self.progress_permille, at.field("progress_permille"), bad);
        let reason = maybe(self.reason, at.field("reason"), bad);
        let directive_generation = counted(self.directive_generation, at.field("directive_generation"), bad);
        Some(UpdateReport {
            state: state?,
            bundle: bundle?,
            directive_generation: directive_generation?,
            set: set?,
            drain_id: drain_id?,
            grant_id: grant_id?,
            tries: self.tries,
            progress_permille: progress_permille?,
            reason: reason?,
        })
    }
}

impl From<&UpdateEvent> for v1::UpdateNews {
    fn from(event: &UpdateEvent) -> Self {
        use v1::update_news::News as W;
        let news = match event {
            UpdateEvent::Changed(report) => W::Changed(report.into()),
            UpdateEvent::DirectiveRefused { generation, reason } => {
                W::Refused(v1::DirectiveRefused { generation: *generation, reason: Some(reason.into()) })
            }
            UpdateEvent::Ready { drain_id, set } => {
                W::Ready(v1::ActivateRequest { drain_id: drain_id.to_string(), set: set.to_string() })
            }
        };
        Self { news: Some(news) }
    }
}

impl Parse<UpdateEvent> for v1::UpdateNews {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<UpdateEvent> {
        use v1::update_news::News as W;
        match self.news {
            Some(W::Changed(report)) => report.parse_at(at.field("changed"), bad).map(UpdateEvent::Changed),
            Some(W::Refused(refused)) => {
                let at = at.field("refused");
                let generation = from_one(refused.generation, at.field("generation"), bad);
                let reason = need(refused.reason, at.field("reason"), bad);
                Some(UpdateEvent::DirectiveRefused { generation: generation?, reason: reason? })
            }
            Some(W::Ready(ready)) => {
                let at = at.field("ready");
                let drain_id = id(&ready.drain_id, DrainId::parse, at.field("drain_id"), bad);
                let set = id(&ready.set, SetId::parse, at.field("set"), bad);
                Some(UpdateEvent::Ready { drain_id: drain_id?, set: set? })
            }
            None => {
                bad.add(at.field("news").to_string(), "is required, of a known kind");
                None
            }
        }
    }
}
