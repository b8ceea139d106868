//! The server's half: directives signed, robots assigned, a kill in the middle of that, and the way back.
//!
//! Robots are told to fetch as soon as a roll-out has started, whatever their wave: waves, budgets and windows pace only who changes to it. So
//! one roll-out with a small first wave answers both when that wave was offered it and when everybody was.

mod assign;
mod back;
mod cut;
pub mod rollouts;
pub mod scene;
mod sign;
mod trace;

use super::args::OtaArgs;
use crate::figure::{Figure, median};
use crate::fsync::Disk;
use crate::fsync::place;
use crate::link::allowed;
use assign::Assigned;
use back::WentBack;
use cut::Cut;

/// Appends to the disk in each round, for the figures that end with a commit.
const APPENDS: usize = 200;

/// Runs rounds of everything and the disk, in turn.
pub async fn run(args: &OtaArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let (robots, note) = allowed(args.server.robots)?;
    if let Some(note) = note {
        say(&note);
    }
    let mut figures = sign::run(args.server.directives, args.rounds)?;
    let (mut hear, mut take, mut cuts, mut ways, mut syncs_ms) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for _ in 0..args.rounds {
        if robots > 0 {
            hear.push(report_run(assign::measure(args, robots, assign::Robots::Hear).await?, say));
            take.push(report_run(assign::measure(args, robots, assign::Robots::Take).await?, say));
            match cut::measure(args, robots).await? {
                Some(cut) => cuts.push(report_run(cut, say)),
                None => say("every robot was assigned before the server could be killed: nothing is told of it"),
            }
        }
        if args.server.back_robots > 0 {
            ways.push(report_run(back::measure(args).await?, say));
        }
        let dir = place(args.dir.as_ref())?;
        syncs_ms.push(median(&Disk::beside(dir.path())?.appends_ms(APPENDS)?));
    }
    let bare_s = figures.iter().find_map(|f| f.limit.as_ref()).map_or(0.0, |bare| 1.0 / bare.median);
    figures.extend(of_assigned(robots, "hear", &hear, &syncs_ms, bare_s));
    figures.extend(of_assigned(robots, "answer", &take, &syncs_ms, bare_s));
    figures.extend(of_cuts(robots, &cuts, &hear));
    figures.extend(of_ways(args.server.back_robots, &ways, &syncs_ms));
    Ok(figures)
}

/// Reports the result of one run: all of them together take minutes.
fn report_run<T: std::fmt::Debug>(run: T, say: &dyn Fn(&str)) -> T {
    say(&format!("{run:?}"));
    run
}

fn each<T>(runs: &[T], what: impl Fn(&T) -> f64) -> Vec<f64> {
    runs.iter().map(what).collect()
}

/// What so many waits for the disk take, one after the other, in seconds.
fn waits_s(groups: Vec<f64>, syncs_ms: &[f64]) -> Vec<f64> {
    groups.iter().zip(syncs_ms).map(|(groups, ms)| groups * ms / 1e3).collect()
}

fn of_assigned(robots: usize, do_what: &str, runs: &[Assigned], syncs_ms: &[f64], bare_s: f64) -> Vec<Figure> {
    if runs.is_empty() {
        return Vec::new();
    }
    let name = |what: &str| format!("{robots} robots that {do_what}: {what}");
    let idle = "the same robots as long, no roll-out";
    let waits = ("an fdatasync for each group commit", waits_s(each(runs, |r| r.groups), syncs_ms));
    let sync_s = ("fdatasync of 4 KiB, p50", each(syncs_ms, |ms| ms / 1e3));
    let mut figures = Vec::new();
    let mut add = |what: &str, values: Vec<f64>, (limit, of_limit): (&str, Vec<f64>)| {
        figures.push(Figure::new("P9", name(what), "s", &values, Some((limit, &of_limit))));
    };
    add(
        "CPU of create, submit, approve",
        each(runs, |r| r.written_cpu_s),
        (idle, each(runs, |r| r.idle_cores * r.written_s)),
    );
    add("start to its answer", each(runs, |r| r.answered_s), sync_s.clone());
    add("start to first wave offered", each(runs, |r| r.first_s), sync_s);
    add("CPU to first wave offered", each(runs, |r| r.first_cpu_s), (idle, each(runs, |r| r.idle_cores * r.first_s)));
    add("start to all assigned and offered", each(runs, |r| r.all_s), (waits.0, waits.1));
    add("CPU to all assigned and offered", each(runs, |r| r.all_cpu_s), (idle, each(runs, |r| r.idle_cores * r.all_s)));
    // Robots that beat cost the longer the slower the machine is: this is what the roll-out itself took.
    let beyond = each(runs, |r| (r.all_cpu_s - r.idle_cores * r.all_s).max(0.0));
    let signed = ("as many bare ed25519 signatures", each(runs, |_| robots as f64 * bare_s));
    add("CPU to all, beyond that of idle robots", beyond, signed);
    let cores = ("the same robots, no roll-out", each(runs, |r| r.idle_cores));
    let after = each(runs, |r| r.after_cores);
    figures.push(Figure::new("P9", name("server while they fetch"), "cores", &after, Some((cores.0, &cores.1))));
    figures
}

fn of_cuts(robots: usize, cuts: &[Cut], whole: &[Assigned]) -> Vec<Figure> {
    if cuts.is_empty() {
        return Vec::new();
    }
    let name = |what: &str| format!("{robots} robots, killed at work: {what}");
    let first = ("undisturbed: start to first wave offered", each(whole, |r| r.first_s));
    let all = ("undisturbed: start to all offered", each(whole, |r| r.all_s));
    let all_cpu = ("undisturbed: CPU to all offered", each(whole, |r| r.all_cpu_s));
    let count = vec![robots as f64; whole.len()];
    let mut figures =
        vec![Figure::new("P9", name("assigned by then"), "robots", &each(cuts, |c| c.before), Some(("all", &count)))];
    let mut add = |what: &str, values: Vec<f64>, limit: &(&str, Vec<f64>)| {
        figures.push(Figure::new("P9", name(what), "s", &values, Some((limit.0, &limit.1))));
    };
    add("start to ready", each(cuts, |c| c.ready_s), &first);
    add("ready to first new assignment", each(cuts, |c| c.first_s), &first);
    add("ready to all assigned", each(cuts, |c| c.all_s), &all);
    add("CPU from start to all assigned", each(cuts, |c| c.cpu_s), &all_cpu);
    add("ready to all attached and offered", each(cuts, |c| c.offered_s), &all);
    figures
}

fn of_ways(robots: usize, ways: &[WentBack], syncs_ms: &[f64]) -> Vec<Figure> {
    if ways.is_empty() {
        return Vec::new();
    }
    let name = |what: &str| format!("{robots} idle robots, no budget: {what}");
    let of = |way: fn(&WentBack) -> &back::RollbackTimes, what: &str| {
        let disk = waits_s(each(ways, |w| way(w).groups), syncs_ms);
        let (took, half) = (each(ways, |w| way(w).all_s), each(ways, |w| way(w).half_s));
        let disk = Some(("an fdatasync for each group commit", disk.as_slice()));
        [
            Figure::new("P9", name(&format!("{what}, half of them")), "s", &half, disk),
            Figure::new("P9", name(&format!("{what}, all")), "s", &took, disk),
        ]
    };
    let mut figures = Vec::from(of(|w| &w.on_trial, "abort to kept version, on trial"));
    figures.extend(of(|w| &w.committed, "roll-back to kept version, committed"));
    figures
}
