//! What people and programs ask of the planner.

use midshift_core::ids::RolloutId;
use midshift_core::reason::Refusal;
use midshift_core::rollout::Board;
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::requests::{Ask, CommandOutcome};
use midshift_core::time::Now;
use tokio::sync::oneshot;

/// What is made of the projection for whoever asked.
pub type Answer = Box<dyn FnOnce(&RolloutProjection, &Board, &Now) + Send>;

/// A question about the projection as it is now.
pub struct Question {
    /// Roll-outs that it is about: they are in the projection when it is answered, if they are there.
    pub about: Vec<RolloutId>,
    pub answer: Answer,
}

/// Something a person asks of the planner.
pub enum Request {
    /// Change something; answered after the commit.
    Do(Box<PendingCommand>),
    /// Read something.
    Question(Question),
}

/// A command, until it is answered.
pub struct PendingCommand {
    pub ask: Ask,
    pub reply: oneshot::Sender<Result<CommandOutcome, Refusal>>,
    /// How often it was decided and lost, because what it is about had been changed meanwhile.
    pub lost: u32,
}
