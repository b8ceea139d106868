//! `midshift task type …`: task types of the site.

use crate::client::{Call, Exit, unary};
use crate::out::{Out, columns, plain};
use clap::{Subcommand, ValueEnum};
use midshift_core::nearest;
use midshift_proto::convert::ms_of;
use midshift_proto::convert::task_type::kind_of;
use midshift_proto::task::v1;
use std::path::{Path, PathBuf};

/// Largest file of a type, bytes: four times a type, which is 16 KiB as JSON.
const FILE_BYTES: u64 = 64 * 1024;

/// Verbs of task types.
#[derive(Subcommand)]
pub enum Verb {
    /// List task types: registered ones, then those that are built in.
    Ls {
        #[command(flatten)]
        call: Call,
    },
    /// Show a registered type: its fields with units and bounds, and its steps.
    Get {
        #[command(flatten)]
        call: Call,
        /// Its name.
        name: String,
    },
    /// Register a type, or replace it whole; it holds for tasks submitted from then on.
    Put {
        #[command(flatten)]
        call: Call,
        /// TOML, or JSON as `get -o json` prints it. With an etag in it: only if the type is still as that says.
        file: PathBuf,
        /// Check only; nothing changes.
        #[arg(long)]
        dry_run: bool,
    },
    /// Delete a registered type; tasks that were made of it stay.
    Delete {
        #[command(flatten)]
        call: Call,
        /// Its name.
        name: String,
        /// Only if it is still as this etag says.
        #[arg(long, default_value = "")]
        if_match: String,
        /// Check only; nothing changes.
        #[arg(long)]
        dry_run: bool,
    },
    /// Say whether tasks of unknown types are taken.
    Accept {
        #[command(flatten)]
        call: Call,
        /// Which types are taken.
        which: Accepted,
        /// Check only; nothing changes.
        #[arg(long)]
        dry_run: bool,
    },
}

/// Which types are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Accepted {
    /// Known types, and any other name as a label, unless it is likely a slip of a known one. So it is where nobody said.
    Any,
    /// Types that are built in or registered, and no other.
    Known,
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Ls { call } => list(&call, out).await,
        Verb::Get { call, name } => get(&call, &name, out).await,
        Verb::Put { call, file, dry_run } => put_file(&call, &file, dry_run, out).await,
        Verb::Delete { call, name, if_match, dry_run } => {
            let request = v1::DeleteTaskTypeRequest { name: name.clone(), etag: if_match, validate_only: dry_run };
            let answer = call.task().await?.delete_task_type(unary(request)).await?.into_inner();
            let end = if dry_run { "may be deleted; nothing was" } else { "is deleted" };
            out.one(&answer, &name, || format!("{name} {end}"))?;
            Ok(())
        }
        Verb::Accept { call, which, dry_run } => {
            let rules = v1::TaskTypeRules { known_only: which == Accepted::Known, ..v1::TaskTypeRules::default() };
            let request = v1::PutTaskTypeRulesRequest { rules: Some(rules), validate_only: dry_run };
            let answer = call.task().await?.put_task_type_rules(unary(request)).await?.into_inner();
            let rules = answer.rules.unwrap_or_default();
            out.one(&rules, if rules.known_only { "known" } else { "any" }, || says(&rules).to_owned())?;
            if dry_run {
                out.inform("valid; nothing was stored");
            }
            Ok(())
        }
    }
}

/// What a site does with types that it does not know.
fn says(rules: &v1::TaskTypeRules) -> &'static str {
    if rules.known_only {
        "only these types are taken"
    } else {
        "other types are taken as labels, unless they are likely a slip of these"
    }
}

async fn read(call: &Call) -> Result<v1::ListTaskTypesResponse, Exit> {
    Ok(call.task().await?.list_task_types(unary(v1::ListTaskTypesRequest {})).await?.into_inner())
}

async fn list(call: &Call, out: &Out) -> Result<(), Exit> {
    let whole = read(call).await?;
    let built_in = whole.built_in.iter().filter(|of| !whole.types.iter().any(|known| known.name == of.name));
    let built_in = built_in.map(|of| v1::TaskType {
        name: of.name.clone(),
        description: of.description.clone(),
        ..v1::TaskType::default()
    });
    let all: Vec<v1::TaskType> = whole.types.iter().cloned().chain(built_in).collect();
    let row = |of: &v1::TaskType| {
        let fields = of.fields.iter().map(|field| field.name.as_str()).collect::<Vec<_>>().join(", ");
        let fields = if of.etag.is_empty() { "built in".to_owned() } else { fields };
        vec![of.name.clone(), fields, of.description.clone()]
    };
    out.many(&whole, &all, |of| of.name.clone(), &["TYPE", "FIELDS", "WHAT"], row)?;
    out.inform(says(&whole.rules.unwrap_or_default()));
    Ok(())
}

async fn get(call: &Call, name: &str, out: &Out) -> Result<(), Exit> {
    let whole = read(call).await?;
    if let Some(of) = whole.types.iter().find(|of| of.name == name) {
        return show(of, out);
    }
    let known: Vec<&str> = nearest::nearest(name, whole.types.iter().map(|of| of.name.as_str())).collect();
    let text = match whole.built_in.iter().any(|of| of.name == name) {
        true => format!("{name} is built in and has no fields"),
        false if known.is_empty() => format!("the site has no type {name} registered"),
        false => format!("the site has no type {name} registered; did you mean {}?", known.join(" or ")),
    };
    Err(Exit::new(4, text).or_try("midshift task type ls"))
}

