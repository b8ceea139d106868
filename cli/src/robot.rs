//! `midshift robot …`

mod adopt;
mod software;
mod table;

pub use table::{controls, robots};

use super::client::{Call, Change, Exit, Guarded, follow, unary};
use super::enrol::{self, Machine};
use super::explain::verdict;
use super::out::{Format, Out, few, plain};
use super::robot_target::{RobotTarget, find_robot};
use super::rollout;
use super::zone;
use clap::Subcommand;
use midshift_core::time::Utc;
use midshift_proto::convert::duration;
use midshift_proto::fleet::v1 as fleet;
use midshift_proto::json;
use midshift_proto::telemetry::v1;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::time::Duration;

/// Verbs of robots.
#[derive(Subcommand)]
pub enum Verb {
    /// List robots.
    Ls {
        #[command(flatten)]
        call: Call,
    },
    /// Show one robot: live state and what was decided about it.
    Get(RobotTarget),
    /// Follow the live state of robots.
    Watch {
        #[command(flatten)]
        call: Call,
        /// Only these robots, each by its id or a prefix that only one robot has.
        ids: Vec<String>,
        /// Time between two pictures.
        #[arg(long, value_parser = super::duration, default_value = "1s")]
        period: Duration,
    },
    /// Why a robot has no work.
    Explain(RobotTarget),
    /// No new work; what it does now, it finishes.
    Cordon(Order),
    /// Back to work; also resets the breaker.
    Uncordon(Bare),
    /// Out of work for maintenance: its task ends or waits, it parks, and then nothing moves it.
    Drain {
        #[command(flatten)]
        order: Order,
        /// Site time after which it is given up and the robot works on.
        #[arg(long, value_parser = super::duration, default_value = "30m")]
        within: Duration,
    },
    /// Back to work after a drain.
    Undrain(Bare),
    /// Out of the fleet for good: no work, and no roll-out or drain waits for it any more.
    Retire(Order),
    /// Ignore an attempt that the robot lists and the server does not know. It must stand still; no place and no load is freed.
    Disown {
        #[command(flatten)]
        order: Order,
        /// The attempt as `robot explain` names it: task_id/epoch or errand:robot:number/epoch.
        attempt: String,
    },
    /// Settle by your word that it carries nothing. A robot that knows its load by memory alone forgets it; one that feels it is believed.
    Load {
        #[command(flatten)]
        order: Order,
        /// It carries nothing.
        #[arg(long, required = true)]
        none: bool,
    },
    /// Give it labels that go before what it says itself, or take such labels back.
    Label {
        #[command(flatten)]
        order: Bare,
        /// KEY=VALUE gives one, KEY- takes one back.
        #[arg(required = true)]
        labels: Vec<String>,
    },
    /// Keep it at the software that it runs.
    Pin {
        #[command(flatten)]
        one: RobotTarget,
        /// Why it is kept there, for the audit.
        #[arg(long)]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
    /// Let it take part in roll-outs again.
    Unpin {
        #[command(flatten)]
        one: RobotTarget,
        #[command(flatten)]
        change: Change,
    },
    /// Tell a robot that could not go back from a bundle to do so once more: you mended what kept it.
    Unstick {
        #[command(flatten)]
        one: RobotTarget,
        /// What you mended.
        #[arg(long)]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
    /// Let a machine become this robot: prints the line to run on it, with a secret for one use within an hour.
    Enroll(Machine),
    /// Let another machine take this robot's place: the old one's key is worth nothing as soon as the new one is enrolled. Or, with --accept-key, take the device
    /// key that its machine shows now.
    Replace {
        #[command(flatten)]
        machine: Machine,
        /// Enrol no machine: the one that is attached is the robot's, though it signs what it has installed with another device key than before. Without KEY
        /// the key that `robot get` shows.
        #[arg(long, value_name = "KEY", num_args = 0..=1, require_equals = true, default_missing_value = "", conflicts_with_all = ["link_server", "identity_server", "site"])]
        accept_key: Option<String>,
    },
    /// Take a machine in that shows a certificate of this site and is not enrolled here: after a restore, one that was enrolled since the backup.
    Adopt {
        #[command(flatten)]
        call: Call,
        /// Which robot it is.
        robot_id: String,
        /// SHA-256 of the key of its certificate. Without it the key that the robot's open incident ROBOT_NOT_ENROLLED names.
        #[arg(long, value_name = "SHA256")]
        key: Option<String>,
        /// The robot has another machine, whose key is taken out.
        #[arg(long)]
        replace: bool,
    },
    /// Take the robot's key out: it is cut off, and let in nowhere until it is enrolled anew.
    Revoke {
        #[command(flatten)]
        one: RobotTarget,
        /// Why, for the audit.
        #[arg(long, default_value = "")]
        reason: String,
    },
    /// Which robots are enrolled, and until when their certificates are good.
    Identities {
        #[command(flatten)]
        call: Call,
    },
    /// Leave it out of a roll-out that did not take it out of work yet.
    Exclude {
        #[command(flatten)]
        one: RobotTarget,
        /// Of which roll-out.
        #[arg(long, value_name = "ROLLOUT_ID")]
        from: String,
        /// Why it is left out, for the audit.
        #[arg(long, default_value = "")]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
}

/// What fleet is told about one robot.
#[derive(clap::Args)]
pub struct Bare {
    #[command(flatten)]
    one: RobotTarget,
    #[command(flatten)]
    guarded: Guarded,
}

/// What fleet is told about one robot, and why.
#[derive(clap::Args)]
pub struct Order {
    #[command(flatten)]
    one: RobotTarget,
    /// Why: what you saw, or what it is for.
    #[arg(long)]
    reason: String,
    #[command(flatten)]
    guarded: Guarded,
}

impl Verb {
    /// The one robot that it is about, of those that the server has heard of.
    fn one(&mut self) -> Option<&mut RobotTarget> {
        match self {
            Self::Get(one) | Self::Explain(one) => Some(one),
            Self::Cordon(Order { one, .. }) | Self::Retire(Order { one, .. }) => Some(one),
            Self::Uncordon(Bare { one, .. }) | Self::Undrain(Bare { one, .. }) => Some(one),
            Self::Drain { order: Order { one, .. }, .. } | Self::Disown { order: Order { one, .. }, .. } => Some(one),
            Self::Load { order: Order { one, .. }, .. } | Self::Label { order: Bare { one, .. }, .. } => Some(one),
            Self::Pin { one, .. } | Self::Unpin { one, .. } | Self::Exclude { one, .. } => Some(one),
            Self::Unstick { one, .. } => Some(one),
            // A robot that is enrolled needs not have been heard.
            Self::Revoke { .. } | Self::Enroll(_) | Self::Replace { .. } | Self::Adopt { .. } => None,
            Self::Ls { .. } | Self::Watch { .. } | Self::Identities { .. } => None,
        }
    }
}

/// Sends fleet a command about one robot; what is decided about the robot after it.
macro_rules! command {
    ($one:ident, $guarded:ident, $call:ident, $request:ident { $($field:ident),* }) => {{
        let request = fleet::$request {
            robot_id: $one.robot_id.clone(),
            request_id: $guarded.change.request_id.clone(),
            etag: $guarded.if_match.clone(),
            validate_only: $guarded.change.dry_run,
            $($field),*
        };
        let answer = $one.call.fleet().await?.$call(unary(request)).await;
        answer.map(|answer| answer.into_inner().control.unwrap_or_default())
    }};
}

/// Runs one verb.
pub async fn run(mut verb: Verb, out: &Out) -> Result<(), Exit> {
    if let Some(one) = verb.one() {
        one.robot_id = find_robot(&one.call, &one.robot_id).await?;
    }
    match verb {
        Verb::Ls { call } => table::list(&call, out).await,
        Verb::Get(one) => get(&one, out).await,
        Verb::Watch { call, mut ids, period } => {
            for id in &mut ids {
                *id = find_robot(&call, id).await?;
            }
            watch(&call, ids, period, out).await
        }
        Verb::Explain(one) => explain(&one, out).await,
        Verb::Enroll(machine) => enrol::offer(machine, false, out).await,
        Verb::Replace { machine, accept_key: None } => enrol::offer(machine, true, out).await,
        Verb::Replace { machine, accept_key: Some(key) } => {
            adopt::accept_key(machine.call(), machine.robot_id(), &key, out).await
        }
        Verb::Adopt { call, robot_id, key, replace } => adopt::run(&call, &robot_id, key, replace, out).await,
        Verb::Revoke { one, reason } => enrol::revoke(&one.call, &one.robot_id, reason, out).await,
        Verb::Identities { call } => enrol::list(&call, out).await,
        Verb::Cordon(Order { one, reason, guarded }) => {
            show(&command!(one, guarded, cordon_robot, CordonRobotRequest { reason })?, out)?;
            out.next(&format!("midshift robot uncordon {}", one.robot_id));
            Ok(())
        }
        Verb::Uncordon(Bare { one, guarded }) => {
            Ok(show(&command!(one, guarded, uncordon_robot, UncordonRobotRequest {})?, out)?)
        }
        Verb::Drain { order: Order { one, reason, guarded }, within } => {
            let within = Some(duration(u64::try_from(within.as_millis()).unwrap_or(u64::MAX)));
            show(&command!(one, guarded, drain_robot, DrainRobotRequest { reason, within })?, out)?;
            out.next(&format!("midshift robot get {0}; midshift robot undrain {0}", one.robot_id));
            Ok(())
        }
        Verb::Undrain(Bare { one, guarded }) => {
            Ok(show(&command!(one, guarded, undrain_robot, UndrainRobotRequest {})?, out)?)
        }
        Verb::Retire(Order { one, reason, guarded }) => {
            show(&command!(one, guarded, retire_robot, RetireRobotRequest { reason })?, out)?;
            out.next(&format!("midshift robot uncordon {} brings it back", one.robot_id));
            if !guarded.change.dry_run {
                zone::tell_kept(&one.call, &one.robot_id, out).await;
            }
            Ok(())
        }
        Verb::Disown { order: Order { one, reason, guarded }, attempt } => {
            let named = attempt.rsplit_once('/').and_then(|(subject, epoch)| Some((subject, epoch.parse().ok()?)));
            let Some((subject, epoch)) = named.map(|(subject, epoch)| (subject.to_owned(), epoch)) else {
                return Err(Exit::usage(format!("{attempt} is no attempt: say SUBJECT/EPOCH, as robot explain does")));
            };
            let request = command!(one, guarded, disown_attempt, DisownAttemptRequest { reason, subject, epoch });
            Ok(show(&request?, out)?)
        }
        Verb::Load { order: Order { one, reason, guarded }, none: _ } => {
            let settled = command!(one, guarded, settle_robot_load, SettleRobotLoadRequest { reason });
            let settled = settled.map_err(Exit::with_facts)?;
            show(&settled, out)?;
            if settled.load_settled.is_some_and(|word| word.is_forget_pending) {
                // It says within a heartbeat or two that it has forgotten it.
                out.next(&format!("midshift robot get {}", one.robot_id));
            }
            Ok(())
        }
        Verb::Label { order: Bare { one, guarded }, labels } => {
            let (labels, removed) = relabeling(&labels)?;
            let labelled = command!(one, guarded, label_robot, LabelRobotRequest { labels, removed });
            Ok(show(&labelled.map_err(Exit::with_facts)?, out)?)
        }
        Verb::Pin { one, reason, change } => software::pin(&one, reason, change, out).await,
        Verb::Unpin { one, change } => software::unpin(&one, change, out).await,
        Verb::Unstick { one, reason, change } => software::unstick(&one, reason, change, out).await,
        Verb::Exclude { one, from, reason, change } => {
            let from = rollout::find(&one.call, &from).await?;
            rollout::exclude(&one.call, from, one.robot_id, reason, change, out).await
        }
    }
}

/// Labels that are given, and keys of those that are taken back.
fn relabeling(words: &[String]) -> Result<(BTreeMap<String, String>, Vec<String>), Exit> {
    let (mut labels, mut removed) = (BTreeMap::new(), Vec::new());
    for word in words {
        match (word.split_once('='), word.strip_suffix('-')) {
            (Some((key, value)), _) => {
                labels.insert(key.to_owned(), value.to_owned());
            }
            (None, Some(key)) => removed.push(key.to_owned()),
            (None, None) => {
                return Err(Exit::usage(format!("{word} is no label: say KEY=VALUE, or KEY- to take one back")));
            }
        }
    }
    Ok((labels, removed))
}

fn show(control: &fleet::RobotControl, out: &Out) -> anyhow::Result<()> {
    out.one(control, &control.robot_id, || control_line(control))
}

fn control_line(control: &fleet::RobotControl) -> String {
    let duty = control.duty().as_str_name().trim_start_matches("DUTY_");
    let why = control.cordon.as_ref().map(|c| format!(" ({})", plain(&c.reason))).unwrap_or_default();
    let holder = if control.holder.is_empty() { "no work" } else { &control.holder };
    let holds = if control.hold_tokens.is_empty() {
        String::new()
    } else {
        format!("  held by {}", few(control.hold_tokens.clone()).join(" "))
    };
    let by_word = |word: &fleet::LoadSettled| {
        let is_empty = if word.is_forget_pending { "is told that it carries nothing" } else { "carries nothing" };
        format!("  {is_empty}, says {} ({})", plain(&word.actor), plain(&word.reason))
    };
    let load = control.load_settled.as_ref().map(by_word).unwrap_or_default();
    let labels: Vec<String> = control.labels.iter().map(|(k, v)| format!("{}={}", plain(k), plain(v))).collect();
    let labels = if labels.is_empty() { String::new() } else { format!("  labels {}", labels.join(" ")) };
    format!("{}  {duty}{why}  {holder}{holds}{load}{labels}", control.robot_id)
}

/// What its launcher says.
fn beacon_line(beacon: &v1::Beacon) -> String {
    let set: String = beacon.set_id.chars().take(12).collect();
    let back = beacon.expected_back.as_ref().map(|at| Utc(at.seconds * 1_000).rfc3339()).unwrap_or_default();
    format!(
        "* its launcher starts set {set}, try {}; expected back by {back}. A hint: beacons are not proven",
        beacon.tries
    )
}

async fn get(one: &RobotTarget, out: &Out) -> Result<(), Exit> {
    let request = v1::GetRobotRequest { robot_id: one.robot_id.clone() };
    let answer = one.call.telemetry().await?.get_robot(unary(request)).await?.into_inner();
    let robot = answer.robot.unwrap_or_default();
    let request = fleet::GetRobotControlRequest { robot_id: one.robot_id.clone() };
    let control =
        one.call.fleet().await?.get_robot_control(unary(request)).await?.into_inner().control.unwrap_or_default();
    match out.format {
        Format::Table => {
            table::show(&[table::row(&robot, Some(&control), None)], out);
            robot.beacon.iter().for_each(|beacon| out.line(&beacon_line(beacon)));
            if robot.observed {
                out.line("another machine is attached under this name; it gets no work");
            }
            out.line(&control_line(&control));
            software::lines(&robot).iter().for_each(|line| out.line(line));
        }
        Format::Name => out.line(&robot.robot_id),
        Format::Json | Format::Jsonl => {
            out.value(&both(&robot, &control)?)?;
        }
    }
    Ok(())
}

/// What the robot says and what was decided about it, in one document.
fn both(robot: &v1::Robot, control: &fleet::RobotControl) -> anyhow::Result<serde_json::Value> {
    Ok(serde_json::json!({"robot": json::to_json(robot)?, "control": json::to_json(control)?}))
}

async fn watch(call: &Call, robot_ids: Vec<String>, period: Duration, out: &Out) -> Result<(), Exit> {
    let filter = v1::RobotFilter { robot_ids, ..v1::RobotFilter::default() };
    let period_ms = u32::try_from(period.as_millis()).unwrap_or(u32::MAX);
    let open = async || {
        let request = v1::WatchRobotsRequest { filter: Some(filter.clone()), period_ms };
        Ok(call.telemetry().await?.watch_robots(request).await?.into_inner())
    };
    let take = |message: Option<v1::WatchRobotsResponse>| {
        if let Some(message) = message {
            match out.format {
                Format::Json | Format::Jsonl => out.json(&message)?,
                Format::Table | Format::Name => {
                    message.robots.iter().for_each(|r| out.line(table::row(r, None, None).join("  ").trim_end()));
                }
            }
        }
        Ok(ControlFlow::Continue(()))
    };
    follow(out, open, take).await
}

async fn explain(one: &RobotTarget, out: &Out) -> Result<(), Exit> {
    let request = fleet::ExplainRobotRequest { robot_id: one.robot_id.clone() };
    let answer = one.call.fleet().await?.explain_robot(unary(request)).await?.into_inner();
    let e = answer.explanation.clone().unwrap_or_default();
    out.one(&answer, &one.robot_id, || {
        let mut text = control_line(&e.control.clone().unwrap_or_default());
        text += &verdict(e.verdict.as_ref(), "nothing keeps it from work");
        text += &e.energy.as_ref().map_or_else(String::new, super::explain::energy);
        let rows: Vec<Vec<String>> = e
            .candidates
            .iter()
            .map(|c| {
                let why =
                    c.reason.as_ref().map_or_else(|| "eligible".to_owned(), |r| format!("{}: {}", r.code, r.message));
                vec![c.task_id.clone(), why]
            })
            .collect();
        if !rows.is_empty() {
            text += &super::out::columns(&["WAITING TASK", "WHY NOT"], &rows);
        }
        text
    })?;
    Ok(())
}
