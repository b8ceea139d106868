//! The stop service is killed at any call that changes its folder: what it answered as durable is there when it begins again, robots bring the rest, and said once
//! more everything comes to the same.
//!
//! Without being asked a seeded sample of the calls is cut; `MIDSHIFT_SITES=all` cuts every one. A write of which half arrives is the latch file's own test.

#![expect(clippy::print_stdout, reason = "the one that is killed says what it has done")]

use crate::harness::{Folder, Robot, Server, eventually, scope};
use crate::strace::{Sites, Victim, killed_after, sites};
use midshift_core::stop::Stop;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope as W;
use midshift_stop::verify;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use tonic::Code;

/// Names the folder to the process that is to be killed.
const LIFE_IN: &str = "MIDSHIFT_TEST_STOP_IN";
/// The test that lives there.
const LIVES: &str = "killed::a_life_lived_once_more_comes_to_the_same";
/// Cuts of a sample.
const SAMPLE: usize = 8;

/// What people do. A stop's reason is its name.
#[derive(Clone, Copy)]
enum Act {
    Engage(&'static str, bool),
    Reset(&'static str),
    /// The service ends in order and begins again.
    Restart,
}

const ACTS: [Act; 7] = [
    Act::Engage("a", true),
    Act::Engage("b", false),
    Act::Reset("a"),
    Act::Restart,
    Act::Engage("c", true),
    Act::Reset("b"),
    Act::Engage("d", false),
];
/// What is engaged in the end.
const LEFT: [&str; 2] = ["c", "d"];

fn request(name: &str, is_fleet: bool) -> v1::EngageRequest {
    let whom = if is_fleet { W::Fleet(v1::Fleet {}) } else { W::RobotId("r1".to_owned()) };
    v1::EngageRequest { reason: name.to_owned(), request_id: name.to_owned(), ..scope(whom) }
}

fn records(folder: &Path) -> usize {
    fs::read_to_string(folder.join("audit.jsonl")).map_or(0, |text| text.lines().count())
}

/// At least so many records are there, and all that was done is in both files: what is written next is written because of what is done next.
async fn settled(folder: &Path, least: usize) {
    let is_settled = || {
        let found = records(folder);
        let (_, kept) = midshift_latch::read::<serde_json::Value>(&folder.join("latch")).ok()?;
        (found >= least && kept["audit"]["n"].as_u64() == Some(found as u64)).then_some(())
    };
    eventually(async || is_settled()).await;
}

fn named<'a>(robot: &'a Robot, name: &str) -> Option<&'a Stop> {
    robot.latch.effective().find(|stop| stop.reason == name)
}

/// Does it all, or once more what of it was not done by a life before whose robot `brings` what it knows. Each line says what a robot knows, or what was answered.
async fn live(folder: &Path, brings: Option<Vec<Stop>>) {
    let is_first = brings.is_none();
    let mut least = records(folder) + 1;
    let mut server = Server::start(folder).await;
    let mut robot = Robot::dial(&server, "r1", brings.unwrap_or_default()).await.synced().await;
    settled(folder, least).await;
    for act in ACTS {
        match act {
            Act::Engage(name, is_fleet) if is_first => {
                // The robot may know of it before the disk does.
                let told = async {
                    robot.until(|robot| named(robot, name).is_some()).await;
                    println!("+told {}", serde_json::to_string(named(&robot, name).unwrap()).unwrap());
                };
                let (answer, ()) = tokio::join!(server.engage(request(name, is_fleet)), told);
                assert!(answer.unwrap().durable);
                println!("+engaged {name}");
                least += 1;
            }
            Act::Engage(name, is_fleet) => match server.engage(request(name, is_fleet)).await {
                Ok(answer) => {
                    assert!(answer.durable);
                    robot.until(|robot| named(robot, name).is_some()).await;
                }
                Err(status) => assert_eq!(status.code(), Code::FailedPrecondition, "{name} was reset: {status}"),
            },
            Act::Reset(name) => {
                // Two, if the service was killed before it had kept which request engaged the one that the robot brought.
                while let Some(stop_id) = named(&robot, name).map(|stop| stop.stop_id.to_string()) {
                    println!("+resetting {name}");
                    assert!(server.reset(&stop_id).await.durable);
                    println!("+reset {name}");
                    least += 1;
                    robot.until(|robot| !robot.effective().contains(&stop_id)).await;
                }
            }
            Act::Restart => {
                let brings = robot.latch.effective().cloned().collect();
                drop(robot);
                server.end().await;
                least += 1;
                server = Server::start(folder).await;
                robot = Robot::dial(&server, "r1", brings).await.synced().await;
            }
        }
        settled(folder, least).await;
    }
    let mut left: Vec<String> = robot.latch.effective().map(|stop| stop.reason.clone()).collect();
    left.sort_unstable();
    left.dedup();
    // A latch that was lost is one stop more.
    left.retain(|name| name.len() == 1);
    assert_eq!(left, LEFT);
    drop(robot);
    server.end().await;
}

