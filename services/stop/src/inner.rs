//! What the service is built from, and what its lines, its calls and its writer share.

use crate::disk::Disk;
use crate::engaged::EngagedStops;
use crate::proof::Key;
use crate::robots::Robots;
use crate::site_index::SiteIndex;
use midshift_core::ids::SiteId;
use midshift_core::site::Site;
use midshift_core::time::{Clock, LinkTime, Utc};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock};
use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;

/// What the service is built from.
#[derive(Clone)]
pub struct Parts {
    /// Latch, audit, key and roster; made with mode 0700. One process has it at a time.
    pub folder: PathBuf,
    /// Where areas and zones are. None: every part means everywhere.
    pub site: Option<Arc<Site>>,
    /// Where the time of the wall and of the link is read.
    pub clock: Arc<dyn Clock>,
}

/// What its parts share.
pub(crate) struct Inner {
    pub clock: Arc<dyn Clock>,
    /// Which site's; none: there is no site file.
    pub site_id: Option<SiteId>,
    pub site_index: SiteIndex,
    pub key: Key,
    /// Taken before `engaged_stops` by whoever changes it: lines hear of changes in their order.
    pub fan: Mutex<()>,
    pub engaged_stops: Mutex<EngagedStops>,
    pub robots: Robots,
    pub disk: Disk,
    /// Counts what watchers may want to look at.
    pub changed: watch::Sender<u64>,
    pub watchers: Arc<Semaphore>,
    /// When who is known was last said to be what it is; unset: nobody looks.
    pub principals: OnceLock<watch::Receiver<Utc>>,
    pub started: LinkTime,
    /// It was asked to end.
    pub shutdown: CancellationToken,
    /// Streams end.
    pub ended: CancellationToken,
}

impl Inner {
    /// There is something that watchers may want to look at.
    pub fn touch(&self) {
        self.changed.send_modify(|n| *n += 1);
    }
}
