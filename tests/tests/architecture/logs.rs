//! What programs log: ids and codes, never where something is or what somebody has written.

use crate::{ROOMS, code, of_rooms, read};
use std::collections::BTreeSet;

/// Names of fields of the log that would be where something is, or what somebody has written.
const TOLD: [&str; 30] = [
    "pose",
    "x",
    "y",
    "x_mm",
    "y_mm",
    "theta",
    "theta_mrad",
    "position",
    "waypoint",
    "places",
    "vitals",
    "reason",
    "note",
    "text",
    "message",
    "detail",
    "why",
    "comment",
    "description",
    "warning",
    "problem",
    "advice",
    "rejection",
    "refusal",
    "body",
    "event",
    "labels",
    "params",
    "report",
    "secret",
];
/// Fields of such a name, or shown whole, that are neither. Each for a reason.
const LOGGED: &[(&str, &str, &str)] = &[
    ("robot_agent/src/core/step.rs", "replayed", "numbers of samples"),
    ("robot_agent/src/session/mod.rs", "why", "what the transport said, and sentences of this program"),
    ("robot_agent/src/stop/line.rs", "why", "what the transport said, and sentences of this program"),
    (
        "robot_agent/src/core/stops.rs",
        "why",
        "which field of the link's stops breaks a rule, in the words of the decoder",
    ),
    ("robot_agent/src/core/stops.rs", "level", "one of four words"),
    ("robot_agent/src/core/stops.rs", "stops", "ids"),
    ("robot_agent/src/core/stops.rs", "awaiting_resume", "ids"),
    (
        "robot_agent/src/core/update/directive_check.rs",
        "rejection",
        "one of a closed list of sentences about signed documents",
    ),
    ("robot_agent/src/core/update/directive_check.rs", "keys", "digests"),
    ("robot_agent/src/core/update/integrity.rs", "sets", "digests"),
    (
        "robot_agent/src/core/update/integrity.rs",
        "why",
        "which file of a set has which digest, in sentences of this program",
    ),
    ("robot_agent/src/update/io.rs", "base", "a digest"),
    ("robot_agent/src/core/update/results.rs", "why", "what the transport or a disk said"),
    ("robot_agent/src/core/update/record.rs", "from", "one of a closed list of states"),
    ("robot_agent/src/core/update/record.rs", "to", "one of a closed list of states"),
    ("robot_agent/src/core/update/record.rs", "state", "one of a closed list of states"),
    ("robot_sim/src/swarm.rs", "deed", "a word and an id"),
    ("robot_sim/src/swarm.rs", "why", "what the operating system said of a program"),
    ("services/fleet/src/reconcile.rs", "text", "the key of a row, and what could not be read of it"),
    ("services/fleet/src/standby.rs", "text", "the key of a row, and what could not be read of it"),
    ("services/dev/src/lib.rs", "warning", "what the lint says of the site's own file"),
    ("services/midshift/src/robots.rs", "deed", "a word and an id"),
    ("services/server/src/serve.rs", "warning", "what the lint says of the site's own file"),
    ("services/ota/src/repository.rs", "why", "one of a closed list of words"),
    ("services/ota/src/repository.rs", "advice", "a sentence of this program"),
    ("services/ota/src/repository/documents.rs", "problem", "what is wrong with a signed file"),
    ("services/ota/src/rollouts/reconcile.rs", "text", "the key of a row, and what could not be read of it"),
    ("services/ota/src/rollouts/standby.rs", "text", "the key of a row, and what could not be read of it"),
    (
        "services/server/src/stop_service/supervisor.rs",
        "why",
        "a sentence of this program, or what the system said of a process",
    ),
    ("services/stop/src/changes.rs", "level", "one of four words"),
    ("services/stop/src/opening.rs", "why", "a sentence of this program"),
    ("services/telemetry/src/link.rs", "why", "which field breaks which rule, in the words of the decoder"),
    ("services/telemetry/src/facts.rs", "why", "which field breaks which rule, in the words of the decoder"),
    ("services/telemetry/src/session.rs", "why", "which field breaks which rule, in the words of the decoder"),
    ("services/telemetry/src/welcome.rs", "rejection", "one of a closed list of sentences about signed documents"),
    ("services/process/src/logs.rs", "message", "the constant words of a line that was counted"),
];

