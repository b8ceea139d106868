//! Lists of tasks in files: one JSON object a line, or CSV with a header; each becomes a JSON value with its line.
//!
//! Invariant: nothing is judged here but the form of the file; the rules of a task are checked where every task is. Called by
//! the CLI for `task submit` and `--tasks`.

use crate::limits::{SITE_FILE_BYTES, TASK_LIST_MAX};
use crate::reason::{Refusal, Violations};
use serde_json::{Map, Value};

/// Mistakes listed of one file.
const VIOLATIONS_MAX: usize = 100;

/// Columns that hold text.
const TEXT_COLUMNS: [&str; 7] =
    ["task_type", "from_waypoint", "to_waypoint", "item_sku", "robot_id", "same_robot_as", "coalesce_key"];
/// Text columns of a transport alone.
const TRANSPORT_COLUMNS: [&str; 3] = ["from_waypoint", "to_waypoint", "item_sku"];
/// What the name of a column begins with that holds a field of a registered type.
const FIELD_COLUMN: &str = "fields.";
/// Columns that hold whole numbers.
const NUMBER_COLUMNS: [&str; 5] =
    ["priority", "timeout_seconds", "max_retry_times", "retry_interval_seconds", "schedule_to_start_seconds"];

/// One task of a file, in either JSON form.
#[derive(Clone, Debug, PartialEq)]
pub struct ListedTask {
    /// Line of the file, from 1.
    pub line: usize,
    /// A JSON object.
    pub task: Value,
}

fn check_size(text: &str) -> Result<(), Refusal> {
    if text.len() > SITE_FILE_BYTES {
        return Err(Refusal::field("file", format!("must be at most {SITE_FILE_BYTES} bytes")));
    }
    Ok(())
}

/// Reads one JSON object a line; empty lines and lines with `#` are skipped. Errors: each bad line, up to 100.
pub fn parse_jsonl(text: &str) -> Result<Vec<ListedTask>, Refusal> {
    check_size(text)?;
    let mut v = Violations::default();
    let mut tasks = Vec::new();
    for (at, row) in text.lines().enumerate() {
        let (line, row) = (at + 1, row.trim());
        if row.is_empty() || row.starts_with('#') {
            continue;
        }
        match serde_json::from_str::<Value>(row) {
            Ok(task @ Value::Object(_)) => tasks.push(ListedTask { line, task }),
            Ok(_) => v.add(format!("line {line}"), "must be a JSON object"),
            Err(e) => v.add(format!("line {line}"), format!("is no JSON: {e}")),
        }
        if v.0.len() >= VIOLATIONS_MAX || tasks.len() > TASK_LIST_MAX {
            break;
        }
    }
    finish(v, tasks)
}

/// Reads CSV into the flat JSON form, or, where columns are called `fields.NAME`, into that of tasks by type and fields. The
/// first row names the columns, in any order. `task_type` must be among them, and for the flat form `to_waypoint` and
/// `timeout_seconds`; an empty cell is an absent field. Errors: each bad line, up to 100.
pub fn parse_csv(text: &str) -> Result<Vec<ListedTask>, Refusal> {
    check_size(text)?;
    let mut v = Violations::default();
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).trim(csv::Trim::All).from_reader(text.as_bytes());
    let columns: Vec<String> = match reader.headers() {
        Ok(row) => row.iter().map(str::to_owned).collect(),
        Err(e) => return Err(Refusal::field("line 1", format!("is no CSV: {e}"))),
    };
    check_columns(&columns, &mut v);
    if !v.0.is_empty() {
        return Err(Refusal::invalid(v.0));
    }
    let mut tasks = Vec::new();
    for row in reader.records() {
        match row {
            Ok(row) => {
                let line = row_line(text, row.position());
                let task = row_task(&mut v, line, &columns, &row);
                tasks.push(ListedTask { line, task });
            }
            Err(e) => {
                let line = row_line(text, e.position());
                v.add(format!("line {line}"), format!("is no CSV row: {e}"));
            }
        }
        if v.0.len() >= VIOLATIONS_MAX || tasks.len() > TASK_LIST_MAX {
            break;
        }
    }
    finish(v, tasks)
}

fn is_field(column: &str) -> bool {
    column.strip_prefix(FIELD_COLUMN).is_some_and(|name| !name.is_empty())
}

fn check_columns(columns: &[String], v: &mut Violations) {
    let is_typed = columns.iter().any(|name| is_field(name));
    for (at, name) in columns.iter().enumerate() {
        let is_known = TEXT_COLUMNS.contains(&name.as_str()) || NUMBER_COLUMNS.contains(&name.as_str());
        if is_typed && TRANSPORT_COLUMNS.contains(&name.as_str()) {
            v.add("header", format!("{name:?} is of a transport, and cannot be with columns fields.NAME of a type"));
        } else if !is_known && !is_field(name) {
            let known = [TEXT_COLUMNS.join(", "), NUMBER_COLUMNS.join(", ")].join(", ");
            v.add("header", format!("{name:?} is none of {known}, fields.NAME"));
        } else if columns[..at].contains(name) {
            v.add("header", format!("{name:?} is there twice"));
        }
    }
    let needed: &[&str] = if is_typed { &["task_type"] } else { &["task_type", "to_waypoint", "timeout_seconds"] };
    for name in needed {
        if !columns.iter().any(|c| c == name) {
            v.add("header", format!("{name:?} is missing"));
        }
    }
}

