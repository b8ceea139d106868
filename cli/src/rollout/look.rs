//! Reading roll-outs: lists, one of them, its robots, what one robot waits for, what happened.

use super::commands::Client;
use super::target::RolloutTarget;
use super::text;
use crate::client::{Call, Exit, unary};
use crate::out::{Format, Out, columns, plain};
use crate::pages::{self, Listed, PAGE_SIZE};
use midshift_proto::convert::time_of;
use midshift_proto::json::to_json;
use midshift_proto::ota::v1;
use prost_types::Timestamp;

/// gRPC's exit code for something that is not there.
const NOT_FOUND: u8 = 4;

/// Lists all.
pub async fn list(call: &Call, out: &Out) -> Result<(), Exit> {
    let mut client = call.rollouts().await?;
    let request = |page_token| {
        let rollout_id_prefix = String::new();
        unary(v1::ListRolloutsRequest { page_size: PAGE_SIZE, page_token, rollout_id_prefix })
    };
    Ok(out.list(&pages::all(async |page_token| client.list_rollouts(request(page_token)).await).await?)?)
}

impl Listed for v1::Rollout {
    const HEADER: &'static [&'static str] = &["ROLLOUT", "BUNDLE", "PHASE", "WAVE", "DECIDED", "FAILED", "SINCE"];
    fn name(&self) -> String {
        self.rollout_id.clone()
    }
    fn row(&self) -> Vec<String> {
        let counts = self.counts.unwrap_or_default();
        let waves = text::waves_of(self);
        let wave = text::wave(self.wave, waves);
        let begun = self.start_time.is_some();
        vec![
            self.rollout_id.clone(),
            text::bundle(&self.bundle_label, self.spec.as_ref().map_or("", |s| &s.bundle)),
            text::state(self),
            if begun { wave.trim_start_matches("wave ").to_owned() } else { "-".to_owned() },
            if begun { format!("{}/{}", text::decided(&counts), text::total(&counts)) } else { "-".to_owned() },
            counts.failed.to_string(),
            text::time(self.since.as_ref()),
        ]
    }
}

/// All robots of one, or only one of them.
pub async fn members(
    client: &mut Client,
    rollout_id: &str,
    robot_id: &str,
) -> Result<v1::ListRolloutRobotsResponse, Exit> {
    let request = v1::ListRolloutRobotsRequest {
        rollout_id: rollout_id.to_owned(),
        robot_id: robot_id.to_owned(),
        page_size: PAGE_SIZE,
        page_token: String::new(),
    };
    let read = async |page_token| {
        client.list_rollout_robots(unary(v1::ListRolloutRobotsRequest { page_token, ..request.clone() })).await
    };
    pages::all(read).await.map_err(Exit::with_facts)
}

impl Listed for v1::RolloutRobot {
    const HEADER: &'static [&'static str] =
        &["ROBOT", "WAVE", "STEP", "SINCE", "FROM", "WAITS FOR", "WAITS SINCE", "UNTIL"];
    fn name(&self) -> String {
        self.robot_id.clone()
    }
    fn row(&self) -> Vec<String> {
        let why = self.failure.as_ref().or(self.why.as_ref()).filter(|_| self.blocked_by.is_none());
        let waits = self.blocked_by.as_ref().or(why).map(|r| r.code.clone()).unwrap_or_default();
        vec![
            self.robot_id.clone(),
            (self.wave + 1).to_string(),
            text::step(self.step()).to_owned(),
            text::time(self.since.as_ref()),
            self.from_version.clone(),
            waits,
            text::time(self.blocked_since.as_ref()),
            text::time(self.deadline.as_ref()),
        ]
    }
}

/// Lists robots of one.
pub async fn robots(one: &RolloutTarget, out: &Out) -> Result<(), Exit> {
    let whole = members(&mut one.call.rollouts().await?, &one.rollout_id, "").await?;
    out.list(&whole)?;
    out.next(&format!("midshift rollout explain {} ROBOT", one.rollout_id));
    Ok(())
}

/// Shows one.
pub async fn get(one: &RolloutTarget, robots: bool, out: &Out) -> Result<(), Exit> {
    let rollout = one.read().await?;
    let whole = members(&mut one.call.rollouts().await?, &one.rollout_id, "").await?;
    match (out.format, robots) {
        (Format::Json | Format::Jsonl, true) => {
            let robots =
                whole.robots.iter().map(to_json).collect::<Result<Vec<_>, _>>().map_err(anyhow::Error::from)?;
            let rollout = to_json(&rollout).map_err(anyhow::Error::from)?;
            out.value(&serde_json::json!({"rollout": rollout, "robots": robots}))?;
        }
        _ => out.one(&rollout, &rollout.rollout_id, || whole_text(&rollout, &whole.robots, robots))?,
    }
    out.next(&text::next(&rollout));
    Ok(())
}

