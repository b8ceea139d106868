//! Robots in columns: what they say of themselves beside what was decided about them, each since when.
//!
//! Invariant: what is not known now is not shown as if it were: it stands in parentheses, with its age beside it.

use crate::client::{Call, Exit, unary};
use crate::endpoint::Line;
use crate::out::{Format, Out, few};
use crate::pages::{self, PAGE_SIZE};
use crate::presence::{age, presence, since, wall};
use midshift_core::time::Utc;
use midshift_proto::convert::{ms_of, time_of};
use midshift_proto::fleet::v1 as fleet;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::json::to_json;
use midshift_proto::link::v1 as link;
use midshift_proto::telemetry::v1;
use std::collections::BTreeMap;
use tonic::Status;

/// Columns of a robot.
const HEADER: [&str; 11] =
    ["ROBOT", "PRESENCE", "STATE", "AREA", "AT", "BATTERY", "LOAD", "WORK", "SPEED", "SOFTWARE", "AGE"];

/// Columns that a narrow terminal does without, in this order.
const SPARE: [&str; 6] = ["SOFTWARE", "SPEED", "AT", "LOAD", "WORK", "AREA"];

/// Shows robots as the terminal is wide.
pub fn show(rows: &[Vec<String>], out: &Out) {
    out.table(&HEADER, rows, &SPARE);
}

/// One robot. `now`: the moment on the site clock at which `control` was looked at; none: not known.
pub fn row(robot: &v1::Robot, control: Option<&fleet::RobotControl>, now: Option<Utc>) -> Vec<String> {
    let reported = robot.reported.clone().unwrap_or_default();
    let vitals = reported.vitals.clone().unwrap_or_default();
    let last = robot.last_heard.as_ref();
    let is_now = robot.reported.is_some() && robot.presence() != v1::Presence::Offline;
    let shown = |text: String| if is_now || text.is_empty() { text } else { format!("({text})") };
    let work = reported.attempts.iter().find(|a| a.state() < link::WorkState::Succeeded).map(|a| {
        let id = a.attempt.as_ref().map(|i| i.subject.clone()).unwrap_or_default();
        format!("{id} {}", a.state().as_str_name().trim_start_matches("WORK_STATE_"))
    });
    let is_known = robot.reported.is_some() || last.is_some();
    let battery_permille = last.map_or(vitals.battery_permille, |last| last.battery_permille);
    let charging = if vitals.charging { " +" } else { "" };
    let battery = format!("{:.0} %{charging}", f64::from(battery_permille) / 10.0);
    let is_empty =
        control.and_then(|control| control.load_settled.as_ref()).is_some_and(|word| !word.is_forget_pending);
    let load = reported.load.as_ref().filter(|_| !is_empty).map(|l| l.item.clone());
    let age_ms = robot.age.as_ref().or(last.and_then(|last| last.age.as_ref())).map(ms_of);
    vec![
        robot.robot_id.clone(),
        presence(robot),
        state(robot, control, now),
        robot.area_id.clone(),
        shown(last.map_or(vitals.waypoint, |last| last.waypoint.clone())),
        if is_known { shown(battery) } else { "-".to_owned() },
        shown(load.unwrap_or_default()),
        shown(work.unwrap_or_default()),
        if is_now { format!("{:.1} m/s", f64::from(vitals.speed_mm_s) / 1000.0) } else { "-".to_owned() },
        robot.inventory.as_ref().map(|inventory| inventory.software.clone()).unwrap_or_default(),
        age_ms.map_or_else(|| "-".to_owned(), age),
    ]
}

/// What keeps a robot from work, by its own word and by what was decided, the gravest first, each since when; `ok` if nothing.
fn state(robot: &v1::Robot, control: Option<&fleet::RobotControl>, now: Option<Utc>) -> String {
    let wall = wall(robot);
    let mut all: Vec<String> =
        robot.conditions.iter().map(|c| format!("{}{}", c.what, since(c.since.as_ref(), wall))).collect();
    all.extend(control.into_iter().flat_map(|control| decided(control, now)));
    if all.is_empty() { "ok".to_owned() } else { all.join(", ") }
}

