//! All task types of a site: built in, registered, and names that were types; and whether a type that a task names will do.
//!
//! Invariant: a type that is built in or registered is taken, whatever it is near to. One that is none, and near to none, is
//! a label that somebody chose, unless the site takes known types alone.

use super::definition::{RULES_ID, TaskType, TaskTypeRow, TypeRules};
use crate::nearest;
use crate::reason::{Kind, Reason, Refusal, Violations};
use crate::rows::{BadRow, Record, Revision, Row};
use crate::unknown_rows;
use std::collections::BTreeMap;

/// Names of types that are known everywhere, with what such a task does: those of the short forms, the command line and the
/// examples. They have no fields.
pub const BUILT_IN: [(&str, &str); 4] = [
    ("inspect", "Goes somewhere and looks at something."),
    ("patrol", "Drives along waypoints."),
    ("pick", "Fetches an item."),
    ("transport", "Brings an item from one waypoint to another."),
];
/// Types that are named to somebody who named an unknown one.
const NAMES_SHOWN: usize = 10;

/// All task types of a site as their rows were read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TypeCatalogue {
    types: BTreeMap<String, (TaskType, Revision)>,
    /// Names that were types, with the moment of the deletion, unix ms.
    deleted: BTreeMap<String, (i64, Revision)>,
    rules: Option<(TypeRules, Revision)>,
    /// Rows of a newer version, by their ids, with why they are kept aside.
    unread: BTreeMap<String, Reason>,
}

/// Whether a type of this name is known without any row.
pub fn is_built_in(name: &str) -> bool {
    BUILT_IN.iter().any(|(known, _)| *known == name)
}

impl TypeCatalogue {
    /// The types that these rows hold. A row of a newer version is kept aside: its name is known, and nothing is made of it.
    ///
    /// # Errors
    /// A row is damaged.
    pub fn from_rows(rows: &[Row]) -> Result<Self, BadRow> {
        let mut catalogue = Self::default();
        for row in rows.iter().filter(|row| row.key.table == TaskTypeRow::TABLE) {
            let id = row.key.id.to_string();
            match row.decode() {
                Ok(TaskTypeRow::Type(of)) => drop(catalogue.types.insert(id, (of, row.revision))),
                Ok(TaskTypeRow::Deleted { at_unix_ms, .. }) => {
                    catalogue.deleted.insert(id, (at_unix_ms, row.revision));
                }
                Ok(TaskTypeRow::Rules(rules)) => catalogue.rules = Some((rules, row.revision)),
                Err(error) if error.is_unknown() => {
                    catalogue.unread.insert(id, unknown_rows::reason(row, &error));
                }
                Err(error) => return Err(error),
            }
        }
        Ok(catalogue)
    }

    /// Registered types by name, each with the revision of its row.
    pub fn types(&self) -> impl Iterator<Item = &(TaskType, Revision)> {
        self.types.values()
    }
    /// How many types are registered, those of a newer version among them.
    pub fn count(&self) -> usize {
        self.types.len() + self.unread.keys().filter(|id| *id != RULES_ID).count()
    }
    /// The registered type of this name.
    pub fn find(&self, name: &str) -> Option<&(TaskType, Revision)> {
        self.types.get(name)
    }
    /// Names that were types, with the moment of the deletion (unix ms) and the revision of the row.
    pub fn deleted(&self) -> &BTreeMap<String, (i64, Revision)> {
        &self.deleted
    }
    /// Whether only known types are taken, with the revision of the row. None: nobody ever said.
    pub fn rules(&self) -> Option<(TypeRules, Revision)> {
        self.rules
    }
    /// Why the row of this id is kept aside. None: it is not.
    pub fn unread(&self, id: &str) -> Option<&Reason> {
        self.unread.get(id)
    }

