//! Makes the steps of a task of the fields that its type has.

use super::super::raw::{RawStep, RawStepKind, RawTask};
use super::definition::{StepTemplate, TaskType, TemplateKind, shown};
use super::field::TypeField;
use crate::ids::WaypointId;
use crate::nearest;
use crate::reason::Violations;
use serde_json::{Map, Value};

/// A task as a caller sent it by type and fields.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TypedTask {
    /// Its type and what else every task has; no steps.
    pub task: RawTask,
    /// What it says of the fields of its type, by name.
    pub fields: Map<String, Value>,
}

impl TypedTask {
    /// The task with the steps that its type makes of its fields. Without steps where a field breaks a rule: each is noted
    /// under `at`. `knows` answers whether the site has a waypoint.
    pub fn into_raw(
        self,
        of: &TaskType,
        at: &str,
        knows: &dyn Fn(&WaypointId) -> bool,
        bad: &mut Violations,
    ) -> RawTask {
        let values = read_fields(of, &self.fields, at, knows, bad);
        let steps = values.map(|values| of.steps.iter().filter_map(|step| make_step(step, of, &values)).collect());
        let timeout_ms = self.task.timeout_ms.or_else(|| of.timeout_ms.map(|ms| ms as i64));
        RawTask { steps: steps.unwrap_or_default(), timeout_ms, ..self.task }
    }
}

/// The value of each field; none: some break a rule, and each is noted.
fn read_fields(
    of: &TaskType,
    sent: &Map<String, Value>,
    at: &str,
    knows: &dyn Fn(&WaypointId) -> bool,
    bad: &mut Violations,
) -> Option<Map<String, Value>> {
    let before = bad.0.len();
    for name in sent.keys().filter(|name| of.field(name).is_none()) {
        bad.add(format!("{at}.{}", shown(name)), unknown_field(of, name));
    }
    let read = |field: &TypeField, bad: &mut Violations| {
        let value = match sent.get(&field.name).or(field.default.as_ref()) {
            Some(value) => field.kind.read(value, knows),
            None => Err(format!("is required, {}", field.kind)),
        };
        let value = bad.accept(&format!("{at}.{}", field.name), value)?;
        Some((field.name.clone(), value))
    };
    let values = of.fields.iter().filter_map(|field| read(field, bad)).collect();
    (bad.0.len() == before).then_some(values)
}

/// What is said of a field that a type does not have.
fn unknown_field(of: &TaskType, name: &str) -> String {
    let names = || of.fields.iter().map(|field| field.name.as_str());
    let meant: Vec<&str> = nearest::nearest(name, names()).collect();
    let hint = match (meant.as_slice(), of.fields.as_slice()) {
        ([], []) => "it has none".to_owned(),
        ([], _) => format!("its fields are {}", names().collect::<Vec<_>>().join(", ")),
        (meant, _) => format!("did you mean {}?", meant.join(" or ")),
    };
    format!("{} has no such field; {hint}", of.name)
}

/// One step. None: a field that it reads is not there, which the check of a type rules out.
fn make_step(step: &StepTemplate, of: &TaskType, values: &Map<String, Value>) -> Option<RawStep> {
    let kind = match &step.kind {
        TemplateKind::Goto { field } => RawStepKind::Goto(values.get(field)?.as_str()?.to_owned()),
        TemplateKind::Wait { field } => {
            let unit_ms = of.field(field)?.kind.unit_ms()?;
            RawStepKind::Wait(values.get(field)?.as_i64()?.saturating_mul(unit_ms))
        }
        TemplateKind::Action { name, params } => {
            let params = params.iter().map(|(param, field)| Some((param.clone(), values.get(field)?.clone())));
            RawStepKind::Action(name.clone(), params.collect::<Option<_>>()?)
        }
    };
    Some(RawStep { kind: Some(kind), effect: step.effect.map(Some), ..RawStep::default() })
}

#[cfg(test)]
mod tests {
    use super::super::definition::tests::shelf_scan;
    use super::*;
    use crate::step::Effect;
    use serde_json::json;

    fn sent(fields: Value) -> TypedTask {
        let task = RawTask { kind: "shelf-scan".into(), ..RawTask::default() };
        TypedTask { task, fields: fields.as_object().expect("an object").clone() }
    }

    fn made(task: TypedTask) -> (RawTask, Vec<(String, String)>) {
        let mut bad = Violations::default();
        let raw = task.into_raw(&shelf_scan(), "typed.fields", &|waypoint| waypoint.as_str() == "A01", &mut bad);
        (raw, bad.0.into_iter().map(|v| (v.field, v.description)).collect())
    }

    #[test]
    fn steps_are_made_of_fields_and_of_the_defaults_of_those_that_were_not_sent() {
        let (raw, bad) = made(sent(json!({"shelf": "A01", "side": "left", "height_mm": "900"})));
        assert_eq!(bad, []);
        let kinds: Vec<_> = raw.steps.iter().map(|step| step.kind.clone().expect("a kind")).collect();
        let params = json!({"height_mm": 900, "zoom": 1, "side": "left", "note": ""});
        let params = params.as_object().expect("an object").clone();
        let wanted =
            [RawStepKind::Goto("A01".into()), RawStepKind::Wait(2_000), RawStepKind::Action("scan".into(), params)];
        assert_eq!(kinds, wanted);
        assert_eq!(raw.steps[2].effect, Some(Some(Effect::Repeatable)));
        assert_eq!(raw.timeout_ms, Some(300_000), "that of the type");
        let own = TypedTask { task: RawTask { timeout_ms: Some(1), ..RawTask::default() }, ..TypedTask::default() };
        assert_eq!(made(own).0.timeout_ms, Some(1));
    }

    #[test]
    fn every_field_that_breaks_a_rule_is_told_at_once_and_no_step_is_made() {
        let fields = json!({"shelf": "A99", "hieght_mm": 1, "colour": "red", "zoom": 9, "settle_s": 1.5});
        let (raw, bad) = made(sent(fields));
        let wanted = [
            ("colour", "shelf-scan has no such field; its fields are shelf, height_mm, zoom, side, note, settle_s"),
            ("hieght_mm", "shelf-scan has no such field; did you mean height_mm?"),
            ("shelf", "the site has no waypoint A99"),
            ("zoom", "must be a number, 1..4"),
            ("side", "is required, one of left, right"),
            ("settle_s", "must be a whole number, 1..60 s"),
        ];
        assert_eq!(bad, wanted.map(|(field, text)| (format!("typed.fields.{field}"), text.to_owned())));
        assert_eq!(raw.steps, []);
    }
}
