//! The table, walked whole: against a golden list of its cells, and for the promises that hold in every cell.

use super::*;
use crate::task::AttemptPhase;
use std::collections::{BTreeMap, BTreeSet};

const GOLDEN: &str = include_str!("table.txt");

const THENS: [AfterStopping; 7] = [
    AfterStopping::Canceled,
    AfterStopping::Failed,
    AfterStopping::Retry,
    AfterStopping::Suspended,
    AfterStopping::Requeue,
    AfterStopping::Expired,
    AfterStopping::NeedsOperator,
];

/// What a clock does to a task with a live attempt; none of these may free the robot.
const BY_TIME: [Event; 8] = [
    Event::OfferAckTimeout,
    Event::StartToClose,
    Event::Stall,
    Event::StopConfirmTimeout,
    Event::LeaseOver,
    Event::UncertainTimeout,
    Event::Deadline,
    Event::ScheduleToStart,
];

fn all_facts() -> impl Iterator<Item = Facts> {
    (0..2048_u32).map(|bits| {
        let bit = |n: u32| bits & (1 << n) != 0;
        Facts {
            retries_left: bit(0),
            retry_wanted: bit(1),
            drops_left: bit(2),
            opened: bit(3),
            begun_repeatable: bit(4),
            refusals_spent: bit(5),
            refused_by_all: bit(6),
            semantic: bit(7),
            held: bit(8),
            accepted: bit(9),
            elsewhere: bit(10),
        }
    })
}

fn all_standings() -> impl Iterator<Item = MachineState> {
    let thens: Vec<Option<AfterStopping>> = std::iter::once(None).chain(THENS.map(Some)).collect();
    Phase::ALL.into_iter().flat_map(move |phase| {
        let thens = thens.clone();
        [false, true].into_iter().flat_map(move |uncertain| {
            thens.clone().into_iter().map(move |then| MachineState { phase, uncertain, then })
        })
    })
}

/// Standings that a task can be in: `then` only while it stops or nobody knows.
fn reachable() -> impl Iterator<Item = MachineState> {
    all_standings().filter(|s| match (s.phase, s.uncertain) {
        (Phase::Stopping, _) => s.then.is_some(),
        (phase, true) => phase.has_attempt(),
        (_, false) => s.then.is_none(),
    })
}

fn snake(text: &str) -> String {
    let mut out = String::new();
    for c in text.chars() {
        if c.is_ascii_uppercase() && !out.is_empty() {
            out.push('_');
        }
        out.push(c.to_ascii_lowercase());
    }
    out
}

fn event_named(name: &str) -> Event {
    Event::ALL.into_iter().find(|e| snake(&format!("{e:?}")) == name).unwrap_or_else(|| panic!("no event {name}"))
}

fn standing_named(name: &str) -> MachineState {
    let (uncertain, name) = name.strip_prefix('?').map_or((false, name), |rest| (true, rest));
    let (phase, then) = name.split_once('(').map_or((name, None), |(p, t)| (p, Some(t.trim_end_matches(')'))));
    let then = then.map(|t| {
        let named = THENS.into_iter().find(|then| snake(&format!("{then:?}")).to_uppercase() == t);
        named.unwrap_or_else(|| panic!("no then {t}"))
    });
    let phase = Phase::ALL.into_iter().find(|p| p.as_str() == phase).unwrap_or_else(|| panic!("no phase {phase}"));
    MachineState { phase, uncertain, then }
}

fn facts_named(names: &str) -> Facts {
    let mut f = Facts::default();
    for name in names.split(',').filter(|n| *n != "-") {
        match name {
            "retries_left" => f.retries_left = true,
            "retry_wanted" => f.retry_wanted = true,
            "drops_left" => f.drops_left = true,
            "drop" => (f.drops_left, f.begun_repeatable) = (true, true),
            "opened" => f.opened = true,
            "begun_repeatable" => f.begun_repeatable = true,
            "refusals_spent" => f.refusals_spent = true,
            "refused_by_all" => f.refused_by_all = true,
            "semantic" => f.semantic = true,
            "elsewhere" => (f.semantic, f.elsewhere, f.begun_repeatable, f.retries_left) = (true, true, true, true),
            "held" => f.held = true,
            "accepted" => f.accepted = true,
            other => panic!("no fact {other}"),
        }
    }
    f
}

fn shown(at: MachineState) -> String {
    let then = at.then.map(|t| format!("({})", snake(&format!("{t:?}")).to_uppercase())).unwrap_or_default();
    format!("{}{}{then}", if at.uncertain { "?" } else { "" }, at.phase.as_str())
}