/// The line that a row stands on: the reader's position is before the empty lines and comments that it skipped.
fn row_line(text: &str, position: Option<&csv::Position>) -> usize {
    let Some(position) = position else { return 0 };
    let rest = text.get(position.byte() as usize..).unwrap_or_default();
    position.line() as usize + rest.lines().take_while(|l| l.is_empty() || l.starts_with('#')).count()
}

fn row_task(v: &mut Violations, line: usize, columns: &[String], row: &csv::StringRecord) -> Value {
    let (mut task, mut fields) = (Map::new(), Map::new());
    let is_typed = columns.iter().any(|name| is_field(name));
    for (name, cell) in columns.iter().zip(row).filter(|(_, cell)| !cell.is_empty()) {
        if let Some(field) = name.strip_prefix(FIELD_COLUMN) {
            fields.insert(field.to_owned(), Value::from(cell));
        } else if !NUMBER_COLUMNS.contains(&name.as_str()) {
            let name = if is_typed && name == "task_type" { "type" } else { name };
            task.insert(name.to_owned(), Value::from(cell));
        } else if let Ok(number) = cell.parse::<i64>() {
            task.insert(name.clone(), Value::from(number));
        } else {
            v.add(format!("line {line}.{name}"), format!("{cell:?} is not a whole number"));
        }
    }
    if is_typed {
        task.insert("fields".to_owned(), Value::Object(fields));
    }
    Value::Object(task)
}

fn finish(mut v: Violations, tasks: Vec<ListedTask>) -> Result<Vec<ListedTask>, Refusal> {
    if tasks.len() > TASK_LIST_MAX {
        v.add("file", format!("must have at most {TASK_LIST_MAX} tasks"));
    }
    v.finish()?;
    Ok(tasks)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn fields(refusal: &Refusal) -> Vec<&str> {
        refusal.violations.iter().map(|v| v.field.as_str()).collect()
    }

    #[test]
    fn each_json_line_is_a_task_with_its_line() {
        let tasks = parse_jsonl("# two\n{\"type\": \"transport\"}\n\n  {\"task_type\": \"pick\"}\r\n").expect("reads");
        let want = [(2, json!({"type": "transport"})), (4, json!({"task_type": "pick"}))];
        assert_eq!(tasks, want.map(|(line, task)| ListedTask { line, task }));
    }

    #[test]
    fn bad_json_lines_are_all_named() {
        assert_eq!(fields(&parse_jsonl("{}\n[1]\n{\"a\":\n").expect_err("two bad lines")), ["line 2", "line 3"]);
    }

    #[test]
    fn a_csv_row_becomes_the_flat_form_without_its_empty_cells() {
        let text = "task_type,priority,from_waypoint,to_waypoint,item_sku,timeout_seconds,max_retry_times,retry_interval_seconds,robot_id\n\
                    transport,3,A01,B03,\"SKU, red\",600,2,5,\n\n# later\npatrol,,,P01,,60,,,rbt-01\n";
        let tasks = parse_csv(text).expect("reads");
        let first = json!({"task_type": "transport", "priority": 3, "from_waypoint": "A01", "to_waypoint": "B03",
            "item_sku": "SKU, red", "timeout_seconds": 600, "max_retry_times": 2, "retry_interval_seconds": 5});
        let second = json!({"task_type": "patrol", "to_waypoint": "P01", "timeout_seconds": 60, "robot_id": "rbt-01"});
        assert_eq!(tasks, [(2, first), (5, second)].map(|(line, task)| ListedTask { line, task }));
    }

    #[test]
    fn a_csv_with_columns_of_fields_becomes_tasks_by_type_and_fields() {
        let text = "task_type,priority,fields.shelf,fields.height_mm\nshelf-scan,3,A01,1200\nshelf-scan,,B03,\n";
        let first = json!({"type": "shelf-scan", "priority": 3, "fields": {"shelf": "A01", "height_mm": "1200"}});
        let second = json!({"type": "shelf-scan", "fields": {"shelf": "B03"}});
        let tasks = parse_csv(text).expect("reads");
        assert_eq!(tasks, [(2, first), (3, second)].map(|(line, task)| ListedTask { line, task }));
        let refusal = parse_csv("fields.shelf,to_waypoint,fields.\n").expect_err("a transport, no name and no type");
        assert_eq!(fields(&refusal), ["header"; 3]);
    }

    #[test]
    fn bad_csv_names_columns_lines_and_cells() {
        let refusal = parse_csv("task_type,colour,task_type\n").expect_err("a bad header");
        assert_eq!(fields(&refusal), ["header"; 4]);
        let refusal =
            parse_csv("task_type,to_waypoint,timeout_seconds\nt,A01,soon\nt,A01\nt,A01,60\n").expect_err("bad rows");
        assert_eq!(fields(&refusal), ["line 2.timeout_seconds", "line 3"]);
    }
}
