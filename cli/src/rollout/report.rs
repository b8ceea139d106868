//! `midshift rollout report`: the whole record of one roll-out as one document. It says who did what and when, what gates said,
//! what became of each robot, and which tasks ended meanwhile.
//!
//! Invariant: pure functions of messages, apart from [`run`]. A page names nothing outside itself, and what anybody typed is
//! text in it.

use super::look::{events, members, whole_text};
use super::target::RolloutTarget;
use super::text;
use crate::client::Exit;
use crate::out::{Format, Out};
use midshift_proto::json::to_json;
use midshift_proto::ota::v1;
use serde_json::{Value, json};

/// The look of a page.
const STYLE: &str = "body{font:15px/1.4 sans-serif;margin:2em;max-width:80em}table{border-collapse:collapse;margin:.5em 0 1.5em}\
    th,td{border:1px solid #bbb;padding:.2em .6em;text-align:left;vertical-align:top}th{background:#eee}";

/// Reads one roll-out with all its robots and writes the document.
pub async fn run(one: &RolloutTarget, out: &Out) -> Result<(), Exit> {
    let rollout = one.read().await?;
    let robots = members(&mut one.call.rollouts().await?, &one.rollout_id, "").await?.robots;
    match out.format {
        _ if out.is_page() => out.line(&page(&rollout, &robots)),
        Format::Table => out.line(&for_people(&rollout, &robots)),
        Format::Name => out.line(&rollout.rollout_id),
        Format::Json | Format::Jsonl => out.value(&document(&rollout, &robots)?)?,
    }
    Ok(())
}

fn for_people(rollout: &v1::Rollout, robots: &[v1::RolloutRobot]) -> String {
    let mut lines = vec![whole_text(rollout, robots, true), tasks(rollout), "what happened".to_owned()];
    lines.extend(events(rollout, robots).iter().map(|e| format!("  {}  {}", text::time(Some(&e.time)), e.text)));
    lines.join("\n")
}

/// The document as JSON.
pub fn document(rollout: &v1::Rollout, robots: &[v1::RolloutRobot]) -> anyhow::Result<Value> {
    let event = |e: &super::look::Event| json!({"time": text::time(Some(&e.time)), "what": e.what, "text": e.text});
    let events: Vec<Value> = events(rollout, robots).iter().map(event).collect();
    let robots = robots.iter().map(to_json).collect::<Result<Vec<_>, _>>()?;
    Ok(json!({"rollout": to_json(rollout)?, "robots": robots, "events": events}))
}

fn tasks(rollout: &v1::Rollout) -> String {
    let (trial, control) = (rollout.trial.unwrap_or_default(), rollout.control.unwrap_or_default());
    format!(
        "tasks meanwhile: on trial {} done, {} failed; beside it {} done, {} failed",
        trial.succeeded, trial.failed, control.succeeded, control.failed
    )
}

/// The document as a page.
pub fn page(rollout: &v1::Rollout, robots: &[v1::RolloutRobot]) -> String {
    let title = escaped(&format!("Roll-out {}", rollout.rollout_id));
    let mut parts = vec![
        "<!doctype html>".to_owned(),
        format!(
            "<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{title}</title><style>{STYLE}</style></head><body>"
        ),
        format!("<h1>{title}</h1>"),
    ];
    let mut lines = text::header(rollout);
    let acts = [("written down", &rollout.created), ("approved", &rollout.approved)];
    lines.extend(acts.iter().filter_map(|(what, act)| act.as_ref().map(|act| text::act(what, act))));
    lines.extend(rollout.start_time.as_ref().map(|at| format!("began {}", text::time(Some(at)))));
    lines.push(tasks(rollout));
    parts.extend(lines.iter().map(|line| format!("<p>{}</p>", escaped(line.trim()))));
    let waves = text::waves_of(rollout);
    let verdicts: Vec<Vec<String>> = rollout.verdicts.iter().map(|v| verdict(v, waves)).collect();
    parts.push(table(
        "Verdicts",
        &["Wave", "Outcome", "n", "Clean", "Failed", "Known", "Why", "By", "When"],
        &verdicts,
    ));
    let outcomes: Vec<Vec<String>> = robots.iter().map(|r| outcome(r, waves)).collect();
    let header = ["Robot", "Wave", "Outcome", "Since", "Ran before", "Why", "Done on trial", "Failed", "Out of work"];
    parts.push(table("Robots", &header, &outcomes));
    let events = events(rollout, robots);
    let happened: Vec<Vec<String>> = events.iter().map(|e| vec![text::time(Some(&e.time)), e.text.clone()]).collect();
    parts.push(table("What happened", &["When", "What"], &happened));
    parts.push("</body></html>".to_owned());
    parts.join("\n")
}

fn verdict(v: &v1::RolloutVerdict, waves: u32) -> Vec<String> {
    vec![
        text::wave(v.wave, waves),
        text::outcome(v).to_owned(),
        (v.clean + v.failed).to_string(),
        v.clean.to_string(),
        v.failed.to_string(),
        text::bound(v),
        v.reason.as_ref().map(text::reason).unwrap_or_default(),
        v.actor.clone(),
        text::time(v.time.as_ref()),
    ]
}

fn outcome(r: &v1::RolloutRobot, waves: u32) -> Vec<String> {
    let why = r.failure.as_ref().or(r.why.as_ref()).or(r.blocked_by.as_ref());
    let tasks = r.trial.unwrap_or_default();
    vec![
        r.robot_id.clone(),
        text::wave(r.wave, waves),
        text::step(r.step()).to_owned(),
        text::time(r.since.as_ref()),
        r.from_version.clone(),
        why.map(text::reason).unwrap_or_default(),
        tasks.succeeded.to_string(),
        tasks.failed.to_string(),
        r.off_work.as_ref().and_then(text::off_work).unwrap_or_default(),
    ]
}

/// A table under its name; only the name where nothing is in it.
fn table(name: &str, header: &[&str], rows: &[Vec<String>]) -> String {
    if rows.is_empty() {
        return format!("<h2>{name}</h2>\n<p>none</p>");
    }
    let cells = |tag: &str, cells: Vec<String>| -> String {
        let cells: String = cells.iter().map(|cell| format!("<{tag}>{cell}</{tag}>")).collect();
        format!("<tr>{cells}</tr>")
    };
    let head = cells("th", header.iter().map(|name| escaped(name)).collect());
    let body: Vec<String> =
        rows.iter().map(|row| cells("td", row.iter().map(|cell| escaped(cell)).collect())).collect();
    format!("<h2>{name}</h2>\n<table>\n{head}\n{}\n</table>", body.join("\n"))
}

/// Text as a page shows it.
fn escaped(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => shown.push_str("&amp;"),
            '<' => shown.push_str("&lt;"),
            '>' => shown.push_str("&gt;"),
            '"' => shown.push_str("&quot;"),
            '\'' => shown.push_str("&#39;"),
            c => shown.push(c),
        }
    }
    shown
}
