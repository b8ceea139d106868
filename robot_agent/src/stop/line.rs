//! The line to the stop service: a connection of its own, dialed again for as long as it takes, and the writes of what
//! must be kept.
//!
//! Invariant: it decides nothing. Neither the session nor bulk nor the ledger can hold it up: it shares no connection,
//! no queue and no disk write with them. Asked to move over it has the next line before it leaves this one. A message
//! that cannot be read ends the line. Called by the shell alone.

use super::storage::{self, Loaded, StopStorage};
use super::{CheckIn, StopNews};
use crate::transport::dial::Dial;
use crate::transport::repeats::Repeats;
use midshift_core::Boxed;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::stop::Stop;
use midshift_core::stop::ladder::Stage;
use midshift_core::stop::robot::SavedStops;
use midshift_proto::codec::SmallCodec;
use midshift_proto::convert::WireEnum;
use midshift_proto::convert::parse;
use midshift_proto::convert::stop::{FromStop, names};
use midshift_proto::refusal_of;
use midshift_proto::stop::v1;
use prost::Message;
use rand::{RngExt, SeedableRng};
use std::fmt::Display;
use std::future::pending;
use std::ops::Range;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

/// An agent's way to the stop service.
pub struct StopLine {
    /// Makes its connections, to the stop service's own address.
    pub dial: Arc<dyn Dial>,
    /// Saves the stops that must survive the agent.
    pub storage: Box<dyn StopStorage>,
}

/// The way the line takes.
const PATH: &str = "/midshift.stop.v1.StopLinkService/Attend";
/// Shortest and longest pause between attempts to connect, milliseconds of real time.
const RETRY_MS: Range<u64> = 200..5_000;
/// The longest while a line was lost, or this robot began, no longer ago than [`SOON_FOR`]: a service that is started
/// again has its robots back before those among people stand. Each draws its pause, so that they do not come at once.
const RETRY_SOON_MS: u64 = 1_000;
const SOON_FOR: Duration = Duration::from_secs(10);
/// A refusal is given way to for so long at most: well below the time after which a robot among people stands.
const ASKED_MS_MAX: u128 = 1_500;
/// A line that is to move over is made again within this, milliseconds of real time.
const SOON_MS: Range<u64> = 1..500;
/// Messages that may wait for the wire: check-ins of three seconds and of their changes. A line that is stuck this long
/// is given up.
const OUTBOUND: usize = 16;

/// The storage comes back from each write, with its number.
type Written = (Box<dyn StopStorage>, u64, Result<(), storage::Error>);

/// An open line.
pub(crate) struct Open {
    up: mpsc::Sender<v1::AttendRequest>,
    down: Streaming<v1::AttendResponse>,
}

/// Why there is no line.
pub(crate) struct NoLine {
    why: String,
    /// What the stop service asks for.
    again_after: Option<Duration>,
    /// The key of this machine lets nobody in any more, which only a person changes.
    is_revoked: bool,
}

impl NoLine {
    fn failed(why: impl Display) -> Self {
        Self { why: why.to_string(), again_after: None, is_revoked: false }
    }
    fn refused(status: &Status) -> Self {
        let answer = refusal_of(status);
        let is_revoked = answer.code == Some(Code::KeyDenied);
        Self { again_after: answer.retry_after, is_revoked, ..Self::failed(status) }
    }
}

/// How far the agent is with its next line.
enum DialState {
    Idle,
    Waiting(Pin<Box<tokio::time::Sleep>>),
    Dialing(Boxed<'static, Result<Open, NoLine>>),
}

/// An event of the stop line.
pub(crate) enum LineEvent {
    /// It is time to dial.
    DialNow,
    /// What came of it.
    Dialed(Result<Open, NoLine>),
    /// A message; none: the line ended.
    Heard(Option<Box<v1::AttendResponse>>),
    /// What came of a write.
    Saved(Box<dyn StopStorage>, u64, Result<(), storage::Error>),
}

/// The line of one robot.
pub(crate) struct Line {
    dial: Arc<dyn Dial>,
    rng: rand::rngs::StdRng,
    open: Option<Open>,
    dial_state: DialState,
    failures: u32,
    /// Since when there is no line that works.
    without: Instant,
    /// Why there is no line, as the log was told.
    refused: Repeats,
    storage: Option<Box<dyn StopStorage>>,
    saving: Option<Boxed<'static, Written>>,
}

impl Line {
    /// Reads what was kept, and is ready to dial.
    pub(crate) async fn begin(line: StopLine, unreadable: SavedStops, seed: u64) -> (Self, Loaded) {
        let StopLine { dial, mut storage } = line;
        let loaded = storage.load(unreadable).await;
        let line = Self {
            dial,
            rng: rand::rngs::StdRng::seed_from_u64(seed ^ 0x7374_6f70),
            open: None,
            dial_state: DialState::Waiting(Box::pin(tokio::time::sleep(Duration::ZERO))),
            failures: 0,
            without: Instant::now(),
            refused: Repeats::default(),
            storage: Some(storage),
            saving: None,
        };
        (line, loaded)
    }

