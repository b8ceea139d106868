//! What a robot runs: the session to the server, the ring of samples, the ledger of work, the governor, and the body it
//! drives.
//!
//! A maker implements [`body::Body`] and calls [`run`]; `examples/own_robot.rs` does. Rooms, from below: `launcher`
//! starts the program and owns the switch record; `sets` is software on the disk; `storage` is what is remembered;
//! `transport` are the ways to servers; `stop` and `update` are beside the core, which decides; `session` is the shell
//! around the core, and `program` a robot's process. Each uses only those before it. Invariant: a buffered message
//! never starts the body, and a finished task is never done again.

pub mod body;
pub mod bugs;
pub mod core;
pub mod launcher;
pub mod program;
pub mod session;
pub mod sets;
pub mod stop;
pub mod storage;
pub mod transport;
pub mod update;

pub use launcher::{boot, start_policy, switch};
pub use midshift_os::clock;
pub use program::{Config, environment, launcher_heartbeat, run};
pub use storage::{device, ledger, memory, ring, sqlite, store};
pub use transport::{bulk, dial, enrolment, replay, tls};
pub use update::trust;
