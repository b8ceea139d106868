//! The ways of a robot to its servers: how they are dialed, by which proof, and the bulk connection beside the session.
//!
//! Rooms, from below: `tls` is who proves what, `dial` makes connections, `bulk` shares one, `replay` paces old STATUS
//! on it; `enrolment` is how a machine becomes a robot of a site, `repeats` what the log is told of failures.
//! Invariant: nothing here knows what work is.

pub mod bulk;
pub mod dial;
pub mod enrolment;
pub(crate) mod repeats;
pub mod replay;
pub mod tls;
