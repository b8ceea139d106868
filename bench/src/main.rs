//! Figures of midshift beside the raw limits of the same machine in the same run: `cargo run --release -p midshift-bench -- NAME --json FILE`.

mod figure;
mod plan;

use clap::{Parser, ValueEnum};
use std::path::PathBuf;

/// What can be measured.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Name {
    /// One planning cycle at three sizes of fleet.
    Plan,
}

/// Measures one part of midshift. Prints the truth; there are no thresholds.
#[derive(Parser)]
#[command(name = "midshift-bench", version)]
struct Args {
    /// What to measure.
    name: Name,
    /// Also write the figures as a JSON array.
    #[arg(long)]
    json: Option<PathBuf>,
}

#[expect(clippy::print_stdout, reason = "the table is what this program is for")]
fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let figures = match args.name {
        Name::Plan => plan::run()?,
    };
    print!("{}", figure::table(&figures));
    if let Some(path) = args.json {
        std::fs::write(path, serde_json::to_string_pretty(&figures)?)?;
    }
    Ok(())
}
