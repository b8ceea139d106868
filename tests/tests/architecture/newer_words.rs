//! Words of a newer version: each enum that is read from rows has a decision for them.

use crate::{files, read};

/// What this build does with a word of a newer version where such an enum is read.
const WORDS: &[(&str, &[&str])] = &[
    // Kept in the value itself.
    ("kept", &["FaultClass", "HeldGrant", "WorkState"]),
    // The row stands aside: core/src/unknown_rows.rs. A robot's ledger and what lies in an inbox are its own to refuse.
    (
        "aside",
        &[
            "AfterStopping",
            "Ask",
            "AssignmentPolicy",
            "AttemptPhase",
            "DrainState",
            "Duty",
            "Effect",
            "Ending",
            "Errand",
            "FieldKind",
            "Goal",
            "HardwareStop",
            "HolderState",
            "InboxItem",
            "Lane",
            "Mode",
            "Outcome",
            "Pause",
            "Phase",
            "PlaceKind",
            "PlaceNews",
            "Presence",
            "ReleasedBy",
            "Resolution",
            "RobotEvent",
            "RobotHolder",
            "SampleBody",
            "Scope",
            "Step",
            "StepKind",
            "StopLevel",
            "Subject",
            "Suspicion",
            "TaskTypeRow",
            "TemplateKind",
            "TimerKind",
            "UpdateEvent",
            "UpdateState",
            "Verdict",
        ],
    ),
    // A person or a program asks for it, or a file says it: refused, and the field is named.
    (
        "refused",
        &[
            "AbortScope",
            "Command",
            "Kind",
            "LaneTraffic",
            "Revocation",
            "Rule",
            "SmallWave",
            "SmallWaveFailure",
            "Source",
            "Verb",
            "Wave",
        ],
    ),
];

#[test]
fn every_enum_that_is_read_from_rows_has_a_decision_for_words_of_a_newer_version() {
    let mut found = std::collections::BTreeSet::new();
    for path in files("core/src", "rs") {
        let text = read(&path);
        let mut derives = false;
        for line in text.lines().map(str::trim_start) {
            derives |= line.starts_with("#[derive(") && line.contains("Deserialize");
            let name = line.strip_prefix("pub ").unwrap_or(line).strip_prefix("enum ");
            if let Some(name) = name.filter(|_| derives) {
                found.insert(name.trim_end_matches([' ', '{']).to_owned());
            }
            derives &= line.starts_with("#[") || line.starts_with("//");
        }
    }
    let decided = WORDS.iter().flat_map(|(_, names)| names.iter().map(|name| (*name).to_owned())).collect();
    assert_eq!(found, decided, "an enum of core that is read has no decision, or is gone");
}
