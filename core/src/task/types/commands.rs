//! What people change of the task types of a site, and whether it may be: put a type, delete one, take known types alone.
//!
//! Invariant: a change is of one row, over the revision that was decided on. Sent again it changes nothing.

use super::catalogue::{TypeCatalogue, is_built_in};
use super::definition::{RULES_ID, TaskType, TaskTypeRow, TypeRules};
use crate::audit::Note;
use crate::item::{Expect, Item};
use crate::limits;
use crate::nearest;
use crate::reason::{Code, Kind, Reason, Refusal};
use crate::rows::{Key, Record, Revision};
use crate::time::{Now, Utc};

/// What a person asks of the task types of a site.
#[derive(Clone, Debug, PartialEq)]
pub enum TypeCommand {
    /// Registers a type that passed its check, or changes it.
    Put(TaskType),
    /// Deletes the type of this name. Tasks that were made of it stay.
    Delete(String),
    /// Says whether only known types are taken.
    PutRules(TypeRules),
}

impl TypeCommand {
    /// What it leaves in the audit.
    pub fn note(&self) -> Note {
        match self {
            Self::Put(of) => Note::new("task_type.put")
                .about("task_type", &of.name)
                .with("type", TaskTypeRow::Type(of.clone()).body()),
            Self::Delete(name) => Note::new("task_type.delete").about("task_type", name),
            Self::PutRules(rules) => {
                Note::new("task_type.put_rules").about("task_type", RULES_ID).with("known_only", rules.known_only)
            }
        }
    }

    /// Id of the row that it changes.
    fn id(&self) -> &str {
        match self {
            Self::Put(of) => &of.name,
            Self::Delete(name) => name,
            Self::PutRules(_) => RULES_ID,
        }
    }

    /// Adds the change to an item; nothing where all is so already. `seen`: the revision that the caller saw.
    ///
    /// # Errors
    /// The row moved since, is of a newer version or is not there, or there are too many.
    pub fn add_to(
        &self,
        item: &mut Item,
        types: &TypeCatalogue,
        seen: Option<Revision>,
        now: &Now,
    ) -> Result<(), Refusal> {
        if let Some(reason) = types.unread(self.id()) {
            return Err(Refusal::new(Kind::Precondition, reason.clone()));
        }
        match self {
            Self::Put(of) => put_type(of, item, types, seen, now),
            Self::Delete(name) => delete_type(name, item, types, seen, now),
            Self::PutRules(rules) => {
                let known = types.rules();
                if known.map(|(known, _)| known).unwrap_or_default() != *rules {
                    check_seen(seen, known.map(|(_, revision)| revision))?;
                    let expect = known.map_or(Expect::Absent, |(_, revision)| Expect::At(revision));
                    item.put_row(&TaskTypeRow::Rules(*rules), expect, "task_type.rules_put");
                }
                Ok(())
            }
        }
    }
}

fn check_seen(seen: Option<Revision>, current: Option<Revision>) -> Result<(), Refusal> {
    let current = current.unwrap_or_default();
    match seen {
        Some(seen) if seen != current => {
            Err(Refusal::new(Kind::Conflict, Reason::from(Code::EtagMismatch).with("etag", current.0)))
        }
        _ => Ok(()),
    }
}

fn put_type(
    of: &TaskType,
    item: &mut Item,
    types: &TypeCatalogue,
    seen: Option<Revision>,
    now: &Now,
) -> Result<(), Refusal> {
    let known = types.find(&of.name);
    if known.is_some_and(|(known, _)| known == of) {
        return Ok(());
    }
    check_seen(seen, known.map(|(_, revision)| *revision))?;
    let was = types.deleted().get(&of.name);
    if known.is_none() {
        if types.count() >= limits::TASK_TYPES_MAX {
            return Err(Refusal::new(Kind::Precondition, Code::TaskTypesFull));
        }
        if was.is_none() && types.count() + types.deleted().len() >= limits::TASK_TYPE_NAMES_MAX {
            let (name, revision) =
                oldest_past(types, now).ok_or_else(|| Refusal::new(Kind::Precondition, Code::TaskTypesFull))?;
            item.delete(Key::new(TaskTypeRow::TABLE, name), revision, "task_type.forgotten");
        }
    }
    let current = known.map(|(_, revision)| *revision).or_else(|| was.map(|(_, revision)| *revision));
    item.put_row(&TaskTypeRow::Type(of.clone()), current.map_or(Expect::Absent, Expect::At), "task_type.put");
    Ok(())
}

