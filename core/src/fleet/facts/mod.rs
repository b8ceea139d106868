//! Applies facts to the fleet: events, heartbeats, requests, stops, elapsed time, a changed map.
//!
//! In reading order: `feed` dispatches entries of the feed. `inbox` applies a robot's event, `requests` a person's
//! request, `task_changes` one that edits, holds or releases a task. `repair` compares a heartbeat with the rows. `holds`,
//! `unanswered_offers` and `disbelief` are shared by these.
//! `stops` keeps stopped robots held. `sweep` gathers what is due by time. `maps` and `misreads` tell people.
//! Invariant: an entry is applied once and in commit order, and repair never overtakes events.

pub mod disbelief;
pub mod feed;
pub mod holds;
pub mod inbox;
pub mod maps;
pub mod misreads;
pub mod repair;
pub mod requests;
pub mod stops;
pub mod sweep;
mod task_changes;
pub mod unanswered_offers;
