//! `midshift rollout …`: signed software to robots at work, in waves.
//!
//! Exit codes of `watch` and `wait` beside the usual ones: 11 held for review, 12 aborted, rolled back or superseded,
//! 14 ended, and too few robots have it.

mod create;
mod follow;
mod look;
mod parse;
mod report;
#[cfg(test)]
mod tests;
mod text;

use super::client::{Call, Change, Exit, ended, unary};
use super::lookup::{self, Found, whole_id};
use super::out::Out;
use super::robot;
use crate::way::Line;
use clap::{Subcommand, ValueEnum};
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use std::time::Duration;

/// Verbs of roll-outs.
#[derive(Subcommand)]
pub enum Verb {
    /// Write a roll-out down, or only tell what it would do; or write it down and begin.
    Create(Box<create::Create>),
    /// Check it against the fleet as it is now.
    Submit(Said),
    /// Stand for it. Until there is a login whoever wrote it may do so.
    Approve(Said),
    /// Begin: robots of the first wave fetch the bundle while they work.
    Start {
        #[command(flatten)]
        said: Said,
        /// Abort roll-outs that have some of the robots first.
        #[arg(long)]
        supersede: bool,
    },
    /// Stand still: no robot is taken out of work, none may activate. A permission that was given lives for 5 s more.
    Pause(Said),
    /// Go on.
    Resume(Seen),
    /// Go on with the next wave though the gate did not say so.
    Promote(Seen),
    /// End it; robots that it touched go back.
    Abort(Seen),
    /// Take a completed roll-out back with another: its robots go back to what they kept.
    Rollback {
        #[command(flatten)]
        one: One,
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
        said: Said,
        /// With those that failed or were skipped: nobody else can be tried again.
        #[arg(long, required = true)]
        failed: bool,
    },
    /// Leave a robot out that was not taken out of work yet.
    Exclude {
        #[command(flatten)]
        one: One,
        /// The robot that is left out.
        robot_id: String,
        /// Why it is left out, for the audit.
        #[arg(long, default_value = "")]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
    /// Say that a robot that is lost will not come back: it counts in no budget until it is heard, and keeps its drain.
    Lost {
        #[command(flatten)]
        one: One,
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
        one: One,
        /// Each robot too.
        #[arg(long)]
        robots: bool,
    },
    /// List its robots: how far each is and what it waits for.
    Robots(One),
    /// What each robot waits for in it, since when, until when, and what a person can do; of one robot also why it was left out.
    Explain {
        #[command(flatten)]
        one: One,
        /// Only this robot.
        robot_id: Option<String>,
    },
    /// What happened, in order: what people did, what gates said, where each robot came to last.
    History(One),
    /// Its whole record as one document, with -o json or -o html: who, what, when, verdicts, each robot's outcome, tasks done meanwhile.
    Report(One),
    /// Follow it to its end: a live picture on a terminal, else a line for each change.
    Watch(One),
    /// Wait until it has ended, or needs a person.
    Wait {
        #[command(flatten)]
        one: One,
        /// For what.
        #[arg(long = "for", value_enum, default_value_t = Until::Completed)]
        until: Until,
        /// Give up after this (exit code 10).
        #[arg(long, value_parser = super::duration, default_value = "24h")]
        timeout: Duration,
    },
}

/// What to wait for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Until {
    /// All robots are decided. Ends at once when that cannot be any more, or when a person must judge.
    Completed,
    /// Whatever end: also through a review and all the way back.
    Ended,
}

/// One roll-out.
#[derive(clap::Args)]
pub struct One {
    #[command(flatten)]
    call: Call,
    /// Its id, or a prefix that only one roll-out has.
    rollout_id: String,
}

