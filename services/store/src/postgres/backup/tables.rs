//! What tables a schema of some version has, read from the migrations that make it.
//!
//! Invariant: every name that comes into SQL of a copy is from here.

use crate::migrations::Migration;

/// A table as its migration makes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct TableShape {
    pub(super) schema: &'static str,
    pub(super) name: &'static str,
    pub(super) columns: Vec<Column>,
}

/// One column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Column {
    pub(super) name: &'static str,
    pub(super) kind: Kind,
    pub(super) is_nullable: bool,
}

/// What a column holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// Of type `text`.
    Text,
    /// Of type `bigint`.
    Number,
    /// Of type `bytea`.
    Bytes,
}

impl TableShape {
    /// `schema.name (columns)`, for COPY.
    pub(super) fn columns(&self) -> String {
        let names: Vec<&str> = self.columns.iter().map(|column| column.name).collect();
        format!("{}.{} ({})", self.schema, self.name, names.join(", "))
    }
}

/// The tables that these migrations of a schema make, in their order. The schema's own table of versions is not among them.
pub(super) fn tables(schema: &'static str, migrations: &'static [Migration]) -> Vec<TableShape> {
    migrations.iter().filter_map(|migration| made(schema, migration.sql)).collect()
}

/// Reads one `CREATE TABLE`: a column on each line that is indented, but for the key. None: another statement.
fn made(schema: &'static str, sql: &'static str) -> Option<TableShape> {
    let (name, _) = sql.strip_prefix("CREATE TABLE ")?.split_once(' ')?;
    let lines = sql.lines().filter_map(|line| line.strip_prefix("    "));
    let columns = lines.filter(|line| !line.starts_with("UNIQUE (")).filter_map(|line| {
        let (name, kind) = line.trim_end_matches(',').split_once(' ')?;
        let is_nullable = !kind.ends_with(" NOT NULL");
        let kind = match kind.trim_end_matches(" NOT NULL") {
            "TEXT" => Kind::Text,
            "BIGINT" => Kind::Number,
            _ => Kind::Bytes,
        };
        Some(Column { name, kind, is_nullable })
    });
    Some(TableShape { schema, name, columns: columns.collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::postgres::backup::copied::SCHEMAS;
    use std::path::Path;

    /// Whoever adds a statement of another form teaches it to [`tables`], or a copy leaves a table or a column out.
    #[test]
    fn every_migration_is_of_a_form_that_copies_know() {
        for migration in SCHEMAS.iter().flat_map(|(_, migrations)| *migrations) {
            let known = ["CREATE TABLE ", "CREATE INDEX ", "DROP INDEX "];
            assert!(known.iter().any(|form| migration.sql.starts_with(form)), "{}", migration.name);
        }
    }

    #[test]
    fn the_tables_of_a_copy_are_those_of_the_golden_schema() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/postgres.txt");
        let golden = std::fs::read_to_string(path).expect("the golden schema");
        let columns = golden.lines().filter(|line| !line.starts_with("CREATE ") && !line.contains(".schema_version."));
        let mut golden: Vec<String> = columns.map(str::to_owned).collect();
        let all = SCHEMAS.iter().flat_map(|(schema, migrations)| tables(schema, migrations));
        let mut known: Vec<String> = Vec::new();
        for table in all {
            for column in &table.columns {
                let kind = match column.kind {
                    Kind::Text => "text collate C",
                    Kind::Number => "bigint",
                    Kind::Bytes => "bytea",
                };
                let end = if column.is_nullable { "" } else { " not null" };
                known.push(format!("{}.{}.{} {kind}{end}", table.schema, table.name, column.name));
            }
        }
        golden.sort();
        known.sort();
        assert_eq!(known, golden);
    }
}
