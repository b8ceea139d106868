//! `midshift stop --all|--robot|--zone|--area`: engages a stop and follows what each robot confirms.
//!
//! Invariant: nothing is shown as standing that a robot has not said itself. A broken answer is asked for again under
//! the same name: that engages nothing more.

use super::target::{AGAIN_AFTER, StopCall};
use super::words::{confirmed, in_site, level, summary, whom};
use crate::client::{Exit, was_cut};
use crate::endpoint::Line;
use crate::out::{Format, Out};
use clap::{Args, ValueEnum};
use midshift_proto::common::v1::StopLevel;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::time::{Instant, timeout};

/// Whether the stop is engaged is not known, as of any call that nobody has answered in time.
const NOT_KNOWN: u8 = 10;
/// Stops that were not confirmed by all.
const NOT_ALL: u8 = 13;

/// What robots do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Level {
    /// Drive at most 300 mm/s, or as slowly as the body can if that is faster, and work on.
    Slow,
    /// Stand still, powered.
    Halt,
    /// Move into a posture that stays stable, then stand.
    Posture,
}

/// Whom a stop is for.
#[derive(Clone, Debug, Args)]
#[group(required = true, multiple = false)]
struct Whom {
    /// Every robot of the site.
    #[arg(long)]
    all: bool,
    /// One robot, wherever it is.
    #[arg(long, value_name = "ID")]
    robot: Option<String>,
    /// Every robot in or near one passage or standing place.
    #[arg(long, value_name = "ID")]
    zone: Option<String>,
    /// Every robot in or near one area.
    #[arg(long, value_name = "ID")]
    area: Option<String>,
}

impl Whom {
    fn scope(self) -> v1::Scope {
        let narrow = self.robot.map(Scope::RobotId).or(self.zone.map(Scope::Zone)).or(self.area.map(Scope::AreaId));
        v1::Scope { scope: Some(narrow.unwrap_or(Scope::Fleet(v1::Fleet {}))) }
    }
}

/// Engages a stop.
#[derive(Clone, Debug, Args)]
pub struct Engage {
    #[command(flatten)]
    call: StopCall,
    #[command(flatten)]
    whom: Whom,
    /// What they do.
    #[arg(long, value_enum, default_value_t = Level::Halt)]
    level: Level,
    /// Why, for those who come later.
    #[arg(long, default_value = "")]
    reason: String,
    /// Protects against a double call: the same id and content are one stop.
    #[arg(long, default_value = "")]
    request_id: String,
    /// Do not wait for what robots confirm.
    #[arg(long)]
    no_wait: bool,
}

/// Engages a stop, and waits for what robots confirm unless nobody wants to.
///
/// # Errors
/// Not every robot that is meant has confirmed it, or nobody knows whether it is engaged.
pub async fn engage(args: Engage, out: &Out) -> Result<(), Exit> {
    if !args.no_wait {
        return ask(args, out).await;
    }
    let nothing = || {
        let text = format!("no answer within {} s: nobody knows whether the stop is engaged", NO_WAIT.as_secs());
        Exit::new(NOT_KNOWN, text).or_try("midshift stop status, or the same without --no-wait, which goes on asking")
    };
    timeout(NO_WAIT, ask(args, out)).await.unwrap_or_else(|_| Err(nothing()))
}

