//! A simulated robot: a body with kinematics, battery, faults and a world of items, for one robot a process or
//! thousands in one.
//!
//! Invariant: a body is synchronous, reads no clock and starts no task; where it is follows from its path and the time
//! it set out. What bodies did is judged from their own journals ([`judge`]), never from what a server believes.

pub mod behaviour;
pub mod body;
pub mod energy;
pub mod faults;
pub mod fleet;
pub mod handle;
pub mod journal;
pub mod judge;
pub mod launched;
pub mod motion;
pub mod person;
pub mod service;
pub mod swarm;
pub mod workload;
pub mod world;