    /// What it brings next. May be dropped and called again at any time.
    pub(crate) async fn next(&mut self) -> LineEvent {
        let Self { open, dial_state, saving, .. } = self;
        tokio::select! {
            biased;
            message = heard(open) => LineEvent::Heard(message.map(Box::new)),
            said = progress(dial_state) => { *dial_state = DialState::Idle; said }
            (storage, number, done) = written(saving) => { *saving = None; LineEvent::Saved(storage, number, done) }
        }
    }

    /// Makes the next line. What it says first is as it is known now.
    pub(crate) fn dial_now<'a>(&mut self, robot_id: &RobotId, boot_id: &str, stops: impl Iterator<Item = &'a Stop>) {
        let first = attend(robot_id, boot_id, stops);
        let opening = open(self.dial.clone(), first);
        let limit = Duration::from_millis(limits::CHECK_IN_MISSED.as_ms());
        self.dial_state = DialState::Dialing(Box::pin(async move {
            tokio::time::timeout(limit, opening).await.unwrap_or_else(|_| Err(NoLine::failed("nobody answers")))
        }));
    }

    /// Handles an event, and returns the news that the core must hear of it.
    pub(crate) fn take_in(&mut self, robot_id: &RobotId, event: LineEvent) -> Option<StopNews> {
        match event {
            LineEvent::DialNow => None,
            LineEvent::Dialed(Ok(open)) => {
                tracing::info!(%robot_id, "stop line open");
                self.open = Some(open);
                // A number that was never used before, in any life of this robot.
                Some(StopNews::Attended { nonce: self.rng.random::<u64>() ^ rand::random::<u64>() })
            }
            LineEvent::Dialed(Err(NoLine { why, again_after, is_revoked })) => {
                self.log_refusal(robot_id, &why);
                if is_revoked {
                    self.wait(limits::REVOKED_RETRY.as_ms());
                } else {
                    self.wait_to_dial(again_after);
                }
                None
            }
            LineEvent::Heard(None) => self.lost("the line ended"),
            LineEvent::Heard(Some(message)) => match parse(*message) {
                Ok(FromStop::Facts { stops, resets, generation }) => {
                    Some(StopNews::Facts { stops, resets, generation })
                }
                Ok(FromStop::Synced { generation, key }) => {
                    self.failures = 0;
                    self.refused.forget();
                    Some(StopNews::Synced { generation, key })
                }
                Ok(FromStop::CheckInAnswer { nonce, generation }) => {
                    Some(StopNews::CheckInAnswer { nonce, generation })
                }
                Ok(FromStop::MoveOver) => {
                    if matches!(self.dial_state, DialState::Idle) {
                        let pause = self.rng.random_range(SOON_MS);
                        self.wait(pause);
                    }
                    None
                }
                Err(refusal) => {
                    self.log_refusal(robot_id, &format!("a message cannot be read: {refusal}"));
                    self.lost("a message cannot be read")
                }
            },
            LineEvent::Saved(storage, number, done) => {
                self.storage = Some(storage);
                if let Err(error) = &done {
                    tracing::error!(%robot_id, %error, "stops not kept: they are obeyed all the same");
                }
                Some(StopNews::Saved { number, is_durable: done.is_ok() })
            }
        }
    }

    /// Sends a check-in. False: the line was stuck and is given up.
    pub(crate) fn check_in(&mut self, nonce: u64, check_in: &CheckIn) -> bool {
        let Some(open) = &self.open else { return true };
        let wire = v1::AttendRequest {
            message: Some(v1::attend_request::Message::CheckIn(v1::CheckIn {
                nonce,
                generation: check_in.generation,
                durable: check_in.is_durable,
                obeys: check_in.obeys.to_wire(),
                standstill: check_in.is_still,
                inside: names(&check_in.inside),
                awaiting_resume: names(&check_in.awaiting_resume),
                silence: match check_in.silence {
                    Stage::Heard => v1::SilenceStage::Heard,
                    Stage::Slow => v1::SilenceStage::Slow,
                    Stage::Stand => v1::SilenceStage::Stand,
                } as i32,
                without_people: check_in.is_without_people,
            })),
        };
        let is_sent = open.up.try_send(wire).is_ok();
        if !is_sent {
            self.redial("the way up is stuck");
        }
        is_sent
    }

