//! Ends what serves when a person or the system asks for it. What only asks has no such token: Ctrl-C ends it at once.

use midshift_os::told_to_end;
use tokio_util::sync::CancellationToken;

/// A token that Ctrl-C and SIGTERM cancel.
pub fn interrupts() -> CancellationToken {
    let stop = CancellationToken::new();
    let cancel = stop.clone();
    tokio::spawn(async move {
        told_to_end().await;
        cancel.cancel();
    });
    stop
}
