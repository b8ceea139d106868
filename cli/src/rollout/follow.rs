//! A roll-out as it goes: a live picture, a line for each change, or only its end.
//!
//! Invariant: nothing is asked again and again; the server sends each change.

use super::target::RolloutTarget;
use super::text;
use crate::client::{Exit, follow};
use crate::out::{Format, Out};
use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use midshift_proto::ota::v1::{self, RolloutOutcome, RolloutPhase};
use prost_types::Timestamp;
use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::time::Duration;
use tonic::Streaming;

/// What to wait for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Until {
    /// All robots are decided. Ends at once when that cannot be any more, or when a person must judge.
    Completed,
    /// Whatever end: also through a review and all the way back.
    Ended,
}

/// Exit code: a person must judge.
const REVIEW: u8 = 11;
/// Exit code: it did not stay.
const WENT_BACK: u8 = 12;

/// Exit code: it ended, and too few robots have it.
const INCOMPLETE: u8 = 14;

/// Whether the time that is left is shown as it passes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Countdowns {
    Shown,
    NotShown,
}

/// A roll-out as it was told last.
#[derive(Default)]
pub struct Picture {
    rollout: v1::Rollout,
    robots: BTreeMap<String, v1::RolloutRobot>,
}

impl Picture {
    /// Notes what a message says; what is new in it, a line each, with its time.
    pub fn note_changes(&mut self, message: v1::WatchRolloutResponse) -> Vec<String> {
        let after = message.rollout.unwrap_or_default();
        let before = std::mem::replace(&mut self.rollout, after);
        let rollout = &self.rollout;
        let waves = text::waves_of(rollout);
        let line = |time: Option<&Timestamp>, text: &str| format!("{}  {text}", text::time(time)).trim_end().to_owned();
        let mut news = Vec::new();
        for robot in message.robots {
            let known = self.robots.get(&robot.robot_id);
            if known.is_none_or(|k| k.step != robot.step || k.failure != robot.failure) {
                news.push(line(robot.since.as_ref(), &text::robot(&robot)));
            } else if known.is_some_and(|k| k.trial != robot.trial) {
                // Of a task nobody says here when it ended.
                news.push(line(None, &text::robot(&robot)).trim_start().to_owned());
            }
            self.robots.insert(robot.robot_id.clone(), robot);
        }
        let verdicts = rollout.verdicts.iter().skip(before.verdicts.len());
        news.extend(verdicts.map(|v| line(v.time.as_ref(), &text::verdict(v, waves))));
        if let Some(abort) = rollout.abort.as_ref().filter(|_| before.abort.is_none()) {
            news.push(line(abort.time.as_ref(), &text::abort(abort)));
        }
        let moved = (before.phase, before.wave, &before.pauses) != (rollout.phase, rollout.wave, &rollout.pauses);
        if moved || before.rollout_id.is_empty() {
            let counts = text::counts(&rollout.counts.unwrap_or_default());
            let begun = rollout.start_time.is_some();
            let wave = if begun { text::wave(rollout.wave, waves) } else { String::new() };
            let told = format!("{}  {}  {wave}  {counts}", rollout.rollout_id, text::state(rollout));
            // Of a pause nobody says when it began.
            let is_new = before.phase != rollout.phase;
            news.push(if is_new { line(rollout.since.as_ref(), &told) } else { told.trim_end().to_owned() });
        }
        news
    }

    /// The whole of it as it is now, with what the last verdict leaves unproven, and what to do if it waits for a person.
    pub fn lines(&self) -> Vec<String> {
        let rollout = &self.rollout;
        let mut lines = text::header(rollout);
        lines.extend(text::tree(rollout, self.robots.values()));
        let last = rollout.verdicts.last();
        lines.extend(last.map(|v| format!("last verdict: {}", text::verdict(v, text::waves_of(rollout)))));
        if rollout.phase() == RolloutPhase::Review {
            lines.push(format!("next: {}", text::next(rollout)));
        }
        lines
    }
}

