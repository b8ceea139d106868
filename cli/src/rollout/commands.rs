//! What is asked of the service of roll-outs: a change of one, or of a robot in one.

use super::target::RolloutTarget;
use super::text;
use crate::client::{Call, Change, Exit, ended, unary};
use crate::endpoint::Line;
use crate::out::Out;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;

/// The service of roll-outs.
pub type Client = RolloutServiceClient<Line>;

/// A request about one roll-out.
#[derive(Clone, Copy, Debug)]
pub enum Ask {
    /// Check it against the fleet.
    Submit,
    /// Stand for it.
    Approve,
    /// Begin, after roll-outs that have some of the robots were aborted if they may be.
    Start {
        /// They may be aborted.
        supersede: bool,
    },
    /// Stand still.
    Pause,
    /// Go on.
    Resume,
    /// Go on with the next wave.
    Promote,
    /// End it.
    Abort,
    /// Once more with those that failed.
    Retry,
}

/// Sends one request; the roll-out after it.
pub async fn ask(
    client: &mut Client,
    ask: Ask,
    rollout_id: &str,
    etag: &str,
    reason: &str,
) -> Result<v1::Rollout, Exit> {
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

/// Sends a command about one robot of a roll-out, and prints the roll-out after it.
macro_rules! about_robot {
    ($call:ident, $request:ident, $server:expr, $rollout_id:expr, $robot_id:ident, $reason:ident, $change:ident, $out:ident) => {{
        let only = $change.only();
        let request = v1::$request {
            rollout_id: $rollout_id,
            etag: String::new(),
            reason: $reason,
            robot_id: $robot_id,
            request_id: $change.request_id,
            validate_only: $change.dry_run,
        };
        let answer = $server.rollouts().await?.$call(unary(request)).await.map_err(Exit::with_facts)?.into_inner();
        show(&answer.rollout.unwrap_or_default(), $out)?;
        ended(answer.done_before.as_ref(), only, "", $out);
        Ok(())
    }};
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
    about_robot!(exclude_robot, ExcludeRobotRequest, call, rollout_id, robot_id, reason, change, out)
}

/// Counts a lost robot in no budget.
pub async fn write_off(
    one: RolloutTarget,
    robot_id: String,
    reason: String,
    change: Change,
    out: &Out,
) -> Result<(), Exit> {
    about_robot!(write_off_robot, WriteOffRobotRequest, one.call, one.rollout_id, robot_id, reason, change, out)
}

/// Submits, approves and starts one that is written down, and says each.
pub async fn begin(client: &mut Client, rollout_id: &str, supersede: bool, out: &Out) -> Result<v1::Rollout, Exit> {
    ask(client, Ask::Submit, rollout_id, "", "").await?;
    out.inform("checked against the fleet");
    let by_another =
        format!("midshift rollout approve {rollout_id} by somebody else, then midshift rollout start {rollout_id}");
    let approved = ask(client, Ask::Approve, rollout_id, "", "").await.map_err(|exit| match exit.code() {
        6 => exit.or_try(&by_another),
        _ => exit,
    })?;
    out.inform(approval(&approved));
    let started = ask(client, Ask::Start { supersede }, rollout_id, "", "").await?;
    out.inform("started");
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

/// Prints a roll-out, and what may be done about it.
pub fn show(rollout: &v1::Rollout, out: &Out) -> Result<(), Exit> {
    out.one(rollout, &rollout.rollout_id, || text::header(rollout).join("\n"))?;
    out.next(&text::next(rollout));
    Ok(())
}
