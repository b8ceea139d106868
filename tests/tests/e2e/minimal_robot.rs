//! A robot that was written from docs/robot-protocol.md: its server is killed in the middle of a task, it is cut off in the middle of another
//! and killed in the middle of a third, and it takes no offer that lay in a buffer. Its own journal of effects is the judge. What it carries by its
//! memory alone it forgets by a person's word.

use crate::harness::{Running, until};
use crate::languages::minimal_robot;
use crate::proxy::Proxy;
use crate::rolled_out::done;
use crate::room::{LIMIT, Room};
use anyhow::{Context, ensure};
use midshift_core::site::CORRIDOR;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{ExplainRobotRequest, RobotExplanation};
use midshift_proto::link::v1::robot_event::Event as Said;
use midshift_proto::link::v1::{AttemptReport, Lane, WorkState};
use midshift_proto::task::v1::{GetTaskRequest, TaskState};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListEventsRequest, event::Item};
use std::io::Write;
use std::path::Path;
use std::time::Duration;

const NAME: &str = "rbt-py";
/// How long an offer lies in the proxy: it is valid for 5 s, and the robot gives a silent session up after 10 s.
const HELD: Duration = Duration::from_secs(7);

fn lines(path: &Path) -> Vec<String> {
    std::fs::read_to_string(path).unwrap_or_default().lines().map(str::to_owned).collect()
}

/// What the robot has written down.
fn memory(dir: &Path) -> anyhow::Result<serde_json::Value> {
    Ok(serde_json::from_slice(&std::fs::read(dir.join("robot.json"))?)?)
}

/// Whether it has written down that it begins the pick of a task, and nothing of its end.
fn is_picking(dir: &Path, task: &str) -> anyhow::Result<bool> {
    let holder = &memory(dir)?["holder"];
    Ok(holder["subject"] == task && holder["intent"] == 1)
}

async fn until_it_picks(dir: &Path, task: &str) -> anyhow::Result<()> {
    until("it picks", LIMIT, async || Ok(is_picking(dir, task)?.then_some(()))).await
}

/// A number that the robot has written down.
fn number(dir: &Path, key: &str) -> anyhow::Result<u64> {
    memory(dir)?[key].as_u64().with_context(|| format!("no {key}"))
}

/// Events that the robot has written and the server has not acknowledged to it.
fn unacknowledged(dir: &Path) -> anyhow::Result<u64> {
    Ok(number(dir, "produced")?.saturating_sub(number(dir, "acked")?))
}

fn reports<'a>(said: &'a [Said], task: &str) -> Vec<&'a AttemptReport> {
    let of_task = |s: &'a Said| match s {
        Said::Attempt(report) if report.attempt.as_ref().is_some_and(|id| id.subject == task) => Some(report),
        _ => None,
    };
    said.iter().filter_map(of_task).collect()
}

async fn attempts(room: &Room, task: &str) -> anyhow::Result<usize> {
    let request = GetTaskRequest { task_id: task.to_owned() };
    Ok(room.server.tasks()?.get_task(request).await?.into_inner().attempts.len())
}

