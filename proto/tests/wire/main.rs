//! What the wire promises: both forms of the article, the link there and back, and comments that say the rules.

mod access;
mod article;
mod comments;
mod fleet;
mod link;
mod privacy;
mod task;
mod task_type;
mod telemetry;
mod unknown;
