//! Carries a player's words over whatever line it is given: the simulated network, or a socket.

use super::{End, Player};
use midshift_agent::dial::Dial;
use midshift_core::time::Clock;
use midshift_proto::link::v1::link_service_client::LinkServiceClient;
use midshift_proto::link::v1::{SessionRequest, SessionResponse};
use midshift_proto::session::ToRobot;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::error::Error;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

/// It looks at what is due this often.
const TICK: Duration = Duration::from_millis(200);
/// Between two sessions, at least.
const PAUSE: Duration = Duration::from_millis(300);
/// Messages that wait for the network; one that does not fit is lost with its session.
const UP_MAX: usize = 256;
/// Heartbeats of a machine that has its name beside it.
const SECOND_BEATS: u32 = 20;

/// A player that outlives its sessions.
#[derive(Clone)]
pub struct Line {
    player: Arc<Mutex<Player>>,
    dial: Arc<dyn Dial>,
    clock: Arc<dyn Clock>,
    /// How its sessions ended, in words, and how often; the second says whether the server gave a reason.
    ends: Arc<Mutex<BTreeMap<String, (u64, bool)>>>,
}

impl Line {
    /// Of this player.
    pub fn new(player: Arc<Mutex<Player>>, dial: Arc<dyn Dial>, clock: Arc<dyn Clock>) -> Self {
        Self { player, dial, clock, ends: Arc::default() }
    }
    fn player(&self) -> MutexGuard<'_, Player> {
        lock(&self.player)
    }
    /// How its sessions ended, in words, how often, and whether the server gave a reason.
    pub fn ends(&self) -> BTreeMap<String, (u64, bool)> {
        lock(&self.ends).clone()
    }
    fn note(&self, end: &End) {
        lock(&self.ends).entry(format!("{end:?}")).or_insert((0, end.is_told())).0 += 1;
    }
    /// Plays for ever.
    pub async fn play(self) {
        loop {
            let hello = self.player().hello(self.clock.now().wall.0);
            // However it ends, it begins again.
            let Err(end) = self.session(hello).await;
            self.note(&end);
            tokio::time::sleep(PAUSE).await;
        }
    }
    async fn open(&self, hello: SessionRequest) -> Result<SessionStreams, End> {
        let (up, words) = mpsc::channel(UP_MAX);
        up.try_send(hello).map_err(|_| End::Own)?;
        let mut client = LinkServiceClient::new(self.dial.dial().await.map_err(|_| End::Own)?);
        let down = client.session(ReceiverStream::new(words)).await.map_err(|status| ended(&status))?;
        Ok((up, down.into_inner()))
    }
    /// One session to its end, which is its result.
    async fn session(&self, hello: SessionRequest) -> Result<Infallible, End> {
        let (up, mut down) = self.open(hello).await?;
        let mut tick = tokio::time::interval(TICK);
        loop {
            tokio::select! {
                biased;
                message = down.message() => {
                    let message = message.map_err(|status| ended(&status))?.ok_or(End::Own)?;
                    let now = self.clock.now();
                    self.player().receive(message, now.link.0)?;
                }
                _ = tick.tick() => {
                    let now = self.clock.now();
                    let said = self.player().due_messages(now.link.0, now.wall.0);
                    for message in said {
                        up.try_send(message).map_err(|_| End::Own)?;
                    }
                    if self.player().has_second() {
                        tokio::spawn(self.clone().second());
                    }
                    if self.player().drops() {
                        return Err(End::Own);
                    }
                }
            }
        }
    }
    /// A machine that has its name beside it, for a while.
    async fn second(self) {
        let hello = self.player().second_hello(self.clock.now().wall.0);
        let (up, mut down) = match self.open(hello).await {
            Ok(ways) => ways,
            Err(end) => return self.note(&end),
        };
        for _ in 0..SECOND_BEATS {
            let now = self.clock.now();
            let said = self.player().second_says(now.wall.0);
            if up.try_send(said).is_err() {
                return;
            }
            tokio::select! {
                () = tokio::time::sleep(Duration::from_secs(1)) => {}
                end = ends(&mut down) => return self.note(&end),
            }
        }
    }
}

/// The way up and the way down.
type SessionStreams = (mpsc::Sender<SessionRequest>, Streaming<SessionResponse>);

async fn ends(down: &mut Streaming<SessionResponse>) -> End {
    loop {
        match down.message().await {
            Ok(Some(message)) => {
                if let Ok(ToRobot::Close(close)) = midshift_proto::parse::<ToRobot, _>(message) {
                    return End::Closed(close.reason);
                }
            }
            Ok(None) => return End::Own,
            Err(status) => return ended(&status),
        }
    }
}

/// A network that breaks says so with a cause of its own; what comes from the server has none.
fn ended(status: &Status) -> End {
    if status.source().is_some() {
        return End::Own;
    }
    End::Status(midshift_proto::status::refusal_of(status).reason)
}

fn lock<T>(what: &Mutex<T>) -> MutexGuard<'_, T> {
    what.lock().unwrap_or_else(PoisonError::into_inner)
}
