//! A gateway that loses its database and not its robots: it gives no new authority, its robots go to the other gateway with their work,
//! nothing is done twice, and it takes part again when the database is back.
//!
//! The gateway has a line of its own to PostgreSQL. Judged by rows, by what robots said they accepted and when, by their ledgers and journals.
//! Times of robots and processes are of this machine's one clock; the epoch of a session is the moment at which it began.

use crate::harness::{channel, folder, in_states, until};
use crate::kill::{TASKS, all_over, at_work, judge, judge_ledgers, submit};
use crate::robots::{Robots, with_robots};
use crate::split::{ROBOTS, events_have_no_hole};
use crate::stack::{Stack, is_ready};
use anyhow::{Context, ensure};
use midshift_core::limits;
use midshift_core::rows::Table;
use midshift_core::site::{DEMO, text};
use midshift_core::task::Attempt;
use midshift_process::clock::clock;
use midshift_proto::link::v1::robot_event::Event as Said;
use midshift_proto::link::v1::{WorkState, sample};
use midshift_proto::task::v1::TaskState;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListEventsRequest, ListRobotsRequest, Presence, event};
use midshift_store::{PostgresConfig, PostgresStore, Store};
use midshift_tests::line::Line;
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::Duration;

/// Longest wait for robots to be where they should be, on a machine that is busy.
const LIMIT: Duration = Duration::from_secs(60);
/// Robots at work that the gateway must have when it is cut off.
const AT_WORK: usize = 3;

/// Sessions in charge that a gateway says it has begun: robot and epoch.
fn begun(log: &str) -> Vec<(String, u64)> {
    let field = |line: &str, name: &str| {
        line.split_whitespace().find_map(|word| word.strip_prefix(name)).map(|value| value.trim_matches('"').to_owned())
    };
    let lines = log.lines().filter(|line| line.contains("session begun") && line.contains("observed=false"));
    lines.filter_map(|line| Some((field(line, "robot_id=")?, field(line, "session_epoch=")?.parse().ok()?))).collect()
}

/// Robots that are online and the epochs of their sessions, as whoever is asked has it; none while it does not answer.
async fn online(server: SocketAddr) -> anyhow::Result<Option<BTreeMap<String, u64>>> {
    let page = TelemetryServiceClient::new(channel(server)?).list_robots(ListRobotsRequest::default()).await;
    let robots = page.ok().map(|page| page.into_inner().robots);
    let is_online = |robot: &midshift_proto::telemetry::v1::Robot| robot.presence() == Presence::Online;
    Ok(robots.map(|all| all.into_iter().filter(is_online).map(|r| (r.robot_id, r.session_epoch)).collect()))
}

/// An attempt that a robot accepted, by its own clock.
struct Accepted {
    robot_id: String,
    attempt: (String, u64),
    at_unix_ms: i64,
}

/// What every robot ever accepted.
async fn accepted(public: SocketAddr) -> anyhow::Result<Vec<Accepted>> {
    let mut telemetry = TelemetryServiceClient::new(channel(public)?);
    let (mut cursor, mut all) = (String::new(), Vec::new());
    loop {
        let request = ListEventsRequest { page_size: 1_000, cursor, ..ListEventsRequest::default() };
        let page = telemetry.list_events(request).await?.into_inner();
        for event in page.events {
            let Some(event::Item::Sample(sample)) = event.item else { continue };
            let Some(sample::Body::Event(said)) = sample.body else { continue };
            let Some(Said::Attempt(report)) = said.event else { continue };
            if report.state() == WorkState::Accepted {
                let id = report.attempt.context("an attempt has an id")?;
                let (robot_id, at_unix_ms) = (event.robot_id, sample.robot_unix_ms);
                all.push(Accepted { robot_id, attempt: (id.subject, id.epoch), at_unix_ms });
            }
        }
        if page.caught_up {
            return Ok(all);
        }
        cursor = page.cursor;
    }
}

/// Every attempt that has a row, by subject and epoch.
async fn attempts(stack: &Stack) -> anyhow::Result<BTreeMap<(String, u64), Attempt>> {
    let (config, site) = (PostgresConfig::new(stack.url()), text::parse(DEMO)?);
    let store = PostgresStore::open(&config, site.site_id().clone(), clock(1000)).await?;
    let snapshot = store.snapshot(&[Table::Attempt]).await?;
    store.close().await;
    let by_id = |attempt: Attempt| ((attempt.attempt.subject.to_string(), attempt.attempt.epoch), attempt);
    snapshot.rows.iter().map(|row| Ok(by_id(row.decode()?))).collect()
}

