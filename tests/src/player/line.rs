//! Carries a player's words over whatever line it is given: the simulated network, or a socket.

use super::Player;
use midshift_agent::dial::Dial;
use midshift_core::time::Clock;
use midshift_proto::link::v1::link_service_client::LinkServiceClient;
use midshift_proto::link::v1::{SessionRequest, SessionResponse};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;

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
}

impl Line {
    /// Of this player.
    pub fn new(player: Arc<Mutex<Player>>, dial: Arc<dyn Dial>, clock: Arc<dyn Clock>) -> Self {
        Self { player, dial, clock }
    }
    fn player(&self) -> MutexGuard<'_, Player> {
        self.player.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// Plays for ever.
    pub async fn play(self) {
        loop {
            let hello = self.player().hello(self.clock.now().wall.0);
            // However it ends, it begins again.
            let _ = self.session(hello).await;
            tokio::time::sleep(PAUSE).await;
        }
    }
    async fn open(
        &self,
        hello: SessionRequest,
    ) -> anyhow::Result<(mpsc::Sender<SessionRequest>, Streaming<SessionResponse>)> {
        let (up, words) = mpsc::channel(UP_MAX);
        up.try_send(hello)?;
        let mut client = LinkServiceClient::new(self.dial.dial().await?);
        let down = client.session(ReceiverStream::new(words)).await?.into_inner();
        Ok((up, down))
    }
    async fn session(&self, hello: SessionRequest) -> anyhow::Result<()> {
        let (up, mut down) = self.open(hello).await?;
        let mut tick = tokio::time::interval(TICK);
        loop {
            tokio::select! {
                biased;
                message = down.message() => {
                    let Some(message) = message? else { return Ok(()) };
                    let now = self.clock.now();
                    if !self.player().hear(message, now.link.0) {
                        return Ok(());
                    }
                }
                _ = tick.tick() => {
                    let now = self.clock.now();
                    let said = self.player().say(now.link.0, now.wall.0);
                    for message in said {
                        up.try_send(message)?;
                    }
                    if self.player().has_second() {
                        tokio::spawn(self.clone().second());
                    }
                    if self.player().drops() {
                        return Ok(());
                    }
                }
            }
        }
    }
    /// A machine that has its name beside it, for a while.
    async fn second(self) {
        let hello = self.player().second_hello(self.clock.now().wall.0);
        let Ok((up, mut down)) = self.open(hello).await else { return };
        for _ in 0..SECOND_BEATS {
            let now = self.clock.now();
            let said = self.player().second_says(now.wall.0);
            if up.try_send(said).is_err() {
                return;
            }
            tokio::select! {
                () = tokio::time::sleep(Duration::from_secs(1)) => {}
                ended = ends(&mut down) => return ended,
            }
        }
    }
}

async fn ends(down: &mut Streaming<SessionResponse>) {
    while let Ok(Some(_)) = down.message().await {}
}
