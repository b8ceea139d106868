//! Starts the agent of one robot and stays: `midshift_agent::launcher` as a program of its own.

use std::process::ExitCode;

fn main() -> ExitCode {
    midshift_agent::launcher::main(std::env::args().skip(1))
}
