//! What is looked at again and again in a long run, and its thirds.

use crate::child::Child;
use crate::engine::Bed;
use crate::figure::percentile;
use crate::ota::server::scene::Floor;
use crate::process_files::Memory;
use std::fmt;
use std::path::Path;
use std::time::Duration;

/// One look.
#[derive(Clone, Debug)]
pub struct Sample {
    at: Duration,
    /// The server's own memory, MiB.
    pub own_mib: f64,
    /// Of everything that the server keeps, with the database, bytes.
    files_bytes: u64,
    /// Of each submit since the look before, milliseconds.
    submits_ms: Vec<f64>,
}

impl Sample {
    /// Looks at a server and its files.
    pub async fn look_at(
        server: &Child,
        bed: &Bed<'_>,
        floor: &Floor,
        at: Duration,
        submits_ms: Vec<f64>,
    ) -> anyhow::Result<Self> {
        let own_mib = Memory::read(server.pid())?.own_mib;
        let files_bytes = sum_files(&floor.data())? + bed.database_bytes().await?;
        Ok(Self { at, own_mib, files_bytes, submits_ms })
    }
}

impl fmt::Display for Sample {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (minutes, mb) = (self.at.as_secs_f64() / 60.0, self.files_bytes as f64 / 1e6);
        let p50 = percentile(&self.submits_ms, 0.5);
        write!(f, "{minutes:.1} min: {:.1} MiB, {mb:.1} MB of files, submit p50 {p50:.1} ms", self.own_mib)
    }
}

fn sum_files(folder: &Path) -> anyhow::Result<u64> {
    let mut sum = 0;
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        // One that went meanwhile has no bytes.
        let Ok(metadata) = entry.metadata() else { continue };
        sum += if metadata.is_dir() { sum_files(&entry.path())? } else { metadata.len() };
    }
    Ok(sum)
}

/// The second and the last third of a run; the first one warms up.
pub struct Thirds<'s> {
    pub second: &'s [Sample],
    pub last: &'s [Sample],
}

impl<'s> Thirds<'s> {
    /// Cuts a run.
    pub fn cut_run(samples: &'s [Sample]) -> Self {
        let third = samples.len() / 3;
        let (rest, last) = samples.split_at(samples.len() - third);
        Self { second: &rest[rest.len() - third..], last }
    }
}

/// A percentile of the submits of each minute or so: of each twelve looks.
pub fn percentiles(samples: &[Sample], share: f64) -> Vec<f64> {
    const LOOKS: usize = 12;
    let all = |looks: &[Sample]| looks.iter().flat_map(|look| look.submits_ms.clone()).collect::<Vec<_>>();
    samples.chunks(LOOKS).map(|looks| percentile(&all(looks), share)).collect()
}

/// How fast files grow, megabytes a minute.
pub fn growth_mb_a_minute(samples: &[Sample]) -> f64 {
    let (Some(first), Some(last)) = (samples.first(), samples.last()) else { return 0.0 };
    let minutes = (last.at - first.at).as_secs_f64() / 60.0;
    if minutes > 0.0 { (last.files_bytes as f64 - first.files_bytes as f64) / 1e6 / minutes } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(minute: u64, files_bytes: u64, submits_ms: &[f64]) -> Sample {
        let at = Duration::from_secs(minute * 60);
        Sample { at, own_mib: minute as f64, files_bytes, submits_ms: submits_ms.to_vec() }
    }

    #[test]
    fn the_last_third_stands_beside_the_one_before_it_and_the_rest_warms_up() {
        let samples: Vec<Sample> = (0..8).map(|minute| sample(minute, minute * 2_000_000, &[1.0, 3.0])).collect();
        let thirds = Thirds::cut_run(&samples);
        let minutes = |samples: &[Sample]| samples.iter().map(|s| s.own_mib).collect::<Vec<_>>();
        assert_eq!((minutes(thirds.second), minutes(thirds.last)), (vec![4.0, 5.0], vec![6.0, 7.0]));
        assert!((growth_mb_a_minute(thirds.last) - 2.0).abs() < 1e-9);
        assert_eq!(percentiles(thirds.last, 1.0), [3.0]);
        assert_eq!(growth_mb_a_minute(&samples[..1]), 0.0);
    }

    #[test]
    fn files_are_summed_in_folders_too() {
        let dir = tempfile::tempdir().expect("a folder");
        std::fs::create_dir(dir.path().join("inner")).expect("made");
        for (name, bytes) in [("a", 3), ("inner/b", 4)] {
            std::fs::write(dir.path().join(name), vec![0; bytes]).expect("written");
        }
        assert_eq!(sum_files(dir.path()).expect("read"), 7);
    }
}
