//! The raw limit of a stop: one loop that writes as many bytes to every socket, each of which writes an acknowledgement and is answered.
//!
//! It speaks plain text, or TLS as the port of the stop service does. Invariant: nothing of a message is encoded, checked or kept. Called by a child.

use crate::questions::answer_questions;
use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use tokio::io::{AsyncReadExt, AsyncWrite, ReadHalf, WriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;
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

/// Plain or TLS.
type Socket = Either<TcpStream, Box<TlsStream<TcpStream>>>;
type Writer = Mutex<WriteHalf<Socket>>;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[derive(Default)]
struct Sockets {
    open: Mutex<BTreeMap<u64, Arc<Writer>>>,
    acked: AtomicU64,
}

impl Sockets {
    fn write_all(&self) -> u64 {
        self.acked.store(0, Relaxed);
        let frame = [7; FRAME_BYTES];
        lock(&self.open).values().filter(|writer| write_now(writer, &frame)).count() as u64
    }
    /// Holds one connection to its end.
    async fn hold(&self, number: u64, stream: TcpStream, tls: Option<TlsAcceptor>) -> io::Result<()> {
        // So that the first frame finds it known to be writable.
        stream.writable().await?;
        let socket = match tls {
            Some(tls) => Either::Right(Box::new(tls.accept(stream).await?)),
            None => Either::Left(stream),
        };
        let (reader, writer) = tokio::io::split(socket);
        let writer = Arc::new(Mutex::new(writer));
        lock(&self.open).insert(number, writer.clone());
        let ended = self.answer(reader, &writer).await;
        lock(&self.open).remove(&number);
        ended
    }
    async fn answer(&self, mut reader: ReadHalf<Socket>, writer: &Writer) -> io::Result<()> {
        let mut ack = [0; ACK_BYTES];
        loop {
            reader.read_exact(&mut ack).await?;
            self.acked.fetch_add(1, Relaxed);
            if !write_now(writer, &[9; ANSWER_BYTES]) {
                return Err(io::ErrorKind::WriteZero.into());
            }
        }
    }
}

/// Writes without waiting. Whether the kernel took all of it.
fn write_now(writer: &Writer, bytes: &[u8]) -> bool {
    let (mut writer, mut nobody) = (lock(writer), Context::from_waker(Waker::noop()));
    let mut writer = Pin::new(&mut *writer);
    let written = writer.as_mut().poll_write(&mut nobody, bytes);
    matches!(written, Poll::Ready(Ok(taken)) if taken == bytes.len())
        && matches!(writer.poll_flush(&mut nobody), Poll::Ready(Ok(())))
}

/// Takes connections until `stop`: with `tls` over TLS, without it in plain text.
pub async fn serve(address: SocketAddr, tls: Option<TlsAcceptor>, stop: CancellationToken) -> anyhow::Result<()> {
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
            let (sockets, tls) = (sockets.clone(), tls.clone());
            // The robot's end says why it ended.
            tokio::spawn(async move { sockets.hold(number, stream, tls).await });
        }
        io::Result::Ok(())
    };
    tokio::select! {
        ended = accepting => Ok(ended?),
        () = stop.cancelled() => Ok(()),
    }
}
