//! The store: rows that items change under compare-and-set, and a feed of every change in commit order.
//!
//! Services use it through [`Store`]. [`MemoryStore`], [`SqliteStore`] and [`PostgresStore`] pass one contract suite
//! (`tests/store/contract.rs`).
//! Invariants:
//! 1. An item is applied whole or not at all, by the one service that owns its tables
//!    ([`midshift_core::rows::Table::writer`]).
//! 2. An item is acknowledged only once it is as durable as the store can make it.
//! 3. Nothing here decides about the fleet.
//!
//! Two things are not rows. Heartbeats and poses are volatile and stand on the [`LiveBoard`], which processes share
//! through the [`HeartbeatLog`]. Samples are bulky and stand in the [`FrameLog`].

mod audit;
mod board;
mod check;
pub mod expired_rows;
mod frames;
mod frames_pack;
mod frames_queue;
mod gather;
mod group;
mod heartbeats;
pub mod leadership;
mod migrations;
mod model;
mod model_table;
mod open_error;
mod postgres;
mod projection;
mod queue;
mod restored_rows;
mod skipped_rows;
mod sql;
mod sqlite;
mod store;

pub use board::{Dirty, LiveBoard};
pub use frames::{
    Coarsen, FRAME_BYTES_DEFAULT, Frame, FrameLog, FrameMark, FramesOldest, GAPS_MAX, Gap, MemoryFrames, StoredFrame,
};
pub use heartbeats::{HeartbeatLog, MemoryHeartbeats, SavedHeartbeats, StoredHeartbeat, follow_heartbeats};
pub use migrations::Migrated;
pub use model::MemoryStore;
pub use open_error::OpenError;
pub use postgres::{
    CopiedSchema, PostgresConfig, PostgresCopy, PostgresFrames, PostgresHeartbeats, PostgresRestore, PostgresStore,
    RestoreError, Road, Wakes, migrate_postgres,
};
pub use projection::{Change, Fold, Projection};
pub use skipped_rows::SkippedRows;
pub use sqlite::{Database, Described, SqliteFrames, SqliteRestored, SqliteStore, migrate, renew_identity};
pub use store::{
    Applied, Cause, CommitError, Cursor, Error, FEED_PAGE_MAX, FeedPage, GET_KEYS_MAX, ID_BYTES_MAX, Query, Retention,
    SEQ_PLAUSIBLE_MAX, Snapshot, Store, StoreId, Subjects, find_record, follow, load,
};
