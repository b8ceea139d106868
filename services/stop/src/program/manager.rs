//! What a stop service tells the service manager that has started it, as sd_notify(3) says: which process it is now, and that it thinks still.
//!
//! Invariant: nobody waits for a manager; without one nothing is said.

use crate::service::StopService;
use std::env;
use std::ffi::OsStr;
use std::future::pending;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::sync::OnceLock;
use std::time::Duration;

/// Where it wants to hear.
const NOTIFY: &str = "NOTIFY_SOCKET";
/// Microseconds without a word after which it ends the process and starts another.
const WATCHDOG: &str = "WATCHDOG_USEC";
/// Words in that time: one may be lost.
const WORDS: u32 = 3;

/// Says which process the service is from now on.
pub fn is_now(process: u32) {
    let Some(address) = env::var_os(NOTIFY) else { return };
    if let Err(error) = notify(&address, &format!("MAINPID={process}")) {
        tracing::warn!(%error, "the service manager was not told which process this service is now");
    }
}

/// Says again and again that this process thinks still, which it does if it can look at what every stop needs. For ever.
pub async fn is_watched(service: &OnceLock<StopService>) {
    let within = env::var(WATCHDOG).ok().and_then(|micros| micros.parse().ok()).map(Duration::from_micros);
    let (Some(address), Some(within)) = (env::var_os(NOTIFY), within) else { return pending().await };
    let look = || {
        if let Some(service) = service.get() {
            service.look_at_locks();
        }
    };
    say_alive(&address, within, look).await;
}

/// Says so for ever, each time after `look` has come back.
async fn say_alive(address: &OsStr, within: Duration, look: impl Fn()) {
    let mut each = tokio::time::interval((within / WORDS).max(Duration::from_millis(1)));
    let mut is_heard = true;
    loop {
        each.tick().await;
        look();
        let to = address.to_owned();
        let told = tokio::task::spawn_blocking(move || notify(&to, "WATCHDOG=1")).await;
        let hears = matches!(told, Ok(Ok(())));
        if is_heard && !hears {
            tracing::warn!("the service manager does not hear that this service thinks still");
        }
        is_heard = hears;
    }
}

fn notify(address: &OsStr, text: &str) -> io::Result<()> {
    let address = match address.as_bytes() {
        [b'@', name @ ..] => SocketAddr::from_abstract_name(name)?,
        _ => SocketAddr::from_pathname(address)?,
    };
    let socket = UnixDatagram::unbound()?;
    // Of one that does not listen nobody waits.
    socket.set_write_timeout(Some(Duration::from_secs(1)))?;
    socket.send_to_addr(text.as_bytes(), &address).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex, mpsc};
    use std::thread;
    use tokio::sync::oneshot;

    #[test]
    fn a_service_manager_is_told_by_a_path_or_an_abstract_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("notify");
        let name = format!("midshift-next-{}", std::process::id());
        let by_name = UnixDatagram::bind_addr(&SocketAddr::from_abstract_name(&name).unwrap()).unwrap();
        let by_path = UnixDatagram::bind(&path).unwrap();
        for (socket, address) in [(by_path, path.into_os_string()), (by_name, format!("@{name}").into())] {
            notify(&address, "MAINPID=7").unwrap();
            let mut heard = [0; 32];
            let bytes = socket.recv(&mut heard).unwrap();
            assert_eq!(&heard[..bytes], b"MAINPID=7");
        }
    }

    #[test]
    fn a_service_manager_hears_nothing_while_what_every_stop_needs_is_held() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("notify");
        let manager = UnixDatagram::bind(&path).unwrap();
        let needed = Arc::new(Mutex::new(()));
        let held = needed.lock().unwrap();
        let (looks, looked) = mpsc::sync_channel(1);
        let (ends, ended) = oneshot::channel::<()>();
        let locks = needed.clone();
        let service = thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
            runtime.block_on(async {
                let look = || {
                    // Only the first is waited for.
                    let _ = looks.try_send(());
                    drop(locks.lock().unwrap());
                };
                tokio::select! {
                    () = say_alive(path.as_os_str(), Duration::from_millis(3), look) => {}
                    _ = ended => {}
                }
            });
        });
        looked.recv().unwrap();
        let mut heard = [0; 32];
        manager.set_nonblocking(true).unwrap();
        assert_eq!(manager.recv(&mut heard).map_err(|error| error.kind()), Err(io::ErrorKind::WouldBlock));
        manager.set_nonblocking(false).unwrap();
        drop(held);
        let bytes = manager.recv(&mut heard).unwrap();
        assert_eq!(&heard[..bytes], b"WATCHDOG=1");
        ends.send(()).unwrap();
        service.join().unwrap();
    }

    #[test]
    fn a_manager_that_is_not_there_is_an_error_and_no_wait() {
        let dir = tempfile::tempdir().unwrap();
        assert!(notify(dir.path().join("nobody").as_os_str(), "MAINPID=7").is_err());
    }
}