    /// This line does not work: another one.
    pub(crate) fn redial(&mut self, why: &str) {
        if let Some(times) = self.refused.count(why) {
            tracing::warn!(why, times, "stop line given up");
        }
        if self.failures == 0 {
            self.without = Instant::now();
        }
        self.open = None;
        if matches!(self.dial_state, DialState::Idle) {
            self.wait_to_dial(None);
        }
    }

    /// Begins to write the stops, beside everything else.
    pub(crate) fn save_stops(&mut self, number: u64, saved: &SavedStops) {
        let Some(mut storage) = self.storage.take() else { return };
        let saved = saved.clone();
        self.saving = Some(Box::pin(async move {
            let done = storage.save(saved).await;
            (storage, number, done)
        }));
    }

    fn lost(&mut self, why: &str) -> Option<StopNews> {
        self.redial(why);
        Some(StopNews::LineLost)
    }

    /// Says why there is no line, about once a minute: it is tried again for as long as it takes.
    fn log_refusal(&mut self, robot_id: &RobotId, why: &str) {
        if let Some(times) = self.refused.count(why) {
            tracing::warn!(%robot_id, why, times, "no stop line");
        }
    }

    /// Not sooner than the service asks for, but never so late that a service which turns robots away makes them stand
    /// by itself.
    fn wait_to_dial(&mut self, again_after: Option<Duration>) {
        let longest = if self.without.elapsed() < SOON_FOR { RETRY_SOON_MS } else { RETRY_MS.end };
        let most = ((2 * RETRY_MS.start) << self.failures.min(8)).min(longest);
        self.failures = self.failures.saturating_add(1);
        let pause = self.rng.random_range(RETRY_MS.start..=most);
        let asked_ms = again_after.map_or(0, |after| after.as_millis().min(ASKED_MS_MAX));
        let asked_ms = u64::try_from(asked_ms).unwrap_or_default();
        let pause = if asked_ms > pause { asked_ms + self.rng.random_range(SOON_MS) } else { pause };
        self.wait(pause);
    }

    fn wait(&mut self, pause_ms: u64) {
        self.dial_state = DialState::Waiting(Box::pin(tokio::time::sleep(Duration::from_millis(pause_ms))));
    }
}

/// Who comes, and what it knows: whole as far as there is room, the most restrictive first, and the rest by name. Of
/// more than twice as many as there may be it says nothing; it keeps them and obeys them all the same.
fn attend<'a>(robot_id: &RobotId, boot_id: &str, stops: impl Iterator<Item = &'a Stop>) -> v1::AttendRequest {
    let mut known: Vec<&Stop> = stops.collect();
    known.sort_by_key(|stop| std::cmp::Reverse(stop.level));
    let (mut room, mut whole, mut more) = (limits::STOP_ATTEND_BYTES, Vec::new(), Vec::new());
    for stop in known {
        let wire = v1::Stop::from(stop);
        let bytes = wire.encoded_len();
        if bytes <= room && whole.len() < limits::STOPS_MAX {
            room -= bytes;
            whole.push(wire);
        } else if more.len() < limits::STOPS_MAX {
            more.push(wire.stop_id);
        }
    }
    let (robot_id, boot_id) = (robot_id.to_string(), boot_id.to_owned());
    let attend = v1::Attend { robot_id, boot_id, stops: whole, more_stop_ids: more };
    v1::AttendRequest { message: Some(v1::attend_request::Message::Attend(attend)) }
}

async fn open(dial: Arc<dyn Dial>, first: v1::AttendRequest) -> Result<Open, NoLine> {
    let channel = dial.dial().await.map_err(NoLine::failed)?;
    let (up, queue) = mpsc::channel(OUTBOUND);
    up.try_send(first).map_err(NoLine::failed)?;
    let mut client = tonic::client::Grpc::new(channel);
    client.ready().await.map_err(NoLine::failed)?;
    let path = tonic::codegen::http::uri::PathAndQuery::from_static(PATH);
    let request = tonic::Request::new(ReceiverStream::new(queue));
    let answer = client.streaming(request, path, SmallCodec::default()).await;
    let answer = answer.map_err(|status| NoLine::refused(&status))?;
    Ok(Open { up, down: answer.into_inner() })
}

async fn heard(open: &mut Option<Open>) -> Option<v1::AttendResponse> {
    match open {
        Some(open) => open.down.message().await.ok().flatten(),
        None => pending().await,
    }
}

async fn progress(dial_state: &mut DialState) -> LineEvent {
    match dial_state {
        DialState::Idle => pending().await,
        DialState::Waiting(sleep) => {
            sleep.await;
            LineEvent::DialNow
        }
        DialState::Dialing(dialing) => LineEvent::Dialed(dialing.await),
    }
}

async fn written(saving: &mut Option<Boxed<'static, Written>>) -> Written {
    match saving {
        Some(writing) => writing.await,
        None => pending().await,
    }
}