/// Where the task and its attempt's certainty stand after `next`, and the fate, in the words of the golden list.
fn outcome(at: MachineState, next: Option<Next>) -> (String, String) {
    let Some(next) = next else { return (".".to_owned(), String::new()) };
    let uncertain = match next.action {
        AttemptAction::Uncertain => true,
        AttemptAction::Known | AttemptAction::End | AttemptAction::Abandon => false,
        AttemptAction::Keep | AttemptAction::Stop => at.uncertain && next.phase.has_attempt(),
    };
    let after = MachineState { phase: next.phase, uncertain, then: next.then };
    (shown(after), format!("{:?}", next.action).to_lowercase())
}

struct Cell {
    sign: char,
    state: String,
    event: String,
    facts: String,
    next: String,
    action: String,
}

fn golden() -> Vec<Cell> {
    let lines = GOLDEN.lines().filter(|l| !l.is_empty() && !l.starts_with('#'));
    lines
        .map(|line| {
            let sign = line.chars().next().unwrap_or(' ');
            let words: Vec<String> = line[1..].split_whitespace().map(str::to_owned).collect();
            assert!(words.len() >= 4, "{line}");
            Cell {
                sign,
                state: words[0].clone(),
                event: words[1].clone(),
                facts: words[2].clone(),
                next: words[3].clone(),
                action: words.get(4).cloned().unwrap_or_default(),
            }
        })
        .collect()
}

