//! Where a stop service is: on the host of a server, with its files below the data folder of that server.

pub use midshift_agent::program::stop_service_beside as beside_on;
pub use midshift_core::stop::{FOLDER, PORT};

/// The stop service on the host of a server: host:port. None: `server` names no host.
pub fn beside(server: &str) -> Option<String> {
    beside_on(server, PORT)
}
