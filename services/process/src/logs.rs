//! Logs to stderr: one format, UTC, JSON if asked; the level by `MIDSHIFT_LOG`.
//!
//! A line that a peer can cause as often as it likes has a field `peer`, which says who; left empty, its `robot_id` does. Such a line is
//! written a few times and then counted ([`midshift_core::flood`]), so that no flood of requests is a flood of lines.

use clap::ValueEnum;
use midshift_core::flood::{Count, Floods};
use midshift_core::limits;
use midshift_core::time::LinkTime;
use std::fmt;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;
use tokio::time::Instant;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

/// How log lines look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

impl Format {
    /// The same as an argument of a program of ours; none: it is what a program does by itself.
    pub fn argument(self) -> Option<String> {
        let word = self.to_possible_value().filter(|_| self != Self::default());
        word.map(|word| format!("--log={}", word.get_name()))
    }
}

/// Starts logging. `default` is the level where the environment says nothing.
pub fn start(format: Format, default: &str) {
    let filter = EnvFilter::try_from_env("MIDSHIFT_LOG").unwrap_or_else(|_| EnvFilter::new(default));
    let colour = std::env::var_os("NO_COLOR").is_none() && std::io::IsTerminal::is_terminal(&std::io::stderr());
    // A line that stderr does not take is lost. Said there again it would end the process, and a full disk must end nothing.
    let lines = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_target(false);
    let lines = lines.log_internal_errors(false);
    // A second start in one process (tests) keeps the first.
    let _ = match format {
        Format::Text => lines.with_ansi(colour).finish().with(Throttle(counted())).try_init(),
        Format::Json => lines.json().flatten_event(true).finish().with(Throttle(counted())).try_init(),
    };
}

/// Says once a minute how often lines were left out, until it is dropped.
pub async fn count_floods() {
    let mut tick = tokio::time::interval(Duration::from_millis(limits::FLOOD_COUNTED_EVERY.as_ms()) / 4);
    loop {
        tick.tick().await;
        counted().counts().iter().for_each(log_count);
    }
}

/// What is counted in this process.
fn counted() -> &'static Counted {
    static COUNTED: OnceLock<Counted> = OnceLock::new();
    COUNTED.get_or_init(Counted::new)
}

/// A line: its level and its message, which is constant.
type Line = (Level, String);

/// Floods of this process, by its monotonic clock.
struct Counted {
    begun: Instant,
    floods: Mutex<Floods<Line>>,
}

impl Counted {
    fn new() -> Self {
        Self { begun: Instant::now(), floods: Mutex::default() }
    }

    fn now(&self) -> LinkTime {
        LinkTime(u64::try_from(self.begun.elapsed().as_millis()).unwrap_or(u64::MAX))
    }

    fn is_written(&self, line: Line, peer: String) -> bool {
        self.floods.lock().unwrap_or_else(PoisonError::into_inner).is_written(line, peer, self.now())
    }

    fn counts(&self) -> Vec<Count<Line>> {
        self.floods.lock().unwrap_or_else(PoisonError::into_inner).counts(self.now())
    }
}

fn log_count(count: &Count<Line>) {
    let Count { line: (level, line), peer, times } = count;
    let (again, of) = ("more of these in the last minute", peer.as_deref().unwrap_or("many"));
    match *level {
        Level::ERROR => tracing::error!(times, line, of, "{again}"),
        Level::WARN => tracing::warn!(times, line, of, "{again}"),
        Level::INFO => tracing::info!(times, line, of, "{again}"),
        _ => tracing::debug!(times, line, of, "{again}"),
    }
}

/// Leaves out the lines of a flood.
struct Throttle(&'static Counted);

impl<S: Subscriber> Layer<S> for Throttle {
    fn event_enabled(&self, event: &Event<'_>, _: Context<'_, S>) -> bool {
        let metadata = event.metadata();
        if metadata.fields().field("peer").is_none() {
            return true;
        }
        let mut fields = LineFields::default();
        event.record(&mut fields);
        let peer = fields.peer.or(fields.robot_id).unwrap_or_default();
        self.0.is_written((*metadata.level(), fields.message), peer)
    }
}

/// The fields of a line that tell it from others.
#[derive(Default)]
struct LineFields {
    message: String,
    peer: Option<String>,
    robot_id: Option<String>,
}

impl LineFields {
    fn add_field(&mut self, field: &Field, value: fmt::Arguments<'_>) {
        match field.name() {
            "message" => self.message = value.to_string(),
            "peer" => self.peer = Some(value.to_string()),
            "robot_id" => self.robot_id = Some(value.to_string()),
            _ => {}
        }
    }
}

impl Visit for LineFields {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.add_field(field, format_args!("{value:?}"));
    }
    fn record_str(&mut self, field: &Field, value: &str) {
        self.add_field(field, format_args!("{value}"));
    }
}

#[cfg(test)]
mod tests;
