//! What the stop line brings, what the robot says on it, and what the shell is to do for it.

use midshift_core::ids::StopId;
use midshift_core::robot::StopLevel;
use midshift_core::stop::ladder::Stage;
use midshift_core::stop::robot::SavedStops;
use midshift_core::stop::{Reset, Stop};

/// What the line brings.
#[derive(Clone, Debug, PartialEq)]
pub enum StopNews {
    /// A line is open. Its check-ins are numbered from here, at random.
    Attended {
        /// First number.
        nonce: u64,
    },
    /// Facts to add.
    Facts {
        /// Stops that are engaged.
        stops: Vec<Stop>,
        /// Resets, each of one stop by its id.
        resets: Vec<Reset>,
        /// State of the latch with them.
        generation: u64,
    },
    /// All that is effective was said.
    Synced {
        /// State of the latch.
        generation: u64,
        /// Public key of the service's marks. Empty: the one that was said before.
        key: Vec<u8>,
    },
    /// The answer to one check-in.
    CheckInAnswer {
        /// Its number.
        nonce: u64,
        /// State of the latch.
        generation: u64,
    },
    /// There is no line any more.
    LineLost,
    /// What came of the write with this number.
    Saved {
        /// Its number.
        number: u64,
        /// It survives the end of the process.
        is_durable: bool,
    },
}

/// What a robot says to the stop service.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CheckIn {
    /// Newest state of the latch that was taken over from this line. 0: none yet.
    pub generation: u64,
    /// It survives the end of the process.
    pub is_durable: bool,
    /// What it obeys.
    pub obeys: StopLevel,
    /// It stands and will not move by itself.
    pub is_still: bool,
    /// Effective stops that it lies inside of.
    pub inside: Vec<StopId>,
    /// What waits for a person's resume.
    pub awaiting_resume: Vec<StopId>,
    /// How far its silence has come.
    pub silence: Stage,
    /// It knows that no people are around it.
    pub is_without_people: bool,
}

impl CheckIn {
    /// The part of it that does not wait for the next second. A robot that works stands and drives all the time.
    pub(super) fn is_urgent_after(&self, old: &Self) -> bool {
        let calm = |c: &Self| Self {
            is_still: c.is_still && c.obeys >= StopLevel::Halt,
            is_without_people: false,
            ..c.clone()
        };
        calm(self) != calm(old)
    }
}

/// What the shell is to do for the stop line.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum StopOrder {
    /// Save these stops, and report [`StopNews::Saved`] with this number.
    Save(u64, Box<SavedStops>),
    /// Make a new line: this one does not work.
    Redial(&'static str),
    /// Say this to the stop service under this number.
    CheckIn(u64, Box<CheckIn>),
}
