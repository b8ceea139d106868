//! What a task is, how it is checked on receipt, and how it moves: business intent that survives robots, restarts and changes of mind.
//!
//! `raw` is what a caller sent, `spec` what it means once every rule holds, `forms` the short forms callers may use,
//! `machine` the table of transitions, `state` the rows. Services never decide a transition by themselves.

pub mod bugs;
pub mod forms;
pub mod machine;
pub mod raw;
pub mod spec;
pub mod state;

pub use machine::{AfterStopping, Event, Phase};
pub use raw::RawTask;
pub use spec::TaskSpec;
pub use state::{Ask, Attempt, AttemptPhase, Resolution, TaskIntake, TaskRequest, TaskState};
