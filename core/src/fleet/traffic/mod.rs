//! Where robots may drive: which places they are granted, by which route, and what each robot is told.
//!
//! In reading order: `engaged_stops` and `starts` say what keeps a place; `routing` finds a way; `anchor` binds a permission to a heartbeat;
//! `desired` composes what a robot should have; `route_requests` says who needs more of its route; `grants` says whether places are free and gives them;
//! `bays` clears a place that others need; `serve` does all of it in turn; `closures` tells people what is closed. Invariant: a place is given on only
//! by a robot's own report or by a person, never by time.

pub mod anchor;
mod bays;
pub mod closures;
pub mod desired;
pub mod engaged_stops;
pub mod grants;
pub mod route_requests;
pub mod routing;
pub mod serve;
pub mod starts;