async fn ask(args: Engage, out: &Out) -> Result<(), Exit> {
    let level = match args.level {
        Level::Slow => StopLevel::Slow,
        Level::Halt => StopLevel::Halt,
        Level::Posture => StopLevel::ControlledStopPosture,
    };
    // Asked again by the same name it engages nothing more.
    let request_id =
        if args.request_id.is_empty() { format!("cli-{:032x}", rand::random::<u128>()) } else { args.request_id };
    let scope = Some(args.whom.scope());
    let target = args.call.target(out).await?;
    let site_id = target.site_id.clone();
    let request = v1::EngageRequest { scope, level: level.into(), reason: args.reason, request_id, site_id };
    let mut client = args.call.client(&target).await?;
    let (mut progress, mut tries) = (EngageProgress::default(), TRIES);
    let mut lost_since = None;
    loop {
        let lost = match progress.follow_answer(&mut client, request.clone(), args.no_wait, out).await {
            Ok(()) => return progress.end(args.no_wait, out),
            Err(Heard::Failed(exit)) => return Err(exit),
            Err(Heard::Lost(status)) => status,
        };
        let lost_since: Instant = *lost_since.get_or_insert_with(Instant::now);
        if tries == 0 || lost_since.elapsed() > ASK_WITHIN {
            return Err(progress.cut(lost).or_try("midshift stop status: it may be engaged all the same"));
        }
        if tries == TRIES {
            out.inform("the stop service broke off before it said everything; it is asked again, for the same stop");
        }
        tries -= 1;
        tokio::time::sleep(AGAIN_AFTER).await;
        // One that is replaced is there again within moments.
        client = args.call.client(&target).await.unwrap_or(client);
    }
}

/// Whoever does not wait has its answer within this, or is told that there is none.
const NO_WAIT: Duration = Duration::from_secs(2);
/// An answer that has not begun after this is asked for again, over a connection of its own; sooner where nobody waits.
const BEGUN_WITHIN: Duration = Duration::from_millis(2_500);
const BEGUN_SOON: Duration = Duration::from_millis(800);
/// Asked so often again where a stop service has ended under a call.
const TRIES: u32 = 10;
/// So long after it broke off first it is not asked again, however few times it was: a person waits.
const ASK_WITHIN: Duration = Duration::from_secs(60);

/// Why no more is heard.
enum Heard {
    /// There is nothing to be heard.
    Failed(Exit),
    /// The stop service has ended, or its way.
    Lost(tonic::Status),
}

/// The progress of one engaged stop, as the answer has shown it until now.
#[derive(Default)]
struct EngageProgress {
    stop: v1::Stop,
    robots: BTreeMap<String, v1::RobotStop>,
    last: v1::EngageResponse,
}

impl EngageProgress {
    /// Engages the stop, unless that was done, and hears of it to the end.
    async fn follow_answer(
        &mut self,
        client: &mut StopServiceClient<Line>,
        request: v1::EngageRequest,
        no_wait: bool,
        out: &Out,
    ) -> Result<(), Heard> {
        let begun = async {
            let mut stream = client.engage(request).await?.into_inner();
            let first = stream.message().await?;
            Ok::<_, tonic::Status>((stream, first))
        };
        let within = if no_wait { BEGUN_SOON } else { BEGUN_WITHIN };
        let (mut stream, mut next) = match timeout(within, begun).await {
            Ok(begun) => begun.map_err(|status| self.lost(status))?,
            Err(_) => return Err(Heard::Lost(tonic::Status::deadline_exceeded("the stop service says nothing"))),
        };
        while let Some(message) = next {
            self.note(message, out).map_err(Heard::Failed)?;
            // Nobody is waited for of whom nobody knows.
            if no_wait || self.last.robot_unknown {
                return Ok(());
            }
            next = stream.message().await.map_err(|status| self.lost(status))?;
        }
        if self.stop.stop_id.is_empty() {
            return Err(Heard::Lost(tonic::Status::unavailable("the stop service ended before it answered")));
        }
        Ok(())
    }

