//! How a decision becomes an item, and what a directive of it says.
//!
//! In reading order: `plan` makes one item of a decision and tells people, `directive` is what is signed for a robot.
//! Invariant: a decision is one item, or leaves the projection as it was.

pub mod directive;
pub mod plan;
