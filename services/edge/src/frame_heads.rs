//! Reads the heads of HTTP/2 frames as they pass, and ends a connection on which too many come that ask for nothing.
//!
//! SETTINGS, PRIORITY, PING, WINDOW_UPDATE, RST_STREAM, empty DATA and frames of an unknown kind cost their sender nine bytes and us a turn of
//! the connection each; the library beneath bounds the memory that they take, not their number. Invariants:
//! 1. A connection may send [`limits::CONTROL_FRAMES_BURST`] of them at once and [`limits::CONTROL_FRAMES_PER_SECOND`] for long.
//! 2. What answers us, or belongs to a request, is paid for by it: each DATA frame that we send and each HEADERS frame that comes lets in
//!    [`limits::CONTROL_FRAMES_PER_ANSWER`] more. So whoever only reads what it asked for is never cut, however fast that is.
//! 3. Bytes pass unchanged and are not kept. HTTP/1.1 passes unread.

use midshift_core::limits;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Instant;

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
const HEAD_BYTES: usize = 9;
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const CONTINUATION: u8 = 9;
const END_STREAM: u8 = 1;

/// What a frame is, as far as it is counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Frame {
    /// DATA with something in it, or the last of its stream.
    Data,
    /// The head of a request or of an answer, or its trailers.
    Headers,
    /// The rest of one: the library counts those.
    Continuation,
    /// Everything else.
    Control,
}

/// Where in the bytes of one direction we are.
#[derive(Clone, Copy, Debug)]
enum Place {
    /// So much of the preface was read.
    Preface(usize),
    /// So much of a head.
    Head([u8; HEAD_BYTES], usize),
    /// So many bytes of a frame are still to come.
    Payload(usize),
    /// No HTTP/2.
    Other,
}

impl Place {
    /// Reads on, and tells of each frame whose head is whole.
    fn read(&mut self, mut bytes: &[u8], mut told: impl FnMut(Frame)) {
        while !bytes.is_empty() {
            *self = match *self {
                Self::Other => return,
                Self::Preface(known) => {
                    let more = bytes.len().min(PREFACE.len() - known);
                    let (now, rest) = bytes.split_at(more);
                    bytes = rest;
                    match (PREFACE[known..].starts_with(now), known + more == PREFACE.len()) {
                        (false, _) => Self::Other,
                        (true, false) => Self::Preface(known + more),
                        (true, true) => Self::Head([0; HEAD_BYTES], 0),
                    }
                }
                Self::Head(mut head, known) => {
                    let more = bytes.len().min(HEAD_BYTES - known);
                    let (now, rest) = bytes.split_at(more);
                    head[known..known + more].copy_from_slice(now);
                    bytes = rest;
                    if known + more == HEAD_BYTES {
                        let length = u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize;
                        told(kind(length, head[3], head[4]));
                        Self::after_head(length)
                    } else {
                        Self::Head(head, known + more)
                    }
                }
                Self::Payload(left) => {
                    let passed = left.min(bytes.len());
                    bytes = &bytes[passed..];
                    Self::after_head(left - passed)
                }
            };
        }
    }

    const fn after_head(left: usize) -> Self {
        if left == 0 { Self::Head([0; HEAD_BYTES], 0) } else { Self::Payload(left) }
    }
}

const fn kind(length: usize, kind: u8, flags: u8) -> Frame {
    match kind {
        DATA if length > 0 || flags & END_STREAM != 0 => Frame::Data,
        HEADERS => Frame::Headers,
        CONTINUATION => Frame::Continuation,
        _ => Frame::Control,
    }
}

/// How many more may come.
#[derive(Clone, Copy, Debug)]
struct Budget {
    left: u64,
    /// When the last that time gives were given.
    given: Instant,
}

impl Budget {
    fn new(now: Instant) -> Self {
        Self { left: limits::CONTROL_FRAMES_BURST, given: now }
    }

    /// What time gives.
    fn refill(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.given);
        let more =
            u64::try_from(passed.as_millis()).unwrap_or(u64::MAX).saturating_mul(limits::CONTROL_FRAMES_PER_SECOND)
                / Duration::from_secs(1).as_millis() as u64;
        if more > 0 {
            self.given = now;
            // What was earned stays.
            self.left = self.left.max(limits::CONTROL_FRAMES_BURST.min(self.left.saturating_add(more)));
        }
    }

    /// What a frame that asks or answers gives.
    fn earn(&mut self) {
        self.left = limits::CONTROL_FRAMES_EARNED_MAX.min(self.left + limits::CONTROL_FRAMES_PER_ANSWER);
    }

    /// Whether there was one left.
    fn spend(&mut self) -> bool {
        let is_left = self.left > 0;
        self.left = self.left.saturating_sub(1);
        is_left
    }
}

