//! Grants places to robots, routes them, and composes what each robot should do.
//!
//! In reading order: `engaged_stops`, `blocked_places` and `starts` find places that a fleet stop, a person or an expected
//! robot keeps. `routing` finds a route. `anchor` ties a permission to a heartbeat. `desired` composes desired work.
//! `route_requests` orders the robots that need more of their route. `bay_ways` finds bays near a waypoint, `remaining_routes`
//! gathers where all robots go, and `safe_order` looks for an order in which they can. `grants` checks that places are free
//! and grants them. `rerouting` leads around closed places, `bays` clears a place that others need. `allocation` runs all of
//! it in turn.
//! `closed_places` tells people what is closed.
//! Invariant: a place passes to another robot only by a robot's own report or by a person, never by time.

pub mod allocation;
pub mod anchor;
mod bay_ways;
mod bays;
pub mod blocked_places;
pub mod closed_places;
pub mod desired;
pub mod engaged_stops;
pub mod grants;
mod remaining_routes;
mod rerouting;
pub mod route_requests;
pub mod routing;
mod safe_order;
pub mod starts;