    /// Every known name, in order.
    pub fn names(&self) -> Vec<&str> {
        let built_in = BUILT_IN.iter().map(|(name, _)| *name);
        let rows = self.types.keys().chain(self.unread.keys()).map(String::as_str).filter(|id| *id != RULES_ID);
        let mut names: Vec<&str> = built_in.chain(rows).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// Notes under `field` that a task names a type which the site does not know: one that is likely a slip, or any where
    /// only known types are taken.
    pub fn check_label(&self, name: &str, field: &str, bad: &mut Violations) {
        let names = self.names();
        if names.binary_search(&name).is_ok() {
            return;
        }
        let meant: Vec<&str> = nearest::misspelled(name, names.iter().copied()).collect();
        if !meant.is_empty() {
            bad.add(field, format!("{name:?} is no known type; did you mean {}?", meant.join(" or ")));
        } else if self.rules.is_some_and(|(rules, _)| rules.known_only) {
            bad.add(field, format!("{name:?} is no known type, and the site takes no other; {}", known(&names)));
        }
    }

    /// The type that a task is to be made of, with the revision of its row; none: there is none, which is noted under `field`.
    ///
    /// # Errors
    /// The type's row is of a newer version.
    pub fn find_for(
        &self,
        name: &str,
        field: &str,
        bad: &mut Violations,
    ) -> Result<Option<&(TaskType, Revision)>, Refusal> {
        if let Some(reason) = self.unread.get(name) {
            return Err(Refusal::new(Kind::Precondition, reason.clone()));
        }
        let found = self.types.get(name);
        if found.is_none() {
            bad.add(field, self.unregistered(name));
        }
        Ok(found)
    }

    /// What is said of a type that is not registered.
    fn unregistered(&self, name: &str) -> String {
        if is_built_in(name) {
            return format!(
                "{name} has no fields here: register a type of that name, or send it as flat, nested or spec"
            );
        }
        let names: Vec<&str> = self.types.keys().map(String::as_str).collect();
        let meant: Vec<&str> = nearest::nearest(name, names.iter().copied()).collect();
        match (names.as_slice(), meant.as_slice()) {
            ([], _) => "the site has no type registered; `midshift task type put FILE` registers one".to_owned(),
            (names, []) => format!("the site has no such type registered; {}", known(names)),
            (_, meant) => format!("the site has no such type registered; did you mean {}?", meant.join(" or ")),
        }
    }
}

fn known(names: &[&str]) -> String {
    let more = if names.len() > NAMES_SHOWN { ", and more: `midshift task type ls`" } else { "" };
    format!("it knows {}{more}", names[..names.len().min(NAMES_SHOWN)].join(", "))
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::definition::tests::shelf_scan;
    use super::*;
    use crate::rows::{Index, Key};

    pub fn row(of: &TaskTypeRow, revision: u64) -> Row {
        Row { key: of.key(), revision: Revision(revision), index: Index::default(), body: of.body() }
    }

    fn catalogue(names: &[&str], known_only: bool) -> TypeCatalogue {
        let of = |name: &&str| TaskTypeRow::Type(TaskType { name: (*name).to_owned(), ..shelf_scan() });
        let mut rows: Vec<Row> = names.iter().map(|name| row(&of(name), 1)).collect();
        rows.push(row(&TaskTypeRow::Rules(TypeRules { known_only }), 1));
        TypeCatalogue::from_rows(&rows).expect("good rows")
    }

    fn told(of: &TypeCatalogue, name: &str) -> Vec<String> {
        let mut bad = Violations::default();
        of.check_label(name, "type", &mut bad);
        bad.0.into_iter().map(|v| v.description).collect()
    }

    #[test]
    fn a_slip_is_refused_with_what_was_meant_and_a_label_of_its_own_is_taken() {
        for of in [TypeCatalogue::default(), catalogue(&["shelf-scan"], false)] {
            assert_eq!(told(&of, "transpot"), ["\"transpot\" is no known type; did you mean transport?"]);
            for taken in ["transport", "patrol", "pick", "inspect", "replenish", "line-7", "x"] {
                assert!(told(&of, taken).is_empty(), "{taken}");
            }
        }
        let of = catalogue(&["shelf-scan"], false);
        assert_eq!(told(&of, "shelf-scna"), ["\"shelf-scna\" is no known type; did you mean shelf-scan?"]);
        assert!(told(&catalogue(&["transpot"], true), "transpot").is_empty(), "a site may call a type so");
    }

    #[test]
    fn where_only_known_types_are_taken_another_one_is_refused_with_those_that_there_are() {
        let of = catalogue(&["shelf-scan"], true);
        let wanted = "\"replenish\" is no known type, and the site takes no other; it knows inspect, patrol, pick, shelf-scan, transport";
        assert_eq!(told(&of, "replenish"), [wanted]);
        assert!(told(&of, "shelf-scan").is_empty() && told(&of, "transport").is_empty());
    }

    #[test]
    fn a_row_of_a_newer_version_keeps_its_name_known_and_makes_nothing() {
        let (key, index) = (Key::new(TaskTypeRow::TABLE, "shelf-scan"), Index::default());
        let newer = Row { key, revision: Revision(1), index, body: r#"{"blend":{"name":"shelf-scan"}}"#.into() };
        let of = TypeCatalogue::from_rows(&[newer]).expect("kept aside");
        assert!(told(&of, "shelf-scan").is_empty());
        let refusal = of.find_for("shelf-scan", "typed.type", &mut Violations::default()).expect_err("a newer version");
        assert_eq!((refusal.kind(), refusal.reason.code), (Kind::Precondition, crate::reason::Code::RowUnknown));
        assert_eq!(of.count(), 1);
    }

    #[test]
    fn a_task_of_fields_hears_why_its_type_has_none() {
        let told = |of: &TypeCatalogue, name: &str| {
            let mut bad = Violations::default();
            assert_eq!(of.find_for(name, "typed.type", &mut bad), Ok(None));
            bad.0.pop().expect("one violation").description
        };
        let of = catalogue(&["shelf-scan"], false);
        assert_eq!(told(&of, "shelf-scn"), "the site has no such type registered; did you mean shelf-scan?");
        assert_eq!(told(&of, "replenish"), "the site has no such type registered; it knows shelf-scan");
        assert!(told(&of, "transport").starts_with("transport has no fields here"));
        assert!(told(&TypeCatalogue::default(), "scan").starts_with("the site has no type registered"));
    }
}
