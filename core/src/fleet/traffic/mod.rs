//! Where robots may drive: which places they are granted, by which route, and what each robot is told.
//!
//! In reading order: `engaged_stops` and `starts` say what keeps a place; `routing` finds a way; `anchor` binds a permission to a heartbeat;
//! `desired` composes what a robot should have; `places` grants; `closures` tells people what is closed. Invariant: a place is given on only
//! by a robot's own report or by a person, never by time.

pub mod anchor;
pub mod closures;
pub mod desired;
pub mod engaged_stops;
pub mod places;
pub mod routing;
pub mod starts;
