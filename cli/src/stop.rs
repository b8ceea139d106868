//! `midshift stop …`: stops the fleet or a part of it, shows what each robot confirms, resets. Never asks back.
//!
//! An operational stop request; not a safety function, no performance level. Nothing is shown as standing that a robot has not said itself.

mod engage;
mod target;
mod words;

pub use engage::Engage;
pub use target::address;

use super::client::{Exit, follow, unary};
use super::lookup::{Found, whole_id};
use super::out::{Format, Out, columns, few, plain};
use crate::endpoint::Line;
use clap::Subcommand;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use std::ops::ControlFlow;
use target::{StopCall, Target};
use words::{at, in_site, level, obeys, summary, whom};

/// What is done with stops besides engaging them.
#[derive(Subcommand)]
pub enum Verb {
    /// What is engaged, and how robots are.
    Status {
        /// Of which stop service.
        #[command(flatten)]
        call: StopCall,
        /// Again whenever it changes, until Ctrl-C.
        #[arg(long)]
        watch: bool,
    },
    /// Take one stop away. Robots that stood stay where they are until they are resumed. Exit code 9: nobody knows that stop; the reset is kept for a robot
    /// that was away.
    Reset {
        /// Of which stop service.
        #[command(flatten)]
        call: StopCall,
        /// Its name, or a prefix that only one engaged stop has.
        stop_id: String,
        /// What you saw that makes it right.
        #[arg(long)]
        reason: String,
    },
}

/// What is asked of a stop service.
pub enum Request {
    /// To engage a stop.
    Engage(Engage),
    /// Something of those that are engaged.
    Of(Verb),
}

/// Asks a stop service.
pub async fn run(request: Request, out: &Out) -> Result<(), Exit> {
    match request {
        Request::Engage(args) => engage::engage(args, out).await,
        Request::Of(Verb::Status { call, watch: false }) => {
            let target = call.target(out).await?;
            let answer = call.client(&target).await?.get_status(unary(v1::GetStatusRequest {})).await?.into_inner();
            show(&target, &answer, out)
        }
        Request::Of(Verb::Status { call, .. }) => watch(&call, out).await,
        Request::Of(Verb::Reset { call, stop_id, reason }) => {
            let target = call.target(out).await?;
            let mut client = call.client(&target).await?;
            let stop_id = find(&mut client, &stop_id).await?;
            reset(client, v1::ResetRequest { stop_id, reason, site_id: target.site_id }, out).await
        }
    }
}

fn show(target: &Target, answer: &v1::GetStatusResponse, out: &Out) -> Result<(), Exit> {
    let status = answer.status.clone().unwrap_or_default();
    target::is_of(target, &status)?;
    match out.format {
        Format::Json | Format::Jsonl => out.json(answer)?,
        Format::Name => status.stops.iter().flat_map(|s| &s.stop).for_each(|stop| out.line(&stop.stop_id)),
        Format::Table => table(&status, out),
    }
    Ok(())
}

/// What this is, in one line.
const WHAT_IT_IS: &str =
    "operational stop requests, not a safety function: the independent emergency stop is the robots' own hardware";

fn table(status: &v1::Status, out: &Out) {
    out.inform(WHAT_IT_IS);
    if !status.durable {
        out.inform("warning: the stop service's disk refuses what is engaged; robots keep it");
    }
    if status.stops.is_empty() {
        out.line(&format!("nothing is engaged{}", in_site(&status.site_id)));
    } else {
        let row = |engaged: &v1::EngagedStop| {
            let stop = engaged.stop.clone().unwrap_or_default();
            let counts = engaged.counts.unwrap_or_default();
            let engaged = at(stop.engaged_unix_ms);
            vec![
                stop.stop_id.clone(),
                level(stop.level).to_owned(),
                whom(&stop),
                engaged,
                summary(&counts),
                stop.reason,
            ]
        };
        let header = ["STOP", "LEVEL", "WHOM", "ENGAGED", "ROBOTS", "REASON"];
        out.line(&columns(&header, &status.stops.iter().map(row).collect::<Vec<_>>()));
    }
    if status.robots.is_empty() {
        return out.inform("the stop service knows of no robot");
    }
    let header = ["ROBOT", "OBEYS", "STANDS", "HEARD", "AWAITS RESUME", "FOREIGN STOPS"];
    out.line(&columns(&header, &status.robots.iter().map(of_robot).collect::<Vec<_>>()));
}

/// Nobody knows what a robot does that is not heard now, whatever it said last.
fn of_robot(robot: &v1::RobotStatus) -> Vec<String> {
    let (obeyed, stands) = match (robot.heard, robot.standstill) {
        (false, _) => ("?".to_owned(), "?"),
        (true, true) => (obeys(robot.obeys), "yes"),
        (true, false) => (obeys(robot.obeys), "no"),
    };
    vec![
        robot.robot_id.clone(),
        obeyed,
        stands.to_owned(),
        at(robot.heard_unix_ms),
        few(robot.awaiting_resume.clone()).join(", "),
        few(robot.foreign_stops.clone()).join(", "),
    ]
}

