//! Copies of a database while servers use it, and a database made of a copy: one file for each table, in PostgreSQL's binary format.
//!
//! Invariant: a copy is one moment of both schemas. What is restored is committed in one transaction, into a database that has no row of
//! midshift, or it is not there; and it is a store of its own, see [`PostgresRestore`]. What a file of a copy may hold is what the
//! migrations make, never what the copy says of itself.

mod check;
mod copied;
mod copy_in;
mod copy_out;
mod tables;

pub use copied::{CopiedSchema, PostgresCopy};
pub use copy_in::{PostgresRestore, RestoreError};
