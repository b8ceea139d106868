//! `midshift robot pin|unpin|unstick`, and what is shown of a robot's software.

use crate::client::{Change, Exit, ended, unary};
use crate::out::{Out, plain};
use crate::robot_target::RobotTarget;
use midshift_proto::ota::v1;
use midshift_proto::telemetry::v1::Robot;

/// Sends a command about a robot's software, and prints what it runs after it and what comes `next`.
macro_rules! command {
    ($one:ident, $change:ident, $out:ident, $call:ident, $request:ident { $($reason:ident)? }, $next:expr) => {{
        let only = $change.only();
        let request = v1::$request {
            robot_id: $one.robot_id.clone(),
            request_id: $change.request_id,
            validate_only: $change.dry_run,
            $($reason)?
        };
        let answer = $one.call.rollouts().await?.$call(unary(request)).await.map_err(Exit::with_facts)?.into_inner();
        let software = answer.software.unwrap_or_default();
        $out.one(&software, &software.robot_id, || describe(&software))?;
        ended(answer.done_before.as_ref(), only, $next, $out);
        Ok(())
    }};
}

/// Keeps a robot at the software that it runs.
pub async fn pin(one: &RobotTarget, reason: String, change: Change, out: &Out) -> Result<(), Exit> {
    let next = format!("midshift robot unpin {}", one.robot_id);
    command!(one, change, out, pin_robot, PinRobotRequest { reason }, &next)
}

/// Lets a pinned robot take part in roll-outs again.
pub async fn unpin(one: &RobotTarget, change: Change, out: &Out) -> Result<(), Exit> {
    command!(one, change, out, unpin_robot, UnpinRobotRequest {}, "")
}

/// Tells a robot that could not go back from a bundle to do so once more.
pub async fn unstick(one: &RobotTarget, reason: String, change: Change, out: &Out) -> Result<(), Exit> {
    let next = format!("midshift robot get {}", one.robot_id);
    command!(one, change, out, unstick_robot, UnstickRobotRequest { reason }, &next)
}

/// Says in words what a robot runs.
fn describe(software: &v1::RobotSoftware) -> String {
    let short = |bundle: &str| bundle.chars().take(12).collect::<String>();
    let version = if software.version.is_empty() { "no version reported" } else { &software.version };
    let keeps = match software.committed.as_str() {
        "" => "what it came with".to_owned(),
        bundle => short(bundle),
    };
    let mut text = format!("{}  runs {version}, keeps {keeps}", software.robot_id);
    if !software.on_trial.is_empty() {
        text += &format!(", tries {}", short(&software.on_trial));
    }
    match &software.pin {
        Some(pin) => text + &format!("  pinned by {} ({})", plain(&pin.actor), plain(&pin.reason)),
        None => text + "  not pinned",
    }
}

/// Names the sets of software on a robot, and what speaks against believing it, a line each.
pub fn lines(robot: &Robot) -> Vec<String> {
    let mut lines = Vec::new();
    if robot.device_key_changed {
        lines.push("another machine's key signed what it says it has installed: not believed".to_owned());
    }
    if !robot.other_device_key.is_empty() {
        lines.push(format!(
            "other key  {}: no software until `midshift robot replace {}`, or --accept-key with it",
            robot.other_device_key, robot.robot_id
        ));
    }
    let Some(installed) = &robot.installed else { return lines };
    let role = |set: &str| match set {
        _ if set == installed.running && set != installed.current => "on trial",
        _ if set == installed.running => "runs",
        _ if set == installed.current || set == installed.previous => "kept",
        _ => "staged",
    };
    let words = |set: &str, version: &str| {
        let name = if version.is_empty() { "what it came with" } else { version };
        format!("software  {:<8}  {name}  {}", role(set), set.get(..12).unwrap_or(set))
    };
    for named in [&installed.running, &installed.current, &installed.previous] {
        if !named.is_empty() && !installed.sets.iter().any(|s| s.set == *named) {
            let line = words(named, "");
            lines.extend((!lines.contains(&line)).then_some(line));
        }
    }
    lines.extend(installed.sets.iter().map(|s| words(&s.set, &s.version)));
    lines
}
