//! The raw limit of a stop: one loop that writes as many bytes to every socket, each of which writes an acknowledgement and is answered.
//!
//! Invariant: nothing is encoded, checked or kept. Called by a child.

use crate::questions::answer_questions;
use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;

/// What one stop of the fleet is on the wire, with the head of its frame, rounded up.
pub const FRAME_BYTES: usize = 192;
/// What a check-in is that names one stop.
pub const ACK_BYTES: usize = 96;
/// What its answer is.
pub const ANSWER_BYTES: usize = 32;

/// Writes to all; the answer is how many could be written to.
pub const TELL: &str = "tell";
/// Acknowledgements since then.
pub const ACKED: &str = "acked";

/// The machine's monotonic clock, which is the same in all processes.
pub fn now_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec.unsigned_abs() * 1_000_000_000 + now.tv_nsec.unsigned_abs()
}

#[derive(Default)]
struct Sockets {
    open: Mutex<BTreeMap<u64, Arc<TcpStream>>>,
    acked: AtomicU64,
}

impl Sockets {
    fn write_all(&self) -> u64 {
        self.acked.store(0, Relaxed);
        let open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        let frame = [7; FRAME_BYTES];
        open.values().filter(|stream| stream.try_write(&frame).is_ok_and(|bytes| bytes == FRAME_BYTES)).count() as u64
    }
}

/// Takes connections until `stop`.
pub async fn serve(address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    let listener = TcpListener::bind(address).await?;
    let sockets = Arc::new(Sockets::default());
    let asked = sockets.clone();
    answer_questions(listener.local_addr()?, stop.clone(), move |question| match question {
        TELL => asked.write_all(),
        _ => asked.acked.load(Relaxed),
    })?;
    let accepting = async {
        for number in 0.. {
            let (stream, _) = listener.accept().await?;
            stream.set_nodelay(true)?;
            let sockets = sockets.clone();
            tokio::spawn(async move {
                let stream = Arc::new(stream);
                let open = || sockets.open.lock().unwrap_or_else(PoisonError::into_inner);
                // So that the first frame finds it known to be writable.
                if stream.writable().await.is_err() {
                    return;
                }
                open().insert(number, stream.clone());
                let _ended = answer(&stream, &sockets.acked).await;
                open().remove(&number);
            });
        }
        io::Result::Ok(())
    };
    tokio::select! {
        ended = accepting => Ok(ended?),
        () = stop.cancelled() => Ok(()),
    }
}

async fn answer(stream: &TcpStream, acked: &AtomicU64) -> io::Result<()> {
    let (mut buffer, mut read) = ([0; ACK_BYTES], 0);
    loop {
        stream.readable().await?;
        match stream.try_read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(bytes) => read += bytes,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => continue,
            Err(error) => return Err(error),
        }
        if read >= ACK_BYTES {
            read -= ACK_BYTES;
            acked.fetch_add(1, Relaxed);
            if stream.try_write(&[9; ANSWER_BYTES])? != ANSWER_BYTES {
                return Err(io::ErrorKind::WriteZero.into());
            }
        }
    }
}
