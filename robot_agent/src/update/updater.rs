//! What the updater believes from its first day, and what it knows that is not on the ledger.
//!
//! Invariant: plain values, lost at each start of the agent. The core decides by them.

use super::jobs::Job;
use crate::sets::Holdings;
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::{KeyId, PublicKey};
use midshift_bundle::trust::Refreshed;
use midshift_core::ids::DrainId;
use midshift_core::reason::Reason;
use midshift_core::time::{LinkTime, SiteTime, Utc};
use midshift_core::update::DesiredUpdate;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// What a robot believes from the day it was set up.
#[derive(Clone, Debug)]
pub struct UpdateConfig {
    /// First root of the repository.
    pub root: Vec<u8>,
    /// Keys whose directives it takes.
    pub directive_keys: BTreeMap<KeyId, PublicKey>,
    /// Its clock is set from the network.
    pub clock_synced: bool,
    /// The site lets components in that bear on a safety function.
    pub allows_safety_related: bool,
    /// Somebody starts the program again when it ends to switch.
    pub is_launched: bool,
}

/// Whether what runs is what was signed and committed.
#[derive(Debug, Default)]
pub(crate) enum Integrity {
    /// Nobody has looked yet.
    #[default]
    Unknown,
    /// It is.
    Holds,
    /// It is not.
    Bad(IntegrityFault),
}

/// What runs is not what was signed and committed.
#[derive(Debug)]
pub(crate) struct IntegrityFault {
    pub(crate) reason: Reason,
    /// Failures to have its bytes anew.
    pub(crate) tries: u32,
    /// They do not come, or help.
    pub(crate) is_given_up: bool,
    /// The committed set lies there whole.
    pub(crate) is_mended: bool,
}

/// What the updater knows that is not on the ledger.
#[derive(Debug, Default)]
pub(crate) struct Updater {
    pub(crate) config: Option<UpdateConfig>,
    /// Newest section of desired state.
    pub(crate) desired: Option<DesiredUpdate>,
    pub(crate) holdings: Option<Holdings>,
    /// As `holdings`, before the first look of its own.
    pub(crate) seen: Option<Holdings>,
    /// What the repository lists, by name, since the last refresh.
    pub(crate) listed: Option<Arc<Refreshed>>,
    /// The job under way.
    pub(crate) running: Option<Job>,
    /// The next job, once everything written before this count is durable.
    pub(crate) next: Option<(Job, u64)>,
    /// Envelope that was looked at and needs no second look.
    pub(crate) judged: Option<String>,
    /// Envelope that was there when the repository was last asked for newer keys.
    pub(crate) keys_asked: Option<String>,
    /// The repository is asked for newer keys alone.
    pub(crate) asks_for_keys: bool,
    /// The time that a proven server told last.
    pub(crate) told: Option<Utc>,
    /// The time floor, and since when it is that by the robot's own clock.
    pub(crate) floor: Option<(Utc, LinkTime)>,
    /// Generation of the section whose order to go back was refused because nothing is kept.
    pub(crate) no_way_back: Option<u64>,
    /// Envelope of a newer order for which a stuck robot has tried to go back.
    pub(crate) back_first: Option<String>,
    /// Content that is known to be there.
    pub(crate) fetched: BTreeSet<Digest>,
    /// Bytes that are there and those that are needed.
    pub(crate) progress: (u64, u64),
    /// No job before this, and how many failed in a row.
    pub(crate) pause: Option<(LinkTime, u32)>,
    /// When a grant was last asked for.
    pub(crate) asked: Option<(DrainId, LinkTime)>,
    /// When the grant ends by which the switch began.
    pub(crate) granted_until: Option<LinkTime>,
    /// Newest grant that came too late.
    pub(crate) stale_grant: u64,
    /// When this process began.
    pub(crate) begun: Option<(LinkTime, SiteTime)>,
    /// When the server last answered a heartbeat of this process.
    pub(crate) server_reached: Option<LinkTime>,
    /// The switch back was written by this process.
    pub(crate) went_back: bool,
    /// The download under way is to be left, and that was said.
    pub(crate) drops: bool,
    pub(crate) dropping: bool,
    /// Garbage was collected since the last end of an update.
    pub(crate) collected: bool,
    /// When the disk was looked at last without an update under way.
    pub(crate) looked: Option<LinkTime>,
    /// Whether what runs is what was signed and committed.
    pub(crate) integrity: Integrity,
    /// When its files were last begun to be read.
    pub(crate) read_at: Option<LinkTime>,
    /// Those that are to be read still.
    pub(crate) unread: Vec<String>,
    /// The process ends once the switch record has a higher number than this.
    pub(crate) leaves: Option<u64>,
}
