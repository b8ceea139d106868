//! Lists what disturbs the machine while a stop is measured.

/// What disturbs the machine while a stop is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Disturbance {
    /// Nothing: no server at all.
    Nothing,
    /// A server at the knee of its ingest.
    Ingest,
    /// A server whose robots download as fast as the machine carries it.
    Bulk,
    /// A server whose PostgreSQL was stopped with SIGSTOP.
    Database,
    /// A server on a disk without room, with the files of the stop service on it too.
    Disk,
    /// A server that is killed with SIGKILL right before each turn.
    Kill,
}

impl Disturbance {
    /// Those that were asked for, or all.
    pub fn all(asked: &[Self]) -> Vec<Self> {
        let all = [Self::Nothing, Self::Ingest, Self::Bulk, Self::Database, Self::Disk, Self::Kill];
        all.into_iter().filter(|disturbance| asked.is_empty() || asked.contains(disturbance)).collect()
    }
    /// For names of figures.
    pub fn words(self) -> &'static str {
        match self {
            Self::Nothing => "nothing beside",
            Self::Ingest => "ingest at the knee",
            Self::Bulk => "downloads at full rate",
            Self::Database => "PostgreSQL stopped",
            Self::Disk => "disk full",
            Self::Kill => "server killed",
        }
    }
}
