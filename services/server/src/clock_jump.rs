//! Saves the last jump of a server's wall clock in its data folder, so that the server still tells of it after a start.
//!
//! Invariant: it is told, and nothing else follows from it: durations, windows and certificates go by jumps of their own run. Whoever asks for the time
//! does not wait for the disk.

use anyhow::Context;
use midshift_core::time::{Clock, Jump, Utc};
use serde::{Deserialize, Serialize};
use std::fs;
use std::path::Path;
use std::time::Duration;

/// In the data folder.
const FILE: &str = "clock-jump.json";
/// How often a server looks whether there was one, real time.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Older ones are over: nobody looks into them any more. Milliseconds.
const TOLD_MS: u64 = 24 * 3_600_000;

/// The last jump of the wall clock, as the file has it.
#[derive(Serialize, Deserialize)]
struct SavedJump {
    /// Milliseconds ahead; negative: back.
    step_ms: i64,
    /// When it had, UTC of the wall, unix ms.
    to_unix_ms: i64,
}

/// What the clock jumped at last before this run, and UTC when it had; none: nothing that is told.
pub fn before(data: &Path, now: Utc) -> Option<(i64, Utc)> {
    let saved: SavedJump = serde_json::from_slice(&fs::read(data.join(FILE)).ok()?).ok()?;
    let to = Utc(saved.to_unix_ms);
    (now.ms_since(to) <= TOLD_MS).then_some((saved.step_ms, to))
}

/// Saves each jump of the wall clock in this run, until it is dropped.
pub async fn save_jumps(data: &Path, clock: &dyn Clock) {
    let mut known = None;
    loop {
        let seen = clock.last_jump();
        if let Some(jump) = seen.filter(|_| seen != known) {
            known = seen;
            if let Err(error) = write(data, &jump) {
                tracing::warn!(error = format!("{error:#}"), "a jump of the clock is not kept for the next start");
            }
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

fn write(data: &Path, jump: &Jump) -> anyhow::Result<()> {
    let (path, saved) = (data.join(FILE), SavedJump { step_ms: jump.step_ms(), to_unix_ms: jump.to.0 });
    midshift_durable::replace(&path, &serde_json::to_vec(&saved)?)
        .with_context(|| format!("writing {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::wall_clock::WallClock;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicI64, Ordering::Relaxed};

    #[tokio::test(start_paused = true)]
    async fn a_jump_is_told_by_the_run_after_it_for_a_day() {
        let began = Utc(1_800_000_000_000);
        let (folder, wall) = (tempfile::tempdir().expect("a folder"), Arc::new(AtomicI64::new(began.0)));
        let set = wall.clone();
        let clock = WallClock::new(|| 0, move || Utc(wall.load(Relaxed)), |_: &Jump| {});
        let runs = async || {
            clock.now();
            let _ = tokio::time::timeout(LOOK_EVERY * 2, save_jumps(folder.path(), &clock)).await;
        };
        runs().await;
        assert_eq!(before(folder.path(), began), None);
        for step_ms in [7_200_000, -6_000] {
            let to = Utc(set.fetch_add(step_ms, Relaxed) + step_ms);
            runs().await;
            assert_eq!(before(folder.path(), to.plus_ms(TOLD_MS)), Some((step_ms, to)));
            assert_eq!(before(folder.path(), to.plus_ms(TOLD_MS + 1)), None);
        }
        fs::write(folder.path().join(FILE), "soon").expect("written");
        assert_eq!(before(folder.path(), began), None);
    }
}