/// Whether a connection was ended for its frames. Clones are the same.
#[derive(Clone, Debug, Default)]
pub(crate) struct FloodFlag(Arc<AtomicBool>);

impl FloodFlag {
    pub fn is_set(&self) -> bool {
        self.0.load(Relaxed)
    }
}

/// A connection whose frames are counted.
pub(crate) struct CountedConnection<Io> {
    io: Io,
    up: Place,
    down: Place,
    budget: Budget,
    flooded: FloodFlag,
}

impl<Io> CountedConnection<Io> {
    /// From its first byte on; `flooded` says later whether it was ended for them.
    pub fn new(io: Io, flooded: FloodFlag) -> Self {
        let down = Place::Head([0; HEAD_BYTES], 0);
        Self { io, up: Place::Preface(0), down, budget: Budget::new(Instant::now()), flooded }
    }

    fn came(&mut self, bytes: &[u8]) -> io::Result<()> {
        let (budget, mut is_flood) = (&mut self.budget, false);
        budget.refill(Instant::now());
        self.up.read(bytes, |frame| match frame {
            Frame::Control => is_flood |= !budget.spend(),
            Frame::Headers => budget.earn(),
            Frame::Data | Frame::Continuation => {}
        });
        if is_flood {
            self.flooded.0.store(true, Relaxed);
            return Err(io::Error::other("more control frames than a peer has a use for"));
        }
        Ok(())
    }

    fn went(&mut self, bytes: &[u8]) {
        if matches!(self.up, Place::Other) {
            return;
        }
        let budget = &mut self.budget;
        self.down.read(bytes, |frame| {
            if frame == Frame::Data {
                budget.earn();
            }
        });
    }
}

impl<Io: AsyncRead + Unpin> AsyncRead for CountedConnection<Io> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        match Pin::new(&mut self.io).poll_read(cx, buffer) {
            Poll::Ready(Ok(())) => Poll::Ready(self.came(&buffer.filled()[before..])),
            other => other,
        }
    }
}