/// From the cut to its next session a robot accepts only what had been decided before the cut, and no longer than such an offer is
/// valid; from then on only what is anchored in a session that began after the cut.
async fn no_authority_came_through(
    stack: &Stack,
    cut_unix_ms: i64,
    moved: &BTreeMap<String, u64>,
) -> anyhow::Result<()> {
    let rows = attempts(stack).await?;
    let (mut late, mut after) = (0, 0);
    for said in accepted(stack.public).await?.into_iter().filter(|said| said.at_unix_ms > cut_unix_ms) {
        let Some(next) = moved.get(&said.robot_id) else { continue };
        let row = rows.get(&said.attempt).with_context(|| format!("no row of {:?}", said.attempt))?;
        if said.at_unix_ms < next.cast_signed() {
            let grace_ms = limits::OFFER_VALID.as_ms().cast_signed();
            ensure!(
                row.offered.0 <= cut_unix_ms && said.at_unix_ms <= cut_unix_ms + grace_ms,
                "cut at {cut_unix_ms}, next session {next}: {} accepted at {} {row:?}",
                said.robot_id,
                said.at_unix_ms
            );
            late += 1;
        } else {
            ensure!(row.offer.session_epoch >= *next, "{} accepted by its old session: {row:?}", said.robot_id);
            after += 1;
        }
    }
    say!("{late} offers were under way at the cut; {after} were accepted by the robots that had moved");
    ensure!(after > 0, "robots that moved have not worked again");
    Ok(())
}

async fn cut_off(sever: fn(&Line), seed: u64) -> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, ROBOTS)?;
    let mut stack = Stack::start(dir.path(), &text::render(&site), &["--no-software"], &[]).await?;
    let (gateway, other) = (stack.address("telemetry", 0)?, stack.address("telemetry", 1)?);
    let robots = Robots::start(dir.path(), stack.robots, stack.public, &site).await?;
    submit(stack.public, &site, seed, TASKS).await?;
    let mut here = BTreeSet::new();
    for done in (4..).step_by(2) {
        let running = at_work(stack.public, done, &BTreeSet::new()).await?;
        let newest = until("every robot", LIMIT, || online(other)).await?;
        here = begun(&stack.said("telemetry", 0)?).into_iter().filter(|(id, at)| newest.get(id) == Some(at)).collect();
        let has = |id: &String| here.iter().any(|(robot, _)| robot == id);
        if running.iter().filter(|task| has(&task.robot_id)).count() >= AT_WORK {
            break;
        }
        ensure!(done < 40, "the gateway never had {AT_WORK} robots at work");
    }
    let before: BTreeMap<String, u64> = here.into_iter().collect();
    let sessions = begun(&stack.said("telemetry", 0)?).len();
    let cut_unix_ms = clock(1000).now().wall.0;
    sever(&stack.line);
    say!("seed {seed}: a gateway with {} robots has lost its database", before.len());
    until("the gateway to say that it is not ready", LIMIT, || async {
        Ok(is_ready(gateway).await.is_some_and(|ready| !ready).then_some(()))
    })
    .await?;
    until("every robot online, those of the gateway in newer sessions", LIMIT, || async {
        let Some(now) = online(other).await? else { return Ok(None) };
        let has_moved = |(id, at): (&String, &u64)| now.get(id).is_some_and(|next| next > at);
        Ok((now.len() == ROBOTS && before.iter().all(has_moved)).then_some(()))
    })
    .await?;
    // The first session of each after the one that it had there.
    let mut moved: BTreeMap<String, u64> = BTreeMap::new();
    for (id, next) in begun(&stack.said("telemetry", 1)?) {
        if before.get(&id).is_some_and(|at| next > *at) {
            moved.entry(id).or_insert(next);
        }
    }
    assert!(moved.keys().eq(before.keys()), "not all of {before:?} are at the other gateway: {moved:?}");
    let last_ms = moved.values().max().map_or(0, |next| next.cast_signed() - cut_unix_ms);
    ensure!(last_ms < limits::AUTHORITY.as_ms().cast_signed(), "after {last_ms} ms their authority was over");
    say!(
        "the last of them was at the other gateway after {last_ms} ms; their authority to go on lasts {:?}",
        limits::AUTHORITY
    );
    // Work goes on meanwhile, also that of the robots that moved.
    let done = in_states(stack.public, &[TaskState::Succeeded]).await?;
    at_work(stack.public, done.map_or(0, |done| done.len()) + 10, &BTreeSet::new()).await?;
    ensure!(is_ready(gateway).await == Some(false), "it says that it is ready without a database");
    assert_eq!(begun(&stack.said("telemetry", 0)?).len(), sessions, "it began a session without its database");

    stack.line.heal();
    until("the gateway to be ready again", LIMIT, || async {
        Ok(is_ready(gateway).await.is_some_and(|ready| ready).then_some(()))
    })
    .await?;
    // It has what it missed: it says the same as the other one.
    until("the gateway to know where its robots are", LIMIT, || async {
        let (here, there) = (online(gateway).await?, online(other).await?);
        Ok((here == there && here.is_some_and(|robots| robots.len() == ROBOTS)).then_some(()))
    })
    .await?;
    let ended = all_over(stack.public, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    no_authority_came_through(&stack, cut_unix_ms, &moved).await?;
    events_have_no_hole(stack.public, ROBOTS).await?;
    judge_ledgers(&ended, robots).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_of_a_gateway_whose_database_answers_no_more_go_to_the_other_one_and_nothing_is_done_twice()
-> anyhow::Result<()> {
    cut_off(Line::cut, 13).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_of_a_gateway_whose_database_is_gone_go_to_the_other_one_and_nothing_is_done_twice() -> anyhow::Result<()>
{
    cut_off(Line::break_off, 17).await
}