#[test]
fn every_cell_of_the_golden_list_is_what_the_table_says() {
    let mut wrong = Vec::new();
    for cell in golden() {
        let at = standing_named(&cell.state);
        let found = outcome(at, next(at, event_named(&cell.event), &facts_named(&cell.facts)));
        if found != (cell.next.clone(), cell.action.clone()) {
            let (state, event, facts) = (cell.state, cell.event, cell.facts);
            wrong.push(format!("{state} {event} {facts}: {found:?}, listed {} {}", cell.next, cell.action));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Cells differ by `then` and, among uncertain ones, by phase only in where they come back to: the list stands for all of them.
fn listed_as(at: MachineState) -> String {
    match (at.uncertain && at.phase.has_attempt(), at.phase) {
        (true, _) => "?RUNNING".to_owned(),
        (false, phase) => phase.as_str().to_owned(),
    }
}

#[test]
fn what_the_golden_list_does_not_name_is_no_transition() {
    let mut listed: BTreeMap<(String, String), bool> = BTreeMap::new();
    for cell in golden() {
        let key = (listed_as(standing_named(&cell.state)), cell.event);
        *listed.entry(key).or_default() |= cell.next != ".";
    }
    for at in reachable() {
        for event in Event::ALL {
            let key = (listed_as(at), snake(&format!("{event:?}")));
            let moves = all_facts().any(|facts| next(at, event, &facts).is_some());
            // A stop ends the wait for a start only if it is there because nobody took the offer.
            let other_stop = (at.uncertain || at.phase == Phase::Stopping) && at.then != Some(AfterStopping::Requeue);
            let named = listed.get(&key).copied().unwrap_or(false);
            let named = named && !(event == Event::ScheduleToStart && other_stop);
            assert_eq!(moves, named, "{} {}", shown(at), key.1);
        }
    }
}

#[test]
fn the_golden_list_has_each_of_the_109_pairs_of_the_design() {
    let pairs: BTreeSet<(String, String)> = golden()
        .into_iter()
        .filter(|c| c.sign != '+')
        .map(|c| (listed_as(standing_named(&c.state)), c.event))
        .collect();
    assert_eq!(pairs.len(), 109);
}

#[test]
fn the_table_answers_every_corner_and_never_with_a_broken_standing() {
    let reachable: Vec<MachineState> = reachable().collect();
    for at in all_standings() {
        for event in Event::ALL {
            for facts in all_facts() {
                let answer = next(at, event, &facts);
                let Some(next) = answer.filter(|_| reachable.contains(&at)) else { continue };
                let corner = format!("{} {event:?} {facts:?} -> {next:?}", shown(at));
                assert!(next.phase != Phase::Stopping || next.then.is_some(), "stops for nothing: {corner}");
                assert!(next.action != AttemptAction::Stop || next.phase == Phase::Stopping, "{corner}");
                let over = matches!(next.action, AttemptAction::End | AttemptAction::Abandon);
                assert!(!over || !next.phase.has_attempt(), "a live phase without an attempt: {corner}");
                assert!(!over || next.then.is_none(), "a wish without an attempt: {corner}");
                if at.phase.has_attempt() && !next.phase.has_attempt() {
                    assert!(over, "the attempt is lost sight of: {corner}");
                }
            }
        }
    }
}

#[test]
fn a_terminal_phase_never_moves() {
    for at in all_standings().filter(|s| s.phase.is_terminal()) {
        for event in Event::ALL {
            assert!(all_facts().all(|facts| next(at, event, &facts).is_none()), "{} {event:?}", shown(at));
        }
    }
}

#[test]
fn no_timeout_frees_an_attempt() {
    for at in reachable().filter(|s| s.phase.has_attempt()) {
        for event in BY_TIME {
            for facts in all_facts() {
                let action = next(at, event, &facts).map(|n| n.action);
                assert_ne!(action, Some(AttemptAction::End), "{} {event:?} {facts:?}", shown(at));
            }
        }
    }
}

#[test]
fn stopping_ends_by_the_robots_word_by_a_person_and_without_either() {
    for then in THENS {
        for uncertain in [false, true] {
            let at = MachineState { phase: Phase::Stopping, uncertain, then: Some(then) };
            let silence = if uncertain { Event::UncertainTimeout } else { Event::StopConfirmTimeout };
            for event in [Event::StopConfirmed, Event::Succeeded, Event::CancelForce, silence] {
                for facts in all_facts() {
                    let after = next(at, event, &facts).unwrap_or_else(|| panic!("{} {event:?}", shown(at)));
                    assert!(!after.phase.has_attempt(), "{} {event:?} -> {after:?}", shown(at));
                }
            }
        }
    }
}

#[test]
fn a_hold_and_its_end_lose_no_wish() {
    for at in reachable() {
        for event in [Event::Hold, Event::LastHoldGone] {
            for facts in all_facts() {
                let Some(after) = next(at, event, &facts) else { continue };
                assert_eq!(after.then, at.then, "{} {event:?}", shown(at));
                assert_eq!(after.action, AttemptAction::Keep, "{} {event:?}", shown(at));
            }
        }
    }
}

#[test]
fn a_wish_that_stands_is_answered_whatever_the_robot_reports() {
    let at = |phase, uncertain| MachineState { phase, uncertain, then: Some(AfterStopping::Canceled) };
    for phase in [Phase::Running, Phase::Held, Phase::Stopping] {
        for event in [Event::Refused, Event::FailedRecoverable, Event::FailedFinal, Event::StopConfirmed] {
            for facts in all_facts() {
                let known = next(at(Phase::Stopping, false), event, &facts).map(|n| n.phase);
                let unknown = next(at(phase, true), event, &facts).map(|n| n.phase);
                assert_eq!((known, unknown), (Some(Phase::Canceled), Some(Phase::Canceled)), "{event:?} {facts:?}");
            }
        }
        for event in [Event::Accepted, Event::Progress, Event::SeenRunning] {
            let back = next(at(phase, true), event, &Facts::default());
            let stops =
                Next { phase: Phase::Stopping, then: Some(AfterStopping::Canceled), action: AttemptAction::Known };
            assert_eq!(back, Some(stops), "{event:?}");
        }
    }
}

#[test]
fn a_person_can_end_every_task_that_has_not_ended() {
    for at in reachable().filter(|s| !s.phase.is_terminal()) {
        let after = next(at, Event::CancelForce, &Facts::default()).map(|n| n.phase);
        assert_eq!(after, Some(Phase::Canceled), "{}", shown(at));
    }
}

#[test]
fn an_attempt_ends_from_every_live_phase_and_only_a_lost_one_learns_the_truth_later() {
    use AttemptPhase::{
        Aborted, Accepted, Executing, Failed, Lost, Navigating, OfferExpired, Offered, Paused, Refused, Stopping,
        Succeeded,
    };
    for live in [Offered, Accepted, Navigating, Executing, Paused, Stopping] {
        for end in [Succeeded, Failed, Lost] {
            assert!(live.transitions().contains(&end), "{live:?} -> {end:?}");
        }
        assert!(!live.transitions().contains(&live) && !live.transitions().contains(&Offered), "{live:?}");
    }
    assert!(!Stopping.transitions().iter().any(|p| !p.is_terminal()), "a stop is never taken back");
    for over in [Refused, OfferExpired, Succeeded, Failed, Aborted] {
        assert!(over.transitions().is_empty(), "{over:?}");
    }
    assert_eq!(Lost.transitions(), [Succeeded, Failed, Aborted]);
}
