//! A short measured run as a user starts it, and the file it leaves.

use crate::harness::midshift;
use serde_json::Value;
use std::process::Command;

#[test]
fn a_short_measured_run_ends_good_and_its_report_accounts_for_every_task() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let file = dir.path().join("report.json");
    let mut command = Command::new(midshift()?);
    command.args(["dev", "--robots", "6", "--speedup", "20", "--seed", "7", "--for", "2m", "--listen", "127.0.0.1:0"]);
    let output = command.arg("--report").arg(&file).output()?;
    let said = String::from_utf8(output.stderr)?;
    assert!(output.status.success(), "{said}");
    assert!(output.stdout.is_empty(), "a report goes to its file, talk to stderr");

    let report: Value = serde_json::from_str(&std::fs::read_to_string(&file)?)?;
    let number = |key: &str| report[key].as_u64().unwrap_or_else(|| panic!("no {key} in {report:#}"));
    assert_eq!((number("robots"), number("seed")), (6, 7));
    assert!(number("succeeded") > 0 && report["path_m"].as_f64() > Some(0.0), "nobody worked: {report:#}");
    assert!(report["site_s"].as_f64() >= Some(120.0), "{report:#}");
    let six = ["succeeded", "failed", "canceled", "expired", "to_operator", "open"].map(number);
    assert_eq!(six.iter().sum::<u64>(), number("submitted"));
    assert_eq!(report["states_add_up"], true);
    assert_eq!((number("exclusion_violations"), number("steps_done_twice")), (0, 0));
    assert_eq!((&report["items_conserved"], &report["collisions"]), (&Value::from(true), &Value::from("modelled")));
    // What the run was held to: two minutes are too short for amounts of work, never for the backlog.
    assert_eq!(report["asked"], serde_json::json!({"succeeded_min": null, "to_operator_max": null, "open_max": 12}));
    assert!(number("open") <= 12);
    for key in ["tasks_per_site_hour", "empty_run_rate", "no_progress_robot_minutes", "achieved_speedup"] {
        assert!(report[key].is_number(), "no {key} in {report:#}");
    }
    assert!(report["completion_s"]["p95"].as_f64() >= report["completion_s"]["p50"].as_f64());
    assert!(said.contains(&format!("{} submitted, {} succeeded", number("submitted"), number("succeeded"))), "{said}");
    Ok(())
}
