//! What a process of the server side has around its services: its log, its metrics, its clocks, and the door of its port.
//!
//! Called by the programs `midshift` and `midshift-stop`. Invariant: nothing of the store is here, so that a program
//! without it can have all of this.

pub mod clock;
pub mod door;
pub mod logs;
pub mod metrics_catalog;
pub mod recorder;
