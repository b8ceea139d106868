//! What a task is, how it is checked on receipt, and how it moves: business intent that survives robots, restarts and changes of mind.
//!
//! `raw` is what a caller sent, `spec` what it means once every rule holds, `forms` the short forms callers may use,
//! `types` the task types that a site knows, `machine` the table of transitions, `state` the rows, `edit` what people change of a task, `requests` what they ask
//! of it. Services never decide a transition by themselves.

pub mod bugs;
pub mod edit;
pub mod figures;
pub mod forms;
pub mod machine;
pub mod raw;
pub mod requests;
pub mod spec;
pub mod state;
pub mod types;

pub use edit::TaskEdit;
pub use machine::{AfterStopping, Event, Phase};
pub use raw::RawTask;
pub use requests::{Ask, Resolution, TaskRequest};
pub use spec::TaskSpec;
pub use state::{Attempt, AttemptPhase, TaskIntake, TaskState};
