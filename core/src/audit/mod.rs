//! The audit: who decided what, as rows of one chain a service, each with the hash of the one before it.
//!
//! Invariant: pure. A row is never changed; what is hashed are the bytes that are stored, so that a reader of any version can hold them to their
//! hash. Called by the store, which alone knows the order, and by whoever verifies. What a chain proves and what not: docs/audit.md.

mod chain;
mod note;
mod verify;

pub use chain::{
    Attribution, AuditRow, DONE, Draft, FleetAudit, IdentityAudit, Kind, Opened, OtaAudit, StopAudit, TaskAudit,
    append, id_of, link, open,
};
pub use note::{ANCHOR, CUT, Crowd, Head, NOTHING, Note};
pub use verify::{Broken, Chain, Ends, Export, Held, Mark, Verified};