    fn note(&mut self, mut message: v1::EngageResponse, out: &Out) -> Result<(), Exit> {
        if out.format == Format::Jsonl {
            out.json(&message)?;
        }
        if let Some(stop) = message.stop.as_ref().filter(|stop| stop.stop_id != self.stop.stop_id) {
            self.stop = stop.clone();
            match out.format {
                Format::Table => {
                    let site = in_site(&message.site_id);
                    out.line(&format!("{} {} {} engaged{site}", stop.stop_id, level(stop.level), whom(stop)));
                }
                Format::Name => out.line(&stop.stop_id),
                Format::Json | Format::Jsonl => {}
            }
        }
        for robot in &message.robots {
            // That it was told is no news, and a fleet is long.
            let is_news = self.robots.get(&robot.robot_id) != Some(robot);
            if is_news && out.format == Format::Table && robot.confirmation() != v1::Confirmation::Requested {
                out.line(&confirmed(robot));
            }
            self.robots.insert(robot.robot_id.clone(), robot.clone());
        }
        // What the first message alone says stays.
        let before = std::mem::take(&mut self.last);
        if message.stop.is_none() {
            (message.site_id, message.robot_unknown) = (before.site_id, before.robot_unknown);
            message.nearest_robot_ids = before.nearest_robot_ids;
        }
        self.last = message;
        Ok(())
    }

    fn lost(&self, status: tonic::Status) -> Heard {
        match was_cut(&status) {
            true => Heard::Lost(status),
            false if self.stop.stop_id.is_empty() => Heard::Failed(Exit::with_facts(status)),
            false => Heard::Failed(self.cut(status)),
        }
    }

    /// The stream broke: the stop stands all the same.
    fn cut(&self, status: tonic::Status) -> Exit {
        let stop_id = &self.stop.stop_id;
        let exit = Exit::from(status);
        if stop_id.is_empty() {
            return exit;
        }
        Exit::new(NOT_ALL, format!("{stop_id} was engaged, and what robots confirm is not heard any more: {exit}"))
            .or_try("midshift stop status")
    }

    /// Whether nobody waits for this robot's word any more: a stop of one robot waits for that one alone, and no stop
    /// for one that said it lies elsewhere.
    fn is_settled(&self, robot: &v1::RobotStop) -> bool {
        use v1::Confirmation as C;
        if let Some(Scope::RobotId(meant)) = self.stop.scope.as_ref().and_then(|s| s.scope.as_ref())
            && *meant != robot.robot_id
        {
            return true;
        }
        match robot.confirmation() {
            C::StandstillConfirmed | C::Outside => true,
            C::Acked => self.stop.level() == StopLevel::Slow,
            C::Unreachable => robot.elsewhere,
            C::Requested | C::Unspecified => false,
        }
    }

    /// That the stop is for a robot that the stop service does not know, and which ones it knows by nearly that name.
    fn unknown(&self) -> Option<String> {
        let robot = self.last.robot_unknown.then(|| whom(&self.stop))?;
        Some(match self.last.nearest_robot_ids.as_slice() {
            [] => format!("no {robot} is known: nobody has confirmed it"),
            nearest => format!("no {robot} is known: nobody has confirmed it. There is {}", nearest.join(", ")),
        })
    }

