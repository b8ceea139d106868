//! proto3-JSON of every message, by reflection on the one descriptor set: what `-o json` prints and what files of tasks are read from.
//!
//! Names are written in camelCase and read in either form; what has its default is left out.

use crate::FILE_DESCRIPTOR_SET;
use prost::{Message, Name};
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor};
use serde_json::Value;
use std::sync::LazyLock;

/// A value that is not JSON of the message it was read as, or a message that this build has no descriptor of.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No descriptor of that name.
    #[error("no message is called {0}")]
    UnknownMessage(String),
    /// The bytes are not of that message.
    #[error("reading a message")]
    Decode(#[from] prost::DecodeError),
    /// The value does not fit the message.
    #[error("reading json: {0}")]
    Json(#[from] serde_json::Error),
}

/// Descriptors of all packages.
pub fn pool() -> &'static DescriptorPool {
    static POOL: LazyLock<DescriptorPool> = LazyLock::new(|| {
        DescriptorPool::decode(FILE_DESCRIPTOR_SET)
            .unwrap_or_else(|e| unreachable!("the build wrote a bad descriptor set: {e}"))
    });
    &POOL
}

fn descriptor(full_name: &str) -> Result<MessageDescriptor, Error> {
    pool().get_message_by_name(full_name).ok_or_else(|| Error::UnknownMessage(full_name.to_owned()))
}

/// A message as proto3-JSON.
pub fn to_json<M: Message + Name>(message: &M) -> Result<Value, Error> {
    let dynamic = DynamicMessage::decode(descriptor(&M::full_name())?, message.encode_to_vec().as_slice())?;
    Ok(serde_json::to_value(&dynamic)?)
}

/// A message from proto3-JSON. Unknown fields are refused.
pub fn from_json<M: Message + Name + Default>(value: Value) -> Result<M, Error> {
    let dynamic = DynamicMessage::deserialize(descriptor(&M::full_name())?, value)?;
    Ok(dynamic.transcode_to()?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::task::v1::{SubmitTaskRequest, Task, TaskState, submit_task_request::Body};
    use serde_json::json;

    #[test]
    fn json_names_are_camel_case_and_enums_are_words() {
        let task = Task { task_id: "t1".into(), state: TaskState::NeedsOperator.into(), number: 7, ..Task::default() };
        let value = to_json(&task).expect("json");
        assert_eq!(value, json!({"taskId": "t1", "state": "TASK_STATE_NEEDS_OPERATOR", "number": "7"}));
        assert_eq!(from_json::<Task>(value).expect("back"), task);
    }

    #[test]
    fn either_form_of_a_name_is_read_and_an_unknown_one_is_refused() {
        for key in ["task_type", "taskType"] {
            let request: SubmitTaskRequest = from_json(json!({"flat": {key: "transport"}})).expect("json");
            assert!(matches!(request.body, Some(Body::Flat(flat)) if flat.task_type == "transport"));
        }
        let error = from_json::<SubmitTaskRequest>(json!({"flat": {"typo": 1}})).expect_err("refused");
        assert!(error.to_string().contains("typo"), "{error}");
    }
}
