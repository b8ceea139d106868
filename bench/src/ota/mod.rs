//! P9: what software of robots costs: directives, ten thousand robots assigned, a kill in the middle of it, and the way back.
//!
//! Called by `main`. Rooms: `server` measures the server, with robots of `hearers` and `swarm` in processes of their own; `release` is the
//! people who sign. Each part adds its figures to one table.

pub mod hearers;
mod release;
mod server;
pub mod swarm;

use crate::figure::Figure;
use std::path::PathBuf;

/// Which figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Part {
    /// All there are.
    All,
    /// Of the server: directives, robots assigned, a kill, the way back.
    Server,
}

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct OtaArgs {
    /// Only these figures.
    #[arg(long, value_enum, default_value_t = Part::All)]
    part: Part,
    /// Rounds of each.
    #[arg(long, default_value_t = 2)]
    rounds: usize,
    /// Where the databases are made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    dir: Option<PathBuf>,
    #[command(flatten)]
    server: server::ServerArgs,
}

/// Runs the parts that were asked for.
pub async fn run(args: OtaArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    if matches!(args.part, Part::All | Part::Server) {
        figures.extend(server::run(&args, say).await?);
    }
    Ok(figures)
}
