//! Access rights: roles and their scopes, callers, and the rows of tokens, keys and enrolments.
//!
//! Invariants:
//! 1. Rights are never merged. A right holds only in the scope of the one grant that gives it; engaging a stop is open
//!    to every grant.
//! 2. A token without a grant permits nothing beyond what is open to anybody.
//! 3. Rows hold digests of secrets, never the secrets.
//!
//! Called by the edge of every port, by identity, and by services for each object.

mod actor;
mod caller;
mod directory;
mod enrolment;
mod grant;
mod proof;
mod revocation;
mod rows;
mod session;
mod token;

pub use actor::Actor;
pub use caller::{Caller, Principal};
pub use directory::{Directory, DirectoryToken};
pub use enrolment::{Deny, EnrolmentState, Replace, RobotIdentity};
pub use grant::{Access, Grant, HeldGrant, Object, Permission, Role, Scope};
pub use proof::ServerProof;
pub use revocation::{Revocation, revocations};
pub use rows::{Act, RootCertificate, Rotation, ServerCertificate, TokenName, TokenRecord};
pub use session::SessionSecret;
pub use token::{Digest, Secret, TokenId};

/// The folder of a server's keys and certificates, below its data folder.
pub const FOLDER: &str = "identity";
