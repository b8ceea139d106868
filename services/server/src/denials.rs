//! Writes down whom the port denied what: in the chain of the service that was asked, or in that of identity where the service has none.
//!
//! Invariant: the port never waits for this. What cannot be written is counted, and said once; how many are written at most is the port's to say.

use midshift_cli::roles::Role;
use midshift_core::audit::Note;
use midshift_core::item::Item;
use midshift_core::rows::Writer;
use midshift_edge::Denial;
use midshift_store::Store;
use tokio::sync::mpsc::Receiver;

/// Action of its rows.
const ACTION: &str = "request.deny";
/// Denials written in one commit at most.
const AT_ONCE: usize = 64;

/// Until it is dropped.
pub async fn write(store: &dyn Store, mut denials: Receiver<Denial>) {
    let (mut told, mut failing) = (Vec::new(), false);
    while denials.recv_many(&mut told, AT_ONCE).await > 0 {
        let mut lost = 0;
        for result in store.commit(told.drain(..).map(item).collect()).await {
            let Err(error) = result else { continue };
            lost += 1;
            if lost == 1 && !failing {
                tracing::warn!(%error, "denied requests are not written into the audit");
            }
        }
        failing = lost > 0;
        metrics::counter!("midshift_denials_lost_total").increment(lost);
    }
    // The port is gone.
    std::future::pending().await
}

fn item(denial: Denial) -> Item {
    let Denial { actor, network, path, robot_id, code, left_out } = denial;
    let mut item = Item::new(chain(&path), &actor);
    let note = Note::new(ACTION).with("path", path).with("network", network).refused(code);
    let note = match robot_id {
        Some(robot_id) => note.about("robot", robot_id),
        None => note,
    };
    item.audit(if left_out > 0 { note.with("left_out", left_out) } else { note });
    item
}

/// The chain of the service that a path is of.
fn chain(path: &str) -> Writer {
    let service = path.trim_start_matches('/').split('/').next().unwrap_or_default();
    match Role::ALL.into_iter().find(|role| role.services().contains(&service)) {
        Some(Role::Task) => Writer::Task,
        Some(Role::Fleet) => Writer::Fleet,
        Some(Role::Ota) => Writer::Ota,
        Some(Role::Telemetry | Role::Identity | Role::StopFollower) | None => Writer::Identity,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::audit::AuditRow;
    use midshift_core::identity::{Actor, TokenId};
    use midshift_core::ids::SiteId;
    use midshift_core::reason::Code;
    use midshift_core::rows::Table;
    use midshift_core::time::{ScaledClock, Utc};
    use midshift_store::{MemoryStore, Query, StoreId};
    use std::net::Ipv4Addr;
    use std::sync::Arc;
    use std::time::Duration;
    use tokio::sync::mpsc;

    #[tokio::test]
    async fn a_denial_is_a_row_with_who_what_and_why_and_how_many_more_there_were() {
        let clock = Arc::new(ScaledClock::new(|| 0, Utc(1_000_000), 1000));
        let store = MemoryStore::new(SiteId::parse("s").expect("a site"), StoreId("store-1".into()), clock);
        let (sender, denials) = mpsc::channel(1);
        let path = "/midshift.task.v1.TaskService/SubmitTask".to_owned();
        let (actor, network) = (Actor::new("anna", TokenId::new("t1")), Ipv4Addr::LOCALHOST.into());
        let robot_id = Some("r7".to_owned());
        let denial = Denial { actor, network, path, robot_id, code: Code::NotPermitted, left_out: 7 };
        sender.send(denial).await.expect("there is room");
        let written = async {
            loop {
                let rows = store.list(Query::all(Table::TaskAudit)).await.expect("rows");
                if !rows.is_empty() {
                    return rows;
                }
                tokio::task::yield_now().await;
            }
        };
        let rows = tokio::select! {
            () = write(&store, denials) => panic!("it goes on until it is dropped"),
            rows = tokio::time::timeout(Duration::from_secs(60), written) => rows.expect("a row"),
        };
        let row: AuditRow = serde_json::from_str(&rows[0].body).expect("a row");
        let with = |name: &str| row.with.get(name).map(String::as_str);
        assert_eq!((rows.len(), row.actor.as_str(), row.action.as_str()), (1, "anna", ACTION));
        assert_eq!(row.token_id, "t1");
        assert_eq!((row.outcome.as_str(), row.about.as_slice()), ("NOT_PERMITTED", &["robot:r7".to_owned()][..]));
        assert_eq!(with("path"), Some("/midshift.task.v1.TaskService/SubmitTask"));
        assert_eq!((with("network"), with("left_out")), (Some("127.0.0.1"), Some("7")));
    }

    #[test]
    fn a_denial_stands_in_the_chain_of_the_service_that_was_asked() {
        let chains = [
            ("/midshift.task.v1.TaskService/SubmitTask", Writer::Task),
            ("/midshift.fleet.v1.FleetService/CordonRobot", Writer::Fleet),
            ("/midshift.ota.v1.RolloutService/StartRollout", Writer::Ota),
            ("/midshift.telemetry.v1.TelemetryService/ListRobots", Writer::Identity),
            ("/midshift.stop.v1.StopService/Engage", Writer::Identity),
            ("/metrics", Writer::Identity),
            ("", Writer::Identity),
        ];
        for (path, writer) in chains {
            assert_eq!(chain(path), writer, "{path}");
            assert!(Table::audit_of(writer).is_some(), "it has a chain");
        }
    }
}
