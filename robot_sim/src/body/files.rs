//! Files of a body in its directory: its journal, and its own one that says where it stands, with what in its battery
//! and which fault.
//!
//! Invariant: their JSON is read back by later versions. The body's file is replaced whole.

use crate::energy::Stores;
use crate::journal;
use midshift_core::ids::WaypointId;
use midshift_core::robot::Fault;
use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

/// Name of the journal in a body's directory.
pub const JOURNAL_FILE: &str = "journal.jsonl";
/// Name of the body's own file.
const BODY_FILE: &str = "body.json";

/// Why a body could not be made or brought back.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Its start is not on the map.
    #[error("start {0} is no waypoint of the site")]
    UnknownStart(WaypointId),
    /// Its journal could not be used.
    #[error(transparent)]
    Journal(#[from] journal::Error),
    /// Its file could not be read or written.
    #[error("body file {path}: {source}")]
    File {
        /// The file of the body.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
}

/// The body's file.
#[derive(Serialize, Deserialize)]
pub(super) struct BodyFile {
    pub(super) life: u32,
    pub(super) x_m: f64,
    pub(super) y_m: f64,
    pub(super) theta_rad: f64,
    pub(super) last: Option<WaypointId>,
    pub(super) touching: Option<WaypointId>,
    pub(super) lane: Option<(WaypointId, WaypointId)>,
    pub(super) charging: bool,
    pub(super) parked: bool,
    pub(super) broken: Option<Fault>,
    pub(super) stores: Stores,
    pub(super) odometer_mm: f64,
    pub(super) loaded_mm: f64,
}

impl BodyFile {
    /// As it was written to this directory last; none: never.
    pub(super) fn read(dir: &Path) -> Result<Option<Self>, Error> {
        let path = dir.join(BODY_FILE);
        let failed = |source| Error::File { path: path.clone(), source };
        match std::fs::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map(Some).map_err(|e| failed(e.into())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(failed(error)),
        }
    }

    /// Writes it to this directory. A failure is logged: the body goes on.
    pub(super) fn write(&self, dir: &Path) {
        let (path, new) = (dir.join(BODY_FILE), dir.join("body.json.new"));
        let written = serde_json::to_vec(self).map_err(io::Error::from);
        let replaced =
            written.and_then(|bytes| std::fs::write(&new, bytes)).and_then(|()| std::fs::rename(&new, &path));
        if let Err(error) = replaced {
            tracing::error!(path = %path.display(), %error, "body file not written");
        }
    }
}

/// Where a body is kept, and how often it came back.
#[derive(Debug)]
pub(super) struct Keeper {
    pub(super) dir: PathBuf,
    pub(super) life: u32,
}
