//! Memories of robots of each release, read by this build's agent.

use crate::plant::Engine;
use crate::run::ROBOTS;
use anyhow::{Context, ensure};
use midshift_agent::launcher::SWITCH;
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::{Kept, Store};
use midshift_agent::switch::Switch;
use midshift_agent::trust::Trust;
use midshift_core::robot::Lane;
use midshift_tests::released::{self, Release};
use midshift_tests::rows::keeps;
use serde::Serialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// Rows of a text by table, each as its values.
fn rows_of(sql: &str) -> BTreeMap<String, Vec<Vec<String>>> {
    let mut rows: BTreeMap<String, Vec<Vec<String>>> = BTreeMap::new();
    for line in sql.lines() {
        let Some((table, values)) = line.strip_prefix("INSERT INTO \"").and_then(|rest| rest.split_once("\" VALUES("))
        else {
            continue;
        };
        rows.entry(table.to_owned()).or_default().push(values_of(values));
    }
    rows
}

/// `1,'it''s',NULL);` as its values.
fn values_of(text: &str) -> Vec<String> {
    let (mut values, mut value, mut is_quoted) = (Vec::new(), String::new(), false);
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        match letter {
            '\'' if is_quoted && letters.peek() == Some(&'\'') => value.extend(letters.next()),
            '\'' => is_quoted = !is_quoted,
            ',' | ')' if !is_quoted => values.push(std::mem::take(&mut value)),
            other => value.push(other),
        }
    }
    values
}

/// Whether a value of a row and what this build made of it say the same.
fn same(text: &str, now: &impl Serialize, at: &str) -> anyhow::Result<()> {
    keeps(&serde_json::from_str::<Value>(text)?, &serde_json::to_value(now)?, at)
}

/// Holds what this build read against the text that it was read from. Every row must have a place.
fn hold(sql: &str, kept: &Kept) -> anyhow::Result<()> {
    let (ledger, ring) = (&kept.ledger, &kept.ring);
    let none = Vec::new();
    let rows = rows_of(sql);
    let of = |table: &str| rows.get(table).unwrap_or(&none);
    for fact in of("fact") {
        let [key, value] = &fact[..] else { anyhow::bail!("{fact:?}") };
        match key.as_str() {
            "ring" => ensure!(ring.id == *value, "the ring is {}", ring.id),
            "session" => same(value, &ledger.session, key)?,
            "applied" => same(value, &ledger.applied, key)?,
            "policy" => same(value, &ledger.policy, key)?,
            "holder" => same(value, &ledger.holder, key)?,
            "places" => same(value, &ledger.places, key)?,
            "maintenance" => same(value, &ledger.maintenance, key)?,
            "software" => same(value, &ledger.software, key)?,
            "trusted" => same(value, &ledger.trusted.as_deref(), key)?,
            "device" => same(value, &ledger.device, key)?,
            other => anyhow::bail!("fact {other} has no place here: add it"),
        }
    }
    for lane in Lane::ALL {
        let (number, has) = ((lane as i64).to_string(), ring.lane(lane));
        let of_lane = |table: &str| of(table).iter().filter(|row| row[0] == number).collect::<Vec<_>>();
        for row in of_lane("lane") {
            ensure!([&row[1], &row[2]] == [&has.produced.to_string(), &has.acked.to_string()], "{lane:?}: {row:?}");
        }
        let samples = of_lane("sample");
        ensure!(samples.len() == has.samples.len(), "{lane:?} had {} samples", samples.len());
        for (row, sample) in samples.iter().zip(&has.samples) {
            same(&row[2], sample.as_ref(), "sample")?;
        }
        ensure!(of_lane("gap").len() == has.gaps.len(), "{lane:?} had other gaps");
    }
    for row in of("subject") {
        let found = ledger.subjects().iter().find(|(subject, _)| subject.to_string() == row[0]);
        let (_, found) = found.with_context(|| format!("subject {} is lost", row[0]))?;
        ensure!([&row[1], &row[2]] == [&found.epoch.to_string(), &found.at_unix_ms.to_string()], "{row:?}");
        match (&found.report, row[3].as_str()) {
            (None, "NULL") => {}
            (Some(report), text) => same(text, report.as_ref(), "report")?,
            (None, text) => anyhow::bail!("report {text} is lost"),
        }
    }
    ensure!(of("unclosed").len() == ledger.unclosed.len(), "unclosed attempts are lost");
    Ok(())
}

#[tokio::test]
async fn nothing_of_a_robots_memory_is_lost() -> anyhow::Result<()> {
    for release in Release::all()? {
        for engine in [Engine::Sqlite, Engine::Postgres] {
            for (id, _) in ROBOTS {
                let from = release.engine(engine.name()).join("robots").join(id);
                read(&from).await.with_context(|| from.display().to_string())?;
            }
        }
    }
    Ok(())
}

async fn read(from: &Path) -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    released::copy(from, dir.path())?;
    let kept = SqliteStore::open(&dir.path().join("data/agent.db")).await?.load("another ring").await?;
    let sql = std::fs::read_to_string(from.join("data/agent.sql"))?;
    hold(&sql, &kept)?;
    let waits = kept.ring.lane(Lane::Event).samples.len();
    let works = kept.ledger.holder.is_some();
    ensure!(works == (waits > 0), "only the robot at work has news that no server has: {waits}");
    Trust::read(&dir.path().join("trust.json"))?;
    let switch = Switch::read(&dir.path().join("sets").join(SWITCH))?;
    let mut sets = DiskSets::open(&dir.path().join("sets"))?;
    let holdings = sets.holdings()?;
    ensure!(holdings.switch == switch, "{:?}", holdings.switch);
    ensure!(holdings.version(&switch.current).as_deref() == Some("1.5.0"), "it runs {}", switch.current);
    Ok(sets.verify(&switch.current.parse()?)?)
}
