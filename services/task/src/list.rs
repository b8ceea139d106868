//! One page of tasks, newest first; of those whose ids begin alike, the greatest id first. A page token is bound to its filter.

use crate::TaskService;
use crate::rows::{TaskRows, read_many, sees, unavailable};
use crate::search::{Direction, Search};
use midshift_core::identity::Caller;
use midshift_core::ids::TaskId;
use midshift_core::limits;
use midshift_core::reason::{Refusal, Violations};
use midshift_proto::convert::task::TaskFilter;
use midshift_proto::pages;
use midshift_proto::task::v1;
use midshift_store::Cursor;
use prost::Message;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::sync::Arc;

fn print_of(filter: &Option<v1::TaskFilter>) -> String {
    let bytes = filter.as_ref().map(Message::encode_to_vec).unwrap_or_default();
    Sha256::digest(bytes).iter().take(6).map(|b| format!("{b:02x}")).collect()
}

fn token(print: &str, cursor: &Cursor) -> String {
    format!("{print}:{}:{}", cursor.order, cursor.id)
}

fn cursor_of(text: &str, print: &str) -> Result<Cursor, Refusal> {
    let bad = || Refusal::field("page_token", "is not a page token of this filter");
    let mut parts = text.splitn(3, ':');
    let (of, order, id) = (parts.next(), parts.next(), parts.next());
    if of != Some(print) {
        return Err(bad());
    }
    let order = order.and_then(|o| o.parse().ok()).ok_or_else(bad)?;
    Ok(Cursor { order, id: Arc::from(id.ok_or_else(bad)?) })
}

impl TaskService {
    /// One page of what the caller may see.
    pub async fn list(&self, r: v1::ListTasksRequest, by: &Caller) -> Result<v1::ListTasksResponse, Refusal> {
        let print = print_of(&r.filter);
        let filter: TaskFilter = midshift_proto::parse_field(Some(r.filter.unwrap_or_default()), "filter")?;
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let after = if r.page_token.is_empty() { None } else { Some(cursor_of(&r.page_token, &print)?) };
        if filter.task_ids.is_empty() {
            self.page(&filter, by, &print, size, after).await
        } else {
            self.named(&filter, by, &print, size, after).await
        }
    }

    /// Tasks that are named need no search.
    async fn named(
        &self,
        filter: &TaskFilter,
        by: &Caller,
        print: &str,
        size: usize,
        after: Option<Cursor>,
    ) -> Result<v1::ListTasksResponse, Refusal> {
        let ids: Vec<TaskId> = filter.task_ids.iter().cloned().collect();
        let place =
            |task: &TaskRows| Cursor { order: task.state.number as i64, id: task.state.task_id.as_str().into() };
        let mut found = read_many(self.store(), &ids).await?;
        let rows_read = found.len() as u64;
        let site = &self.inner.parts.site;
        let admits = |t: &TaskRows| filter.admits(&t.intake, &t.state) && sees(site, by, &t.intake);
        found.retain(|t| admits(t) && after.as_ref().is_none_or(|after| place(t) < *after));
        found.sort_by_key(|task| std::cmp::Reverse(place(task)));
        let more = found.len() > size;
        found.truncate(size);
        let last = found.last().filter(|_| more).map(|task| token(print, &place(task)));
        let tasks = found.iter().map(TaskRows::encode).collect();
        Ok(v1::ListTasksResponse { tasks, next_page_token: last.unwrap_or_default(), rows_read })
    }

    /// Tasks that must be looked for. The token is given only if there is another task, or if the call has looked at as many as one may.
    async fn page(
        &self,
        filter: &TaskFilter,
        by: &Caller,
        print: &str,
        size: usize,
        mut after: Option<Cursor>,
    ) -> Result<v1::ListTasksResponse, Refusal> {
        let (store, site) = (self.store(), &self.inner.parts.site);
        let admits = |t: &TaskRows| filter.admits(&t.intake, &t.state) && sees(site, by, &t.intake);
        let mut search = Search::new(filter, Direction::NewestFirst, after.clone(), size + 1);
        let (mut tasks, mut rows_read) = (Vec::new(), 0);
        let go_on = |after: Option<&Cursor>| after.map(|c| token(print, c)).unwrap_or_default();
        while rows_read < limits::LIST_ROWS_READ_MAX {
            let rows = search.next(store).await.map_err(unavailable)?;
            if rows.is_empty() {
                return Ok(v1::ListTasksResponse {
                    tasks,
                    next_page_token: String::new(),
                    rows_read: rows_read as u64,
                });
            }
            let found = read_many(store, &search.find_candidates(store, &rows).await.map_err(unavailable)?).await?;
            if found.len() * 2 < rows.len() {
                search.grow();
            }
            let mut found: BTreeMap<_, _> = found.into_iter().map(|t| (t.intake.task_id.to_string(), t)).collect();
            for row in &rows {
                rows_read += 1;
                if let Some(task) = found.remove(&*row.key.id).filter(admits) {
                    if tasks.len() == size {
                        let (next_page_token, rows_read) = (go_on(after.as_ref()), rows_read as u64);
                        return Ok(v1::ListTasksResponse { tasks, next_page_token, rows_read });
                    }
                    tasks.push(task.encode());
                }
                after = Some(Cursor::of_row(row));
            }
        }
        Ok(v1::ListTasksResponse { tasks, next_page_token: go_on(after.as_ref()), rows_read: rows_read as u64 })
    }
}