/// Waits until the body has picked the item of a task up.
async fn until_carried(dir: &Path, task: &str) -> anyhow::Result<()> {
    let picked = format!("pick {task} ");
    until("the item is picked up", LIMIT, async || {
        Ok(lines(&dir.join("effects")).iter().any(|line| line.starts_with(&picked)).then_some(()))
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_from_the_proto_files_alone_outlives_kills_and_a_cut_and_does_nothing_twice() -> anyhow::Result<()> {
    let mut room = Room::open_on(&CORRIDOR.replace("speed_limit_mm_s = 1500", "speed_limit_mm_s = 5000")).await?;
    let (dir, proxy) = (&room.dir.path().to_owned(), Proxy::before(room.server.address).await?);
    let log = dir.join("robot.log");
    let mut command = minimal_robot(NAME, proxy.address, None, dir).await?;
    let mut robot = Running::start(&mut command, &log)?;
    room.until_held("park-a", NAME, true).await?;

    // What it says to a server that stands still is lost with that server: it must be said again.
    room.submit("T1", NAME).await?;
    until_it_picks(dir, "T1").await?;
    room.server.freeze()?;
    let before = number(dir, "produced")?;
    until("events that nobody hears", LIMIT, async || Ok((number(dir, "produced")? > before + 1).then_some(())))
        .await?;
    room.server.kill_and_restart().await?;
    room.until_state("T1", TaskState::Succeeded).await?;

    // Cut in the middle of a task, with events under way that the server may have and the robot does not know of.
    room.submit("T2", NAME).await?;
    until_carried(dir, "T2").await?;
    proxy.hold(true);
    until("events without an answer", LIMIT, async || Ok((unacknowledged(dir)? > 0).then_some(()))).await?;
    proxy.cut();
    proxy.hold(false);
    room.until_state("T2", TaskState::Succeeded).await?;

    // Killed inside a pick, which the gripper ends without it: what it must remember is in its file, and what was done is in the journal.
    room.submit("T3", NAME).await?;
    until_it_picks(dir, "T3").await?;
    robot.kill()?;
    ensure!(is_picking(dir, "T3")? && lines(&dir.join("effects")).len() == 4, "it was not killed inside its pick");
    writeln!(std::fs::OpenOptions::new().append(true).open(dir.join("effects"))?, "pick T3 1 found")?;
    robot = Running::start(&mut command, &log)?;
    room.until_state("T3", TaskState::Succeeded).await?;
    ensure!(!robot.has_ended()?, "{:?}", lines(&log));

    let effects: Vec<_> = ["T1", "T2", "T3"]
        .into_iter()
        .flat_map(|task| [format!("pick {task} 1 found"), format!("place {task} 3 found")])
        .collect();
    assert_eq!(lines(&dir.join("effects")), effects);
    let sessions =
        lines(&log).iter().filter(|line| line.starts_with("session ") && line.ends_with("in charge")).count();
    assert!(sessions >= 4, "a break was not noticed: {:?}", lines(&log));
    let said = room.said(NAME).await?;
    for task in ["T1", "T2", "T3"] {
        assert_eq!(attempts(&room, task).await?, 1, "{task} was granted again");
        let done = reports(&said, task).into_iter().filter(|r| r.state() == WorkState::Succeeded).count();
        assert_eq!(done, 1, "{task} ended once");
    }
    every_event_is_there_once(&room).await
}

/// Whatever was cut off on the way up was sent again, and stored once.
async fn every_event_is_there_once(room: &Room) -> anyhow::Result<()> {
    let mut client = TelemetryServiceClient::new(room.server.channel()?);
    let request = ListEventsRequest { robot_ids: vec![NAME.to_owned()], page_size: 1_000, ..Default::default() };
    let mut expected = 1;
    for event in client.list_events(request).await?.into_inner().events {
        let lane = event.lane();
        let Some(Item::Sample(sample)) = event.item else { anyhow::bail!("a gap: {event:?}") };
        assert_eq!((lane, sample.seq), (Lane::Event, expected));
        expected += 1;
    }
    ensure!(expected > 10, "only {expected} events");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_from_the_proto_files_alone_refuses_an_offer_that_lay_in_a_buffer() -> anyhow::Result<()> {
    let room = Room::open_on(&CORRIDOR.replace("speed_limit_mm_s = 1500", "speed_limit_mm_s = 5000")).await?;
    let (dir, proxy) = (room.dir.path(), Proxy::before(room.server.address).await?);
    let mut command = minimal_robot(NAME, proxy.address, None, dir).await?;
    let _robot = Running::start(&mut command, &dir.join("robot.log"))?;
    room.until_held("park-a", NAME, true).await?;
    proxy.hold(true);
    room.submit("T1", NAME).await?;
    room.until_state("T1", TaskState::Assigned).await?;
    // The fault itself: this is how long the bytes lie in the proxy.
    tokio::time::sleep(HELD).await;
    proxy.hold(false);
    room.until_state("T1", TaskState::Succeeded).await?;
    let said = room.said(NAME).await?;
    let epochs: Vec<_> = reports(&said, "T1")
        .into_iter()
        .filter(|r| r.state() == WorkState::Accepted)
        .filter_map(|r| r.attempt.as_ref().map(|id| id.epoch))
        .collect();
    assert_eq!(epochs.len(), 1, "taken once: {epochs:?}");
    assert!(epochs[0] > 1, "it took what was {HELD:?} old");
    let refusals = reports(&said, "T1").into_iter().filter_map(|r| r.refusal.clone()).map(|reason| reason.code);
    assert!(refusals.clone().any(|code| code == "STALE_AUTHORITY"), "{:?}", refusals.collect::<Vec<_>>());
    Ok(())
}

/// Why it has no work.
async fn explained(room: &Room) -> anyhow::Result<RobotExplanation> {
    let request = ExplainRobotRequest { robot_id: NAME.to_owned() };
    let answer = FleetServiceClient::new(room.server.channel()?).explain_robot(request).await?;
    answer.into_inner().explanation.context("an explanation")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_from_the_proto_files_alone_forgets_a_load_by_a_persons_word_and_works() -> anyhow::Result<()> {
    let room = Room::open_on(&CORRIDOR.replace("speed_limit_mm_s = 1500", "speed_limit_mm_s = 5000")).await?;
    let dir = room.dir.path();
    // It remembers what somebody took off while it was switched off.
    std::fs::write(dir.join("robot.json"), r#"{"load": {"task_id": "", "item": "SKU-9"}}"#)?;
    let mut command = minimal_robot(NAME, room.server.address, None, dir).await?;
    let _robot = Running::start(&mut command, &dir.join("robot.log"))?;
    room.until_held("park-a", NAME, true).await?;
    room.submit("T1", NAME).await?;
    let waits_for = until("its load keeps it from work", LIMIT, async || {
        let verdict = explained(&room).await?.verdict.filter(|verdict| verdict.code == "ROBOT_LOADED");
        let item = |metadata: &str| verdict.as_ref().and_then(|verdict| verdict.metadata.get(metadata).cloned());
        Ok(item("item").filter(|item| item == "SKU-9").and(item("waits_for")))
    })
    .await?;
    ensure!(waits_for.ends_with(&format!("midshift robot load {NAME} --none")), "{waits_for}");
    let server = room.server.address.to_string();
    done(&["robot", "load", NAME, "--none", "--reason", "I took it off", "--server", &server])?;
    room.until_state("T1", TaskState::Succeeded).await?;
    let loads: Vec<_> = room
        .said(NAME)
        .await?
        .into_iter()
        .filter_map(|said| match said {
            Said::Load(report) => Some(report.load.map(|load| load.task_id)),
            _ => None,
        })
        .collect();
    assert_eq!(loads, [None, Some("T1".to_owned()), None], "first it forgets what it was told of");
    assert_eq!(lines(&dir.join("effects")), ["pick T1 1 found", "place T1 3 found"]);
    until("the word is over", LIMIT, async || {
        let control = explained(&room).await?.control.context("what fleet holds")?;
        Ok(control.load_settled.is_none().then_some(()))
    })
    .await
}
