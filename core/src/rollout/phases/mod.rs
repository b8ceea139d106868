//! Brings a whole roll-out from phase to phase, lets it stand still, and takes it back.
//!
//! In reading order: `advance` goes through waves and gates, `pauses` stands still and goes on.

pub mod advance;
pub mod pauses;
