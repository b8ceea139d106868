//! What a run must have come to: rows in a real store, bodies of a real hall that stood still.

use super::{Inputs, Kind, Report};
use crate::task_summary::read_once;
use midshift_core::ids::TaskId;
use midshift_core::item::Item;
use midshift_core::rows::Writer;
use midshift_core::site::{DEMO, text};
use midshift_core::task::forms::Transport;
use midshift_core::task::{Phase, TaskIntake, TaskState};
use midshift_process::clock;
use midshift_sim::fleet::{Fleet, FleetConfig, FleetReport};
use midshift_store::{MemoryStore, Store, StoreId};
use std::sync::Arc;

const ROBOTS: usize = 4;
const TEN_MINUTES_MS: u64 = 600_000;
const OWN: Kind = Kind { built_in: true, own_backlog: true };

fn store() -> anyhow::Result<Arc<dyn Store>> {
    let id = StoreId(Arc::from("report"));
    Ok(Arc::new(MemoryStore::new(text::parse(DEMO)?.site_id().clone(), id, clock::clock(1_000))))
}

/// How request ids of the run begin.
const RUN: &str = "run-";

/// Admits a task that is in this phase.
async fn admit(store: &Arc<dyn Store>, number: usize, request_id: &str, phase: Phase) -> anyhow::Result<TaskId> {
    let form = Transport {
        kind: "transport".into(),
        from_waypoint: "A01".into(),
        to_waypoint: "B03".into(),
        timeout_ms: Some(600_000),
        ..Transport::default()
    };
    let intake = TaskIntake {
        task_id: TaskId::parse(&format!("TASK-{number:04}"))?,
        spec: form.into_raw().check("task", &|_| true)?,
        actor: String::new(),
        request_id: request_id.to_owned(),
        payload_hash: String::new(),
        created: clock::clock(1_000).now().utc,
        number: number as u64,
        type_revision: None,
    };
    let state = TaskState { phase, ..TaskState::born(&intake) };
    let mut item = Item::new(Writer::Task, "");
    item.create(&intake, "task.admitted").create(&state, "task.born");
    for committed in store.commit(vec![item]).await {
        committed?;
    }
    Ok(intake.task_id)
}

fn bodies() -> anyhow::Result<FleetReport> {
    let clock = clock::clock(1_000);
    let hall = Fleet::open(&FleetConfig::new(Arc::new(text::parse(DEMO)?), ROBOTS, 1), &clock.now())?;
    Ok(hall.report(clock.now().site)?)
}

/// A run of four robots that came to so many tasks of each phase.
async fn run(kind: Kind, site_ms: u64, phases: &[(Phase, usize)]) -> anyhow::Result<Report> {
    let store = store()?;
    let mut acknowledged = Vec::new();
    for (phase, count) in phases {
        for _ in 0..*count {
            let number = acknowledged.len() + 1;
            acknowledged.push(admit(&store, number, &format!("{RUN}{number}"), *phase).await?);
        }
    }
    report(kind, site_ms, store, acknowledged).await
}

async fn report(kind: Kind, site_ms: u64, store: Arc<dyn Store>, acknowledged: Vec<TaskId>) -> anyhow::Result<Report> {
    Ok(Report::from_run(Inputs {
        kind,
        seed: 1,
        acknowledged,
        tasks: read_once(store, RUN, 0).await?,
        bodies: bodies()?,
        place_waits: 0,
        no_progress_ms: 0,
        site_ms,
        wall_ms: site_ms,
        story: None,
    }))
}

#[tokio::test]
async fn a_run_at_the_very_edge_of_what_is_asked_is_good() -> anyhow::Result<()> {
    let phases = [(Phase::Succeeded, 92), (Phase::NeedsOperator, 2), (Phase::Queued, 5), (Phase::Running, 3)];
    let report = run(OWN, TEN_MINUTES_MS, &phases).await?;
    assert_eq!((report.submitted, report.to_operator, report.open), (102, 2, 8));
    assert_eq!(report.objections(), Vec::<String>::new());
    Ok(())
}

#[tokio::test]
async fn each_of_the_six_states_is_counted_from_its_rows() -> anyhow::Result<()> {
    let phases: Vec<(Phase, usize)> = Phase::ALL.iter().enumerate().map(|(i, phase)| (*phase, i + 1)).collect();
    let report = run(Kind::default(), 1_000, &phases).await?;
    let of = |wanted: Phase| phases.iter().filter(|(p, _)| *p == wanted).map(|(_, n)| *n).sum::<usize>();
    let over = [report.succeeded, report.failed, report.canceled, report.expired, report.to_operator];
    let wanted = [Phase::Succeeded, Phase::Failed, Phase::Canceled, Phase::Expired, Phase::NeedsOperator].map(of);
    assert_eq!(over, wanted);
    assert_eq!(report.open, phases.iter().map(|(_, n)| *n).sum::<usize>() - wanted.iter().sum::<usize>());
    assert!(report.states_add_up);
    Ok(())
}

