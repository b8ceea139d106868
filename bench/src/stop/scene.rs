//! What goes on beside a stop: nothing, ingest at the knee, downloads, a database that hangs, a disk without room, a server that is killed.
//!
//! Invariant: the load is there in the turns of all; whatever was mounted or stopped is unmounted or goes on however the measurement ends.

use super::disturbance::Disturbance;
use super::simulators::text;
use super::site::Site;
use super::turns::{StopArgs, Turns, turns};
use crate::child::Child;
use crate::engine::{Engine, children_of};
use crate::fsync::place;
use crate::grid_map;
use crate::ota::noise::Releases;
use anyhow::{Context, ensure};
use rustix::process::{Pid, Signal, kill_process};
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// Robots of the load at the knee, as `link` has them.
const KNEE_ROBOTS: usize = 32;
/// Robots that keep their sessions where a server or its database is taken away.
const HEARERS: usize = 200;
/// Downloads at once, and the bytes of their file.
const DOWNLOADS: usize = 4;
const FILE_BYTES: u64 = 64 << 20;
/// Room of the disk that is filled: two slots of the latch, a database, and something to fill.
const DISK: &str = "size=256m";
/// A load is there by then.
const WITHIN: Duration = Duration::from_secs(30);
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// One size in one situation.
pub async fn measure(
    args: &StopArgs,
    site: &Site,
    robots: usize,
    disturbance: Disturbance,
    say: &dyn Fn(&str),
) -> anyhow::Result<Turns> {
    let room = place(args.dir.as_ref())?;
    let stops = room.path().join("stops");
    match disturbance {
        Disturbance::Nothing => turns(args, site, robots, &stops, room.path(), async || Ok(())).await,
        Disturbance::Ingest => ingest(args, site, robots, room.path(), say).await,
        Disturbance::Bulk => bulk(args, site, robots, room.path(), say).await,
        Disturbance::Database => database(args, site, robots, room.path()).await,
        Disturbance::Disk => disk(args, site, robots, room.path()).await,
        Disturbance::Kill => kill(args, site, robots, room.path()).await,
    }
}

/// A server below `room` on the first core, where the stop service is too.
async fn server(room: &Path) -> anyhow::Result<Child> {
    let map = grid_map::write(room, (HEARERS as f64).sqrt() as usize + 2)?;
    Child::serve(&room.join("data"), Some(&map), None, Some(0)).await
}

async fn hearers(server: &Child) -> anyhow::Result<Child> {
    let (address, robots) = (server.address.to_string(), HEARERS.to_string());
    Child::start(&["hearers", "--server", &address, "--robots", &robots], Some(1))
}

/// Waits until a child's counter has come so far.
async fn until(child: &mut Child, counter: &str, least: u64) -> anyhow::Result<()> {
    let end = Instant::now() + WITHIN;
    while child.ask(counter)? < least {
        ensure!(Instant::now() < end, "{counter} does not come to {least}");
        sleep(LOOK_EVERY).await;
    }
    Ok(())
}

async fn ingest(args: &StopArgs, site: &Site, robots: usize, room: &Path, say: &dyn Fn(&str)) -> anyhow::Result<Turns> {
    let server = server(room).await?;
    let (address, flooding) = (server.address.to_string(), KNEE_ROBOTS.to_string());
    let mut flood = Child::start(&["flood", "--server", &address, "--robots", &flooding], Some(1))?;
    until(&mut flood, "acked", 1).await?;
    let (begun, cpu_s, acked) = (Instant::now(), server.cpu_s()?, flood.ask("acked")?);
    let turns = turns(args, site, robots, &room.join("stops"), room, async || Ok(())).await?;
    let wall_s = begun.elapsed().as_secs_f64();
    let (reports, cpu_s) = ((flood.ask("acked")? - acked) as f64, server.cpu_since_s(cpu_s)?);
    say(&format!("  beside: {:.0} durable reports a second, {:.2} core", reports / wall_s, cpu_s / wall_s));
    Ok(turns)
}