impl<Io: AsyncWrite + Unpin> AsyncWrite for CountedConnection<Io> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.io).poll_write(cx, bytes);
        if let Poll::Ready(Ok(n)) = written {
            self.went(&bytes[..n]);
        }
        written
    }
    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.io).poll_write_vectored(cx, slices);
        if let Poll::Ready(Ok(mut left)) = written {
            for slice in slices {
                let n = left.min(slice.len());
                self.went(&slice[..n]);
                left -= n;
            }
        }
        written
    }
    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: u8 = 4;
    const BURST: u64 = limits::CONTROL_FRAMES_BURST;

    fn frame(kind: u8, flags: u8, payload: usize) -> Vec<u8> {
        let mut bytes = (payload as u32).to_be_bytes()[1..].to_vec();
        bytes.extend([kind, flags, 0, 0, 0, 1]);
        bytes.extend(vec![b'x'; payload]);
        bytes
    }

    fn kinds(parts: &[&[u8]]) -> Vec<Frame> {
        let (mut place, mut told) = (Place::Preface(0), Vec::new());
        parts.iter().for_each(|part| place.read(part, |frame| told.push(frame)));
        told
    }

    #[test]
    fn heads_are_read_wherever_the_bytes_are_cut_and_other_protocols_are_not() {
        let frames = [
            frame(SETTINGS, 0, 6),
            frame(HEADERS, 4, 300),
            frame(DATA, 0, 0),
            frame(DATA, 1, 0),
            frame(DATA, 0, 70_000),
        ];
        let whole = [PREFACE, &frames.concat(), &frame(CONTINUATION, 0, 1), &frame(0xbe, 0, 0)].concat();
        let expected = [
            Frame::Control,
            Frame::Headers,
            Frame::Control,
            Frame::Data,
            Frame::Data,
            Frame::Continuation,
            Frame::Control,
        ];
        assert_eq!(kinds(&[&whole]), expected);
        for cut in 0..400 {
            assert_eq!(kinds(&[&whole[..cut], &whole[cut..]]), expected, "{cut}");
        }
        let bytes: Vec<&[u8]> = whole.chunks(1).collect();
        assert_eq!(kinds(&bytes), expected);
        assert_eq!(kinds(&[b"PRI * HTTP/1.1\r\n", &whole]), []);
        assert_eq!(kinds(&[b"GET / HTTP/1.1\r\n\r\n", &[4; 900]]), []);
    }

    #[tokio::test(start_paused = true)]
    async fn a_burst_passes_and_then_what_time_gives_and_what_is_earned() {
        let mut counted = CountedConnection::new((), FloodFlag::default());
        counted.came(PREFACE).expect("the preface");
        let settings = frame(SETTINGS, 0, 0);
        for _ in 0..BURST {
            counted.came(&settings).expect("within the burst");
        }
        // An hour saves up no more than a burst.
        tokio::time::advance(Duration::from_secs(3_600)).await;
        for _ in 0..BURST {
            counted.came(&settings).expect("within the burst");
        }
        tokio::time::advance(Duration::from_secs(1)).await;
        for _ in 0..limits::CONTROL_FRAMES_PER_SECOND {
            counted.came(&settings).expect("a second's");
        }
        counted.went(&frame(DATA, 0, 5));
        counted.came(&frame(HEADERS, 5, 20)).expect("a request");
        for _ in 0..2 * limits::CONTROL_FRAMES_PER_ANSWER {
            counted.came(&settings).expect("earned");
        }
        // Our own control frames, such as answers to pings, earn nothing.
        counted.went(&frame(6, 1, 8));
        assert!(!counted.flooded.is_set());
        assert!(counted.came(&settings).is_err() && counted.flooded.is_set());
    }

    /// What a client sends of itself: when it begins a watch, at each message of it, and every 10 s to see that the line stands.
    struct Client {
        name: &'static str,
        begin: Vec<Vec<u8>>,
        message: Vec<Vec<u8>>,
        alive: Vec<Vec<u8>>,
    }

    /// With `keepalive_time` of 10 s and all else as it is by default. What grpcio 1.85 and grpc-js 1.14 send was read off a line; what grpc-go sends, of which
    /// grpcurl is made, is the most that its transport can.
    fn clients() -> [Client; 3] {
        let settings = |bytes| [frame(SETTINGS, 0, bytes), frame(SETTINGS, 1, 0)].concat();
        let request = [frame(HEADERS, 4, 199), frame(DATA, END_STREAM, 10)].concat();
        let (window, ping) = (|| frame(8, 0, 4), || frame(6, 0, 8));
        [
            Client {
                name: "grpcio",
                begin: vec![settings(36), window(), request.clone(), window(), window()],
                message: vec![window(), window(), ping()],
                alive: vec![window(), window(), ping()],
            },
            Client { name: "grpc-js", begin: vec![settings(6), request.clone()], message: vec![], alive: vec![ping()] },
            Client {
                name: "grpc-go",
                begin: vec![settings(0), request],
                message: vec![window(), window(), ping(), window()],
                alive: vec![ping()],
            },
        ]
    }

    #[tokio::test(start_paused = true)]
    async fn clients_that_see_each_10_s_that_the_line_stands_are_cut_neither_in_an_idle_watch_nor_in_a_fast_one() {
        for Client { name, begin, message, alive } in clients() {
            let mut counted = CountedConnection::new((), FloodFlag::default());
            counted.came(&[PREFACE, &begin.concat()].concat()).expect(name);
            counted.went(&[frame(SETTINGS, 0, 12), frame(HEADERS, 4, 20), frame(DATA, 0, 50)].concat());
            let (answers_to_us, our_answer) = (frame(6, 1, 8), frame(6, 1, 8));
            // A day in which nothing happens, with pings of ours too.
            for _ in 0..24 * 360 {
                tokio::time::advance(Duration::from_secs(10)).await;
                counted.came(&[alive.concat(), answers_to_us.clone()].concat()).expect(name);
                counted.went(&our_answer);
            }
            for _ in 0..100_000 {
                counted.went(&frame(DATA, 0, 200));
                counted.came(&message.concat()).expect(name);
            }
            assert!(!counted.flooded.is_set(), "{name}");
        }
    }

    #[test]
    fn what_is_earned_is_bounded() {
        let mut budget = Budget::new(Instant::now());
        (0..1_000_000).for_each(|_| budget.earn());
        assert_eq!(budget.left, limits::CONTROL_FRAMES_EARNED_MAX);
    }
}
