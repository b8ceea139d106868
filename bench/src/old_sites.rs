//! Makes sites where much is over, as the tests do.

#[expect(clippy::expect_used, reason = "shared with the tests, which fail by panicking")]
#[expect(dead_code, reason = "shared with the tests, which commit old sites whole too")]
#[path = "../../tests/src/old_site.rs"]
pub mod old_site;
#[path = "../../tests/src/old_tables.rs"]
pub mod old_tables;
