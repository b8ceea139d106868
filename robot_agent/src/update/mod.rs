//! The robot's updater without IO: which bytes to fetch, when to switch, when to go back.
//!
//! Rooms: here what it knows and asks for; `pursue` is the machine; `believes` is what it holds directives against; `standing` holds what runs
//! against what was signed and committed, and `proven` is what the ledger keeps for that; `way_back` takes orders that lead
//! back from the committed set; `migrate` is what follows a commit; `io` does the jobs; `remote` asks the server;
//! `again` says how long is waited for what failed; `behind` mends a switch record that is older than the ledger. Called
//! by the core.
//! Invariant: each side effect is a [`Job`], and a job begins only after the ledger row that explains it is durable; at most one job is
//! under way. The switch record wins over the ledger, unless it has on trial what the ledger has committed.

mod again;
mod behind;
mod believes;
pub mod io;
pub mod migrate;
pub mod proven;
mod pursue;
pub mod remote;
mod standing;
mod way_back;

use crate::core::AgentCore;
use crate::sets::{Holdings, Wanted};
use crate::switch::Switch;
use midshift_bundle::digest::Digest;
use midshift_bundle::directive::Directive;
use midshift_bundle::keys::{KeyId, PublicKey};
use midshift_bundle::manifest::Manifest;
use midshift_bundle::set::SetManifest;
use midshift_bundle::trust::{Reading, Refreshed, Trusted};
use midshift_core::ids::{BundleId, DrainId, SetId};
use midshift_core::reason::Reason;
use midshift_core::time::{LinkTime, SiteTime, Utc};
use midshift_core::update::{DesiredUpdate, UpdateReport, UpdateState};
use migrate::DueMigration;
use serde::{Deserialize, Serialize};
use standing::Standing;
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

/// What the ledger remembers of software.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SoftwareRow {
    /// Generation of the newest directive that was taken.
    pub directive: u64,
    /// Digest of its envelope; none: it was taken before that was written down.
    #[serde(default)]
    pub envelope: Option<Digest>,
    /// Keys that were handed over; none: those of the trust file count.
    #[serde(default)]
    pub keys: Option<HeldKeys>,
    /// Highest grant that was used.
    pub grant_id: u64,
    /// Lowest `rollback_index` of each component that may be taken.
    pub floors: BTreeMap<String, u64>,
    /// When the set that runs was committed; none: the robot came with it, or nobody wrote it down.
    #[serde(default)]
    pub committed_at: Option<Utc>,
    /// Migrations of the committed set that are not done yet.
    #[serde(default)]
    pub due: Vec<DueMigration>,
    /// The newest update.
    pub update: Option<Update>,
}

/// Keys of directives that were handed over by those before them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeldKeys {
    /// Number of their set.
    pub number: u64,
    /// The keys, as 64 hexadecimal digits each.
    #[serde(with = "hex_keys")]
    pub keys: Vec<PublicKey>,
    /// Keys that the trust file named when they were taken: another file counts instead of them, but never an older set.
    pub from: Vec<KeyId>,
}

mod hex_keys {
    use midshift_bundle::keys::PublicKey;
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(keys: &[PublicKey], to: S) -> Result<S::Ok, S::Error> {
        keys.iter().map(PublicKey::hex).collect::<Vec<_>>().serialize(to)
    }
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<PublicKey>, D::Error> {
        let keys = Vec::<String>::deserialize(from)?;
        keys.iter().map(|key| PublicKey::from_hex(key).ok_or_else(|| D::Error::custom("no key"))).collect()
    }
}

/// One update.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// Where it stands.
    pub state: UpdateState,
    /// Its manifest.
    pub bundle: Digest,
    /// Bytes of the manifest.
    pub manifest_length: u64,
    /// No component may have a lower `rollback_index`.
    pub rollback_floor: u64,
    /// What comes of it; none before it was planned.
    pub set: Option<SetManifest>,
    /// Floors rise when it is committed.
    pub raises_floor: bool,
    /// It cannot be gone back from once it is committed.
    pub is_irreversible: bool,
    /// The drain in which it was activated, or gone back from.
    pub drain_id: Option<DrainId>,
    /// Starts that the set was given before it was put away.
    pub tries: u32,
    /// Milliseconds of site time on probation.
    pub probation_ms: u64,
    /// Why it was refused or went back.
    pub reason: Option<Reason>,
}

impl Update {
    /// Name of its set in the switch record.
    pub fn set_name(&self) -> Option<String> {
        self.set.as_ref().map(|set| set.id().to_string())
    }
}