/// What was decided about a robot, each since when.
fn decided(control: &fleet::RobotControl, now: Option<Utc>) -> Vec<String> {
    let cordon = |word: &str, cordon: &fleet::Cordon| format!("{word}{}", since(cordon.since.as_ref(), now));
    let hold = |hold: &fleet::Hold| format!("held by {}{}", hold.token, since(hold.since.as_ref(), now));
    let drain = control.drain.as_ref().filter(|drain| drain.state() != fleet::DrainState::Refused);
    let drain = drain.map(|drain| {
        let state = drain.state().as_str_name().trim_start_matches("DRAIN_STATE_").to_lowercase();
        let word = if state == "draining" { state } else { format!("drain {state}") };
        format!("{word}{}", since(drain.since.as_ref(), now))
    });
    let breaker = control.breaker_open_time.as_ref().map(|at| format!("broken off{}", since(Some(at), now)));
    let retired = control.retired.as_ref().map(|retired| cordon("retired", retired));
    let cordoned = control.cordon.as_ref().map(|cordoned| cordon("cordoned", cordoned));
    let holds = few(control.holds.iter().map(hold).collect());
    holds.into_iter().chain([retired, cordoned, breaker, drain].into_iter().flatten()).collect()
}

/// Lists all robots.
pub async fn list(call: &Call, out: &Out) -> Result<(), Exit> {
    let robots = robots(call).await?;
    let (controls, now) = controls(&mut call.fleet().await?).await?;
    let control = |robot: &v1::Robot| controls.get(&robot.robot_id);
    match out.format {
        Format::Table => {
            let rows: Vec<Vec<String>> = robots.iter().map(|robot| row(robot, control(robot), now)).collect();
            show(&rows, out);
        }
        Format::Name => robots.iter().for_each(|robot| out.line(&robot.robot_id)),
        Format::Json => {
            let robots: Vec<_> = robots.iter().map(|r| document(r, control(r))).collect::<anyhow::Result<_>>()?;
            out.value(&serde_json::json!({ "robots": robots }))?;
        }
        Format::Jsonl => {
            for robot in &robots {
                out.value(&document(robot, control(robot))?)?;
            }
        }
    }
    Ok(())
}

/// A robot with what was decided about it in the key `control`.
fn document(robot: &v1::Robot, control: Option<&fleet::RobotControl>) -> anyhow::Result<serde_json::Value> {
    let mut document = to_json(robot)?;
    if let (Some(control), Some(fields)) = (control, document.as_object_mut()) {
        fields.insert("control".to_owned(), to_json(control)?);
    }
    Ok(document)
}

/// All robots of a server.
pub async fn robots(call: &Call) -> Result<Vec<v1::Robot>, Exit> {
    let mut client = call.telemetry().await?;
    let request = |page_token| unary(v1::ListRobotsRequest { filter: None, page_size: PAGE_SIZE, page_token });
    Ok(pages::all(async |page_token| client.list_robots(request(page_token)).await).await?.robots)
}

