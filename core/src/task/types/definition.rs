//! A task type as a site registers it, and the rows of the table that holds them.
//!
//! Invariant: the row of a deleted type stays, without what it said, so that a revision of its name never means two things.

use super::super::raw::name_ok;
use super::field::{FieldKind, TypeField, check_sentence};
use crate::ids::WaypointId;
use crate::limits;
use crate::reason::Violations;
use crate::rows::{Record, Table, body_is_json};
use crate::step::Effect;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Id of the row that says whether only known types are taken: no name of a type.
pub const RULES_ID: &str = "*";

/// A registered task type.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TaskType {
    /// As tasks name it: 1-64 of [a-z0-9-_].
    pub name: String,
    /// What such a task does, as a sentence, 1-256 bytes.
    pub description: String,
    /// What a task of it says, each name once, at most 32.
    pub fields: Vec<TypeField>,
    /// What is done, in order, 1..=64 steps.
    pub steps: Vec<StepTemplate>,
    /// Timeout of tasks that say none, milliseconds of site time. None: each must say one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout_ms: Option<u64>,
}

/// A step that is made of fields.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StepTemplate {
    /// What is done in it.
    pub kind: TemplateKind,
    /// What may happen if nobody knows whether it was done. None: by what is done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effect: Option<Effect>,
}

/// What is done in a step that is made of fields.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TemplateKind {
    /// Drive to a waypoint.
    Goto {
        /// The field that names it.
        field: String,
    },
    /// Do something where the robot stands.
    Action {
        /// Name of the action.
        name: String,
        /// Which field each parameter takes its value from.
        params: BTreeMap<String, String>,
    },
    /// Stand where the robot is.
    Wait {
        /// The field that says how long: a whole number with the unit `s` or `ms`.
        field: String,
    },
}

/// Whether a site takes tasks of types that it does not know.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeRules {
    /// Only types that are built in or registered are taken.
    pub known_only: bool,
}

/// One row of the table of task types.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskTypeRow {
    /// A registered type.
    Type(TaskType),
    /// A name that was a type.
    Deleted {
        /// The name.
        name: String,
        /// UTC of the wall, unix ms, since when it is none.
        at_unix_ms: i64,
    },
    /// Whether only known types are taken. One row at most.
    Rules(TypeRules),
}

impl Record for TaskTypeRow {
    const TABLE: Table = Table::TaskType;
    body_is_json!();
    fn id(&self) -> String {
        match self {
            Self::Type(of) => of.name.clone(),
            Self::Deleted { name, .. } => name.clone(),
            Self::Rules(_) => RULES_ID.to_owned(),
        }
    }
}

impl TaskType {
    /// The field of this name.
    pub fn field(&self, name: &str) -> Option<&TypeField> {
        self.fields.iter().find(|field| field.name == name)
    }

    /// Notes every rule that the type breaks, under `at`. `knows` answers whether the site has a waypoint.
    pub fn check(&self, at: &str, knows: &dyn Fn(&WaypointId) -> bool, bad: &mut Violations) {
        if !name_ok(&self.name) {
            bad.add(format!("{at}.name"), "is required, 1-64 of [a-z0-9-_]");
        }
        check_sentence(&self.description, &format!("{at}.description"), bad);
        if self.timeout_ms.is_some_and(|ms| !limits::TASK_TIMEOUT_MS.contains(&ms)) {
            bad.add(format!("{at}.timeout"), "must be 1 s .. 24 h");
        }
        if self.fields.len() > limits::TYPE_FIELDS_MAX {
            bad.add(format!("{at}.fields"), "must be at most 32");
        }
        let mut seen = BTreeSet::new();
        for (i, field) in self.fields.iter().enumerate().take(limits::TYPE_FIELDS_MAX) {
            let at = format!("{at}.fields[{i}]");
            field.check(&at, knows, bad);
            if !seen.insert(&field.name) {
                bad.add(format!("{at}.name"), "stands there twice");
            }
            if !self.steps.iter().any(|step| step.fields().any(|name| *name == field.name)) {
                bad.add(at, format!("is read by no step: let one read {:?}, or leave the field out", field.name));
            }
        }
        if !(1..=limits::STEPS_MAX).contains(&self.steps.len()) {
            bad.add(format!("{at}.steps"), "must be 1..64 steps");
        }
        for (i, step) in self.steps.iter().enumerate().take(limits::STEPS_MAX) {
            self.check_step(step, &format!("{at}.steps[{i}]"), bad);
        }
        if self.bytes() > limits::TASK_TYPE_BYTES_MAX {
            bad.add(at, "must be at most 16 KiB as JSON");
        }
    }

