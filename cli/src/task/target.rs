//! Finds the task or the tasks that a person names, and says what may be answered.

use super::shown::{state, waypoints};
use crate::client::{Call, Exit, unary};
use crate::lookup::{self, Found};
use clap::ValueEnum;
use midshift_proto::task::v1;
use tonic::Code;

/// One task.
#[derive(clap::Args)]
pub struct TaskTarget {
    /// Of which server.
    #[command(flatten)]
    pub call: Call,
    /// Its id, or a prefix that only one task has.
    pub task_id: String,
}

/// One task, or many.
#[derive(clap::Args)]
pub struct TaskSelection {
    /// Of which server.
    #[command(flatten)]
    pub call: Call,
    /// Its id, or a prefix that only one task has.
    #[arg(required_unless_present = "all")]
    task_id: Option<String>,
    /// All tasks that the flags mean; each is asked for by itself, with the rights that it needs.
    #[arg(long, conflicts_with_all = ["task_id", "if_match"])]
    all: bool,
    /// Of all tasks, those that are meant.
    #[command(flatten)]
    pub meant: TargetTasks,
}

/// Which tasks are meant.
#[derive(clap::Args)]
pub struct TargetTasks {
    /// Only these states, e.g. needs-operator.
    #[arg(long)]
    state: Vec<String>,
    /// Only of these robots.
    #[arg(long)]
    robot: Vec<String>,
    /// Only these types.
    #[arg(long = "type")]
    kind: Vec<String>,
    /// Only of this work order.
    #[arg(long, default_value = "")]
    external_ref: String,
}

impl TaskSelection {
    /// The one task; none: many are meant.
    pub fn one(&self) -> Option<TaskTarget> {
        self.task_id.clone().map(|task_id| TaskTarget { call: self.call.clone(), task_id })
    }
}

impl TargetTasks {
    /// As the server reads it.
    pub fn filter(&self) -> Result<v1::TaskFilter, Exit> {
        let mut states = Vec::new();
        for text in &self.state {
            let name = format!("TASK_STATE_{}", text.to_uppercase().replace('-', "_"));
            let state = v1::TaskState::from_str_name(&name)
                .ok_or_else(|| Exit::usage(format!("there is no task state {text}")))?;
            states.push(state as i32);
        }
        Ok(v1::TaskFilter {
            states,
            robot_ids: self.robot.clone(),
            types: self.kind.clone(),
            external_ref: self.external_ref.clone(),
            ..v1::TaskFilter::default()
        })
    }
}

impl TaskTarget {
    /// The whole id behind a prefix. A whole id is always itself, however many others begin with it.
    pub async fn find(&self) -> Result<String, Exit> {
        if self.task_id.is_empty() {
            return Err(Exit::usage("the id of a task is empty\n  try: midshift task ls"));
        }
        let mut client = self.call.task().await?;
        match client.get_task(unary(v1::GetTaskRequest { task_id: self.task_id.clone() })).await {
            Ok(_) => return Ok(self.task_id.clone()),
            Err(status) if matches!(status.code(), Code::NotFound | Code::InvalidArgument) => {}
            Err(status) => return Err(status.into()),
        }
        let filter = v1::TaskFilter { task_id_prefix: self.task_id.clone(), ..v1::TaskFilter::default() };
        let request =
            v1::ListTasksRequest { filter: Some(filter), page_size: lookup::SHOWN, page_token: String::new() };
        let page = client.list_tasks(unary(request)).await?.into_inner();
        let found = Found::page(&page, |task| vec![state(task), waypoints(task)]);
        let nothing = || Exit::new(4, format!("no task begins with {}\n  try: midshift task ls", self.task_id));
        found.single("task", &self.task_id)?.ok_or_else(nothing)
    }
    /// As it is now, by its whole id or the beginning of it.
    pub async fn read(&self) -> Result<v1::GetTaskResponse, Exit> {
        let task_id = self.find().await?;
        Ok(self.call.task().await?.get_task(unary(v1::GetTaskRequest { task_id })).await?.into_inner())
    }
}

/// Answers to NEEDS_OPERATOR.
#[derive(Clone, Copy, ValueEnum)]
pub enum Answer {
    /// Try again.
    Requeue,
    /// Try again; the item was handed to another robot.
    HandedOver,
    /// Try again from the start; the item was put back.
    PutBack,
    /// Done by hand.
    Succeeded,
    /// Give up.
    Failed,
    /// Give up; the item is lost.
    ItemLost,
    /// Not wanted any more.
    Canceled,
}

impl Answer {
    /// The word for an answer on the wire, as `--as` takes it.
    pub fn word(answer: v1::Resolution) -> Option<String> {
        let known = Self::value_variants().iter().find(|word| word.wire() == answer)?;
        Some(known.to_possible_value()?.get_name().to_owned())
    }
    /// The answer on the wire.
    pub fn wire(self) -> v1::Resolution {
        match self {
            Self::Requeue => v1::Resolution::Requeue,
            Self::HandedOver => v1::Resolution::RequeueHandedOver,
            Self::PutBack => v1::Resolution::RequeuePutBack,
            Self::Succeeded => v1::Resolution::Succeeded,
            Self::Failed => v1::Resolution::Failed,
            Self::ItemLost => v1::Resolution::FailedItemLost,
            Self::Canceled => v1::Resolution::Canceled,
        }
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn each_answer_that_a_task_allows_is_told_by_the_word_that_the_command_takes() {
        use clap::ValueEnum;
        for number in 1.. {
            let Ok(answer) = super::v1::Resolution::try_from(number) else { break };
            let word = super::Answer::word(answer).expect("a word");
            assert_eq!(super::Answer::from_str(&word, false).map(super::Answer::wire), Ok(answer), "{word}");
        }
    }
}
