//! What a child is asked while it runs: a line in, a number out.

use std::io::Write;
use std::net::SocketAddr;
use tokio_util::sync::CancellationToken;

/// Says the address, then answers each line of stdin with a number; the end of stdin is the end of all.
pub fn answer_questions(
    address: SocketAddr,
    stop: CancellationToken,
    answer: impl Fn(&str) -> u64 + Send + 'static,
) -> anyhow::Result<()> {
    print_line(&address.to_string())?;
    tokio::task::spawn_blocking(move || {
        let told =
            std::io::stdin().lines().map_while(Result::ok).try_for_each(|line| print_line(&answer(&line).to_string()));
        stop.cancel();
        told
    });
    Ok(())
}

fn print_line(line: &str) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}
