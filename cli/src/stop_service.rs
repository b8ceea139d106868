//! Where a stop service is: on the host of a server, with its files below the data folder of that server.

pub use midshift_agent::program::{STOP_PORT as PORT, stop_service_beside as beside_on};

/// The folder of its files below the data folder.
pub const FOLDER: &str = "stop";

/// The stop service on the host of a server: host:port. None: `server` names no host.
pub fn beside(server: &str) -> Option<String> {
    beside_on(server, PORT)
}
