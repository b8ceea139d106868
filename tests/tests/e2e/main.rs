//! Real programs as a user has them: the midshift binary, agents killed with SIGKILL, grpcurl, clients in three languages.
//!
//! `cargo xtask test` builds the programs once and says where they are.

mod begin_and_end;
mod clients;
mod cut;
mod golden_cli;
mod harness;
mod held;
mod kill;
mod languages;
mod launched;
mod ledger_cuts;
mod measured;
mod minimal_robot;
mod proxy;
mod public_address;
mod restored;
mod robots;
mod rolled_out;
mod room;
mod swarm_software;
mod tuf;
