//! The program of the stop service: see `midshift-stop --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    midshift_stop::program::main()
}