#[tokio::test]
async fn a_life_lived_once_more_comes_to_the_same() {
    if let Some(folder) = std::env::var_os(LIFE_IN) {
        // In the process that is to be killed.
        return live(Path::new(&folder), None).await;
    }
    let folder = Folder::new();
    for brings in [None, Some(Vec::new())] {
        live(&folder.path(), brings).await;
        verify(&folder.path()).unwrap();
    }
}

/// What a process had said before it was killed.
#[derive(Default)]
struct Said {
    told: Vec<Stop>,
    engaged: BTreeSet<String>,
    resetting: BTreeSet<String>,
    reset: BTreeSet<String>,
}

impl Said {
    fn read(text: &str) -> Self {
        let mut said = Self::default();
        for (word, rest) in text.lines().filter_map(|line| line.strip_prefix('+')?.split_once(' ')) {
            match word {
                "told" => said.told.push(serde_json::from_str(rest).unwrap()),
                "engaged" => said.engaged.extend([rest.to_owned()]),
                "resetting" => said.resetting.extend([rest.to_owned()]),
                _ => said.reset.extend([rest.to_owned()]),
            }
        }
        said
    }
}

/// It begins again on what is there, its robot comes back, and what is to be done is done once more.
async fn goes_on(folder: &Path, said: &Said, is_lost: bool, when: &str) {
    let server = Server::start(folder).await;
    let robot = Robot::dial(&server, "r1", said.told.clone()).await.synced().await;
    let mut engaged = server.engaged().await;
    engaged.sort_unstable();
    assert_eq!(robot.effective(), engaged, "{when}: one latch");
    let is_engaged = |name: &str| named(&robot, name).is_some();
    let told = said.told.iter().map(|stop| &stop.reason);
    for name in told.chain(&said.engaged).filter(|name| !said.resetting.contains(*name)) {
        assert!(is_engaged(name), "{when}: {name} is gone");
    }
    assert!(!said.reset.iter().any(|name| is_engaged(name)), "{when}: a reset is gone");
    for stop in said.told.iter().filter(|stop| is_engaged(&stop.reason)) {
        assert_eq!(named(&robot, &stop.reason), Some(stop), "{when}: whole as it was told");
    }
    let known: BTreeSet<&str> = robot.latch.effective().map(|stop| stop.reason.as_str()).collect();
    assert_eq!(known.len(), engaged.len(), "{when}: each once");
    let lost =
        server.status().await.stops.into_iter().filter(|s| s.stop.as_ref().is_some_and(|s| s.actor == "midshift"));
    assert_eq!(lost.count(), usize::from(is_lost), "{when}: the fleet is stopped if the latch was lost, and only then");
    let brings = robot.latch.effective().cloned().collect();
    drop(robot);
    server.kill();
    live(folder, Some(brings)).await;
    verify(folder).unwrap_or_else(|error| panic!("{when}: {error}"));
}

/// Cuts a life that begins with nothing, or with a latch that cannot be read.
async fn cut(is_lost: bool) {
    let seed = std::env::var("MIDSHIFT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(1);
    let all = std::env::var("MIDSHIFT_SITES").is_ok_and(|sites| sites == "all");
    let begin = async || {
        let folder = Folder::new();
        if is_lost {
            let server = Server::start(&folder.path()).await;
            settled(&folder.path(), 1).await;
            server.end().await;
            fs::write(folder.path().join("latch"), [7; 4096]).unwrap();
        }
        folder
    };
    let at = |folder: &Path| [(LIFE_IN, folder.as_os_str().to_owned())];
    let folder = begin().await;
    let home = folder.path();
    let Sites { calls, paths } = sites(&Victim { test: LIVES, environment: &at(&home), folder: &home });
    let found = calls.len();
    assert!(found > 4 * ACTS.len(), "{found} calls change the disk: {calls:?}");
    let mut cuts: Vec<usize> = (1..=found).collect();
    if !all {
        cuts.shuffle(&mut StdRng::seed_from_u64(seed));
        cuts.truncate(SAMPLE);
    }
    for cut in &cuts {
        let when = format!("lost: {is_lost}, killed after call {cut}, {:?}, MIDSHIFT_SEED={seed}", calls[cut - 1]);
        let folder = begin().await;
        let home = folder.path();
        let said = killed_after(&Victim { test: LIVES, environment: &at(&home), folder: &home }, &paths, *cut);
        goes_on(&home, &Said::read(&said), is_lost, &when).await;
    }
    println!("lost: {is_lost}: {found} calls change the folder; {} of them were cut; MIDSHIFT_SEED={seed}", cuts.len());
}

#[tokio::test]
async fn wherever_it_is_killed_every_stop_that_was_answered_or_told_is_there_and_every_reset_that_was_answered() {
    cut(false).await;
}

#[tokio::test]
async fn wherever_it_is_killed_while_its_latch_is_lost_the_fleet_is_stopped() {
    cut(true).await;
}
