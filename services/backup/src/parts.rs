//! The registry of everything durable that a server keeps, in the order in which it is copied.

use super::identity::Identity;
use super::keys::OnlineKeys;
use super::part::Part;
use super::releases::Releases;
use super::rows::{Rows, Schemas};
use super::stops::Stops;
use midshift_store::Database;

/// All parts. Rows come first: what they name is copied after them and never taken away while a copied row may name it. They are put
/// back in the other order: the rows make a server of the rest.
pub const PARTS: [&dyn Part; 7] =
    [&Rows(Database::Control), &Rows(Database::Telemetry), &Schemas, &Releases, &OnlineKeys, &Identity, &Stops];