/// All that is known about one, for people.
pub fn whole_text(rollout: &v1::Rollout, members: &[v1::RolloutRobot], robots: bool) -> String {
    let mut lines = text::header(rollout);
    lines.extend(text::tree(rollout, members.iter()));
    if !rollout.verdicts.is_empty() {
        lines.push("verdicts".to_owned());
    }
    for verdict in &rollout.verdicts {
        lines.push(format!("  {}", text::verdict(verdict, text::waves_of(rollout))));
        lines.extend(text::evidence(verdict).into_iter().map(|line| format!("    {line}")));
    }
    if let Some(medians) = text::off_work_medians(members.iter()) {
        lines.push(format!("out of work, medians: {medians}"));
    }
    let acts = [("written down", &rollout.created), ("approved", &rollout.approved)];
    lines.extend(acts.iter().filter_map(|(what, act)| act.as_ref().map(|act| text::act(what, act))));
    if rollout.start_time.is_some() {
        lines.push(format!("began {}", text::time(rollout.start_time.as_ref())));
    }
    if robots {
        let rows: Vec<Vec<String>> = members.iter().map(Listed::row).collect();
        lines.push(columns(v1::RolloutRobot::HEADER, &rows));
    }
    lines.join("\n")
}

/// What one robot waits for, or why it is not in it.
pub async fn explain(one: &RolloutTarget, robot_id: &str, out: &Out) -> Result<(), Exit> {
    let rollout = one.read().await?;
    let mut client = one.call.rollouts().await?;
    let found = members(&mut client, &one.rollout_id, robot_id).await?.robots;
    let Some(robot) = found.first() else { return left_out(&mut client, &rollout, robot_id, out).await };
    match out.format {
        Format::Table => out.line(&explanation(&rollout, robot)),
        Format::Name => out.line(&robot.robot_id),
        Format::Json | Format::Jsonl => {
            let of = rollout.verdicts.iter().filter(|v| v.wave == robot.wave);
            let verdicts = of.map(to_json).collect::<Result<Vec<_>, _>>().map_err(anyhow::Error::from)?;
            let robot = to_json(robot).map_err(anyhow::Error::from)?;
            out.value(&serde_json::json!({"robot": robot, "verdicts": verdicts}))?;
        }
    }
    Ok(())
}

/// What each robot waits for that waits for anything.
pub async fn explain_all(one: &RolloutTarget, out: &Out) -> Result<(), Exit> {
    let rollout = one.read().await?;
    let mut whole = members(&mut one.call.rollouts().await?, &one.rollout_id, "").await?;
    whole.robots.retain(|robot| robot.blocked_by.is_some());
    match out.format {
        Format::Table => {
            text::header(&rollout).iter().for_each(|line| out.line(line));
            whole.robots.iter().for_each(|robot| out.line(&explanation(&rollout, robot)));
        }
        _ => out.list(&whole)?,
    }
    out.next(&text::next(&rollout));
    Ok(())
}

/// What one robot waits for, for people.
pub fn explanation(rollout: &v1::Rollout, robot: &v1::RolloutRobot) -> String {
    let waves = text::waves_of(rollout);
    let since = text::time(robot.since.as_ref());
    let step = text::step(robot.step());
    let wave = text::wave(robot.wave, waves);
    let mut lines = vec![format!("{} in {}, {wave}: {step} since {since}", robot.robot_id, rollout.rollout_id)];
    match &robot.blocked_by {
        Some(by) => {
            let until = match &robot.deadline {
                Some(deadline) => format!("until {} at most", text::time(Some(deadline))),
                None => "as long as it takes".to_owned(),
            };
            lines.push(format!("  waits for {}", text::reason(by)));
            lines.extend(by.metadata.get("robot_ids").map(|robots| format!("  for its turn after {}", plain(robots))));
            lines.push(format!("  since {}, {until}", text::time(robot.blocked_since.as_ref())));
        }
        None => lines.push("  waits for nothing".to_owned()),
    }
    let whys = [("failed", &robot.failure), ("because", &robot.why)];
    lines.extend(whys.iter().filter_map(|(word, why)| why.as_ref().map(|r| format!("  {word}: {}", text::reason(r)))));
    if !robot.from_version.is_empty() {
        lines.push(format!("  ran {} before", robot.from_version));
    }
    let off_work = robot.off_work.as_ref().and_then(text::off_work);
    lines.extend(off_work.map(|parts| format!("  out of work: {parts}")));
    if let Some(tasks) = robot.trial.filter(|t| t.succeeded + t.failed > 0) {
        lines.push(format!("  on trial: {} tasks done, {} failed", tasks.succeeded, tasks.failed));
    }
    if !robot.drain_id.is_empty() {
        lines.push(format!("  drain {}", robot.drain_id));
    }
    lines.extend(robot.lost.as_ref().map(|since| format!("  lost since {}", text::time(Some(since)))));
    lines.extend(
        robot.written_off.as_ref().map(|act| format!("  {}", text::act("counts in no budget, written off", act))),
    );
    let of = rollout.verdicts.iter().filter(|v| v.wave == robot.wave);
    lines.extend(of.map(|v| format!("  {}", text::verdict(v, waves))));
    lines.join("\n")
}

