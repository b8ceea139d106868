//! What hostile peers do.

/// What hostile peers do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Load {
    /// A preface, one byte in half a second.
    Slow,
    /// Nothing, or half a preface, and then nothing.
    HalfOpen,
    /// As half-open, more of them than the server has descriptors.
    Descriptors,
    /// Oversized and malformed frames, again and again.
    Frames,
    /// Requests as fast as they are answered.
    Flood,
}

impl Load {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Slow, Self::HalfOpen, Self::Descriptors, Self::Frames, Self::Flood];

    /// As figures name it.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Slow => "slow peers",
            Self::HalfOpen => "half-open peers",
            Self::Descriptors => "out of descriptors",
            Self::Frames => "broken frames",
            Self::Flood => "flood of requests",
        }
    }
    /// As the command line names it.
    pub const fn flag(self) -> &'static str {
        match self {
            Self::Slow => "slow",
            Self::HalfOpen => "half-open",
            Self::Descriptors => "descriptors",
            Self::Frames => "frames",
            Self::Flood => "flood",
        }
    }
}
