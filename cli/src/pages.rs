//! Lists of a server: read from the first page to the last, and what `ls` shows of each thing in one.
//!
//! A verb that lists names its request; columns, names and pages stand here and beside the thing itself.

use midshift_proto::fleet::v1 as fleet;
use midshift_proto::identity::v1 as identity;
use midshift_proto::ota::v1 as ota;
use midshift_proto::task::v1 as task;
use midshift_proto::telemetry::v1 as telemetry;
use prost::{Message, Name};
use tonic::{Response, Status};

/// Things of one page, as many as a server gives at once.
pub const PAGE_SIZE: u32 = 1_000;

/// A thing that `ls` shows in columns.
pub trait Listed: Message + Name {
    /// Heads of the columns.
    const HEADER: &'static [&'static str];
    /// What `-o name` prints.
    fn name(&self) -> String;
    /// Cells, one for each column.
    fn row(&self) -> Vec<String>;
}

/// An answer that is one page of a list, or all pages in one.
pub trait Page: Message + Name + Default {
    /// What is listed.
    type Item: Message + Name;
    /// What is on it.
    fn items(&self) -> &[Self::Item];
    /// Whether there is none behind it.
    fn is_last(&self) -> bool;
    /// What is on it, and the token of the page behind it; empty: there is none.
    fn parts(&mut self) -> (&mut Vec<Self::Item>, &mut String);
}

macro_rules! pages {
    ($($page:ty { $items:ident: $item:ty })*) => { $(
        impl Page for $page {
            type Item = $item;
            fn items(&self) -> &[$item] {
                &self.$items
            }
            fn is_last(&self) -> bool {
                self.next_page_token.is_empty()
            }
            fn parts(&mut self) -> (&mut Vec<$item>, &mut String) {
                (&mut self.$items, &mut self.next_page_token)
            }
        }
    )* };
}

pages! {
    fleet::ListIncidentsResponse { incidents: fleet::Incident }
    fleet::ListPlacesResponse { places: fleet::Place }
    fleet::ListRobotControlsResponse { controls: fleet::RobotControl }
    identity::ListAuditResponse { rows: identity::AuditRow }
    identity::ListRobotIdentitiesResponse { robots: identity::RobotIdentity }
    identity::ListTokensResponse { tokens: identity::Token }
    ota::ListBundlesResponse { bundles: ota::Bundle }
    ota::ListQuarantinesResponse { quarantines: ota::Quarantine }
    ota::ListRobotSoftwareResponse { software: ota::RobotSoftware }
    ota::ListRolloutRobotsResponse { robots: ota::RolloutRobot }
    ota::ListRolloutsResponse { rollouts: ota::Rollout }
    task::ListTasksResponse { tasks: task::Task }
    telemetry::ListRobotsResponse { robots: telemetry::Robot }
}

/// Reads all pages into one, by a function of the page's token. What an answer says beside its things is that of the
/// last page.
///
/// # Errors
/// What the server says to any page.
pub async fn all<P: Page>(read: impl AsyncFnMut(String) -> Result<Response<P>, Status>) -> Result<P, Status> {
    first(usize::MAX, read).await
}

/// Reads pages until there are `most` things or more, or all: then the token of the page behind them is empty.
///
/// # Errors
/// What the server says to any page.
pub async fn first<P: Page>(
    most: usize,
    mut read: impl AsyncFnMut(String) -> Result<Response<P>, Status>,
) -> Result<P, Status> {
    let (mut read_before, mut page_token) = (Vec::new(), String::new());
    loop {
        let mut page = read(page_token).await?.into_inner();
        let (items, next) = page.parts();
        read_before.append(items);
        if next.is_empty() || read_before.len() >= most {
            *items = read_before;
            return Ok(page);
        }
        page_token = std::mem::take(next);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn pages_become_one_that_says_beside_its_things_what_the_last_one_said() {
        let mut asked = Vec::new();
        let read = async |token: String| {
            asked.push(token);
            let n = asked.len() as u64;
            let room = Some(ota::SoftwareRoom { used_bytes: n, ..Default::default() });
            let bundles = vec![ota::Bundle { length: n, ..Default::default() }];
            let next_page_token = if n < 3 { n.to_string() } else { String::new() };
            Ok(Response::new(ota::ListBundlesResponse { bundles, room, next_page_token, ..Default::default() }))
        };
        let whole = all(read).await.expect("three pages");
        assert_eq!(asked, ["", "1", "2"]);
        assert_eq!(whole.items().iter().map(|bundle| bundle.length).collect::<Vec<_>>(), [1, 2, 3]);
        assert_eq!((whole.room.map(|room| room.used_bytes), whole.next_page_token.as_str()), (Some(3), ""));
    }

    #[tokio::test]
    async fn of_a_list_that_is_cut_the_token_says_that_there_is_more() {
        let read = async |token: String| {
            let next_page_token = format!("{token}x");
            Ok(Response::new(task::ListTasksResponse {
                tasks: vec![Default::default(); 2],
                next_page_token,
                rows_read: 0,
            }))
        };
        let some = first(3, read).await.expect("two pages");
        assert_eq!((some.tasks.len(), some.next_page_token.as_str()), (4, "xx"));
    }
}
