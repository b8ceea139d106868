//! Who may do what: roles and where they hold, callers, and what is known of tokens and keys.
//!
//! Invariant: rights are never merged. A right holds where the one grant that gives it says, and a caller without a grant may do nothing.
//! Secrets are never here, only their digests. Called by the edge of every port, by identity, and by services for each object.

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
pub use caller::{Caller, Who};
pub use directory::{Directory, DirectoryToken};
pub use enrolment::{Deny, EnrolmentState, Replace, RobotIdentity};
pub use grant::{Access, Grant, Object, Permission, Role, Scope};
pub use proof::ServerProof;
pub use revocation::{Revocation, revocations};
pub use rows::{Act, Authority, Rotation, ServerCertificate, TokenName, TokenRecord};
pub use session::SessionSecret;
pub use token::{Digest, Secret, TokenId};

/// The folder of a server's keys and certificates, below its data folder.
pub const FOLDER: &str = "identity";
