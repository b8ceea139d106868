//! Where a stop service is: on the host of a server, with its files below the data folder of that server.

use crate::way::uri;

/// Its port, beside the 7420 of the business.
pub const PORT: u16 = 7421;
/// The folder of its files below the data folder.
pub const FOLDER: &str = "stop";

/// The stop service on the host of a server: host:port. None: `server` names no host.
pub fn beside(server: &str) -> Option<String> {
    beside_on(server, PORT)
}

/// The same where it has another port.
pub fn beside_on(server: &str, port: u16) -> Option<String> {
    let uri: http::Uri = uri(server).parse().ok()?;
    Some(format!("{}:{port}", uri.host()?))
}
