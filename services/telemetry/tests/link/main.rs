//! The robot's session and the projection of robots over real gRPC connections in memory.

mod disk;
mod enrolled;
mod flood;
mod gateways;
mod machines;
mod newer;
#[path = "../../../../tests/src/raw.rs"]
mod raw;
mod reach;
mod replay;
mod retention;
mod robots;
mod second;
mod sessions;
mod status;
mod stops;
mod unreadable;
mod world;
