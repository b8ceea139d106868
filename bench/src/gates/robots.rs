//! Verdicts on how many robots failed: the naive rule, the sequential test, and the policy for a failure among few.

use super::luck::seeded;
use crate::figure::{Estimate, Figure};
use midshift_core::gates::{RobotOutcomes, Verdict, upper_bound_permille};
use rand::RngExt;

/// Where the design's own figures are from: its page on OTA, section Gates.
const DESIGN: &str = "design, OTA gates";
/// Where the others are from.
const EXACT: &str = "exact, over all outcomes";
/// Rates of failing robots that are looked at: 2 % is good, 20 % is bad.
const RATES: [f64; 5] = [0.02, 0.05, 0.10, 0.20, 0.40];
/// Sizes of fleets that the sequential test is looked at for.
const FLEETS: [u32; 3] = [10, 24, 60];
/// Robots of the naive rule, and its limit in percent.
const NAIVE: (u32, u32) = (5, 10);
/// The naive rule in the design, percent: good roll-outs (2 %) that it aborts, and those at 10 % that it lets pass.
const DESIGN_NAIVE: (f64, f64) = (9.6, 59.0);
/// Bounds of the failure rate in the design, percent, after so many clean robots.
const DESIGN_BOUNDS: [(u32, f64); 4] = [(1, 95.0), (3, 63.0), (5, 45.0), (12, 22.0)];
/// The sequential test in the design: the most robots among which two failures abort, clean robots that promote, robots that promote with
/// one failure.
const DESIGN_SEQUENTIAL: (u32, u32, u32) = (10, 12, 24);

/// Says after each robot how a roll-out stands.
type Judge = fn(RobotOutcomes) -> Verdict;

/// How roll-outs end, as shares or as counts.
#[derive(Clone, Copy, Debug, Default)]
struct Ends {
    abort: f64,
    promote: f64,
    /// Mean of the robots that were touched.
    touched: f64,
}

/// "More than 10 % of 5 robots".
fn naive_rule(seen: RobotOutcomes) -> Verdict {
    match seen.decided() {
        n if n < NAIVE.0.into() => Verdict::Inconclusive,
        n if u64::from(seen.failed) * 100 > n * u64::from(NAIVE.1) => Verdict::Abort,
        _ => Verdict::Promote,
    }
}

/// `small_wave_failure = abort` before the sequential test: a failure among few robots ends it.
fn first_failure_rule(seen: RobotOutcomes) -> Verdict {
    if seen.is_early_failure() { Verdict::Abort } else { seen.verdict() }
}

/// All ways that a roll-out over `fleet` robots can end, each by its chance.
fn exactly(judge: Judge, rate: f64, fleet: u32) -> Ends {
    let mut ends = Ends::default();
    let mut open = vec![1.0];
    for n in 1..=fleet {
        ends.touched += open.iter().sum::<f64>();
        let mut next = vec![0.0; n as usize + 1];
        for (failed, share) in open.iter().enumerate() {
            next[failed] += share * (1.0 - rate);
            next[failed + 1] += share * rate;
        }
        for (failed, share) in (0..).zip(next.iter_mut()) {
            match judge(RobotOutcomes { clean: n - failed, failed }) {
                Verdict::Abort => ends.abort += std::mem::take(share),
                Verdict::Promote => ends.promote += std::mem::take(share),
                Verdict::Inconclusive => {}
            }
        }
        open = next;
    }
    ends
}

/// One roll-out: its verdict and the robots it touched.
fn roll_out(judge: Judge, rate: f64, fleet: u32, rng: &mut impl RngExt) -> (Verdict, u32) {
    let mut seen = RobotOutcomes::default();
    for n in 1..=fleet {
        if rng.random_bool(rate) {
            seen.failed += 1;
        } else {
            seen.clean += 1;
        }
        let verdict = judge(seen);
        if verdict != Verdict::Inconclusive {
            return (verdict, n);
        }
    }
    (Verdict::Inconclusive, fleet)
}

fn many(judge: Judge, rate: f64, fleet: u32, (seed, kind): (u64, u64), runs: usize) -> Vec<(Verdict, u32)> {
    let mut rng = seeded(seed, kind);
    (0..runs).map(|_| roll_out(judge, rate, fleet, &mut rng)).collect()
}

fn share(ends: &[(Verdict, u32)], verdict: Verdict) -> Estimate {
    Estimate::percent(ends.iter().filter(|(end, _)| *end == verdict).count(), ends.len())
}

