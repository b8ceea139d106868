//! Which robots belong to a roll-out, in which wave, and what robots get that come to an area later.
//!
//! In reading order: `matching` says whom a roll-out reaches, `assign` gives them their rows, `area_bundles` keeps
//! which roll-out serves an area, `newcomers` gives a place to robots that come later.

pub mod area_bundles;
pub mod assign;
pub mod matching;
pub mod newcomers;
