//! The agent of a robot: its session to the server, its stored samples and work, its governor, and its body.
//!
//! A maker implements [`body::Body`] and calls [`run`], as `examples/own_robot.rs` does. Modules, from the lowest to
//! the highest; each uses only those before it:
//! 1. `launcher` starts the program and owns the switch record.
//! 2. `sets` keeps software on the disk.
//! 3. `storage` keeps the ledger and the ring of samples.
//! 4. `transport` connects to servers.
//! 5. `stop` and `update` do what fleet stops and updates need outside the core.
//! 6. `core` decides, without IO.
//! 7. `session` is the shell around the core, and `program` is a robot's process.
//!
//! Invariant: a buffered message never starts the body, and a finished task is never done again.

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
pub use update::trust_anchors;