/// What follows from counts without any chance.
pub fn computed() -> Vec<Figure> {
    let of = |decided: u32, failed: u32| RobotOutcomes { clean: decided - failed, failed };
    let first = |failed, wanted| (failed..1_000).find(|n| of(*n, failed).verdict() == wanted).unwrap_or(0);
    let last = (2..1_000).rev().find(|n| of(*n, 2).verdict() == Verdict::Abort).unwrap_or(0);
    let anchors = [
        ("most robots among which 2 failures abort", last, DESIGN_SEQUENTIAL.0),
        ("clean robots that promote", first(0, Verdict::Promote), DESIGN_SEQUENTIAL.1),
        ("robots that promote with 1 failure", first(1, Verdict::Promote), DESIGN_SEQUENTIAL.2),
    ];
    let figure =
        |name: String, unit, ours: f64, design: f64| Figure::new("G2", name, unit, &[ours], Some((DESIGN, &[design])));
    let anchors =
        anchors.map(|(name, ours, design)| figure(format!("SPRT, {name}"), "robots", ours.into(), design.into()));
    let bounds = DESIGN_BOUNDS.map(|(clean, design)| {
        let ours = f64::from(upper_bound_permille(of(clean, 0))) / 10.0;
        figure(format!("95 % bound of the failure rate, {clean} clean"), "%", ours, design)
    });
    anchors.into_iter().chain(bounds).collect()
}

/// The rule that the design does not use.
pub fn naive(seed: u64, runs: usize) -> Vec<Figure> {
    let rule = format!("naive, more than {} % of {}", NAIVE.1, NAIVE.0);
    let aborted = share(&many(naive_rule, 0.02, NAIVE.0, (seed, 1), runs), Verdict::Abort);
    let missed = share(&many(naive_rule, 0.10, NAIVE.0, (seed, 2), runs), Verdict::Promote);
    let figure = |name, estimate, design| Figure::simulated("G0", name, "%", estimate, Some((DESIGN, design)));
    vec![
        figure(format!("{rule}: aborts at 2 %"), aborted, DESIGN_NAIVE.0),
        figure(format!("{rule}: passes at 10 %"), missed, DESIGN_NAIVE.1),
    ]
}

/// The sequential test at each rate and size of fleet.
pub fn sequential(seed: u64, runs: usize) -> Vec<Figure> {
    let mut figures = Vec::new();
    for (rate, kind) in RATES.into_iter().zip(100..) {
        // One set of roll-outs; a smaller fleet ends where it has no more robots.
        let ends = many(RobotOutcomes::verdict, rate, 60, (seed, kind), runs);
        for fleet in FLEETS {
            let cut: Vec<_> = ends
                .iter()
                .map(|(verdict, touched)| match *touched <= fleet {
                    true => (*verdict, *touched),
                    false => (Verdict::Inconclusive, fleet),
                })
                .collect();
            figures.extend(figures_of("SPRT", rate, fleet, &cut, exactly(RobotOutcomes::verdict, rate, fleet)));
        }
    }
    figures
}

/// A failure among few robots aborts, as policy says unless told otherwise; afterwards the sequential test.
pub fn first_failure(seed: u64, runs: usize) -> Vec<Figure> {
    let mut figures = Vec::new();
    for ((rate, fleet), kind) in RATES.into_iter().flat_map(|rate| [1, 3, 5, 9].map(|n| (rate, n))).zip(200..) {
        let aborted = share(&many(first_failure_rule, rate, fleet, (seed, kind), runs), Verdict::Abort);
        let exact = exactly(first_failure_rule, rate, fleet).abort * 100.0;
        let name = format!("first failure aborts, {:.0} %, {fleet} robots: abort", rate * 100.0);
        figures.push(Figure::simulated("G2", name, "%", aborted, Some((EXACT, exact))));
    }
    for (rate, kind) in RATES.into_iter().zip(300..) {
        let ends = many(first_failure_rule, rate, 60, (seed, kind), runs);
        figures.extend(figures_of("first failure, SPRT", rate, 60, &ends, exactly(first_failure_rule, rate, 60)));
    }
    figures
}

/// Shares of each end and the robots touched, beside their exact values.
fn figures_of(rule: &str, rate: f64, fleet: u32, ends: &[(Verdict, u32)], exact: Ends) -> Vec<Figure> {
    let name = |what: &str| format!("{rule}, {:.0} %, n <= {fleet}: {what}", rate * 100.0);
    let open = (1.0 - exact.abort - exact.promote).max(0.0);
    let shares = [
        ("abort", Verdict::Abort, exact.abort),
        ("promote", Verdict::Promote, exact.promote),
        ("inconclusive", Verdict::Inconclusive, open),
    ];
    let mut figures: Vec<Figure> = shares
        .into_iter()
        .map(|(what, verdict, exact)| {
            Figure::simulated("G2", name(what), "%", share(ends, verdict), Some((EXACT, exact * 100.0)))
        })
        .collect();
    let touched: Vec<f64> = ends.iter().map(|(_, touched)| f64::from(*touched)).collect();
    let touched = Estimate::mean(&touched);
    figures.push(Figure::simulated("G2", name("robots touched"), "robots", touched, Some((EXACT, exact.touched))));
    figures
}