/// What a wait comes to at this moment; none: it goes on.
pub fn end(rollout: &v1::Rollout, until: Until) -> Option<Result<(), Exit>> {
    let id = &rollout.rollout_id;
    let phase = rollout.phase();
    let goes_back = matches!(phase, RolloutPhase::Aborting | RolloutPhase::RollingBack);
    let because = |reason: Option<&midshift_proto::common::v1::Reason>| {
        reason.map(|r| format!(": {}", text::reason(r))).unwrap_or_default()
    };
    let exit =
        |code, what: String| Some(Err(Exit::new(code, format!("{id} {what}\n  try: midshift rollout get {id}"))));
    let is_incomplete = rollout.outcome() == RolloutOutcome::Incomplete;
    let judge = format!("midshift rollout promote {id}, or midshift rollout abort {id}");
    match phase {
        RolloutPhase::Completed if is_incomplete => {
            let retry = format!("midshift rollout report {id}, then midshift rollout retry {id} --failed");
            Some(Err(Exit::new(INCOMPLETE, format!("{id} is {}\n  try: {retry}", text::incomplete(rollout)))))
        }
        RolloutPhase::Completed => Some(Ok(())),
        RolloutPhase::Superseded => exit(WENT_BACK, format!("was superseded by {}", rollout.superseded_by)),
        _ if phase == RolloutPhase::Aborted || (goes_back && until == Until::Completed) => {
            let why = because(rollout.abort.as_ref().and_then(|a| a.reason.as_ref()));
            exit(WENT_BACK, format!("is {}{why}", text::phase(phase)))
        }
        RolloutPhase::Review if until == Until::Completed => {
            let why = because(rollout.verdicts.last().and_then(|v| v.reason.as_ref()));
            Some(Err(Exit::new(REVIEW, format!("{id} is held for review{why}\n  try: {judge}"))))
        }
        _ => None,
    }
}

async fn messages(one: &RolloutTarget, countdowns: Countdowns) -> Result<Streaming<v1::WatchRolloutResponse>, Exit> {
    let counts_down = countdowns == Countdowns::Shown;
    let request = v1::WatchRolloutRequest { rollout_id: one.rollout_id.clone(), counts_down };
    Ok(one.call.rollouts().await?.watch_rollout(request).await.map_err(Exit::with_facts)?.into_inner())
}

/// Follows to the end.
pub async fn watch(one: &RolloutTarget, out: &Out) -> Result<(), Exit> {
    let mut picture = Picture::default();
    let is_live = out.format == Format::Table && std::io::stdout().is_terminal();
    let countdowns = if is_live { Countdowns::Shown } else { Countdowns::NotShown };
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::hidden());
    if is_live {
        bar.set_draw_target(ProgressDrawTarget::stdout());
        bar.set_style(ProgressStyle::with_template("{msg}").unwrap_or_else(|_| ProgressStyle::default_spinner()));
    }
    let end = follow(
        out,
        async || messages(one, countdowns).await,
        |message| {
            let Some(message) = message else {
                return Ok(end(&picture.rollout, Until::Ended).map_or(ControlFlow::Continue(()), ControlFlow::Break));
            };
            if matches!(out.format, Format::Json | Format::Jsonl) {
                out.json(&message)?;
                picture.note_changes(message);
                return Ok(ControlFlow::Continue(()));
            }
            let news = picture.note_changes(message);
            if is_live {
                bar.set_message(picture.lines().join("\n"));
            } else {
                news.iter().for_each(|line| out.line(line));
            }
            Ok(ControlFlow::Continue(()))
        },
    );
    let end = end.await?;
    if is_live {
        bar.finish_and_clear();
        picture.lines().iter().for_each(|line| out.line(line));
    }
    out.next(&text::next(&picture.rollout));
    end
}

/// Waits for an end.
pub async fn wait(one: &RolloutTarget, until: Until, timeout: Duration, out: &Out) -> Result<(), Exit> {
    let id = &one.rollout_id;
    let (rollout, end) = tokio::time::timeout(timeout, until_end(one, until, out)).await.map_err(|_| {
        Exit::new(10, format!("{id} has not ended after {timeout:?}\n  try: midshift rollout get {id} --robots"))
    })??;
    out.one(&rollout, id, || text::header(&rollout).join("\n"))?;
    end
}

async fn until_end(one: &RolloutTarget, until: Until, out: &Out) -> Result<(v1::Rollout, Result<(), Exit>), Exit> {
    let take = |message: Option<v1::WatchRolloutResponse>| {
        let rollout = message.and_then(|m| m.rollout).unwrap_or_default();
        Ok(end(&rollout, until).map_or(ControlFlow::Continue(()), |end| ControlFlow::Break((rollout, end))))
    };
    follow(out, async || messages(one, Countdowns::NotShown).await, take).await
}
