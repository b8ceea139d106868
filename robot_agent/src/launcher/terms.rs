//! What a launcher and the program that it starts have agreed on: names of files, variables, ends and the pulse.
//!
//! Invariant: a launcher is older or newer than its program, so these never change.

/// Environment variable that names the set to the program that is started.
pub const SET: &str = "MIDSHIFT_SET";
/// File of a set that is its program; no component has a name with a dot.
pub const PROGRAM: &str = "set.program";
/// The switch record in the folder of the sets.
pub const SWITCH: &str = "switch";
/// The program ends with this to be started again at once: it has written the switch record.
pub const SWITCHED: u8 = 75;
/// The program ends with this when its environment failed it: a lock that is taken, a full disk, a device that is
/// missing. No try of a set is counted for it.
pub const ENVIRONMENT: u8 = 74;
/// Environment variable that asks the program for its pulse.
pub const PULSE_ASKED: &str = "MIDSHIFT_PULSE";
/// The pulse.
pub const PULSE_LINE: &str = "\u{1}midshift-hb";
