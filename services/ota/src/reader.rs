//! The folder of releases in a process that only hands out of it.

use crate::content::{Content, DiskContent};
use crate::downloads::{Downloads, add_bundles, add_chunks};
use crate::repository::{Documents, Error, every_second};
use crate::threads::blocking;
use crate::{folder, http1};
use midshift_core::Boxed;
use midshift_store::{Store, StoreId};
use std::path::PathBuf;
use std::sync::Arc;
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;

/// What a process has of the folder that others keep: it hands out bytes and documents, signs nothing and writes nothing. Cheap to clone.
#[derive(Clone)]
pub struct OtaReader {
    pub(crate) downloads: Downloads,
    pub(crate) documents: Documents,
}

impl OtaReader {
    /// Opens the folder of a store that its processes with role ota keep.
    ///
    /// # Errors
    /// If it is not there, does not say that it is this store's, or documents do not hang together.
    pub fn open(folder: PathBuf, store_id: StoreId) -> Boxed<'static, Result<Self, Error>> {
        Box::pin(async move {
            let of = folder.clone();
            blocking(move || folder::must_be_of(&of, &store_id)).await?;
            let content: Arc<dyn Content> = Arc::new(DiskContent::reading(&folder.join("content")));
            let documents = Documents::reading(&folder.join("metadata"), content.clone()).await?;
            Ok(Self { downloads: Downloads::new(content, documents.clone()), documents })
        })
    }
    /// The same, which gives bytes to machines alone that these rows know as robots.
    #[must_use]
    pub fn with_rows(self, rows: Arc<dyn Store>) -> Self {
        Self { downloads: self.downloads.with_rows(Some(rows)), ..self }
    }
    /// With bytes and documents, for robots: nothing else of releases is answered here.
    pub fn add_to(&self, routes: Routes) -> Routes {
        add_bundles(self.downloads.clone(), add_chunks(self.downloads.clone(), routes))
    }
    /// `/metadata/…` and `/targets/…` over plain HTTP, for clients of TUF that are not ours.
    pub fn pages(&self) -> axum::Router {
        http1::router(self.downloads.clone())
    }
    /// Learns what others publish until shutdown.
    pub fn run(self, shutdown: CancellationToken) -> Boxed<'static, ()> {
        Box::pin(async move { every_second(&shutdown, || self.documents.follow_if_possible()).await })
    }
}
