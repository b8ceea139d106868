//! Laws that more than one witness looks at, by the name under which each is reported.

/// What an honest robot works on is known, and over by its own word alone. That ready work finds it is a matter of `TOLD`: a robot that could
/// take it is no reason for it to wait.
pub const GOES_ON: &str = "honest robots' tasks go on";
/// Nor is it put aside: a player's words never make a decision that no store takes.
pub const REFUSED: &str = "what the store refuses for good is not composed again";
/// Rows, and what the words of one robot open.
pub const BOUNDED: &str = "memory is bounded";
/// Nobody else is given what a robot has, and no item is put down twice.
pub const ONCE: &str = "nobody's work is given twice";
