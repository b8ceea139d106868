//! The same services as processes of their own: each of them is killed or replaced while robots work, and nothing is lost.

use crate::factory::with_software;
use crate::harness::{channel, folder, in_states, until};
use crate::kill::{TASKS, all_over, at_work, judge, judge_journals, judge_ledgers, submit};
use crate::robots::{Robots, with_robots};
use crate::rolled_out::{begin_rollout, call, done};
use crate::rolling::{self, Rolling};
use crate::room::LIMIT;
use crate::stack::Stack;
use anyhow::{Context, ensure};
use midshift_core::site::{DEMO, grid, text};
use midshift_process::clock::clock;
use midshift_proto::convert::common::time_of;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListEventsRequest, ListRobotsRequest, Presence, event};
use midshift_sim::journal::{self, Effect};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Agents of a stack at work.
pub const ROBOTS: usize = 20;
/// Robots under launchers, and the tasks that they have: some before their software is replaced, the others once the first of them may take it.
const LAUNCHED: usize = 4;
const TASKS_BESIDE: [usize; 2] = [10, 20];
/// Each of them fetches the whole program, of a debug build some 200 MB, while as many other tests run as there are cores and one.
const ROLLED_WITHIN: Duration = Duration::from_secs(300);
/// How many instead, in few processes on a free floor; a long run for `cargo xtask torture split`.
const MANY: &str = "MIDSHIFT_SPLIT_ROBOTS";
/// Processes that share them, and tasks for each.
const CROWDS: usize = 3;
const TASKS_EACH: usize = 3;

/// What happens to the stack, one after the other, and what a line says of it.
const BLOWS: [(&str, Blow); 18] = [
    ("kill -9 of identity", Blow::Kill("identity", 0)),
    ("kill -9 of a fleet", Blow::Kill("fleet", 0)),
    ("kill -9 of the other fleet", Blow::Kill("fleet", 1)),
    ("kill -9 of a gateway", Blow::Kill("telemetry", 0)),
    ("kill -9 of a task intake", Blow::Kill("task", 0)),
    ("kill -9 of the other task intake", Blow::Kill("task", 1)),
    ("kill -9 of an ota", Blow::Kill("ota", 0)),
    ("kill -9 of the other ota", Blow::Kill("ota", 1)),
    ("the end of whoever listens for commits", Blow::Deafen),
    ("a reload of the proxy", Blow::Reload),
    ("a gateway is asked to end", Blow::Ask("telemetry", 1)),
    ("a fleet is asked to end", Blow::Ask("fleet", 0)),
    // One of the two led.
    ("the other fleet is asked to end", Blow::Ask("fleet", 1)),
    ("a task intake is asked to end", Blow::Ask("task", 0)),
    ("the other task intake is asked to end", Blow::Ask("task", 1)),
    ("an ota is asked to end", Blow::Ask("ota", 0)),
    ("PostgreSQL ends at once, and starts again", Blow::Cut),
    ("PostgreSQL stays away until gateways let their robots go", Blow::Outage),
];