async fn watch(call: &StopCall, out: &Out) -> Result<(), Exit> {
    let target = call.target(out).await?;
    let open = async || Ok(call.client(&target).await?.watch_status(v1::WatchStatusRequest {}).await?.into_inner());
    follow(out, open, |message: Option<v1::WatchStatusResponse>| {
        if let Some(message) = message {
            show(&target, &v1::GetStatusResponse { status: message.status }, out)?;
        }
        Ok(ControlFlow::Continue(()))
    })
    .await
}

/// The whole name of an engaged stop. What none of them begins with stays as it is: also a stop that this service does not know is reset.
async fn find(client: &mut StopServiceClient<Line>, typed: &str) -> Result<String, Exit> {
    let listed = async {
        let status = client.get_status(unary(v1::GetStatusRequest {})).await?.into_inner().status;
        let stops: Vec<v1::Stop> =
            status.into_iter().flat_map(|s| s.stops).filter_map(|engaged| engaged.stop).collect();
        Ok(engaged(&stops, typed))
    };
    whole_id("stop", typed, listed).await
}

/// Which of these begin with what was typed.
fn engaged(stops: &[v1::Stop], typed: &str) -> Found {
    let begin = stops.iter().filter(|stop| stop.stop_id.starts_with(typed));
    Found::new(begin.map(|stop| (stop.stop_id.clone(), vec![level(stop.level).to_owned(), whom(stop)])), true)
}

async fn reset(mut client: StopServiceClient<Line>, request: v1::ResetRequest, out: &Out) -> Result<(), Exit> {
    let answer = client.reset(unary(request)).await?.into_inner();
    let reset = answer.reset.clone().unwrap_or_default();
    out.one(&answer, &reset.stop_id, || {
        let was = match (answer.was_engaged, answer.is_unknown) {
            (true, _) => "was engaged and is reset",
            (false, false) => "was not engaged here; its name is reset",
            (false, true) => "is known to nobody; its name is reset",
        };
        format!(
            "{} {was} since {} by {}: {}",
            reset.stop_id,
            at(reset.at_unix_ms),
            plain(&reset.actor),
            plain(&reset.reason)
        )
    })?;
    if !answer.durable {
        out.inform("warning: the stop service's disk refused the reset; robots were told, and it is written as soon as it can be");
    }
    if answer.is_unknown {
        let text = format!("nobody knows a stop {}: the reset is kept for a robot that was away", reset.stop_id);
        return Err(Exit::new(9, text).or_try("if you meant another one: midshift stop status"));
    }
    out.next(&format!(
        "robots that stood stay where they are; when it is right that they move: midshift resume --stop {} --reason TEXT",
        reset.stop_id
    ));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_proto::common::v1::StopLevel;

    #[test]
    fn an_engaged_stop_is_meant_by_the_beginning_of_its_name_and_one_that_is_not_engaged_by_its_whole_name() {
        let stop = |id: &str| v1::Stop { stop_id: id.to_owned(), ..v1::Stop::default() };
        let stops = [stop("STOP-aa1"), stop("STOP-aa2"), stop("STOP-b")];
        assert_eq!(engaged(&stops, "STOP-b").single("stop", "STOP-b").expect("one").as_deref(), Some("STOP-b"));
        assert_eq!(engaged(&stops, "STOP-aa2").single("stop", "STOP-aa2").expect("one").as_deref(), Some("STOP-aa2"));
        assert_eq!(engaged(&stops, "STOP-c").single("stop", "STOP-c").expect("none"), None);
        let several = engaged(&stops, "STOP-a").single("stop", "STOP-a").expect_err("it may be either");
        assert!(several.to_string().contains("\n  STOP-aa1") && !several.to_string().contains("STOP-b"), "{several}");
    }

    #[test]
    fn a_robot_that_names_hundreds_of_stops_has_a_row_that_can_be_read() {
        let names: Vec<String> = (0..256).map(|n| format!("STOP-{n:040}")).collect();
        let robot = v1::RobotStatus { awaiting_resume: names.clone(), foreign_stops: names, ..Default::default() };
        let row = of_robot(&robot);
        assert!(row.iter().all(|cell| cell.len() < 200) && row[4].ends_with("+253 more"), "{row:?}");
        assert_eq!(row[4], row[5]);
    }

    #[test]
    fn nobody_knows_what_a_robot_does_that_is_not_heard_now() {
        let robot = |heard, heard_unix_ms, standstill| {
            let obeys = if standstill { StopLevel::Halt } else { StopLevel::None }.into();
            v1::RobotStatus { heard, heard_unix_ms, standstill, obeys, ..v1::RobotStatus::default() }
        };
        let shown = |robot: &v1::RobotStatus| of_robot(robot)[1..4].join(" ");
        assert_eq!(shown(&robot(false, 0, false)), "? ? never");
        assert_eq!(shown(&robot(false, 1_000, true)), "? ? 1970-01-01T00:00:01.000Z", "silent for an hour");
        assert_eq!(shown(&robot(true, 1_000, true)), "HALT yes 1970-01-01T00:00:01.000Z");
        assert_eq!(shown(&robot(true, 1_000, false)), "- no 1970-01-01T00:00:01.000Z");
    }
}