/// What was decided about robots, by robot, and the moment on the site clock at which that was looked at.
pub async fn controls(
    client: &mut FleetServiceClient<Line>,
) -> Result<(BTreeMap<String, fleet::RobotControl>, Option<Utc>), Status> {
    let request = |page_token| unary(fleet::ListRobotControlsRequest { page_size: PAGE_SIZE, page_token });
    let whole = pages::all(async |page_token| client.list_robot_controls(request(page_token)).await).await?;
    let controls = whole.controls.into_iter().map(|control| (control.robot_id.clone(), control)).collect();
    Ok((controls, whole.list_time.as_ref().map(time_of)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_proto::convert::{duration, timestamp};
    use prost_types::Timestamp;

    const NOW: Utc = Utc(1_800_000_000_000);

    fn ago(ms: i64) -> Option<Timestamp> {
        Some(timestamp(Utc(NOW.0 - ms)))
    }

    fn cell<'a>(row: &'a [String], name: &str) -> &'a str {
        HEADER.iter().position(|h| *h == name).map_or("", |at| row[at].as_str())
    }

    fn heard() -> v1::Robot {
        let vitals = link::Vitals { battery_permille: 640, waypoint: "A".into(), ..link::Vitals::default() };
        v1::Robot {
            robot_id: "r1".into(),
            presence: v1::Presence::Online as i32,
            reported: Some(link::ReportedState { vitals: Some(vitals), ..link::ReportedState::default() }),
            receive_time: ago(1_200),
            age: Some(duration(1_200)),
            area_id: "hall".into(),
            ..v1::Robot::default()
        }
    }

    #[test]
    fn a_robot_that_is_held_by_hundreds_of_stops_has_a_row_that_can_be_read() {
        let hold = |n| fleet::Hold { token: format!("resume:STOP-{n:040}"), since: ago(90_000) };
        let control = fleet::RobotControl { holds: (0..256).map(hold).collect(), ..fleet::RobotControl::default() };
        let state = state(&heard(), Some(&control), Some(NOW));
        assert!(state.ends_with(", +253 more") && state.len() < 300, "{state}");
    }

    #[test]
    fn a_robot_is_listed_with_what_keeps_it_from_work_each_since_when() {
        let said = |what: &str, ms| v1::Condition { what: what.to_owned(), since: ago(ms) };
        let robot = v1::Robot { conditions: vec![said("fault 2001", 5_000), said("manual", 180_000)], ..heard() };
        let cordon = fleet::Cordon { since: ago(7_200_000), ..fleet::Cordon::default() };
        let drain =
            fleet::Drain { state: fleet::DrainState::Draining as i32, since: ago(60_000), ..fleet::Drain::default() };
        let control = fleet::RobotControl {
            robot_id: "r1".into(),
            holds: vec![fleet::Hold { token: "stop:S1".into(), since: ago(90_000) }],
            cordon: Some(cordon),
            breaker_open_time: ago(3 * 86_400_000),
            drain: Some(drain.clone()),
            ..fleet::RobotControl::default()
        };
        let shown = row(&robot, Some(&control), Some(NOW));
        let told = "fault 2001 (5.0 s), manual (3 min), held by stop:S1 (1 min), cordoned (2 h), broken off (3 d), draining (1 min)";
        assert_eq!(cell(&shown, "STATE"), told);
        assert_eq!((cell(&shown, "AREA"), cell(&shown, "PRESENCE"), cell(&shown, "AGE")), ("hall", "ONLINE", "1.2 s"));
        assert_eq!(shown.len(), HEADER.len());
        let refused = fleet::Drain { state: fleet::DrainState::Refused as i32, ..drain };
        let works = fleet::RobotControl { drain: Some(refused), ..fleet::RobotControl::default() };
        assert_eq!(cell(&row(&heard(), Some(&works), Some(NOW)), "STATE"), "ok");
    }

    #[test]
    fn what_is_not_known_now_stands_in_parentheses_with_its_age() {
        let last = v1::LastHeard {
            receive_time: ago(7_200_000),
            age: Some(duration(7_200_000)),
            battery_permille: 640,
            waypoint: "A".into(),
        };
        let robot = v1::Robot {
            presence: v1::Presence::Offline as i32,
            presence_since: ago(7_200_000),
            reported: None,
            receive_time: None,
            age: None,
            last_heard: Some(last),
            ..heard()
        };
        let shown = row(&robot, None, None);
        let cells = ["PRESENCE", "AT", "BATTERY", "SPEED", "AGE"].map(|name| cell(&shown, name));
        assert_eq!(cells, ["OFFLINE (2 h)", "(A)", "(64 %)", "-", "2 h"]);
        let nothing = row(&v1::Robot { last_heard: None, presence_since: None, ..robot }, None, None);
        assert_eq!(["BATTERY", "AGE"].map(|name| cell(&nothing, name)), ["-", "-"]);
    }

    #[test]
    fn a_load_that_a_person_settled_is_not_shown() {
        let mut robot = heard();
        robot.presence = v1::Presence::Offline as i32;
        let load = link::Load { item: "crate".into(), ..link::Load::default() };
        robot.reported.as_mut().expect("a report").load = Some(load);
        assert_eq!(cell(&row(&robot, None, None), "LOAD"), "(crate)");
        let control = fleet::RobotControl { load_settled: Some(fleet::LoadSettled::default()), ..Default::default() };
        assert_eq!(cell(&row(&robot, Some(&control), None), "LOAD"), "");
        let told = fleet::LoadSettled { is_forget_pending: true, ..fleet::LoadSettled::default() };
        let control = fleet::RobotControl { load_settled: Some(told), ..Default::default() };
        assert_eq!(cell(&row(&robot, Some(&control), None), "LOAD"), "(crate)", "it has not forgotten it yet");
    }
}