#[tokio::test]
async fn too_few_done_too_many_with_a_person_and_too_many_open_are_three_objections() -> anyhow::Result<()> {
    let phases = [(Phase::Succeeded, 31), (Phase::NeedsOperator, 2), (Phase::Queued, 9)];
    let why = run(OWN, TEN_MINUTES_MS, &phases).await?.objections();
    assert_eq!(
        why,
        ["31 tasks succeeded, 32 were to", "2 tasks wait for an operator, 1 may", "9 tasks are open, 8 may be"]
    );
    Ok(())
}

#[tokio::test]
async fn what_must_succeed_goes_with_the_site_time() -> anyhow::Result<()> {
    let asked = |site_ms| async move { anyhow::Ok(run(OWN, site_ms, &[]).await?.asked.succeeded_min) };
    assert_eq!(asked(TEN_MINUTES_MS).await?, Some(32));
    assert_eq!(asked(2 * TEN_MINUTES_MS).await?, Some(64));
    assert_eq!(asked(TEN_MINUTES_MS / 2).await?, Some(16));
    Ok(())
}

#[tokio::test]
async fn a_short_run_is_held_to_the_laws_and_its_backlog_alone() -> anyhow::Result<()> {
    let short = run(OWN, 120_000, &[(Phase::NeedsOperator, 3), (Phase::Queued, 8)]).await?;
    assert_eq!(short.objections(), Vec::<String>::new());
    assert_eq!(short.asked.open_max, Some(8));
    Ok(())
}

#[tokio::test]
async fn another_floor_or_backlog_is_not_asked_for_what_only_the_built_in_one_gives() -> anyhow::Result<()> {
    let imported = Kind { built_in: false, own_backlog: true };
    let report = run(imported, TEN_MINUTES_MS, &[(Phase::Queued, 9)]).await?;
    assert_eq!(report.objections(), ["9 tasks are open, 8 may be"]);
    let chosen = Kind { built_in: true, own_backlog: false };
    let report = run(chosen, TEN_MINUTES_MS, &[(Phase::Queued, 9), (Phase::NeedsOperator, 2)]).await?;
    assert_eq!(report.objections(), ["2 tasks wait for an operator, 1 may"]);
    Ok(())
}

#[tokio::test]
async fn what_the_journals_say_is_held_against_every_run() -> anyhow::Result<()> {
    let mut report = run(Kind::default(), 1_000, &[]).await?;
    report.exclusion_violations = 1;
    report.items_conserved = false;
    report.steps_done_twice = 2;
    assert_eq!(
        report.objections(),
        ["1 exclusion violations in the bodies' journals", "items were lost or doubled", "2 steps were done twice"]
    );
    Ok(())
}

#[tokio::test]
async fn a_request_that_was_admitted_twice_is_an_objection() -> anyhow::Result<()> {
    let store = store()?;
    let first = admit(&store, 1, "run-1", Phase::Succeeded).await?;
    admit(&store, 2, "run-1", Phase::Queued).await?;
    let report = report(Kind::default(), 1_000, store, vec![first]).await?;
    assert_eq!((report.submitted, report.succeeded, report.open), (1, 1, 1));
    assert_eq!(
        report.objections(),
        ["the six states do not add up to 1 submitted", "1 tasks were admitted without an acknowledgement, or twice"]
    );
    Ok(())
}

#[tokio::test]
async fn a_lost_task_is_an_objection_even_if_a_doubled_one_makes_up_the_sum() -> anyhow::Result<()> {
    let store = store()?;
    let first = admit(&store, 1, "run-1", Phase::Succeeded).await?;
    admit(&store, 2, "run-1", Phase::Queued).await?;
    let report = report(Kind::default(), 1_000, store, vec![first, TaskId::parse("TASK-lost")?]).await?;
    assert!(report.states_add_up);
    assert_eq!(
        report.objections(),
        ["1 acknowledged tasks have no row", "1 tasks were admitted without an acknowledgement, or twice"]
    );
    Ok(())
}

#[tokio::test]
async fn one_task_for_two_requests_does_not_add_up() -> anyhow::Result<()> {
    let store = store()?;
    let first = admit(&store, 1, "run-1", Phase::Succeeded).await?;
    let report = report(Kind::default(), 1_000, store, vec![first.clone(), first]).await?;
    assert_eq!(report.objections(), ["the six states do not add up to 2 submitted"]);
    Ok(())
}

#[tokio::test]
async fn tasks_of_others_are_told_and_held_against_nobody() -> anyhow::Result<()> {
    let store = store()?;
    let own = admit(&store, 1, "run-1", Phase::Succeeded).await?;
    admit(&store, 2, "somebody-1", Phase::NeedsOperator).await?;
    admit(&store, 3, "", Phase::Queued).await?;
    let report = report(OWN, 1_000, store, vec![own]).await?;
    assert_eq!((report.submitted, report.to_operator, report.open, report.of_others), (1, 0, 0, 2));
    assert_eq!(report.objections(), Vec::<String>::new());
    Ok(())
}
