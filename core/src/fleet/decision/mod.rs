//! Turns each decision into one item to commit; limits, reports and gives up decisions; opens incidents.
//!
//! In reading order: `slice` limits the work of one turn. `report` counts what was done and says why the rest was not.
//! `refusals` puts aside decisions that the store refuses for good. `plan` makes the items. `incidents` tells people.
//! Invariant: a decision is one item, or leaves the projection as it was.

pub mod incidents;
pub mod plan;
pub mod refusals;
pub mod report;
pub mod slice;
