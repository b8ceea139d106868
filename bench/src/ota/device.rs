//! P9 on the robot's side: how short the way from one release to the next is, and what a download that is cut off costs ([`super::resume`]).
//!
//! Encoding is what `bundle sign` calls, [`midshift_bundle::encoding`]; decoding is what a robot calls, [`DiskSets`], with all it checks.

use super::programs;
use super::resume::{self, ResumeArgs};
use crate::figure::{Figure, median};
use crate::fsync::place;
use anyhow::{Context, ensure};
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sets::{CHUNK_BYTES, FileRef, Sets};
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding::{self, Base, Encoded};
use std::fs::File;
use std::hint::black_box;
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};
use tokio::time::Instant;

/// Times that a way in memory is measured, and the raw limits beside it.
const TIMES: usize = 3;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct DeviceArgs {
    /// Two releases of one program, e.g. of two revisions. Without it only a made-up pair is measured.
    #[arg(long, num_args = 2, value_names = ["OLD", "NEW"])]
    pair: Option<Vec<PathBuf>>,
    /// Decides the made-up pair, and where downloads are cut off.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Downloads that are cut off.
    #[command(flatten)]
    resume: ResumeArgs,
}

/// Ways between the releases of each pair, then downloads that are cut off.
pub async fn run(args: &DeviceArgs, dir: Option<&PathBuf>) -> anyhow::Result<Vec<Figure>> {
    let room = place(dir)?;
    let mut figures = Vec::new();
    if let Some([old, new]) = args.pair.as_deref() {
        let read = |path: &PathBuf| std::fs::read(path).with_context(|| format!("reading {}", path.display()));
        figures.extend(ways("given pair", &read(old)?, &read(new)?, room.path())?);
    }
    let (old, new) = programs::pair(args.seed);
    let name = format!("made pair, {} of 1000 changed", programs::CHANGED_PERMILLE);
    figures.extend(ways(&name, &old, &new, room.path())?);
    figures.extend(resume::run(&args.resume, args.seed, room.path()).await?);
    Ok(figures)
}

/// Seconds that something took, each time.
fn timed<T>(mut what: impl FnMut() -> anyhow::Result<T>) -> anyhow::Result<(Vec<f64>, T)> {
    let (mut seconds, mut last) = (Vec::new(), None);
    for _ in 0..TIMES {
        let begun = Instant::now();
        last = Some(what()?);
        seconds.push(begun.elapsed().as_secs_f64());
    }
    Ok((seconds, last.context("nothing was timed")?))
}

fn encode(base: Option<&[u8]>, new: &[u8]) -> anyhow::Result<(Vec<u8>, Encoded)> {
    let (mut base, mut out) = (base.map(Cursor::new), Vec::new());
    let base = base.as_mut().map(|base| base as &mut dyn Base);
    let encoded = encoding::encode(base, &mut &*new, new.len() as u64, &mut out, u64::MAX)?;
    Ok((out, encoded.context("it has no limit")?))
}

fn decode(base: Option<&[u8]>, way: &[u8], new: &[u8]) -> anyhow::Result<()> {
    let (mut base, mut out) = (base.map(Cursor::new), Vec::with_capacity(new.len()));
    let base = base.as_mut().map(|base| base as &mut dyn Base);
    encoding::decode(base, &mut &*way, new.len() as u64, &mut out)?;
    ensure!(out == new, "another file came out");
    Ok(())
}

fn store_content(sets: &mut DiskSets, bytes: &[u8]) -> anyhow::Result<FileRef> {
    let wanted = FileRef { digest: Digest::of_content(bytes), length: bytes.len() as u64 };
    for (chunk, at) in bytes.chunks(CHUNK_BYTES as usize).zip((0..).step_by(CHUNK_BYTES as usize)) {
        sets.write(&wanted, at, chunk)?;
    }
    sets.sync(&wanted)?;
    sets.seal(&wanted)?;
    Ok(wanted)
}

/// Seconds that a robot takes to make the new file of a way that is there, read it back and name it, each time in a folder of its own.
fn applied(base: Option<&[u8]>, way: &[u8], new: &[u8], room: &Path) -> anyhow::Result<Vec<f64>> {
    let mut seconds = Vec::new();
    for _ in 0..TIMES {
        let folder = tempfile::tempdir_in(room)?;
        let mut sets = DiskSets::open(folder.path())?;
        let base = base.map(|base| store_content(&mut sets, base)).transpose()?;
        let way = store_content(&mut sets, way)?;
        let wanted = FileRef { digest: Digest::of_content(new), length: new.len() as u64 };
        let begun = Instant::now();
        sets.decode(&wanted, base.map(|base| base.digest).as_ref(), &way)?;
        seconds.push(begun.elapsed().as_secs_f64());
        ensure!(sets.read(&wanted.digest, wanted.length)? == new, "another file came out");
    }
    Ok(seconds)
}

/// Sizes and times of the ways from one release to the next.
fn ways(pair: &str, old: &[u8], new: &[u8], room: &Path) -> anyhow::Result<Vec<Figure>> {
    ensure!(old != new, "{pair}: the two releases are the same");
    let (kib, whole) = (|bytes: usize| bytes as f64 / 1024.0, [new.len() as f64 / 1024.0]);
    let beside_whole = Some(("the file as it is", &whole[..]));
    let (sha_s, _) = timed(|| Ok(black_box(Digest::of_content(new))))?;
    let (copy_s, _) = timed(|| Ok(black_box(new.to_vec())))?;
    let (disk_s, _) = timed(|| {
        let mut file = File::create(room.join("raw"))?;
        file.write_all(new)?;
        file.sync_all()?;
        Ok(black_box(Digest::of_content(new)))
    })?;
    let name = |what: &str| format!("{pair}: {what}");
    let mut figures = Vec::new();
    for (word, base) in [("zstd", None), ("patch", Some(old))] {
        let (encode_s, (way, encoded)) = timed(|| encode(base, new))?;
        ensure!(encoded.length == way.len() as u64, "it counts wrong");
        let (decode_s, ()) = timed(|| decode(base, &way, new))?;
        let apply_s = applied(base, &way, new, room)?;
        let sha = Some(("SHA-256 of the new file", &*sha_s));
        let (copy, disk) =
            (Some(("copy of the new file", &*copy_s)), Some(("write, sync and SHA-256 of it", &*disk_s)));
        figures.extend([
            Figure::new("P9", name(word), "KiB", &[kib(way.len())], beside_whole),
            Figure::new("P9", name(&format!("{word}, share")), "%", &[kib(way.len()) * 100.0 / median(&whole)], None),
            Figure::new("P9", name(&format!("{word}, made by who signs")), "s", &encode_s, sha),
            Figure::new("P9", name(&format!("{word}, undone in memory")), "s", &decode_s, copy),
            Figure::new("P9", name(&format!("{word}, applied by a robot")), "s", &apply_s, disk),
        ]);
    }
    Ok(figures)
}