async fn bulk(args: &StopArgs, site: &Site, robots: usize, room: &Path, say: &dyn Fn(&str)) -> anyhow::Result<Turns> {
    let mut releases = Releases::make(&room.join("releases"))?;
    let release = releases.add(1, FILE_BYTES)?;
    let (data, keys) = (room.join("data"), releases.keys());
    let role = ["server", "--data", text(&data)?, "--keys", text(&keys)?, "--listen", "127.0.0.1:0"];
    let server = Child::start(&role, Some(0))?.listening().await?;
    releases.push(&server).await?;
    let (address, digest) = (server.address.to_string(), release.file.digest.to_string());
    let (length, downloads) = (release.file.length.to_string(), DOWNLOADS.to_string());
    let role = ["pull", "--server", &address, "--digest", &digest, "--length", &length, "--downloads", &downloads];
    let mut pull = Child::start(&role, Some(1))?;
    until(&mut pull, "bytes", 1).await?;
    let (begun, before) = (Instant::now(), pull.ask("bytes")?);
    let turns = turns(args, site, robots, &room.join("stops"), room, async || Ok(())).await?;
    let mib = (pull.ask("bytes")? - before) as f64 / 1_048_576.0;
    say(&format!("  beside: {:.0} MiB a second in {DOWNLOADS} downloads", mib / begun.elapsed().as_secs_f64()));
    Ok(turns)
}

/// Processes that stand until this goes.
struct Stopped(Vec<Pid>);

impl Stopped {
    /// The first process of a server, then all that it has started.
    fn all_of(pid: u32) -> anyhow::Result<Self> {
        let mut stopped = Self(Vec::new());
        stopped.stop(pid)?;
        children_of(pid)?.into_iter().try_for_each(|child| stopped.stop(child))?;
        Ok(stopped)
    }
    fn stop(&mut self, pid: u32) -> anyhow::Result<()> {
        let pid = Pid::from_raw(i32::try_from(pid)?).context("no process")?;
        kill_process(pid, Signal::STOP).context("SIGSTOP")?;
        self.0.push(pid);
        Ok(())
    }
}

impl Drop for Stopped {
    fn drop(&mut self) {
        for pid in &self.0 {
            // One that is gone needs no leave to go on.
            let _ = kill_process(*pid, Signal::CONT);
        }
    }
}

async fn database(args: &StopArgs, site: &Site, robots: usize, room: &Path) -> anyhow::Result<Turns> {
    let engine = Engine::postgres(args.dir.as_deref())?;
    let bed = engine.bed(args.dir.as_ref())?;
    let map = grid_map::write(room, (HEARERS as f64).sqrt() as usize + 2)?;
    let mut server = bed.serve(Some(&map), Some(0)).await?;
    let _hearers = hearers(&server).await?;
    until(&mut server, crate::child::SESSIONS, HEARERS as u64).await?;
    let _stopped = Stopped::all_of(engine.pid().context("PostgreSQL does not say its number")?)?;
    turns(args, site, robots, &room.join("stops"), room, async || Ok(())).await
}

/// A file system in memory, gone with its value.
struct Small(PathBuf);

impl Small {
    fn mount(at: PathBuf) -> anyhow::Result<Self> {
        std::fs::create_dir_all(&at)?;
        let output = Command::new("mount").args(["-t", "tmpfs", "-o", DISK, "tmpfs"]).arg(&at).output()?;
        let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
        ensure!(output.status.success(), "a small disk is a tmpfs, which only root may mount: {said}");
        Ok(Self(at))
    }
    /// Takes all the room there is.
    fn fill(&self) -> anyhow::Result<()> {
        let mut file = OpenOptions::new().append(true).create(true).open(self.0.join("filler"))?;
        let mut bytes = vec![1; 1 << 20];
        while !bytes.is_empty() {
            if file.write_all(&bytes).is_err() {
                bytes.truncate(bytes.len() / 2);
            }
        }
        Ok(())
    }
}

impl Drop for Small {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

async fn disk(args: &StopArgs, site: &Site, robots: usize, room: &Path) -> anyhow::Result<Turns> {
    let small = Small::mount(room.join("disk"))?;
    let mut server = server(&small.0).await?;
    let _hearers = hearers(&server).await?;
    until(&mut server, crate::child::SESSIONS, HEARERS as u64).await?;
    // Again before each turn: whatever was freed meanwhile is taken.
    turns(args, site, robots, &small.0.join("stops"), room, async || small.fill()).await
}

async fn kill(args: &StopArgs, site: &Site, robots: usize, room: &Path) -> anyhow::Result<Turns> {
    let mut hearing: Option<Child> = None;
    turns(args, site, robots, &room.join("stops"), room, async || {
        drop(hearing.take());
        let mut server = server(room).await?;
        hearing = Some(hearers(&server).await?);
        until(&mut server, crate::child::SESSIONS, HEARERS as u64).await?;
        // SIGKILL.
        drop(server);
        Ok(())
    })
    .await
}
