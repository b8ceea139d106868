//! Says why this process cannot sign directives to robots, and what a person does about it.

use midshift_core::reason::{Code, Reason};

/// Why this process cannot sign a directive that robots would accept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CannotSign {
    /// The newest set of directive keys names none that is here.
    Ended {
        /// The set's.
        number: u64,
    },
    /// A set is listed and the disk does not give it, so nobody knows which keys have ended.
    Unknown,
    /// The newest set is listed, and its file is gone or damaged. It is tried again each second.
    Lost(SetLost),
    /// The wall of this machine is in doubt: what is signed by it would end too early or too late.
    Clock,
}

/// The newest set of directive keys is listed, and its file is gone or damaged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SetLost {
    /// The set's.
    pub number: u64,
}

impl CannotSign {
    /// For people.
    pub fn reason(self) -> Reason {
        match self {
            Self::Ended { number } => Reason::from(Code::NoDirectiveKey).with("set", number),
            Self::Unknown => Reason::from(Code::NoDirectiveKey).with("set", "unreadable"),
            Self::Clock => Reason::from(Code::ClockDoubted),
            Self::Lost(SetLost { number }) => {
                Reason::from(Code::NoDirectiveKey).with("set", number).with("file", "gone or damaged")
            }
        }
    }

    /// What to do about it.
    pub(super) const fn advice(self) -> &'static str {
        match self {
            Self::Ended { .. } => {
                "put a key of the newest set into the folder of --ota-keys, or push a next set that names one it has"
            }
            Self::Unknown => {
                "see to the disk, and to who may read its folder `content`: which keys have ended is read there"
            }
            Self::Lost(_) => {
                "put the file of the newest set, N.directive-keys, back into the folder `content` under its SHA-256, from a backup or from the repository that was pushed"
            }
            Self::Clock => Code::ClockDoubted.next_step(),
        }
    }
}
