//! The wire of midshift: generated messages, servers and clients, what they mean as core types, and the one door from refusals to `Status`.
//!
//! Invariant: no rule is decided here. Conversions parse into core types, listing every violation, or write core types out; rules live in core.
//! Called by every service, the agent, the simulator and the CLI.

pub mod access;
pub mod chunk;
pub mod codec;
pub mod convert;
pub mod denials;
mod generated;
pub mod go_away;
pub mod json;
pub mod pages;
pub mod session;
pub mod status;
pub mod watches;

/// `Debug` of messages with a secret: everything but it. Made from the options of their fields, as no message can be forgotten that way.
mod secrets {
    include!(concat!(env!("OUT_DIR"), "/secrets.rs"));
}

pub use convert::{Parse, parse, parse_field, parse_word};
pub use denials::DenialReporter;
pub use generated::{common, fleet, identity, link, ota, sim, stop, task, telemetry};
pub use go_away::GoAwayNotice;
pub use status::{refusal_of, status};

/// Descriptors of all packages with their comments, for reflection and JSON.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptor_set.bin"));
