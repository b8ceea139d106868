//! `midshift rollout …`: signed software to robots at work, in waves.
//!
//! Exit codes of `watch` and `wait` beside the usual ones: 11 held for review, 12 aborted, rolled back or superseded,
//! 14 ended, and too few robots have it.

mod commands;
mod create;
mod follow;
mod look;
mod parse;
mod report;
mod target;
#[cfg(test)]
mod tests;
mod text;

pub use commands::exclude;
pub use target::{RolloutTarget, find};

use super::client::{Call, Change, Exit, unary};
use super::out::Out;
use super::robot_target::find_robot;
use clap::Subcommand;
use commands::{Ask, ask, begin, show};
use follow::Until;
use midshift_proto::ota::v1;
use std::time::Duration;

/// Verbs of roll-outs.
#[derive(Subcommand)]
pub enum Verb {
    /// Write a roll-out down, or only tell what it would do; or write it down and begin.
    Create(Box<create::Create>),
    /// Check it against the fleet as it is now.
    Submit(RolloutWithReason),
    /// Stand for it. Until there is a login whoever wrote it may do so.
    Approve(RolloutWithReason),
    /// Begin: robots of the first wave fetch the bundle while they work.
    Start {
        #[command(flatten)]
        target: RolloutWithReason,
        /// Abort roll-outs that have some of the robots first.
        #[arg(long)]
        supersede: bool,
    },
    /// Stand still: no robot is taken out of work, none may activate. A permission that was given lives for 5 s more.
    Pause(RolloutWithReason),
    /// Go on.
    Resume(RolloutWithEtag),
    /// Go on with the next wave though the gate did not say so.
    Promote(RolloutWithEtag),
    /// End it; robots that it touched go back.
    Abort(RolloutWithEtag),
    /// Take a completed roll-out back with another: its robots go back to what they kept.
    Rollback {
        #[command(flatten)]
        one: RolloutTarget,
        /// Id of the one that takes it back, never used before.
        #[arg(long = "as", value_name = "NEW_ID")]
        new_id: String,
        /// Submit, approve and start it too.
        #[arg(long)]
        start: bool,
    },
    /// Once more with robots of a completed roll-out, one by one; their quarantine is lifted.
    Retry {
        #[command(flatten)]
        target: RolloutWithReason,
        /// With those that failed or were skipped: nobody else can be tried again.
        #[arg(long, required = true)]
        failed: bool,
    },
    /// Leave a robot out that was not taken out of work yet.
    Exclude {
        #[command(flatten)]
        one: RolloutTarget,
        /// The robot that is left out.
        robot_id: String,
        /// Why it is left out, for the audit.
        #[arg(long, default_value = "")]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
    /// Say that a robot that is lost will not come back: it counts in no budget until it is heard, and keeps its drain.
    WriteOff {
        #[command(flatten)]
        one: RolloutTarget,
        /// The robot that will not come back.
        robot_id: String,
        /// Why it is given up, for the audit.
        #[arg(long)]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
    /// List roll-outs, the newest first.
    Ls {
        #[command(flatten)]
        call: Call,
    },
    /// Show one: where it is, its waves, what its gates said.
    Get {
        #[command(flatten)]
        one: RolloutTarget,
        /// Each robot too.
        #[arg(long)]
        robots: bool,
    },
    /// List its robots: how far each is and what it waits for.
    Robots(RolloutTarget),
    /// What each robot waits for in it, since when, until when, and what a person can do; of one robot also why it was left out.
    Explain {
        #[command(flatten)]
        one: RolloutTarget,
        /// Only this robot.
        robot_id: Option<String>,
    },
    /// What happened, in order: what people did, what gates said, where each robot came to last.
    History(RolloutTarget),
    /// Its whole record as one document, with -o json or -o html: who, what, when, verdicts, each robot's outcome, tasks done meanwhile.
    Report(RolloutTarget),
    /// Follow it to its end: a live picture on a terminal, else a line for each change.
    Watch(RolloutTarget),
    /// Wait until it has ended, or needs a person.
    Wait {
        #[command(flatten)]
        one: RolloutTarget,
        /// For what.
        #[arg(long = "for", value_enum, default_value_t = Until::Completed)]
        until: Until,
        /// Give up after this (exit code 10).
        #[arg(long, value_parser = super::duration, default_value = "24h")]
        timeout: Duration,
    },
}

impl Verb {
    /// The one roll-out that it is about, and the one robot in it.
    fn named(&mut self) -> (Option<&mut RolloutTarget>, Option<&mut String>) {
        match self {
            Self::Exclude { one, robot_id, .. } | Self::WriteOff { one, robot_id, .. } => (Some(one), Some(robot_id)),
            Self::Explain { one, robot_id } => (Some(one), robot_id.as_mut()),
            Self::Submit(target) | Self::Approve(target) | Self::Pause(target) => (Some(&mut target.one), None),
            Self::Start { target, .. } | Self::Retry { target, .. } => (Some(&mut target.one), None),
            Self::Resume(target) | Self::Promote(target) | Self::Abort(target) => (Some(&mut target.target.one), None),
            Self::Rollback { one, .. } | Self::Get { one, .. } | Self::Wait { one, .. } => (Some(one), None),
            Self::Robots(one) | Self::History(one) | Self::Report(one) | Self::Watch(one) => (Some(one), None),
            Self::Create(_) | Self::Ls { .. } => (None, None),
        }
    }
    /// Whether its answer can be a page.
    pub fn makes_page(&self) -> bool {
        matches!(self, Self::Report(_))
    }
}

/// One roll-out and why.
#[derive(clap::Args)]
pub struct RolloutWithReason {
    #[command(flatten)]
    one: RolloutTarget,
    /// Why; shown to people.
    #[arg(long, default_value = "")]
    reason: String,
}

/// One roll-out as it was seen.
#[derive(clap::Args)]
pub struct RolloutWithEtag {
    #[command(flatten)]
    target: RolloutWithReason,
    /// The etag you saw; without it the roll-out is read first.
    #[arg(long, visible_alias = "etag", default_value = "")]
    if_match: String,
}

/// Runs one verb.
pub async fn run(mut verb: Verb, out: &Out) -> Result<(), Exit> {
    if let (Some(one), robot_id) = verb.named() {
        one.rollout_id = find(&one.call, &one.rollout_id).await?;
        if let Some(robot_id) = robot_id {
            *robot_id = find_robot(&one.call, robot_id).await?;
        }
    }
    match verb {
        Verb::Create(args) => create::run(*args, out).await,
        Verb::Submit(target) => act(&target, Ask::Submit, out).await,
        Verb::Approve(target) => act(&target, Ask::Approve, out).await,
        Verb::Start { target, supersede } => act(&target, Ask::Start { supersede }, out).await,
        Verb::Pause(target) => act(&target, Ask::Pause, out).await,
        Verb::Resume(target) => act_on(&target, Ask::Resume, out).await,
        Verb::Promote(target) => act_on(&target, Ask::Promote, out).await,
        Verb::Abort(target) => act_on(&target, Ask::Abort, out).await,
        Verb::Rollback { one, new_id, start } => roll_back(&one, new_id, start, out).await,
        Verb::Retry { target, failed: _ } => act(&target, Ask::Retry, out).await,
        Verb::Exclude { one, robot_id, reason, change } => {
            exclude(&one.call, one.rollout_id, robot_id, reason, change, out).await
        }
        Verb::WriteOff { one, robot_id, reason, change } => {
            commands::write_off(one, robot_id, reason, change, out).await
        }
        Verb::Ls { call } => look::list(&call, out).await,
        Verb::Get { one, robots } => look::get(&one, robots, out).await,
        Verb::Robots(one) => look::robots(&one, out).await,
        Verb::Explain { one, robot_id: Some(robot_id) } => look::explain(&one, &robot_id, out).await,
        Verb::Explain { one, robot_id: None } => look::explain_all(&one, out).await,
        Verb::History(one) => look::history(&one, out).await,
        Verb::Report(one) => report::run(&one, out).await,
        Verb::Watch(one) => follow::watch(&one, out).await,
        Verb::Wait { one, until, timeout } => follow::wait(&one, until, timeout, out).await,
    }
}

async fn act(target: &RolloutWithReason, what: Ask, out: &Out) -> Result<(), Exit> {
    let mut client = target.one.call.rollouts().await?;
    show(&ask(&mut client, what, &target.one.rollout_id, "", &target.reason).await?, out)
}

/// Of verbs that judge: what is judged must be what was seen.
async fn act_on(target: &RolloutWithEtag, what: Ask, out: &Out) -> Result<(), Exit> {
    let RolloutWithReason { one, reason } = &target.target;
    let etag = if target.if_match.is_empty() { one.read().await?.etag } else { target.if_match.clone() };
    let mut client = one.call.rollouts().await?;
    show(&ask(&mut client, what, &one.rollout_id, &etag, reason).await?, out)
}

async fn roll_back(one: &RolloutTarget, new_rollout_id: String, start: bool, out: &Out) -> Result<(), Exit> {
    let mut client = one.call.rollouts().await?;
    let request = v1::RollBackRolloutRequest { rollout_id: one.rollout_id.clone(), new_rollout_id };
    let answer = client.roll_back_rollout(unary(request)).await.map_err(Exit::with_facts)?;
    let mut rollout = answer.into_inner().rollout.unwrap_or_default();
    if start {
        rollout = begin(&mut client, &rollout.rollout_id, false, out).await?;
    }
    show(&rollout, out)
}
