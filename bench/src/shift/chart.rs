//! Draws throughput and queue over time as SVG: a line for the median of the seeds, and a band from lowest to highest.

use super::run::Outcome;
use crate::figure::{median, percentile};
use std::fmt::Write;

/// One point of a chart stands for so long, milliseconds.
const STEP_MS: u64 = 600_000;
/// Size of one chart, and the room around it for its words, pixels.
const CHART: (f64, f64) = (420.0, 150.0);
const ROOM: (f64, f64) = (60.0, 40.0);
const COLOURS: [&str; 4] = ["#1f6feb", "#d1242f", "#1a7f37", "#9a6700"];

/// What is drawn of one policy under one workload.
pub struct Course {
    title: String,
    /// Tasks in an hour, by step and seed.
    per_hour: Vec<Vec<f64>>,
    /// Tasks without a robot at the end of each step, by step and seed.
    waiting: Vec<Vec<f64>>,
}

impl Course {
    /// From the shifts of all seeds.
    pub fn new(title: String, seeds: &[Outcome]) -> Self {
        let lasted_ms = seeds.iter().map(|seed| seed.end.at_ms).min().unwrap_or_default();
        let step_ms = STEP_MS.min(lasted_ms / 6).max(1);
        let steps: Vec<u64> = (0..lasted_ms / step_ms).map(|step| step * step_ms).collect();
        let done = |seed: &Outcome, from_ms: u64| {
            let within = |at_ms: u64| (from_ms..from_ms + step_ms).contains(&at_ms);
            seed.tasks.iter().filter(|task| task.done_ms.is_some_and(within)).count() as f64 * 3_600_000.0
                / step_ms as f64
        };
        let waiting = |seed: &Outcome, from_ms: u64| {
            let until = seed.samples.iter().take_while(|sample| sample.at_ms <= from_ms + step_ms);
            until.last().map_or(0.0, |sample| sample.counts.waiting as f64)
        };
        let by_step = |value: &dyn Fn(&Outcome, u64) -> f64| {
            steps.iter().map(|at| seeds.iter().map(|seed| value(seed, *at)).collect()).collect()
        };
        Self { title, per_hour: by_step(&done), waiting: by_step(&waiting) }
    }
}

/// All courses, one row each: throughput at the left, queue at the right.
pub fn draw(courses: &[Course]) -> String {
    let (width, height) = (2.0 * (CHART.0 + ROOM.0) + ROOM.0, courses.len() as f64 * (CHART.1 + ROOM.1) + ROOM.1);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" font-family=\"sans-serif\" \
         font-size=\"11\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (row, course) in courses.iter().enumerate() {
        let colour = COLOURS[row % COLOURS.len()];
        let top = ROOM.1 + row as f64 * (CHART.1 + ROOM.1);
        let charts = [("tasks in an hour", &course.per_hour), ("tasks without a robot", &course.waiting)];
        for (column, (what, values)) in charts.into_iter().enumerate() {
            let left = ROOM.0 + column as f64 * (CHART.0 + ROOM.0);
            draw_chart(&mut svg, (left, top), &format!("{}: {what}", course.title), colour, values);
        }
    }
    svg.push_str("</svg>\n");
    svg
}

fn draw_chart(svg: &mut String, (left, top): (f64, f64), title: &str, colour: &str, values: &[Vec<f64>]) {
    let most = values.iter().flatten().fold(1.0_f64, |most, value| most.max(*value));
    let x = |step: usize| left + CHART.0 * step as f64 / (values.len().max(2) - 1) as f64;
    let y = |value: f64| top + CHART.1 * (1.0 - value / most);
    let points = |value: &dyn Fn(&[f64]) -> f64| -> Vec<String> {
        values.iter().enumerate().map(|(step, seeds)| format!("{:.1},{:.1}", x(step), y(value(seeds)))).collect()
    };
    let (lowest, highest) = (points(&|v| percentile(v, 0.0)), points(&|v| percentile(v, 1.0)));
    let band: Vec<String> = lowest.into_iter().chain(highest.into_iter().rev()).collect();
    let (bottom, right) = (top + CHART.1, left + CHART.0);
    // A String takes whatever is written.
    let _ = write!(
        svg,
        "<text x=\"{left}\" y=\"{}\">{title}</text>\n<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{most:.0}</text>\n\
         <text x=\"{}\" y=\"{bottom}\" text-anchor=\"end\">0</text>\n\
         <path d=\"M{left},{top} V{bottom} H{right}\" fill=\"none\" stroke=\"#888\"/>\n\
         <polygon points=\"{}\" fill=\"{colour}\" opacity=\"0.2\"/>\n\
         <polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\"/>\n",
        top - 8.0,
        left - 4.0,
        top + 8.0,
        left - 4.0,
        band.join(" "),
        points(&|v| median(v)).join(" "),
    );
}
