//! Real programs as a user has them: the midshift binary, agents killed with SIGKILL, grpcurl, clients in three languages.
//!
//! `cargo xtask test` builds the programs once, says where they are, and starts each test as a process of its own.

/// Printed points make a failing run readable.
macro_rules! say {
    ($($text:tt)*) => {{
        use std::io::Write;
        let _ = writeln!(std::io::stderr(), $($text)*);
    }};
}

mod addressed;
mod anybody;
mod areas;
mod arena;
mod audited;
mod batches;
mod begin_and_end;
mod ceremony;
mod changed_map;
mod clients;
mod cut;
mod doors;
mod engine;
mod factory;
mod first_start;
mod followed;
mod golden_cli;
mod handed_over;
mod harness;
mod held;
mod identity;
mod key_files;
mod kill;
mod languages;
mod largest;
mod launched;
mod ledger_cuts;
mod looked_up;
mod made_elsewhere;
mod many;
mod measured;
mod mid_shift;
mod minimal_robot;
mod night;
mod old_site;
mod own_robot;
mod partition;
mod played;
mod proxy;
mod public_address;
mod released;
mod restored;
mod rights;
mod robots;
mod rolled_out;
mod rolling;
mod room;
mod secrets;
mod simulated;
mod split;
mod split_held;
mod split_restored;
mod stack;
mod stop_alone;
mod stopped;
mod stopped_release;
mod story;
mod swallowed;
mod swarm_software;
mod taken_back;
mod tuf;
mod two_of_each;
mod unheard;
mod watched;
