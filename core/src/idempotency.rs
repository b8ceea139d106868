//! Makes commands with a request_id idempotent: the same command with the same request_id is carried out once.
//!
//! Called by what decides on commands in `fleet` and `rollout`. Invariant: the key is written in the item that carries the command out, so that
//! neither stands without the other. What is answered to the second is that, and how things are by then.

use crate::privacy;
use crate::projection::{Projected, Projection, RowMap, Tx};
use crate::reason::{Code, Kind, Reason, Refusal};
use crate::rows::{Index, Record, Revision, Table, body_is_json};
use crate::time::Utc;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Used request_ids that are deleted with one command.
const FORGOTTEN_AT_ONCE: usize = 4;

/// A command of one service that is carried out once for its request_id, however often it is sent.
pub trait IdempotentRequest: Serialize + DeserializeOwned + Clone + PartialEq + Send + Sync + 'static {
    /// Where its used request_ids are kept.
    const KEYS: Table;
}

/// A used request_id of a command. Kept 7 days.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(bound = "C: IdempotentRequest")]
pub struct CommandKey<C> {
    /// The client's request_id.
    pub id: String,
    /// What it asked for.
    pub command: C,
    /// The etag it gave.
    pub seen: Option<Revision>,
    /// UTC of the wall, unix ms.
    pub at_unix_ms: i64,
}

impl<C: IdempotentRequest> Record for CommandKey<C> {
    const TABLE: Table = C::KEYS;
    body_is_json!();
    fn id(&self) -> String {
        self.id.clone()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.at_unix_ms), ..Index::default() }
    }
}

/// Says when a command with this request_id, and the same in every part, was carried out. None: it was not.
///
/// # Errors
/// The request_id was used for something else.
pub fn done_before<C: IdempotentRequest>(
    known: &RowMap<CommandKey<C>>,
    request_id: &str,
    command: &C,
    seen: Option<Revision>,
) -> Result<Option<Utc>, Refusal> {
    match known.get(request_id).map(|k| &k.row) {
        None => Ok(None),
        Some(known) if known.command == *command && known.seen == seen => Ok(Some(Utc(known.at_unix_ms))),
        Some(_) => {
            let reason = Reason::from(Code::RequestIdReused).with("request_id", request_id);
            Err(Refusal::new(Kind::AlreadyExists, reason))
        }
    }
}

/// Whether this command was carried out before, as [`done_before`] finds it.
///
/// # Errors
/// The request_id was used for something else.
pub fn is_repeat<C: IdempotentRequest>(
    known: &RowMap<CommandKey<C>>,
    request_id: &str,
    command: &C,
    seen: Option<Revision>,
) -> Result<bool, Refusal> {
    done_before(known, request_id, command, seen).map(|at| at.is_some())
}

/// Writes down that a command was carried out, and deletes a few request_ids that are past their time.
pub fn remember<P: Projection, C: IdempotentRequest>(
    tx: &mut Tx<'_, P>,
    request_id: &str,
    command: &C,
    seen: Option<Revision>,
) where
    CommandKey<C>: Projected<P>,
{
    let at_unix_ms = tx.now.wall.0;
    let oldest_ms = privacy::retention_of(C::KEYS).before(tx.now.steady_wall()).map_or(i64::MIN, |before| before.0);
    let known = CommandKey::<C>::rows(tx.view).values();
    let past = known.filter(|k| k.row.at_unix_ms < oldest_ms).take(FORGOTTEN_AT_ONCE);
    let past: Vec<String> = past.map(|k| k.row.id.clone()).collect();
    past.iter().for_each(|id| tx.delete::<CommandKey<C>>(id, "command.forgotten"));
    let key = CommandKey { id: request_id.to_owned(), command: command.clone(), seen, at_unix_ms };
    tx.put_row(key, "command.done");
}