    fn bytes(&self) -> usize {
        serde_json::to_string(self).map_or(usize::MAX, |json| json.len())
    }

    fn check_step(&self, step: &StepTemplate, at: &str, bad: &mut Violations) {
        match &step.kind {
            TemplateKind::Goto { field } => {
                let is_fit = |kind: &FieldKind| *kind == FieldKind::Waypoint;
                self.check_reference(field, is_fit, "a waypoint", &format!("{at}.goto.field"), bad);
            }
            TemplateKind::Wait { field } => {
                let is_fit = |kind: &FieldKind| is_time(kind);
                let what = "a whole number with the unit s or ms, within 1 ms .. 24 h";
                self.check_reference(field, is_fit, what, &format!("{at}.wait.field"), bad);
            }
            TemplateKind::Action { name, params } => {
                if !name_ok(name) {
                    bad.add(format!("{at}.action.name"), "is required, 1-64 of [a-z0-9-_]");
                }
                for (param, field) in params {
                    if !(1..=64).contains(&param.len()) || param.chars().any(char::is_control) {
                        bad.add(format!("{at}.action.params"), "must have names of 1-64 bytes");
                    }
                    let at = format!("{at}.action.params[{}]", shown(param));
                    self.check_reference(field, |_| true, "a value", &at, bad);
                }
            }
        }
    }

    fn check_reference(
        &self,
        name: &str,
        is_fit: impl Fn(&FieldKind) -> bool,
        what: &str,
        at: &str,
        bad: &mut Violations,
    ) {
        match self.field(name) {
            None => bad.add(at, format!("{:?} is no field of the type", shown(name))),
            Some(field) if !is_fit(&field.kind) => {
                bad.add(at, format!("{name:?} must be {what}, and is {}", field.kind));
            }
            Some(_) => {}
        }
    }
}

impl StepTemplate {
    /// The fields that it reads.
    pub fn fields(&self) -> impl Iterator<Item = &String> {
        let (one, many) = match &self.kind {
            TemplateKind::Goto { field } | TemplateKind::Wait { field } => (Some(field), None),
            TemplateKind::Action { params, .. } => (None, Some(params.values())),
        };
        one.into_iter().chain(many.into_iter().flatten())
    }
}

/// Whether each value of this kind is a time that a robot may wait.
fn is_time(kind: &FieldKind) -> bool {
    const WAIT_MS: std::ops::RangeInclusive<i64> = 1..=86_400_000;
    let FieldKind::Integer { least, most, .. } = kind else { return false };
    let within = |bound: &i64, unit: i64| WAIT_MS.contains(&bound.saturating_mul(unit));
    kind.unit_ms().is_some_and(|unit| within(least, unit) && within(most, unit))
}

