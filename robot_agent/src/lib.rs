//! What a robot runs: the session to the server, the ring of samples, the ledger of work, the governor, and the body it drives.
//!
//! Invariant: a buffered message never starts the body, and a finished task is never done again.

pub mod body;