enum Blow {
    Kill(&'static str, usize),
    Ask(&'static str, usize),
    Deafen,
    Reload,
    Cut,
    Outage,
}

/// A floor without walls or passages on which so many robots find room and any cell is a station.
fn free_floor(robots: usize) -> String {
    let side = robots.isqrt() * 2;
    let rows = format!("{}\n", ".".repeat(side)).repeat(side);
    format!("type octile\nheight {side}\nwidth {side}\nmap\n{rows}")
}

/// When a task was offered to a robot first, after a moment of this machine's clock; none while nobody can say that one was.
async fn assigned_since(public: SocketAddr, unix_ms: i64) -> anyhow::Result<Option<i64>> {
    let tasks = in_states(public, &[]).await?.unwrap_or_default();
    let offers = tasks.into_iter().filter_map(|task| task.attempt?.offer_time);
    Ok(offers.map(|at| time_of(&at).0).filter(|at| *at > unix_ms).min())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tasks_go_on_while_every_process_of_a_split_stack_is_killed_or_replaced_in_turn() -> anyhow::Result<()> {
    let dir = folder()?;
    let many = std::env::var(MANY).ok().map(|many| many.parse::<usize>()).transpose().context(MANY)?;
    let map = many.map_or_else(|| DEMO.to_owned(), free_floor);
    let site = if many.is_some() { grid::parse_map("site", &map)? } else { with_robots(&map, ROBOTS)? };
    let (count, tasks) = many.map_or((ROBOTS, TASKS), |many| (many, many * TASKS_EACH));
    let samples = dir.path().join("samples");
    let (mut stack, robots) = match many {
        None => {
            let map = text::render(&site);
            let stack = Stack::start(dir.path(), &map, &["--drain-seconds", "20", "--no-software"], &[]).await?;
            let robots = Robots::start(dir.path(), stack.robots, stack.public, &site).await?;
            (stack, robots)
        }
        Some(_) => {
            rolling::prepare(&samples, &site)?;
            let keys = samples.join("keys").display().to_string();
            let stack = Stack::start(dir.path(), &map, &["--drain-seconds", "20"], &["--ota-keys", &keys]).await?;
            let trust = samples.join("trust.json");
            let robots = Robots::crowd(dir.path(), stack.robots, &stack.site, &trust, count, CROWDS)?;
            (stack, robots)
        }
    };
    submit(stack.public, &site, 7, tasks).await?;
    let rolling = match many {
        Some(_) => Some(Rolling::begin(&stack, &samples, "walk-1.5.0", count).await?),
        None => None,
    };
    let mut old_proxies = Vec::new();
    for (nth, (what, blow)) in BLOWS.into_iter().enumerate() {
        // So early that there is work left to assign after the last of them.
        at_work(stack.public, (4 + 7 * nth / 2) * tasks / 100, &BTreeSet::new()).await.context(what)?;
        let begun = clock(1000).now().wall.0;
        match blow {
            Blow::Kill(role, nth) => {
                stack.kill(role, nth)?;
                stack.restart(role, nth)?;
            }
            Blow::Ask(role, nth) => {
                assert_eq!(stack.ask_to_end(role, nth).await?, Some(0), "{what}");
                stack.restart(role, nth)?;
            }
            Blow::Deafen => stack.deafen().context(what)?,
            Blow::Reload => old_proxies.push(stack.reload_proxy()?),
            Blow::Cut => tokio::task::block_in_place(|| {
                stack.postgres.cut();
                stack.postgres.start_again();
            }),
            Blow::Outage => {
                tokio::task::block_in_place(|| stack.postgres.cut());
                stack.all_cut_off().await.context(what)?;
                tokio::task::block_in_place(|| stack.postgres.start_again());
            }
        }
        let next = until("the next assignment", Duration::from_secs(90), || assigned_since(stack.public, begun));
        let next = next.await.context(what)?;
        say!("{what}: the next assignment {} ms after it began", next - begun);
        if let Some(rolling) = &rolling {
            say!("{}", rolling.stands().await?);
        }
    }
    let ended = all_over(stack.public, tasks).await?;
    if let Some(rolling) = rolling {
        let good = rolling.ends(0).await?;
        ensure!(good.committed as usize == count, "not every robot keeps it: {good:?}");
        let ran = rolling::ran_in_their_drains(&stack, &site, &robots, "walk-1.5.0", "1.5.0").await?;
        ensure!(ran.len() == count && ran.values().all(|times| *times == 1), "each robot begins it once: {ran:?}");
        let most = rolling::most_out_of_work(&stack, &site, "walk-1.5.0").await?;
        say!("walk-1.5.0: at most {most} robots out of work at once, of {count}");
        ensure!((1..=count.div_ceil(10)).contains(&most), "a tenth may be: {most}");
        let id = "walk-1.6.0-bad-at-start";
        let bad = Rolling::begin(&stack, &samples, id, count).await?;
        for (role, nth) in [("ota", 0), ("ota", 1), ("fleet", 0), ("telemetry", 0)] {
            stack.kill(role, nth)?;
            stack.restart(role, nth)?;
        }
        let bad = bad.ends(12).await?;
        ensure!(bad.attempted == 1 && bad.committed == 0, "it ends at its canary: {bad:?}");
        let ran = rolling::ran_in_their_drains(&stack, &site, &robots, id, "1.6.0-bad-at-start").await?;
        ensure!(ran.len() == 1, "no robot but its canary runs it: {ran:?}");
    }
    let online = until("every robot", Duration::from_secs(60), || async {
        let request = ListRobotsRequest { page_size: 1_000, ..ListRobotsRequest::default() };
        let page = TelemetryServiceClient::new(channel(stack.public)?).list_robots(request).await;
        let online = |page: &midshift_proto::telemetry::v1::ListRobotsResponse| {
            page.robots.iter().filter(|robot| robot.presence() == Presence::Online).count() == count
        };
        Ok(page.ok().map(tonic::Response::into_inner).filter(online).map(|page| page.robots.len()))
    });
    assert_eq!(online.await?, count);
    // No agent was killed: nothing may need a person.
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    events_have_no_hole(stack.public, count).await.context("events")?;
    judge_ledgers(&ended, robots).await
}

/// Every number of every ring is there, once and in order, whichever gateway took it.
pub async fn events_have_no_hole(public: SocketAddr, count: usize) -> anyhow::Result<()> {
    let telemetry = TelemetryServiceClient::new(channel(public)?);
    let (mut cursor, mut last) = (String::new(), BTreeMap::new());
    loop {
        let request = ListEventsRequest { page_size: 1_000, cursor, ..ListEventsRequest::default() };
        let page = until("a page of events", LIMIT, || {
            let (mut telemetry, request) = (telemetry.clone(), request.clone());
            async move { Ok(telemetry.list_events(request).await.ok().map(tonic::Response::into_inner)) }
        })
        .await?;
        for said in page.events {
            let Some(event::Item::Sample(sample)) = &said.item else { anyhow::bail!("not a sample: {said:?}") };
            let known: &mut u64 = last.entry((said.robot_id.clone(), said.ring.clone(), said.lane)).or_default();
            assert_eq!(sample.seq, *known + 1, "{} of ring {} lane {}", said.robot_id, said.ring, said.lane);
            *known = sample.seq;
        }
        cursor = page.cursor;
        if page.caught_up {
            break;
        }
    }
    let robots: BTreeSet<&String> = last.keys().map(|(robot, ..)| robot).collect();
    assert_eq!(robots.len(), count);
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fleet_that_was_frozen_while_another_took_over_assigns_nothing_twice() -> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, ROBOTS)?;
    let mut stack = Stack::start(dir.path(), &text::render(&site), &["--no-software"], &[]).await?;
    let robots = Robots::start(dir.path(), stack.robots, stack.public, &site).await?;
    submit(stack.public, &site, 11, TASKS).await?;
    for (nth, done) in [(0, 8), (1, 24), (0, 40)] {
        at_work(stack.public, done, &BTreeSet::new()).await?;
        stack.signal("fleet", nth, "STOP")?;
        let stopped = clock(1000).now().wall.0;
        until("the next assignment", Duration::from_secs(90), || assigned_since(stack.public, stopped)).await?;
        stack.signal("fleet", nth, "CONT")?;
    }
    let ended = all_over(stack.public, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    judge_ledgers(&ended, robots).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_roll_out_in_the_middle_of_a_shift_goes_on_while_who_plans_it_signs_it_and_hands_it_out_is_killed()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = text::parse(DEMO)?;
    let (mut stack, robots, journals) = with_software(dir.path(), LAUNCHED).await?;
    let public = stack.public.to_string();
    submit(stack.public, &site, 37, TASKS_BESIDE[0]).await?;
    at_work(stack.public, 1, &BTreeSet::new()).await?;
    let within = format!("{}s", ROLLED_WITHIN.as_secs());
    let begin = |id: &str| {
        let quick = ["--soak", "0s", "--probation", "1s", "--exposure-tasks", "0"];
        done(&[&["rollout", "create", "--server", &public, id, "--waves", "1,50%,rest"][..], &quick].concat())?;
        begin_rollout(&public, id)
    };
    let blows: [(&'static str, usize); 4] = [("ota", 0), ("ota", 1), ("telemetry", 0), ("fleet", 0)];
    begin("walk-1.5.0")?;
    let enough = CancellationToken::new();
    let looking = rolling::looked_at(stack.public, "walk-1.5.0", [1, 2, 1], enough.clone());
    let looking = AbortOnDropHandle::new(tokio::spawn(looking));
    let told = RefCell::new(String::new());
    for (nth, (role, member)) in blows.into_iter().enumerate() {
        if nth == 2 {
            // However long it took until here: who does not take the release now has work.
            submit(stack.public, &site, 41, TASKS_BESIDE[1]).await?;
        }
        say!("kill -9 of {role} {member}");
        stack.kill(role, member)?;
        stack.restart(role, member)?;
        // So that blows fall on different steps of it.
        let wanted = u32::try_from(nth)?.min(2);
        until("some are permitted", ROLLED_WITHIN, async || {
            let Some(seen) = rolling::seen(stack.public, "walk-1.5.0").await? else { return Ok(None) };
            let stands = seen.to_string();
            if *told.borrow() != stands {
                say!("    {stands}");
                told.replace(stands);
            }
            Ok((seen.counts.attempted >= wanted).then_some(()))
        })
        .await?;
    }
    until("somebody answers again", LIMIT, async || rolling::seen(stack.public, "walk-1.5.0").await).await?;
    let wait = ["rollout", "wait", "--server", &public, "walk-1.5.0", "--timeout", &within];
    let waited = tokio::task::block_in_place(|| call(&wait))?;
    assert_eq!(waited.status.code(), Some(0), "{}", String::from_utf8_lossy(&waited.stderr));
    enough.cancel();
    let most = looking.await.context("looking at it")?.context("walk-1.5.0")?;
    ensure!(most >= 1, "nobody was seen out of work");
    for robot in &robots {
        robot.keeps("1.5.0").await?;
    }
    ensure!(work_went_on(&journals, "1.5.0")?, "nobody worked between the first robot and the last that took it");
    begin("walk-1.6.0-bad-at-start")?;
    until("one is permitted", ROLLED_WITHIN, async || {
        let seen = rolling::seen(stack.public, "walk-1.6.0-bad-at-start").await?;
        Ok(seen.filter(|seen| seen.counts.attempted > 0).map(|_| ()))
    })
    .await?;
    for (role, member) in blows {
        stack.kill(role, member)?;
        stack.restart(role, member)?;
    }
    until("somebody answers again", LIMIT, async || rolling::seen(stack.public, "walk-1.6.0-bad-at-start").await)
        .await?;
    let waited = call(&["rollout", "wait", "--server", &public, "walk-1.6.0-bad-at-start", "--timeout", &within])?;
    assert_eq!(waited.status.code(), Some(12), "{}", String::from_utf8_lossy(&waited.stderr));
    for robot in &robots {
        until("it is back on what it kept, or never left it", LIMIT, async || {
            Ok((robot.committed()?.as_deref() == Some("1.5.0") && robot.switch()?.trial.is_none()).then_some(()))
        })
        .await?;
    }
    let ended = rolling::seen(stack.public, "walk-1.6.0-bad-at-start").await?.context("nobody answers")?;
    assert_eq!(ended.counts.attempted, 1, "it ends at its canary");
    let tasks = all_over(stack.public, TASKS_BESIDE.iter().sum()).await?;
    judge_journals(&tasks, &BTreeSet::new(), &site, &journals)
}

/// Whether a robot put down what it carried after one of them began to run this release, and before the last one did.
fn work_went_on(journals: &[PathBuf], version: &str) -> anyhow::Result<bool> {
    let (mut began, mut placed) = (Vec::new(), Vec::new());
    for path in journals {
        let entries = journal::read(path)?;
        // A robot that starts again begins to run it again.
        let first =
            entries.iter().find(|entry| matches!(&entry.effect, Effect::Ran { version: ran } if ran == version));
        began.extend(first.map(|entry| entry.utc_ms));
        placed.extend(entries.iter().filter(|e| matches!(e.effect, Effect::Placed { .. })).map(|entry| entry.utc_ms));
    }
    let (first, last) = began.iter().min().zip(began.iter().max()).context("nobody ran it")?;
    Ok(placed.iter().any(|at| (first..last).contains(&at)))
}
