//! Takes robots out of work and gives them back.
//!
//! In reading order: `budget` says how many robots of an area may be out of work and begins the next drains; `drain` carries each of them out.
//! Invariant: a robot is taken only when nothing else holds it.

pub mod budget;
pub mod drain;
