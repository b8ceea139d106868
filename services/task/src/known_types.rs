//! The task types of the site as they were read last, and up to which commit that holds.

use midshift_core::rows::Seq;
use midshift_core::task::types::TypeCatalogue;
use std::sync::Arc;

/// Task types of the site, as they were when `head` was the newest commit.
pub(crate) struct KnownTypes {
    pub(crate) head: Seq,
    pub(crate) types: Arc<TypeCatalogue>,
}
