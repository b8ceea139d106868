//! Logs to stderr: one format, UTC, JSON if asked; the level by `MIDSHIFT_LOG`.

use clap::ValueEnum;
use tracing_subscriber::EnvFilter;

/// How log lines look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
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
        Format::Text => lines.with_ansi(colour).try_init(),
        Format::Json => lines.json().flatten_event(true).try_init(),
    };
}