/// A name that somebody sent, short enough to be shown.
pub(super) fn shown(name: &str) -> &str {
    &name[..name.floor_char_boundary(64)]
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use serde_json::json;

    /// A type with a field of each kind.
    pub fn shelf_scan() -> TaskType {
        let field =
            |name: &str, kind, default| TypeField { name: name.into(), description: "A field.".into(), kind, default };
        let integer = |least, most, unit: &str| FieldKind::Integer { least, most, unit: unit.into() };
        let step = |kind| StepTemplate { kind, effect: None };
        let params = ["height_mm", "zoom", "side", "note"].map(|name| (name.to_owned(), name.to_owned()));
        TaskType {
            name: "shelf-scan".into(),
            description: "Reads the labels of a shelf.".into(),
            fields: vec![
                field("shelf", FieldKind::Waypoint, None),
                field("height_mm", integer(0, 2_000, "mm"), Some(json!(1_200))),
                field("zoom", FieldKind::Number { least: 1.0, most: 4.0, unit: String::new() }, Some(json!(1))),
                field("side", FieldKind::Choice { choices: vec!["left".into(), "right".into()] }, None),
                field("note", FieldKind::Text { max_bytes: 8 }, Some(json!(""))),
                field("settle_s", integer(1, 60, "s"), Some(json!(2))),
            ],
            steps: vec![
                step(TemplateKind::Goto { field: "shelf".into() }),
                step(TemplateKind::Wait { field: "settle_s".into() }),
                StepTemplate {
                    kind: TemplateKind::Action { name: "scan".into(), params: params.into() },
                    effect: Some(Effect::Repeatable),
                },
            ],
            timeout_ms: Some(300_000),
        }
    }

    fn told(of: &TaskType) -> Vec<String> {
        let mut bad = Violations::default();
        of.check("type", &|_| true, &mut bad);
        bad.0.into_iter().map(|v| v.field).collect()
    }

    #[test]
    fn a_good_type_breaks_no_rule_and_every_broken_rule_is_told_at_once() {
        let good = shelf_scan();
        assert_eq!(told(&good), Vec::<String>::new());
        let mut bad = good.clone();
        (bad.name, bad.description, bad.timeout_ms) = ("Shelf".into(), String::new(), Some(999));
        bad.fields[1].name = "shelf".into();
        bad.steps[0].kind = TemplateKind::Goto { field: "side".into() };
        bad.steps[1].kind = TemplateKind::Wait { field: "zoom".into() };
        bad.steps.push(StepTemplate {
            kind: TemplateKind::Action { name: "No".into(), params: [("p".into(), "nothing".into())].into() },
            effect: None,
        });
        let fields = [
            "name",
            "description",
            "timeout",
            "fields[0]",
            "fields[1].name",
            "fields[1]",
            "fields[5]",
            "steps[0].goto.field",
            "steps[1].wait.field",
            "steps[2].action.params[height_mm]",
            "steps[3].action.name",
            "steps[3].action.params[p]",
        ];
        assert_eq!(told(&bad), fields.map(|field| format!("type.{field}")));
    }

    #[test]
    fn a_type_without_steps_with_too_many_fields_or_too_large_is_refused() {
        let good = shelf_scan();
        let stepless = TaskType { steps: Vec::new(), fields: Vec::new(), ..good.clone() };
        assert_eq!(told(&stepless), ["type.steps"]);
        let many =
            TaskType { steps: vec![good.steps[0].clone(); 65], fields: vec![good.fields[0].clone()], ..good.clone() };
        assert_eq!(told(&many), ["type.steps"]);
        let crowded = TaskType { fields: vec![good.fields[0].clone(); 33], ..good.clone() };
        assert!(told(&crowded).contains(&"type.fields".to_owned()));
        let mut large = good;
        let words = (0..32).map(|n| format!("{n:064}")).collect::<Vec<_>>();
        for n in 0..10 {
            let (kind, name) = (FieldKind::Choice { choices: words.clone() }, format!("c{n}"));
            let TemplateKind::Action { params, .. } = &mut large.steps[2].kind else { panic!("an action") };
            params.insert(name.clone(), name.clone());
            large.fields.push(TypeField { name, description: "Words.".into(), kind, default: None });
        }
        assert_eq!(told(&large), ["type"]);
    }

    #[test]
    fn a_wait_is_made_of_a_time_that_a_robot_may_wait_and_of_nothing_else() {
        let integer = |least, most, unit: &str| FieldKind::Integer { least, most, unit: unit.into() };
        for kind in [integer(1, 86_400, "s"), integer(1, 86_400_000, "ms")] {
            assert!(is_time(&kind), "{kind}");
        }
        for kind in [integer(0, 60, "s"), integer(1, 86_401, "s"), integer(1, 60, "min"), FieldKind::Waypoint] {
            assert!(!is_time(&kind), "{kind}");
        }
    }
}
