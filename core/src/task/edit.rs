//! What people change of a task while no robot has it. It shadows what was asked for, which stays as it was.

use crate::audit::Note;
use crate::ids::RobotId;
use crate::time::Utc;
use serde::{Deserialize, Deserializer, Serialize};

/// What is changed. An outer none leaves a field as it is; an inner none takes its value away, and is null in rows.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskEdit {
    /// 0 most urgent ..= 9.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub priority: Option<u8>,
    /// UTC; inner none: at once.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    pub not_before: Option<Option<Utc>>,
    /// UTC; inner none: never worthless.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    pub deadline: Option<Option<Utc>>,
    /// The only robot; inner none: any that is able.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    pub robot_id: Option<Option<RobotId>>,
}

/// A field that stands there, be it null.
fn given<'de, D: Deserializer<'de>, T: Deserialize<'de>>(field: D) -> Result<Option<Option<T>>, D::Error> {
    Option::deserialize(field).map(Some)
}

impl TaskEdit {
    /// Whether it changes nothing.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
    /// This one, and `later` after it.
    #[must_use]
    pub fn and_then(self, later: Self) -> Self {
        Self {
            priority: later.priority.or(self.priority),
            not_before: later.not_before.or(self.not_before),
            deadline: later.deadline.or(self.deadline),
            robot_id: later.robot_id.or(self.robot_id),
        }
    }
    /// Names of the fields that change.
    pub fn fields(&self) -> impl Iterator<Item = &'static str> {
        let changed = [
            ("priority", self.priority.is_some()),
            ("robot_id", self.robot_id.is_some()),
            ("not_before", self.not_before.is_some()),
            ("deadline", self.deadline.is_some()),
        ];
        changed.into_iter().filter(|(_, is_changed)| *is_changed).map(|(name, _)| name)
    }
    /// Adds to a note what changes; a value that is taken away is empty.
    pub fn note(&self, note: Note) -> Note {
        let time = |at: Option<Utc>| at.map(Utc::rfc3339).unwrap_or_default();
        let robot = |id: &Option<RobotId>| id.as_ref().map(ToString::to_string).unwrap_or_default();
        let changed = [
            ("priority", self.priority.map(|priority| priority.to_string())),
            ("not_before", self.not_before.map(time)),
            ("deadline", self.deadline.map(time)),
            ("robot_id", self.robot_id.as_ref().map(robot)),
        ];
        changed
            .into_iter()
            .filter_map(|(name, value)| Some((name, value?)))
            .fold(note, |note, (name, value)| note.with(name, value))
    }
}

/// Whether a task that may begin at `not_before` can end by `deadline`.
pub fn is_in_order(not_before: Option<Utc>, deadline: Option<Utc>) -> bool {
    not_before.zip(deadline).is_none_or(|(from, until)| until > from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_that_is_taken_away_is_told_from_one_that_stays_as_it_is_in_rows_too() {
        let edit = TaskEdit { deadline: Some(None), robot_id: Some(None), priority: Some(1), ..TaskEdit::default() };
        let text = serde_json::to_string(&edit).expect("JSON");
        assert_eq!(text, r#"{"priority":1,"deadline":null,"robot_id":null}"#);
        assert_eq!(serde_json::from_str::<TaskEdit>(&text).expect("an edit"), edit);
        assert_eq!(serde_json::from_str::<TaskEdit>("{}").expect("an edit"), TaskEdit::default());
    }

    #[test]
    fn a_later_change_goes_before_an_earlier_one_of_the_same_field_alone() {
        let first = TaskEdit { priority: Some(1), deadline: Some(Some(Utc(5))), ..TaskEdit::default() };
        let later = TaskEdit { deadline: Some(None), not_before: Some(Some(Utc(3))), ..TaskEdit::default() };
        let both = first.and_then(later);
        assert_eq!((both.priority, both.deadline, both.not_before), (Some(1), Some(None), Some(Some(Utc(3)))));
    }
}
