//! Accepts the stop lines of robots, and answers each check-in after a look at the latch.
//!
//! Invariant: a check-in is heard only from the robot's newest line, and a generation that was not told on this line is
//! none. A line on which nothing comes up, nothing is read or a message breaks the rules ends with a status that says so:
//! the robot's own silence does the rest.

use crate::audit::{Action, Note};
use crate::changes;
use crate::downlink::Down;
use crate::inner::Inner;
use crate::outbox::{End, Outbox};
use crate::robots::{Attaching, HeldByAnother, Robot, Robots};
use crate::threads::lock;
use midshift_core::identity::Caller;
use midshift_core::ids::{RobotId, StopId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::stop::Stop;
use midshift_core::stop::roster::Heard;
use midshift_core::time::Now;
use midshift_proto::convert::stop::{CheckIn, ToStop};
use midshift_proto::status::unreadable;
use midshift_proto::stop::v1;
use midshift_proto::{DenialReporter, GoAwayNotice};
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;
use tonic::{Response, Status, Streaming};
use tracing::field::Empty;

/// Accepts a line: reads the first message and begins the line. A robot is let in by its own certificate alone.
pub async fn accept_line(
    inner: Arc<Inner>,
    by: &Caller,
    go_away: GoAwayNotice,
    reporter: &DenialReporter,
    mut up: Streaming<v1::AttendRequest>,
) -> Result<Response<Down>, Status> {
    let begun = begin(&inner, by, &mut up).await;
    let (robot, outbox) = begun
        .inspect_err(|refusal| reporter.report(refusal))
        .map_err(|refusal| midshift_proto::status(&refusal, None))?;
    let down = Down::new(inner.clone(), outbox.clone());
    tokio::spawn(async move {
        hold(&inner, &robot, &outbox, &go_away, up).await;
        Robots::detach(&robot, &outbox);
        metrics::gauge!("midshift_stop_lines").decrement(1);
        tracing::info!(peer = Empty, robot_id = %robot.robot_id, "stop line ended");
    });
    Ok(Response::new(down))
}

async fn begin(
    inner: &Arc<Inner>,
    by: &Caller,
    up: &mut Streaming<v1::AttendRequest>,
) -> Result<(Arc<Robot>, Arc<Outbox>), Refusal> {
    let First { robot_id, boot_id, stops, more } = first(up).await?;
    by.is_robot(&robot_id)?;
    let robot = inner.robots.find_or_add(&robot_id)?;
    let listed = stops.iter().map(|stop| &stop.stop_id).chain(&more).cloned().collect();
    let foreign = changes::adopt(inner, &robot_id, stops, more);
    let outbox = Arc::new(Outbox::new(listed));
    let now = inner.clock.now();
    let attached = {
        // No change of the latch falls between: the line begins with the whole, and hears of everything after it.
        let _fan = lock(&inner.fan);
        changes::is_open(inner)?;
        Robots::attach(&robot, &outbox, Attaching { boot_id, foreign }, now.link)
    };
    attached.map_err(|held| held_by_another(inner, &robot_id, by, held, &now))?;
    metrics::gauge!("midshift_stop_lines").increment(1);
    tracing::info!(peer = Empty, %robot_id, "stop line begun");
    inner.touch();
    Ok((robot, outbox))
}

/// Another start of this robot is heard: a second machine, or a first one that lost its power a moment ago.
fn held_by_another(inner: &Inner, robot_id: &RobotId, by: &Caller, held: HeldByAnother, now: &Now) -> Refusal {
    metrics::counter!("midshift_stop_lines_contested_total").increment(1);
    if held.is_news {
        tracing::warn!(peer = Empty, %robot_id, "another start of this robot was not let in while one is heard");
        let note = Note::by_actor(now.wall, Action::Denied, &by.into());
        let note = note.with("code", Code::LineHeld).with("asked", "stop.attend").with("robot_id", robot_id);
        let certificate = by.certificate();
        inner.disk.denied(certificate.iter().fold(note, |note, serial| note.with("certificate", serial)), 0);
    }
    Refusal::new(Kind::Unavailable, Code::LineHeld).again_after(held.for_now)
}

/// What is said first.
struct First {
    robot_id: RobotId,
    boot_id: String,
    stops: Vec<Stop>,
    more: Vec<StopId>,
}

async fn first(up: &mut Streaming<v1::AttendRequest>) -> Result<First, Refusal> {
    let within = Duration::from_millis(limits::STOP_ATTEND_WITHIN.as_ms());
    let first = tokio::time::timeout(within, up.message()).await;
    if let Ok(Err(status)) = &first
        && let Some(refusal) = unreadable(status)
    {
        return Err(refusal);
    }
    let Ok(Ok(Some(message))) = first else {
        return Err(Refusal::new(Kind::Deadline, Reason::new(Code::ProtocolError, "nobody said who comes")));
    };
    match midshift_proto::parse(message)? {
        ToStop::Attend { robot_id, boot_id, stops, more } => Ok(First { robot_id, boot_id, stops, more }),
        ToStop::CheckIn(_) => Err(Refusal::field("message", "the first message must be attend")),
    }
}

/// Hears a robot until its line is over.
async fn hold(
    inner: &Arc<Inner>,
    robot: &Robot,
    outbox: &Arc<Outbox>,
    go_away: &GoAwayNotice,
    mut up: Streaming<v1::AttendRequest>,
) {
    // An old connection: the robot has its next line before it leaves this one.
    let mut moves = pin!(go_away.begun());
    let mut is_moving = false;
    let silent = Duration::from_millis(limits::STOP_LINE_SILENT.as_ms());
    loop {
        let message = tokio::select! {
            biased;
            () = outbox.gone.cancelled() => return,
            () = &mut moves, if !is_moving => {
                is_moving = true;
                outbox.move_over(inner.clock.now().link);
                continue;
            }
            message = tokio::time::timeout(silent, up.message()) => message,
        };
        let now = inner.clock.now();
        let over = match message {
            Ok(Ok(Some(message))) => take_message(inner, robot, outbox, message, &now).err(),
            Ok(Ok(None)) => return outbox.end(End::Done, now.link),
            Ok(Err(status)) => match unreadable(&status) {
                None => return outbox.end(End::Done, now.link),
                refusal => refusal,
            },
            Err(_) => Some(late("nothing came up this line")),
        };
        let unread = || (outbox.unread_for(now.link) >= limits::STOP_LINE_SILENT).then(|| late("nothing is read"));
        if let Some(refusal) = over.or_else(unread) {
            tracing::warn!(peer = Empty, robot_id = %robot.robot_id, code = %refusal.reason.code, "stop line closed");
            return outbox.end(End::Refused(refusal), now.link);
        }
    }
}

fn late(what: &str) -> Refusal {
    let text = format!("{what} for {} s", limits::STOP_LINE_SILENT.as_ms() / 1000);
    Refusal::new(Kind::Deadline, Reason::new(Code::ProtocolError, text))
}

fn take_message(
    inner: &Inner,
    robot: &Robot,
    outbox: &Arc<Outbox>,
    message: v1::AttendRequest,
    now: &Now,
) -> Result<(), Refusal> {
    match midshift_proto::parse(message)? {
        ToStop::Attend { .. } => Err(Refusal::field("message", "attend comes once")),
        ToStop::CheckIn(said) => {
            check_in(inner, robot, outbox, said, now);
            Ok(())
        }
    }
}

fn check_in(inner: &Inner, robot: &Robot, outbox: &Arc<Outbox>, said: CheckIn, now: &Now) {
    // Before the answer: if the latch cannot be looked at, nobody is answered.
    let at = lock(&inner.engaged_stops).generation();
    let nonce = said.nonce;
    let heard = Heard {
        at: now.link,
        // It may remember a service that numbered otherwise.
        generation: if said.generation <= outbox.sent() { said.generation } else { 0 },
        is_durable: said.is_durable,
        level: said.level,
        is_still: said.is_still,
        inside: said.inside.into_iter().collect(),
        stage: said.stage,
        around: said.around,
        awaiting: said.awaiting.into_iter().collect(),
    };
    let mut state = robot.state();
    if !state.line.as_ref().is_some_and(|line| Arc::ptr_eq(line, outbox)) {
        return;
    }
    let is_news = state.heard.as_ref().is_none_or(|before| {
        now.link.since(before.at) >= limits::CHECK_IN_MISSED || Heard { at: heard.at, ..before.clone() } != heard
    });
    state.heard = Some(heard);
    drop(state);
    outbox.answer(nonce, at, now.link);
    metrics::counter!("midshift_stop_check_ins_total").increment(1);
    if is_news {
        inner.touch();
    }
}
