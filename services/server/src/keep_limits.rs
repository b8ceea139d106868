//! How much a server keeps at most of what goes by its age too.

use midshift_store::FRAME_BYTES_DEFAULT;

/// Log entries kept at most, beside the days of [`midshift_core::privacy::Retention::Week`].
const ENTRIES_DEFAULT: u64 = 20_000_000;

/// How much is kept. What is over goes within a minute, the oldest first.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct KeepLimits {
    /// Bytes of STATUS samples kept at most, packed, without the database's own overhead; older ones go before their 30 days are over. The same for each gateway
    /// of a site: the smallest counts.
    #[arg(long, value_name = "BYTES", default_value_t = FRAME_BYTES_DEFAULT, value_parser = clap::value_parser!(u64).range(1_048_576..=1 << 50))]
    pub status_log_bytes: u64,
    /// Entries kept at most of each log of changes, some 1 KB each; older ones go before their 7 days are over, and none that a service has not read. The same for
    /// each process with role fleet.
    #[arg(long, value_name = "N", default_value_t = ENTRIES_DEFAULT, value_parser = clap::value_parser!(u64).range(10_000..))]
    pub log_entries: u64,
}

impl Default for KeepLimits {
    fn default() -> Self {
        Self { status_log_bytes: FRAME_BYTES_DEFAULT, log_entries: ENTRIES_DEFAULT }
    }
}
