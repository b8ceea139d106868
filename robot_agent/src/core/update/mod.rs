//! The robot's updater within the core: which bytes to fetch, when to switch, when to go back.
//!
//! Rooms: `machine` is the table, `conditions` answers what it asks, `steps` does what it says; `pursue` says when,
//! `record` are the verbs of the row, `results` takes what came of a job. `activation` says whether software may change
//! now, `directive_check` what directives are held against; `integrity` holds what runs against what was signed and committed.
//! `way_back` takes orders that lead back from the committed set, `committed` follows a commit, and `switch_repair`
//! mends a switch record that is older than the ledger. Invariant: each side effect is a [`crate::update::Job`], and a
//! job begins only after the ledger row that explains it is durable.

mod activation;
mod committed;
mod conditions;
mod directive_check;
mod integrity;
mod machine;
mod pursue;
mod record;
mod results;
mod steps;
mod switch_repair;
mod way_back;