    fn end(self, no_wait: bool, out: &Out) -> Result<(), Exit> {
        let stop_id = &self.stop.stop_id;
        if out.format == Format::Json {
            let robots = self.robots.values().cloned().collect();
            out.json(&v1::EngageResponse { stop: Some(self.stop.clone()), robots, ..self.last.clone() })?;
        }
        if !self.last.durable {
            out.inform("warning: the stop service's disk refused it; robots were told and keep it, and it is written as soon as it can be");
        }
        out.next(&format!("midshift stop status; when it is over: midshift stop reset {stop_id} --reason TEXT"));
        if let Some(unknown) = self.unknown() {
            return Err(Exit::new(NOT_ALL, format!("{stop_id} is engaged, and {unknown}"))
                .or_try("if another one is meant, engage a stop for it; then reset this one"));
        }
        if no_wait {
            return Ok(());
        }
        let counts = self.last.counts.unwrap_or_default();
        let said = summary(&counts);
        if self.robots.is_empty() {
            return Err(Exit::new(
                NOT_ALL,
                format!("{stop_id} is engaged and the stop service knows of no robot: nobody has confirmed it"),
            ));
        }
        let missing: Vec<&str> =
            self.robots.values().filter(|r| !self.is_settled(r)).map(|r| r.robot_id.as_str()).collect();
        if missing.is_empty() {
            out.inform(&said);
            return Ok(());
        }
        let shown = missing[..missing.len().min(20)].join(", ");
        let more = if missing.len() > 20 { format!(" and {} more", missing.len() - 20) } else { String::new() };
        let text = format!(
            "{stop_id} is engaged and {} of {} robots have not confirmed it: {shown}{more}\n  {said}",
            missing.len(),
            self.robots.len()
        );
        Err(Exit::new(NOT_ALL, text)
            .or_try("look at these robots; their own emergency stops do not depend on midshift"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        engage: Engage,
    }

    #[test]
    fn whom_to_stop_is_named_once() {
        use clap::Parser;
        let parse = |words: &str| Line::try_parse_from(["stop"].into_iter().chain(words.split_whitespace()));
        let all = parse("--all --reason drill").unwrap_or_else(|e| panic!("{e}")).engage;
        assert!(all.whom.all);
        let area = parse("--area hall --level slow --no-wait").unwrap_or_else(|e| panic!("{e}")).engage;
        assert_eq!((area.whom.area.as_deref(), area.level), (Some("hall"), Level::Slow));
        for wrong in ["", "--reason drill", "--all --robot r1"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_stop_of_an_unknown_robot_ends_with_13_and_the_nearest_names_also_where_nobody_waits() {
        let scope = Some(v1::Scope { scope: Some(Scope::RobotId("rbt-4".to_owned())) });
        let stop = v1::Stop { stop_id: "STOP-1".to_owned(), scope, ..v1::Stop::default() };
        let nearest_robot_ids = vec!["rbt-04".to_owned(), "rbt-14".to_owned()];
        let first =
            v1::EngageResponse { stop: Some(stop), robot_unknown: true, nearest_robot_ids, ..Default::default() };
        let out = Out::new(Format::Name);
        for no_wait in [true, false] {
            let mut progress = EngageProgress::default();
            progress.note(first.clone(), &out).unwrap_or_else(|exit| panic!("{exit}"));
            progress.note(v1::EngageResponse::default(), &out).unwrap_or_else(|exit| panic!("{exit}"));
            let exit = progress.end(no_wait, &out).expect_err("nobody has confirmed it");
            assert_eq!(exit.code(), NOT_ALL);
            let said = exit.to_string();
            assert!(said.contains("no robot rbt-4 is known") && said.contains("There is rbt-04, rbt-14"), "{said}");
        }
    }

    #[test]
    fn only_what_robots_said_counts_as_confirmed() {
        let robot = |confirmation: v1::Confirmation| v1::RobotStop {
            robot_id: "r1".to_owned(),
            confirmation: confirmation.into(),
            ..v1::RobotStop::default()
        };
        let progress = |level: StopLevel| EngageProgress {
            stop: v1::Stop { level: level.into(), ..v1::Stop::default() },
            ..EngageProgress::default()
        };
        let settled = |level, confirmation| progress(level).is_settled(&robot(confirmation));
        assert!(settled(StopLevel::Halt, v1::Confirmation::StandstillConfirmed));
        assert!(settled(StopLevel::Halt, v1::Confirmation::Outside));
        assert!(
            !settled(StopLevel::Halt, v1::Confirmation::Acked) && settled(StopLevel::Slow, v1::Confirmation::Acked)
        );
        assert!(!settled(StopLevel::Halt, v1::Confirmation::Unreachable));
        let elsewhere = v1::RobotStop { elsewhere: true, ..robot(v1::Confirmation::Unreachable) };
        assert!(progress(StopLevel::Halt).is_settled(&elsewhere), "it said so, and obeys the stop wherever it drives");
        let text = confirmed(&v1::RobotStop {
            unreachable_since_unix_ms: 1_000,
            self_stop_by_unix_ms: 7_000,
            ..robot(v1::Confirmation::Unreachable)
        });
        assert_eq!(
            text,
            "r1  UNREACHABLE since 1970-01-01T00:00:01.000Z, stands by itself by 1970-01-01T00:00:07.000Z"
        );
    }
}
