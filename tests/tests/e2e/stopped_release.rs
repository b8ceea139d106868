//! A fleet stop in the middle of a roll-out that is given up then: who has the bad release goes back where it stands, and nobody moves before a person has reset
//! and resumed the stop.

use crate::harness::{Server, folder, until};
use crate::kill::{all_over, at_work, submit};
use crate::rolled_out::{Doors, Robot, begin_rollout, call, done, fleet};
use crate::rolling::seen;
use crate::room::LIMIT;
use crate::stopped::{StopServer, judge_stops, resume, until_held};
use anyhow::ensure;
use midshift_agent::switch::FACTORY;
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::TaskState;
use midshift_sim::journal::{self, Effect};
use std::collections::BTreeSet;
use std::path::Path;

const ROBOTS: usize = 4;
const TASKS: usize = 24;
/// Bad with a load, so that it is still on probation when somebody stops the fleet.
const BAD: &str = "1.6.2-bad-with-load";

/// Where the body stood at the end of its journal, and how often it ran the bad release.
fn travelled(journal: &Path) -> anyhow::Result<(u64, usize)> {
    let (mut odometer, mut ran) = (0, 0);
    for entry in journal::read(journal)? {
        match entry.effect {
            Effect::Obeys { odometer_mm, .. } | Effect::Stood { odometer_mm } | Effect::Moved { odometer_mm } => {
                odometer = odometer_mm;
            }
            Effect::Ran { version } => ran += usize::from(version == BAD),
            _ => {}
        }
    }
    Ok((odometer, ran))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_canary_of_a_bad_release_goes_back_under_a_fleet_stop_and_nobody_moves_until_it_is_resumed()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = text::parse(DEMO)?;
    let samples = dir.path().join("samples");
    done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
    let keys = samples.join("keys").display().to_string();
    let server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &keys]).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let address = server.address.to_string();
    let ids: Vec<String> = (1..=ROBOTS).map(|number| format!("rbt-{number:02}")).collect();
    let doors = Doors { people: server.address, robots: server.address, stops: Some(stops.address) };
    let (robots, journals) = fleet(dir.path(), &doors, &samples, ROBOTS).await?;
    submit(server.address, &site, 11, TASKS).await?;
    at_work(server.address, 2, &BTreeSet::new()).await?;

    let id = format!("walk-{BAD}");
    let slow = ["--waves", "1,rest", "--allow-full-push", "--soak", "1h", "--probation", "1h"];
    done(&[&["rollout", "create", "--server", &address, &id][..], &slow, &["--exposure-tasks", "0"]].concat())?;
    begin_rollout(&address, &id)?;
    until("the canary on probation", LIMIT, async || {
        let counts = seen(server.address, &id).await?.map(|seen| seen.counts).unwrap_or_default();
        Ok((counts.attempted == 1 && robots.iter().any(|robot| robot.is_on_trial())).then_some(()))
    })
    .await?;

    // It comes back with success: every robot has confirmed that it stands.
    let stop_id = stops.stop(&["--all"])?;
    until_held(server.address, &ids, &format!("stop:{stop_id}")).await?;
    let stood = journals.iter().map(|journal| travelled(journal)).collect::<anyhow::Result<Vec<_>>>()?;
    done(&["rollout", "abort", "--server", &address, &id, "--reason", "somebody fell"])?;
    let waited = tokio::task::block_in_place(|| {
        call(&["rollout", "wait", "--server", &address, &id, "--for", "ended", "--timeout", "90s"])
    })?;
    ensure!(waited.status.code() == Some(12), "{}", String::from_utf8_lossy(&waited.stderr));
    until("everybody on what it kept", LIMIT, async || {
        let mut switches = robots.iter().map(Robot::switch).collect::<anyhow::Result<Vec<_>>>()?.into_iter();
        Ok(switches.all(|switch| switch.trial.is_none() && switch.running() == FACTORY).then_some(()))
    })
    .await?;
    ensure!(stops.engaged().await? == std::slice::from_ref(&stop_id), "it went back under the stop");
    // Also who was started anew for it, and has said so.
    until_held(server.address, &ids, &format!("stop:{stop_id}")).await?;

    stops.reset(&stop_id)?;
    until_held(server.address, &ids, &format!("resume:{stop_id}")).await?;
    let stands = journals.iter().map(|journal| travelled(journal)).collect::<anyhow::Result<Vec<_>>>()?;
    for ((id, (before, _)), (now, _)) in ids.iter().zip(&stood).zip(&stands) {
        ensure!(before == now, "{id} moved under the stop: from {before} to {now} mm");
    }
    let ran: usize = stands.iter().map(|(_, ran)| ran).sum();
    ensure!(ran == 1, "one robot ran the bad release once, and {ran} did");
    resume(&server, &stop_id)?;
    let ended = all_over(server.address, TASKS).await?;
    ensure!(ended.iter().all(|task| task.state() == TaskState::Succeeded), "{ended:?}");
    judge_stops(journals)
}
