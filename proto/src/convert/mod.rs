//! Wire to core and back. Reading lists every violation of a message at once; writing cannot fail.
//!
//! Invariant: an UNSPECIFIED enum value is refused on receipt unless its comment in the .proto gives it a meaning. What becomes of a number
//! of a newer version is decided for each enum in proto/tests/wire/unknown.rs.

pub mod common;
mod enums;
pub mod fleet;
pub mod plan;
mod reading;
pub mod robot;
pub mod sample;
pub mod session;
pub mod stop;
pub mod submission;
pub mod task;
pub mod task_type;
pub mod telemetry;
pub mod update;
pub mod work;

pub(crate) use common::from_struct;
pub use common::{duration, ms_of, parse_ms, parse_time, shown, time_of, timestamp, to_struct};
pub use enums::WireEnum;
pub use reading::{At, Parse, parse, parse_field, parse_word};
pub(crate) use reading::{counted, from_one, id, list, maybe, maybe_id, need, permille, text, word};