/// Something that takes time, done outside the core.
#[derive(Clone, Debug, PartialEq)]
pub enum Job {
    /// What is on the disk?
    Look,
    /// Ask the repository what there is.
    Refresh {
        /// What is believed so far.
        trusted: Box<Trusted>,
        /// The robot's clock.
        clock: Reading,
        /// Number of the set of directive keys that it has: newer ones are fetched.
        keys_after: u64,
    },
    /// Have this content, whole and checked.
    Fetch {
        /// Digest and length of the content.
        wanted: Wanted,
        /// Content that a patch may be from: the same component in other sets, the running one first.
        bases: Vec<Digest>,
        /// Bytes a second; 0: as fast as it goes.
        rate_bytes_s: u32,
    },
    /// Fetch and read a manifest.
    Manifest {
        /// Digest and length of the manifest.
        wanted: Wanted,
    },
    /// Make a set of what is there and read it back.
    Stage(Box<SetManifest>),
    /// Read a set again.
    Verify(SetId),
    /// Read one file of a set again.
    Check {
        /// The set.
        set: Digest,
        /// Name of a component, or of the program as the launcher calls it.
        file: String,
    },
    /// Have every file of a set as it was signed: what lies there otherwise comes anew.
    Mend(Box<SetManifest>),
    /// Write the switch record.
    Write(Switch),
    /// Have a committed set do something to the robot's data.
    Migrate {
        /// The set.
        set: Digest,
        /// What it is to do.
        due: DueMigration,
    },
    /// Delete what nobody needs.
    Collect(BTreeSet<Digest>),
}

impl Job {
    /// Its name in the log.
    pub const fn as_str(&self) -> &'static str {
        match self {
            Self::Look => "look",
            Self::Refresh { .. } => "refresh",
            Self::Fetch { .. } => "fetch",
            Self::Manifest { .. } => "manifest",
            Self::Stage(_) => "stage",
            Self::Verify(_) => "verify",
            Self::Check { .. } => "check",
            Self::Mend(_) => "mend",
            Self::Write(_) => "write",
            Self::Migrate { .. } => "migrate",
            Self::Collect(_) => "collect",
        }
    }
}

/// What came of a job.
#[derive(Clone, Debug)]
pub enum Done {
    /// What is there.
    Holdings(Box<Holdings>),
    /// What the repository lists.
    Refreshed {
        /// To be believed.
        refreshed: Box<Refreshed>,
        /// Envelopes of newer sets of directive keys, by the number under which they are listed.
        key_sets: BTreeMap<u64, Vec<u8>>,
    },
    /// The repository gave something to be believed, and not what was asked for.
    Believed {
        /// What is believed now.
        trusted: Box<Trusted>,
        /// Why not the rest.
        failure: Failure,
    },
    /// A manifest.
    Manifest {
        /// As it was read.
        manifest: Box<Manifest>,
        /// As it was signed.
        bytes: Vec<u8>,
    },
    /// Done as asked.
    Ok,
    /// Written, with its number.
    Written(Switch),
    /// Not done.
    Failed(Failure),
}

/// Why a job was not done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The server or the disk does not answer: tried again.
    Later(String),
    /// It will not be otherwise next time.
    Refused(Reason),
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
    pub(crate) standing: Standing,
    /// When its files were last begun to be read.
    pub(crate) read_at: Option<LinkTime>,
    /// Those that are to be read still.
    pub(crate) unread: Vec<String>,
    /// The process ends once the switch record has a higher number than this.
    pub(crate) leaves: Option<u64>,
}

impl AgentCore {
    /// What the shell saw on the disk before the start: to be told, nothing is decided on it.
    pub fn saw(&mut self, holdings: Option<Holdings>) {
        self.holds_as_it_came(holdings.as_ref());
        self.update.seen = holdings;
    }
    /// What is on the disk, as it was seen last. None: its software is not changed, or the disk cannot be read.
    pub(crate) fn holdings(&self) -> Option<&Holdings> {
        self.update.holdings.as_ref().or(self.update.seen.as_ref())
    }
}

impl SoftwareRow {
    /// As it is once this directive was taken.
    fn with(&self, directive: &Directive, desired: &DesiredUpdate) -> Self {
        let envelope = Some(Digest::of(desired.directive.as_bytes()));
        Self { directive: directive.generation, envelope, update: None, ..self.clone() }
    }
    /// The newest update as it is reported.
    pub fn report(&self, progress_permille: u16) -> Option<UpdateReport> {
        let update = self.update.as_ref()?;
        Some(UpdateReport {
            state: update.state,
            bundle: BundleId::parse(&update.bundle.to_string()).ok()?,
            directive: self.directive,
            set: update.set_name().and_then(|name| SetId::parse(&name).ok()),
            drain_id: update.drain_id.clone(),
            grant_id: self.grant_id,
            tries: update.tries,
            progress_permille,
            reason: update.reason.clone(),
        })
    }
}
