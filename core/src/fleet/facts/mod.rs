//! What happened, and what follows of it: events, heartbeats, requests, stops, time, a changed map.
//!
//! In reading order: `feed` takes entries; `inbox` obeys a robot's event, `requests` a person's wish; `repair` compares a heartbeat with the
//! rows; `holds`, `answers` and `disbelief` are what they share; `stops` keeps stopped robots held; `sweep` gathers what is due by time; `maps`
//! and `misreads` tell people. Invariant: an entry is obeyed once and in commit order, and repair never overtakes events.

pub mod answers;
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
