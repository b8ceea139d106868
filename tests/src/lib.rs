//! The one integration suite of midshift: its tests are in `tests/tests`, over real programs and real parts.

pub mod counted;
pub mod line;
pub mod metrics;
pub mod old_site;
pub mod old_tables;
pub mod player;
pub mod postgres;
pub mod raw;
