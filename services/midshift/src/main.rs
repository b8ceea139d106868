//! The midshift program: see `midshift --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    midshift::commands::main()
}
