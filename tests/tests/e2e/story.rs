//! The story of `dev --scenario update-midshift` as a user plays it: robots at work, some of them real launcher and agent processes, get releases.
//!
//! Invariant: whether it was good is judged by the program itself, which ends with 0 only then; here it is only asked that it did, and that it
//! told what it should. `MIDSHIFT_SEED` decides the bodies; `MIDSHIFT_STORY=all` plays the long story instead of a short one.

use crate::harness::midshift;
use anyhow::{Context, ensure};
use serde_json::Value;
use std::process::Stdio;
use std::time::Duration;
use tokio::process::Command;

/// A story that has not ended by then never will.
const LONGEST: Duration = Duration::from_secs(3_600);

/// Which story is played.
struct Plot {
    robots: usize,
    launched: usize,
    bundles: &'static [&'static str],
    flags: &'static [&'static str],
}

/// A good release and a bad one; nothing goes wrong by itself, so that chance aborts no good release.
const SHORT: Plot = Plot {
    robots: 20,
    launched: 5,
    bundles: &["1.5.0", "1.6.0-bad-at-start"],
    flags: &["--robots", "20", "--speedup", "10", "--watched", "3s", "--no-faults", "--bundles", "good,bad-at-start"],
};

/// All that a user gets without naming anything but robots and their pace.
const LONG: Plot = Plot {
    robots: 20,
    launched: 5,
    bundles: &["1.5.0", "1.6.0-bad-at-start", "1.6.1-hangs", "1.6.2-bad-with-load"],
    flags: &["--robots", "20", "--speedup", "5"],
};

/// Plays a story; what it told people, and its report.
async fn play(plot: &Plot) -> anyhow::Result<(String, Value)> {
    let seed = std::env::var("MIDSHIFT_SEED").unwrap_or_else(|_| "1".to_owned());
    say!("a story with MIDSHIFT_SEED={seed}");
    let dir = tempfile::tempdir()?;
    let report = dir.path().join("report.json");
    let mut command = Command::new(midshift()?);
    command.args(["dev", "--scenario", "update-midshift", "--listen", "127.0.0.1:0", "--seed", &seed]);
    command.args(plot.flags).arg("--report").arg(&report).stdin(Stdio::null()).kill_on_drop(true);
    let ended = tokio::time::timeout(LONGEST, command.output()).await.context("the story did not end")??;
    let told = String::from_utf8_lossy(&ended.stderr).into_owned();
    ensure!(ended.status.success(), "{}: {told}", ended.status);
    say!("{told}");
    Ok((told, serde_json::from_slice(&std::fs::read(&report)?)?))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_good_release_reaches_every_robot_and_a_bad_one_ends_with_its_canary() -> anyhow::Result<()> {
    let plot = if std::env::var("MIDSHIFT_STORY").is_ok_and(|story| story == "all") { LONG } else { SHORT };
    let (told, report) = play(&plot).await?;
    let Plot { robots, launched, bundles, .. } = plot;
    assert!(told.contains(&format!("{robots} robots at work, {launched} of them processes of their own")), "{told}");
    let acts = report["story"]["acts"].as_array().context("no roll-outs")?;
    assert_eq!(acts.len(), bundles.len(), "{report}");
    assert!(report["story"]["tasks_per_hour_before"].as_f64() > Some(0.0), "{report}");
    for (act, bundle) in acts.iter().zip(bundles) {
        let bundle = format!("walk-{bundle}: ");
        let line = told.lines().find(|l| l.starts_with(&bundle)).with_context(|| format!("no {bundle}: {told}"))?;
        let says = |text: &str| assert!(line.contains(text), "{line} does not say {text}");
        if bundle.contains("bad") || bundle.contains("hangs") {
            says(": ABORTED in ");
            says(", ran on 1 (permitted 1, at the abort 1, begun after it 0)");
            says(", kept by 0,");
            assert!(act["abort"].is_string(), "an abort without evidence: {act}");
        } else {
            says(": COMPLETED in ");
            assert!(act["tasks_per_hour"].as_f64() > Some(0.0), "nothing was done meanwhile: {act}");
            says(&format!(", ran on {robots} (permitted {robots}, "));
            says(&format!(", kept by {robots},"));
        }
        let areas = act["areas"].as_array().context("no areas")?;
        assert!(!areas.is_empty() && areas.iter().all(|a| a["out"].as_u64() <= a["may"].as_u64()), "{act}");
    }
    assert_eq!((&report["lost"], &report["exclusion_violations"]), (&0.into(), &0.into()), "{report}");
    Ok(())
}