async fn put_file(call: &Call, file: &Path, dry_run: bool, out: &Out) -> Result<(), Exit> {
    let of = read_file(file)?;
    let name = of.name.clone();
    let request = v1::PutTaskTypeRequest { r#type: Some(of), validate_only: dry_run };
    let answer = call.task().await?.put_task_type(unary(request)).await?.into_inner();
    show(&answer.r#type.unwrap_or_default(), out)?;
    if dry_run {
        out.inform("valid; nothing was stored");
    } else {
        out.next(&format!("midshift task submit --type {name} --field NAME=VALUE"));
    }
    Ok(())
}

/// A type as TOML, or JSON where the name of the file ends so.
fn read_file(path: &Path) -> Result<v1::TaskType, Exit> {
    let bad = |error: String| {
        Exit::new(2, format!("{}: {error}", path.display())).or_try("docs/send-orders.md has one that works")
    };
    let size = std::fs::metadata(path).map_err(|error| bad(error.to_string()))?.len();
    if size > FILE_BYTES {
        return Err(bad(format!("must be at most {FILE_BYTES} bytes")));
    }
    let text = std::fs::read_to_string(path).map_err(|error| bad(error.to_string()))?;
    parse(&text, path.extension().is_some_and(|ending| ending == "json")).map_err(bad)
}

fn parse(text: &str, is_json: bool) -> Result<v1::TaskType, String> {
    let value: serde_json::Value = if is_json {
        serde_json::from_str(text).map_err(|error| format!("is no JSON: {error}"))?
    } else {
        toml::from_str(text).map_err(|error| format!("is no TOML: {error}"))?
    };
    midshift_proto::json::from_json(value).map_err(|error| {
        let why = std::error::Error::source(&error).map_or_else(|| error.to_string(), ToString::to_string);
        format!("is no task type: {why}")
    })
}

fn show(of: &v1::TaskType, out: &Out) -> Result<(), Exit> {
    out.one(of, &of.name, || describe(of))?;
    Ok(())
}

fn describe(of: &v1::TaskType) -> String {
    let timeout = of.timeout.as_ref().map(|time| format!("  timeout {} s", ms_of(time) as f64 / 1_000.0));
    let mut text = format!("{}{}\n  {}\n", of.name, timeout.unwrap_or_default(), plain(&of.description));
    let rows: Vec<Vec<String>> = of.fields.iter().map(row).collect();
    if !rows.is_empty() {
        text += columns(&["FIELD", "MUST BE", "WITHOUT IT", "WHAT"], &rows).trim_end();
        text += "\n";
    }
    let steps: Vec<String> = of.steps.iter().map(step).collect();
    text + "steps: " + &plain(&steps.join(", ")) + "\n"
}

fn row(field: &v1::TaskTypeField) -> Vec<String> {
    use prost_types::value::Kind;
    let default = match field.default.as_ref().and_then(|value| value.kind.as_ref()) {
        None => "refused".to_owned(),
        Some(Kind::StringValue(text)) if text.is_empty() => "empty".to_owned(),
        Some(Kind::StringValue(text)) => text.clone(),
        Some(Kind::NumberValue(number)) => number.to_string(),
        Some(_) => "?".to_owned(),
    };
    let kind = kind_of(field).map_or_else(|| "?".to_owned(), |kind| kind.to_string());
    vec![field.name.clone(), kind, default, field.description.clone()]
}

fn step(step: &v1::TaskTypeStep) -> String {
    use v1::task_type_step::Kind;
    match &step.kind {
        Some(Kind::Goto(goto)) => format!("go to {}", goto.field),
        Some(Kind::Wait(wait)) => format!("wait {}", wait.field),
        Some(Kind::Action(action)) => {
            let mut params: Vec<String> =
                action.params.iter().map(|(param, field)| format!("{param}={field}")).collect();
            params.sort_unstable();
            format!("{}({})", action.name, params.join(", "))
        }
        None => "?".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCAN: &str = r#"
        name = "shelf-scan"
        description = "Reads the labels of a shelf."
        timeout = "300s"
        fields = [
            { name = "shelf", description = "Which shelf.", waypoint = {} },
            { name = "height_mm", description = "Of the reader.", integer = { most = 2000, unit = "mm" }, default = 1200 },
        ]
        steps = [
            { goto = { field = "shelf" } },
            { action = { name = "scan", params = { height = "height_mm" } } },
        ]
    "#;

    #[test]
    fn a_type_is_read_from_toml_and_back_from_the_json_that_is_printed() {
        let of = parse(SCAN, false).expect("a type");
        let json = midshift_proto::json::to_json(&of).expect("json").to_string();
        assert_eq!(parse(&json, true), Ok(of.clone()));
        let shown = "shelf-scan  timeout 300 s\n  Reads the labels of a shelf.\n\
                     FIELD      MUST BE                     WITHOUT IT  WHAT\n\
                     shelf      a waypoint of the site      refused     Which shelf.\n\
                     height_mm  a whole number, 0..2000 mm  1200        Of the reader.\n\
                     steps: go to shelf, scan(height=height_mm)\n";
        assert_eq!(describe(&of), shown);
    }

    #[test]
    fn a_file_that_is_no_type_says_what_is_wrong() {
        let error = |text, is_json| parse(text, is_json).expect_err("no type");
        assert!(error("name = ", false).starts_with("is no TOML"));
        assert!(error("{", true).starts_with("is no JSON"));
        assert!(error("feilds = []", false).contains("feilds"), "{}", error("feilds = []", false));
    }
}