/// A robot that has no row in it: the dry run knows why.
async fn left_out(client: &mut Client, rollout: &v1::Rollout, robot_id: &str, out: &Out) -> Result<(), Exit> {
    let id = &rollout.rollout_id;
    let request = v1::PlanRolloutRequest { rollout_id: id.clone(), spec: None };
    let plan = client.plan_rollout(unary(request)).await.map(tonic::Response::into_inner).unwrap_or_default();
    let Some(left) = plan.left_out.iter().find(|l| l.robot_id == robot_id) else {
        let not_yet = if rollout.start_time.is_none() { ", which has not begun" } else { "" };
        let text = format!("{robot_id} is not in {id}{not_yet}\n  try: midshift rollout robots {id}");
        return Err(Exit::new(NOT_FOUND, text));
    };
    out.one(left, robot_id, || {
        let why = left.reason.as_ref().map(text::reason).unwrap_or_default();
        format!("{robot_id} is not in {id}; as the fleet is now it is left out\n  {why}")
    })?;
    Ok(())
}

/// One thing that happened.
#[derive(Debug, PartialEq)]
pub struct Event {
    /// When, UTC on the site clock.
    pub time: Timestamp,
    /// What, in one word.
    pub what: &'static str,
    /// What happened, in a line for people.
    pub text: String,
}

/// What happened, as far as rows say it.
pub async fn history(one: &RolloutTarget, out: &Out) -> Result<(), Exit> {
    let rollout = one.read().await?;
    let robots = members(&mut one.call.rollouts().await?, &one.rollout_id, "").await?.robots;
    let events = events(&rollout, &robots);
    match out.format {
        Format::Table => events.iter().for_each(|e| out.line(&format!("{}  {}", text::time(Some(&e.time)), e.text))),
        Format::Name => events.iter().for_each(|e| out.line(e.what)),
        Format::Json | Format::Jsonl => {
            let json =
                |e: &Event| serde_json::json!({"time": text::time(Some(&e.time)), "what": e.what, "text": e.text});
            let all: Vec<_> = events.iter().map(json).collect();
            match out.format {
                Format::Jsonl => all.iter().try_for_each(|event| out.value(event))?,
                _ => out.value(&all.into())?,
            }
        }
    }
    out.inform(
        "read from what the roll-out and its robots are now: of each robot its last step, of pauses none that ended",
    );
    Ok(())
}

/// What happened, in order.
pub fn events(rollout: &v1::Rollout, robots: &[v1::RolloutRobot]) -> Vec<Event> {
    let waves = text::waves_of(rollout);
    let mut events = Vec::new();
    let mut add = |time: Option<Timestamp>, what, text: String| {
        events.extend(time.map(|time| Event { time, what, text }));
    };
    let said = |act: &v1::RolloutAct, what: &str| {
        let why = if act.reason.is_empty() { String::new() } else { format!(" ({})", plain(&act.reason)) };
        format!("{what} by {}{why}", act.actor)
    };
    for (what, word, act) in
        [("created", "written down", &rollout.created), ("approved", "approved", &rollout.approved)]
    {
        if let Some(act) = act {
            add(act.time, what, said(act, word));
        }
    }
    add(rollout.start_time, "started", "began".to_owned());
    for verdict in &rollout.verdicts {
        add(verdict.time, "verdict", text::verdict(verdict, waves));
    }
    if let Some(abort) = &rollout.abort {
        add(abort.time, "aborted", text::abort(abort));
    }
    for robot in robots {
        let why = robot.failure.as_ref().or(robot.why.as_ref()).map(|r| format!("  {}", text::reason(r)));
        let step = text::step(robot.step());
        let wave = text::wave(robot.wave, waves);
        add(robot.since, "robot", format!("{}  {step}  {wave}{}", robot.robot_id, why.unwrap_or_default()));
    }
    add(rollout.since, "phase", format!("came to {}", text::state(rollout)));
    events.sort_by_key(|e| time_of(&e.time));
    events
}