/// The name that was deleted first, if that is so long ago that nobody remembers a revision of it.
fn oldest_past<'a>(types: &'a TypeCatalogue, now: &Now) -> Option<(&'a str, Revision)> {
    let (name, (at, revision)) = types.deleted().iter().min_by_key(|(_, (at, _))| *at)?;
    let is_past = now.steady_wall().ms_since(Utc(*at)) > limits::GONE_KEPT.as_ms();
    is_past.then_some((name, *revision))
}

fn delete_type(
    name: &str,
    item: &mut Item,
    types: &TypeCatalogue,
    seen: Option<Revision>,
    now: &Now,
) -> Result<(), Refusal> {
    if types.deleted().contains_key(name) {
        return Ok(());
    }
    let Some((_, revision)) = types.find(name) else {
        let reason = Reason::from(Code::TaskTypeNotFound).with("type", super::definition::shown(name));
        let names = types.types().map(|(of, _)| of.name.as_str());
        let meant: Vec<&str> = nearest::nearest(name, names).collect();
        let reason = match meant.as_slice() {
            _ if is_built_in(name) => Reason::new(Code::TaskTypeNotFound, format!("{name} is built in and stays.")),
            [] => reason,
            meant => {
                let text = format!("The site has no such task type registered; did you mean {}?", meant.join(" or "));
                Reason::new(Code::TaskTypeNotFound, text).with("type", super::definition::shown(name))
            }
        };
        return Err(Refusal::new(Kind::NotFound, reason));
    };
    check_seen(seen, Some(*revision))?;
    let row = TaskTypeRow::Deleted { name: name.to_owned(), at_unix_ms: now.wall.0 };
    item.update(&row, *revision, "task_type.deleted");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::catalogue::tests::row;
    use super::super::definition::tests::shelf_scan;
    use super::*;
    use crate::item::Write;
    use crate::rows::{Row, Writer};

    const NOW: i64 = 1_800_000_000_000;

    fn decided(command: &TypeCommand, rows: &[Row], seen: Option<u64>) -> Result<Vec<(String, Expect, bool)>, Code> {
        let types = TypeCatalogue::from_rows(rows).expect("good rows");
        let now = Now { wall: Utc(NOW), utc: Utc(NOW), ..Now::default() };
        let mut item = Item::new(Writer::Task, "anna");
        command.add_to(&mut item, &types, seen.map(Revision), &now).map_err(|refusal| refusal.reason.code)?;
        let change = |row: crate::item::RowChange| (row.key.id.to_string(), row.expect, row.write == Write::Delete);
        Ok(item.rows.into_iter().map(change).collect())
    }

    fn make_type(name: &str) -> TaskType {
        TaskType { name: name.to_owned(), ..shelf_scan() }
    }
    fn deleted(name: &str, at_unix_ms: i64) -> TaskTypeRow {
        TaskTypeRow::Deleted { name: name.to_owned(), at_unix_ms }
    }

    #[test]
    fn a_type_is_put_over_the_revision_that_was_seen_and_changes_nothing_when_it_is_there() {
        let (put, changed) = (TypeCommand::Put(make_type("scan")), TaskType { timeout_ms: None, ..make_type("scan") });
        let there = [row(&TaskTypeRow::Type(make_type("scan")), 3)];
        let at = |expect| Ok(vec![("scan".to_owned(), expect, false)]);
        assert_eq!(decided(&put, &[], None), at(Expect::Absent));
        assert_eq!(decided(&put, &[], Some(1)), Err(Code::EtagMismatch));
        assert_eq!(decided(&put, &there, Some(1)), Ok(vec![]), "it is so already");
        let put = TypeCommand::Put(changed);
        assert_eq!(decided(&put, &there, Some(2)), Err(Code::EtagMismatch));
        assert_eq!(decided(&put, &there, Some(3)), at(Expect::At(Revision(3))));
        let was = [row(&deleted("scan", NOW), 4)];
        assert_eq!(decided(&put, &was, None), at(Expect::At(Revision(4))), "revisions of a name go on");
        assert_eq!(decided(&put, &was, Some(4)), Err(Code::EtagMismatch), "nobody saw a type at that revision");
    }

    #[test]
    fn a_type_is_deleted_once_and_its_name_stays() {
        let delete = TypeCommand::Delete("scan".into());
        let there = [row(&TaskTypeRow::Type(make_type("scan")), 3)];
        assert_eq!(decided(&delete, &there, Some(2)), Err(Code::EtagMismatch));
        assert_eq!(decided(&delete, &there, None), Ok(vec![("scan".to_owned(), Expect::At(Revision(3)), false)]));
        assert_eq!(decided(&delete, &[row(&deleted("scan", NOW), 4)], None), Ok(vec![]));
        assert_eq!(decided(&delete, &[], None), Err(Code::TaskTypeNotFound));
        assert_eq!(decided(&TypeCommand::Delete("transport".into()), &[], None), Err(Code::TaskTypeNotFound));
    }

    #[test]
    fn rules_are_one_row_and_the_default_is_that_of_no_row() {
        let rules = |known_only| TypeCommand::PutRules(TypeRules { known_only });
        assert_eq!(decided(&rules(false), &[], None), Ok(vec![]));
        assert_eq!(decided(&rules(true), &[], None), Ok(vec![("*".to_owned(), Expect::Absent, false)]));
        let there = [row(&TaskTypeRow::Rules(TypeRules { known_only: true }), 2)];
        assert_eq!(decided(&rules(true), &there, None), Ok(vec![]));
        assert_eq!(decided(&rules(false), &there, Some(1)), Err(Code::EtagMismatch));
        assert_eq!(decided(&rules(false), &there, Some(2)), Ok(vec![("*".to_owned(), Expect::At(Revision(2)), false)]));
    }

    #[test]
    fn there_are_so_many_types_at_once_and_so_many_names() {
        let put = TypeCommand::Put(make_type("scan"));
        let types = (0..limits::TASK_TYPES_MAX).map(|n| row(&TaskTypeRow::Type(make_type(&format!("t{n}"))), 1));
        let types: Vec<Row> = types.collect();
        assert_eq!(decided(&put, &types, None), Err(Code::TaskTypesFull));
        assert!(decided(&TypeCommand::Put(TaskType { timeout_ms: None, ..make_type("t0") }), &types, None).is_ok());
        let names = |at: i64| -> Vec<Row> {
            let was = |n: usize| row(&deleted(&format!("d{n}"), at + n as i64), 2);
            (0..limits::TASK_TYPE_NAMES_MAX).map(was).collect()
        };
        assert_eq!(decided(&put, &names(NOW - 1_000), None), Err(Code::TaskTypesFull));
        let old = NOW - limits::GONE_KEPT.as_ms() as i64 - 1_000;
        let wanted = [("d0", Expect::At(Revision(2)), true), ("scan", Expect::Absent, false)];
        let wanted = wanted.map(|(id, expect, is_gone)| (id.to_owned(), expect, is_gone)).to_vec();
        assert_eq!(decided(&put, &names(old), None), Ok(wanted));
    }
}
