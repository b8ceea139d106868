//! Task types: what people put becomes a type that broke no rule, what the rows say becomes messages.

use super::{At, WireEnum, common, duration, enums, parse_ms, task::etag, to_struct};
use crate::task::v1;
use midshift_core::ids::WaypointId;
use midshift_core::reason::Violations;
use midshift_core::rows::Revision;
use midshift_core::step::Effect;
use midshift_core::task::types::catalogue::BUILT_IN;
use midshift_core::task::types::definition::TypeRules;
use midshift_core::task::types::{FieldKind, StepTemplate, TaskType, TemplateKind, TypeCatalogue, TypeField};
use serde_json::{Map, Value};

/// A type that somebody puts. None if and only if a rule is broken; each is noted. `knows` answers whether the site
/// has a waypoint.
pub fn parse_task_type(
    wire: v1::TaskType,
    at: At<'_>,
    knows: &dyn Fn(&WaypointId) -> bool,
    bad: &mut Violations,
) -> Option<TaskType> {
    let before = bad.0.len();
    let (fields_at, steps_at) = (at.field("fields"), at.field("steps"));
    let fields = wire.fields.into_iter().enumerate();
    let fields: Vec<_> = fields.map(|(i, field)| parse_field(field, fields_at.index(i), bad)).collect();
    let steps = wire.steps.into_iter().enumerate();
    let steps: Vec<_> = steps.map(|(i, step)| parse_step(step, steps_at.index(i), bad)).collect();
    let timeout_ms = parse_ms(wire.timeout.as_ref(), at.field("timeout"), bad);
    // Beside a field or step of no kind nothing can be said of which reads which.
    let of = TaskType {
        name: wire.name,
        description: wire.description,
        fields: fields.into_iter().collect::<Option<_>>()?,
        steps: steps.into_iter().collect::<Option<_>>()?,
        timeout_ms: timeout_ms.map(|ms| u64::try_from(ms).unwrap_or(0)),
    };
    of.check(&at.to_string(), knows, bad);
    (bad.0.len() == before).then_some(of)
}

/// Which values a field takes. None: its kind is missing, or of a newer version.
pub fn kind_of(field: &v1::TaskTypeField) -> Option<FieldKind> {
    use v1::task_type_field::Kind;
    Some(match field.kind.clone()? {
        Kind::Waypoint(v1::WaypointKind {}) => FieldKind::Waypoint,
        Kind::Integer(v1::IntegerKind { least, most, unit }) => FieldKind::Integer { least, most, unit },
        Kind::Number(v1::NumberKind { least, most, unit }) => FieldKind::Number { least, most, unit },
        Kind::Text(v1::TextKind { max_bytes }) => FieldKind::Text { max_bytes },
        Kind::Choice(v1::ChoiceKind { choices }) => FieldKind::Choice { choices },
    })
}

fn parse_field(wire: v1::TaskTypeField, at: At<'_>, bad: &mut Violations) -> Option<TypeField> {
    let Some(kind) = kind_of(&wire) else {
        bad.add(at.to_string(), "must be one of waypoint, integer, number, text, choice");
        return None;
    };
    let default = match wire.default {
        Some(value) => Some(common::from_value(value, at.field("default"), bad)?),
        None => None,
    };
    Some(TypeField { name: wire.name, description: wire.description, kind, default })
}

fn parse_step(wire: v1::TaskTypeStep, at: At<'_>, bad: &mut Violations) -> Option<StepTemplate> {
    use v1::task_type_step::Kind;
    let kind = match wire.kind {
        Some(Kind::Goto(v1::GotoTemplate { field })) => TemplateKind::Goto { field },
        Some(Kind::Action(v1::ActionTemplate { name, params })) => {
            TemplateKind::Action { name, params: params.into_iter().collect() }
        }
        Some(Kind::Wait(v1::WaitTemplate { field })) => TemplateKind::Wait { field },
        None => {
            bad.add(at.to_string(), "must be one of goto, action, wait");
            return None;
        }
    };
    let effect = wire.effect.map(|number| {
        let effect = Effect::from_wire(number);
        if effect.is_none() {
            bad.add(at.field("effect").to_string(), "UNSPECIFIED is not a value; leave it out for the default");
        }
        effect
    });
    Some(StepTemplate { kind, effect: effect.flatten() })
}

/// A registered type with the revision of its row.
pub fn encode_task_type(of: &TaskType, revision: Option<Revision>) -> v1::TaskType {
    v1::TaskType {
        name: of.name.clone(),
        description: of.description.clone(),
        fields: of.fields.iter().map(encode_field).collect(),
        steps: of.steps.iter().map(encode_step).collect(),
        timeout: of.timeout_ms.map(duration),
        etag: revision.map(etag).unwrap_or_default(),
    }
}

fn encode_field(field: &TypeField) -> v1::TaskTypeField {
    use v1::task_type_field::Kind;
    let kind = match field.kind.clone() {
        FieldKind::Waypoint => Kind::Waypoint(v1::WaypointKind {}),
        FieldKind::Integer { least, most, unit } => Kind::Integer(v1::IntegerKind { least, most, unit }),
        FieldKind::Number { least, most, unit } => Kind::Number(v1::NumberKind { least, most, unit }),
        FieldKind::Text { max_bytes } => Kind::Text(v1::TextKind { max_bytes }),
        FieldKind::Choice { choices } => Kind::Choice(v1::ChoiceKind { choices }),
    };
    let (name, description) = (field.name.clone(), field.description.clone());
    v1::TaskTypeField { name, description, kind: Some(kind), default: field.default.as_ref().and_then(encode_value) }
}

/// A value as the wire has it.
fn encode_value(value: &Value) -> Option<prost_types::Value> {
    let whole = Map::from_iter([("value".to_owned(), value.clone())]);
    to_struct(&whole).fields.remove("value")
}

fn encode_step(step: &StepTemplate) -> v1::TaskTypeStep {
    use v1::task_type_step::Kind;
    let kind = match step.kind.clone() {
        TemplateKind::Goto { field } => Kind::Goto(v1::GotoTemplate { field }),
        TemplateKind::Action { name, params } => Kind::Action(v1::ActionTemplate { name, params }),
        TemplateKind::Wait { field } => Kind::Wait(v1::WaitTemplate { field }),
    };
    v1::TaskTypeStep { kind: Some(kind), effect: step.effect.map(enums::step_effect) }
}

/// Which types a site takes beside those that it knows.
pub fn encode_rules(rules: Option<(TypeRules, Revision)>) -> v1::TaskTypeRules {
    v1::TaskTypeRules {
        known_only: rules.is_some_and(|(rules, _)| rules.known_only),
        etag: rules.map(|(_, revision)| etag(revision)).unwrap_or_default(),
    }
}

/// All types of a site.
pub fn encode_catalogue(types: &TypeCatalogue) -> v1::ListTaskTypesResponse {
    let built_in = BUILT_IN.iter().map(|(name, description)| v1::BuiltInType {
        name: (*name).to_owned(),
        description: (*description).to_owned(),
    });
    v1::ListTaskTypesResponse {
        types: types.types().map(|(of, revision)| encode_task_type(of, Some(*revision))).collect(),
        built_in: built_in.collect(),
        rules: Some(encode_rules(types.rules())),
    }
}
