//! The stop service is a process of its own: while it is heard, no robot is slowed or stood by silence, whatever becomes of the server.

use crate::harness::{Server, channel, folder, until};
use crate::kill::{all_over, at_work, judge, submit};
use crate::robots::Robots;
use crate::stopped::StopServer;
use anyhow::ensure;
use midshift_core::robot::StopLevel;
use midshift_core::site::{DEMO, text};
use midshift_proto::link::v1::StopLevel as Shown;
use midshift_proto::stop::v1::GetStatusRequest;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_sim::journal::{self, Effect};
use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

const ROBOTS: usize = 6;
const TASKS: usize = 40;
const LIMIT: Duration = Duration::from_secs(60);

/// What a body was told to obey, in order: it boots stopped, and is then told what is stopped.
pub fn obeyed(journal: &Path) -> anyhow::Result<Vec<StopLevel>> {
    let effects = journal::read(journal)?.into_iter().map(|entry| entry.effect);
    Ok(effects.filter_map(|effect| if let Effect::Obeys { level, .. } = effect { Some(level) } else { None }).collect())
}

/// Whether it was only ever let go since its start.
fn was_let_alone(levels: &[StopLevel]) -> bool {
    levels.last() == Some(&StopLevel::None) && levels.iter().skip_while(|level| **level != StopLevel::None).count() == 1
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_killed_again_and_again_silences_no_robot_and_the_end_of_the_stop_service_does()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = text::parse(DEMO)?;
    let mut server = Server::start(dir.path()).await?;
    let mut stops = StopServer::start(dir.path(), server.address).await?;
    let (address, line) = (server.address, Some(stops.address));
    let robots = Robots::start_beside(dir.path(), address, address, line, &site, ROBOTS).await?;
    submit(address, &site, 31, TASKS).await?;
    for done in [2, 10, 18, 26] {
        at_work(address, done, &BTreeSet::new()).await?;
        server.kill_and_restart().await?;
    }
    let ended = all_over(address, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    let mut client = StopServiceClient::new(channel(stops.address)?);
    let status = client.get_status(GetStatusRequest {}).await?.into_inner().status.unwrap_or_default();
    ensure!(status.robots.len() == ROBOTS && status.stops.is_empty(), "{status:?}");
    for robot in &status.robots {
        let waits = !robot.awaiting_resume.is_empty() || robot.obeys() != Shown::Unspecified;
        ensure!(robot.heard_unix_ms > 0 && !waits, "{robot:?}");
    }
    for journal in robots.journals() {
        let levels = obeyed(&journal)?;
        ensure!(was_let_alone(&levels), "{}: {levels:?}", journal.display());
    }

    // The same bodies say so when it is the stop service that is silent.
    stops.kill()?;
    until("every robot stood by silence", LIMIT, async || {
        let all = robots.journals().iter().map(|journal| obeyed(journal)).collect::<anyhow::Result<Vec<_>>>()?;
        Ok(all.iter().all(|levels| levels.last() >= Some(&StopLevel::Halt)).then_some(()))
    })
    .await
}
