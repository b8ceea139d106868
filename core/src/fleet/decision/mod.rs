//! How a decision becomes an item: what a turn may still do, what is given up, what is reported, and what people are told.
//!
//! In reading order: `slice` bounds a turn, `report` says what it did, `refusals` puts aside what the store never takes, `plan` makes one item
//! of a decision, `incidents` tells people. Invariant: a decision is one item, or leaves the projection as it was.

pub mod incidents;
pub mod plan;
pub mod refusals;
pub mod report;
pub mod slice;