/// What stands between the brackets of each call of a macro of tracing.
fn logged(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (at, _) in text.match_indices("tracing::") {
        let Some((word, rest)) = text[at + "tracing::".len()..].split_once('(') else { continue };
        if !word.ends_with('!') && word != "instrument" || word.contains(char::is_whitespace) {
            continue;
        }
        let (mut depth, mut quoted, mut escaped) = (1, false, false);
        let end = rest.find(|c: char| {
            match c {
                _ if escaped => escaped = false,
                '\\' if quoted => escaped = true,
                '"' => quoted = !quoted,
                '(' | '[' | '{' if !quoted => depth += 1,
                ')' | ']' | '}' if !quoted => depth -= 1,
                _ => {}
            }
            depth == 0
        });
        found.push(rest[..end.unwrap_or(rest.len())].to_owned());
    }
    found
}

/// Arguments of one call, without those in brackets of their own.
fn arguments(call: &str) -> Vec<String> {
    let (mut depth, mut quoted, mut escaped, mut one, mut all) = (0, false, false, String::new(), Vec::new());
    for c in call.chars() {
        match c {
            _ if escaped => escaped = false,
            '\\' if quoted => escaped = true,
            '"' => quoted = !quoted,
            '(' | '[' | '{' if !quoted => depth += 1,
            ')' | ']' | '}' if !quoted => depth -= 1,
            ',' if !quoted && depth == 0 => {
                all.push(std::mem::take(&mut one));
                continue;
            }
            _ => {}
        }
        one.push(c);
    }
    all.push(one);
    all.into_iter().map(|one| one.trim().to_owned()).filter(|one| !one.is_empty()).collect()
}

/// Fields of one call that tell where something is or what somebody has written: its name and how it is given.
fn tells(call: &str) -> Vec<String> {
    let mut found = Vec::new();
    for argument in arguments(call) {
        if argument.starts_with('"') {
            // Made of what a program knows, not of what it was told: no text of anybody is put into it.
            found.extend(argument.contains('{').then(|| "message".to_owned()));
            continue;
        }
        let (name, value) =
            argument.split_once('=').map_or(("", argument.as_str()), |(name, value)| (name.trim(), value.trim()));
        let plain = value.trim_start_matches(['%', '?', '&']);
        let name = if name.is_empty() { plain.rsplit('.').next().unwrap_or_default() } else { name };
        let ends = [".code", ".code.as_str()", ".code.as_str())", "reason.name()", "reason.name())", "why.name()"];
        let is_code = ends.iter().any(|end| plain.ends_with(end));
        let is_place = [".pose", ".waypoint", ".text()", ".message", ".vitals"].iter().any(|part| plain.contains(part));
        if is_place || !is_code && (TOLD.contains(&name) || value.starts_with('?')) {
            found.push(name.to_owned());
        }
    }
    found
}

#[test]
fn logs_carry_ids_and_codes_and_never_where_something_is_or_what_somebody_wrote() {
    let (mut calls, mut used) = (0, BTreeSet::new());
    for path in of_rooms(&ROOMS) {
        for call in logged(&code(&read(&path))) {
            calls += 1;
            for name in tells(&call) {
                let known = LOGGED.iter().find(|(file, field, _)| *file == path && *field == name);
                let known = known.unwrap_or_else(|| {
                    panic!("{path} logs {name}: log its id or code, or say in this test why it is neither: {call}")
                });
                used.insert((known.0, known.1));
            }
        }
    }
    assert!(calls > 100, "only {calls} calls were looked at");
    let unused: Vec<_> = LOGGED.iter().filter(|(file, name, _)| !used.contains(&(*file, *name))).collect();
    assert!(unused.is_empty(), "strike what is not logged any more: {unused:?}");
}

#[test]
fn a_place_or_a_text_in_the_log_is_found_however_it_is_given() {
    let found = |text: &str| logged(text).iter().flat_map(|call| tells(call)).collect::<Vec<_>>();
    assert_eq!(found("tracing::info!(robot_id = %r.robot_id, pose = ?v.pose, \"moved\");"), ["pose"]);
    assert_eq!(found("tracing::warn!(%robot_id, at = vitals.pose.x_mm, \"stands\");"), ["at"]);
    assert_eq!(found("tracing::info!(%request.reason, \"cordoned\")"), ["reason"]);
    assert_eq!(found("tracing::info!(cause = refusal.reason.text(), \"refused\")"), ["cause"]);
    assert_eq!(found("tracing::info!(?report, \"said\")"), ["report"]);
    assert_eq!(found("tracing::error!(\"{reason}: no, {text}\")"), ["message"]);
    assert_eq!(found("#[tracing::instrument(note)] fn f() {}"), ["note"]);
    let fine =
        "tracing::warn!(%task_id, reason = why.code.as_str(), n = list.len(), error = %x(1, \")\"), \"told, once\");";
    assert_eq!(found(fine), Vec::<String>::new());
}
