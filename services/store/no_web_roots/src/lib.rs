//! No roots of the public web: what is believed is what an address names (docs/decisions/0048).

use pki_types::TrustAnchor;

/// No root at all.
pub const TLS_SERVER_ROOTS: &[TrustAnchor<'static>] = &[];