impl Verb {
    /// The one roll-out that it is about, and the one robot in it.
    fn named(&mut self) -> (Option<&mut One>, Option<&mut String>) {
        match self {
            Self::Exclude { one, robot_id, .. } | Self::Lost { one, robot_id, .. } => (Some(one), Some(robot_id)),
            Self::Explain { one, robot_id } => (Some(one), robot_id.as_mut()),
            Self::Submit(said) | Self::Approve(said) | Self::Pause(said) => (Some(&mut said.one), None),
            Self::Start { said, .. } | Self::Retry { said, .. } => (Some(&mut said.one), None),
            Self::Resume(seen) | Self::Promote(seen) | Self::Abort(seen) => (Some(&mut seen.said.one), None),
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

/// The whole id of a roll-out.
pub async fn find(call: &Call, typed: &str) -> Result<String, Exit> {
    let mut client = call.rollouts().await?;
    let listed = async {
        let (page_size, rollout_id_prefix) = (lookup::SHOWN, typed.to_owned());
        let request = v1::ListRolloutsRequest { page_size, rollout_id_prefix, page_token: String::new() };
        let page = client.list_rollouts(unary(request)).await?.into_inner();
        Ok(Found::page(&page.rollouts, &page.next_page_token, |r| &r.rollout_id, look::row))
    };
    whole_id("rollout", typed, listed).await
}

/// One roll-out and why.
#[derive(clap::Args)]
pub struct Said {
    #[command(flatten)]
    one: One,
    /// Why; shown to people.
    #[arg(long, default_value = "")]
    reason: String,
}

/// One roll-out as it was seen.
#[derive(clap::Args)]
pub struct Seen {
    #[command(flatten)]
    said: Said,
    /// The etag you saw; without it the roll-out is read first.
    #[arg(long, visible_alias = "etag", default_value = "")]
    if_match: String,
}

/// The service.
type Client = RolloutServiceClient<Line>;

/// A request about one roll-out.
#[derive(Clone, Copy, Debug)]
enum Ask {
    Submit,
    Approve,
    Start { supersede: bool },
    Pause,
    Resume,
    Promote,
    Abort,
    Retry,
}

/// Sends one request; the roll-out after it.
async fn ask(client: &mut Client, ask: Ask, rollout_id: &str, etag: &str, reason: &str) -> Result<v1::Rollout, Exit> {
    let (rollout_id, etag, reason) = (rollout_id.to_owned(), etag.to_owned(), reason.to_owned());
    macro_rules! send {
        ($call:ident, $request:ident $(, $field:ident)?) => {
            client
                .$call(unary(v1::$request { rollout_id, etag, reason $(, $field)? }))
                .await
                .map(|answer| answer.into_inner().rollout)
        };
    }
    let answer = match ask {
        Ask::Submit => send!(submit_rollout, SubmitRolloutRequest),
        Ask::Approve => send!(approve_rollout, ApproveRolloutRequest),
        Ask::Start { supersede } => send!(start_rollout, StartRolloutRequest, supersede),
        Ask::Pause => send!(pause_rollout, PauseRolloutRequest),
        Ask::Resume => send!(resume_rollout, ResumeRolloutRequest),
        Ask::Promote => send!(promote_rollout, PromoteRolloutRequest),
        Ask::Abort => send!(abort_rollout, AbortRolloutRequest),
        Ask::Retry => send!(retry_rollout, RetryRolloutRequest),
    };
    Ok(answer.map_err(Exit::with_facts)?.unwrap_or_default())
}

impl One {
    async fn read(&self) -> Result<v1::Rollout, Exit> {
        let request = v1::GetRolloutRequest { rollout_id: self.rollout_id.clone() };
        let answer = self.call.rollouts().await?.get_rollout(unary(request)).await.map_err(Exit::with_facts)?;
        Ok(answer.into_inner().rollout.unwrap_or_default())
    }
}

/// Runs one verb.
pub async fn run(mut verb: Verb, out: &Out) -> Result<(), Exit> {
    if let (Some(one), robot_id) = verb.named() {
        one.rollout_id = find(&one.call, &one.rollout_id).await?;
        if let Some(robot_id) = robot_id {
            *robot_id = robot::find(&one.call, robot_id).await?;
        }
    }
    match verb {
        Verb::Create(args) => create::run(*args, out).await,
        Verb::Submit(said) => act(&said, Ask::Submit, out).await,
        Verb::Approve(said) => act(&said, Ask::Approve, out).await,
        Verb::Start { said, supersede } => act(&said, Ask::Start { supersede }, out).await,
        Verb::Pause(said) => act(&said, Ask::Pause, out).await,
        Verb::Resume(seen) => act_on(&seen, Ask::Resume, out).await,
        Verb::Promote(seen) => act_on(&seen, Ask::Promote, out).await,
        Verb::Abort(seen) => act_on(&seen, Ask::Abort, out).await,
        Verb::Rollback { one, new_id, start } => roll_back(&one, new_id, start, out).await,
        Verb::Retry { said, failed: _ } => act(&said, Ask::Retry, out).await,
        Verb::Exclude { one, robot_id, reason, change } => {
            exclude(&one.call, one.rollout_id, robot_id, reason, change, out).await
        }
        Verb::Lost { one, robot_id, reason, change } => write_off(one, robot_id, reason, change, out).await,
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

async fn act(said: &Said, what: Ask, out: &Out) -> Result<(), Exit> {
    let mut client = said.one.call.rollouts().await?;
    show(&ask(&mut client, what, &said.one.rollout_id, "", &said.reason).await?, out)
}

/// Of verbs that judge: what is judged must be what was seen.
async fn act_on(seen: &Seen, what: Ask, out: &Out) -> Result<(), Exit> {
    let Said { one, reason } = &seen.said;
    let etag = if seen.if_match.is_empty() { one.read().await?.etag } else { seen.if_match.clone() };
    let mut client = one.call.rollouts().await?;
    show(&ask(&mut client, what, &one.rollout_id, &etag, reason).await?, out)
}

async fn roll_back(one: &One, new_rollout_id: String, start: bool, out: &Out) -> Result<(), Exit> {
    let mut client = one.call.rollouts().await?;
    let request = v1::RollBackRolloutRequest { rollout_id: one.rollout_id.clone(), new_rollout_id };
    let answer = client.roll_back_rollout(unary(request)).await.map_err(Exit::with_facts)?;
    let mut rollout = answer.into_inner().rollout.unwrap_or_default();
    if start {
        rollout = begin(&mut client, &rollout.rollout_id, false, out).await?;
    }
    show(&rollout, out)
}

/// Leaves a robot out.
pub async fn exclude(
    call: &Call,
    rollout_id: String,
    robot_id: String,
    reason: String,
    change: Change,
    out: &Out,
) -> Result<(), Exit> {
    let only = change.only();
    let request = v1::ExcludeRobotRequest {
        rollout_id,
        etag: String::new(),
        reason,
        robot_id,
        request_id: change.request_id,
        validate_only: change.dry_run,
    };
    let answer = call.rollouts().await?.exclude_robot(unary(request)).await.map_err(Exit::with_facts)?;
    let answer = answer.into_inner();
    show(&answer.rollout.unwrap_or_default(), out)?;
    ended(answer.done_before.as_ref(), only, "", out);
    Ok(())
}

/// Counts a lost robot in no budget.
async fn write_off(one: One, robot_id: String, reason: String, change: Change, out: &Out) -> Result<(), Exit> {
    let only = change.only();
    let request = v1::WriteOffRobotRequest {
        rollout_id: one.rollout_id,
        etag: String::new(),
        reason,
        robot_id,
        request_id: change.request_id,
        validate_only: change.dry_run,
    };
    let answer = one.call.rollouts().await?.write_off_robot(unary(request)).await.map_err(Exit::with_facts)?;
    let answer = answer.into_inner();
    show(&answer.rollout.unwrap_or_default(), out)?;
    ended(answer.done_before.as_ref(), only, "", out);
    Ok(())
}

/// Submits, approves and starts one that is written down, and says each.
async fn begin(client: &mut Client, rollout_id: &str, supersede: bool, out: &Out) -> Result<v1::Rollout, Exit> {
    ask(client, Ask::Submit, rollout_id, "", "").await?;
    out.say("checked against the fleet");
    let by_another =
        format!("midshift rollout approve {rollout_id} by somebody else, then midshift rollout start {rollout_id}");
    let approved = ask(client, Ask::Approve, rollout_id, "", "").await.map_err(|exit| match exit.code() {
        6 => exit.or_try(&by_another),
        _ => exit,
    })?;
    out.say(approval(&approved));
    let started = ask(client, Ask::Start { supersede }, rollout_id, "", "").await?;
    out.say("started");
    Ok(started)
}

/// Who stands for it.
fn approval(rollout: &v1::Rollout) -> &'static str {
    let by = |act: &Option<v1::RolloutAct>| act.as_ref().map(|a| a.actor.clone());
    if by(&rollout.created) == by(&rollout.approved) {
        "approved by its author: there is no login yet, so nobody else can be asked"
    } else {
        "approved"
    }
}

fn show(rollout: &v1::Rollout, out: &Out) -> Result<(), Exit> {
    out.one(rollout, &rollout.rollout_id, || text::header(rollout).join("\n"))?;
    out.next(&text::next(rollout));
    Ok(())
}
