//! What is due for each robot of a roll-out, where that leads, and what is written for it.
//!
//! In reading order: `machine` is the table of steps and moves, `drains` asks fleet for drains and releases
//! them, `due` finds the move that is due, `moves` writes it.

pub mod drains;
pub mod due;
pub mod machine;
pub mod moves;
