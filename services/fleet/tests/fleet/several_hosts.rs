//! Two processes of fleet on one PostgreSQL database, each with connections of its own. Time is real here, so nothing is driven to its end.

use crate::harness::World;
use crate::server::PostgresServer;
use midshift_core::fleet::bugs::Bugs;
use midshift_core::ids::SiteId;
use midshift_core::leadership::FleetLeader;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_core::time::Clock;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService as Face;
use midshift_store::{PostgresConfig, PostgresStore, Store, migrate_postgres};
use std::sync::Arc;

async fn open(config: &PostgresConfig, site_id: SiteId, clock: Arc<dyn Clock>) -> Arc<dyn Store> {
    Arc::new(PostgresStore::open(config, site_id, clock).await.expect("a store"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_postgresql_one_of_two_processes_plans_and_the_other_goes_on_after_it_is_killed() {
    let config = PostgresConfig::new(PostgresServer::shared().database());
    migrate_postgres(&config).await.expect("migrations");
    let mut w =
        World::over(CORRIDOR, Bugs::default(), async |site_id, clock| open(&config, site_id, clock).await).await;
    let lease = async |w: &World| {
        midshift_store::load::<FleetLeader>(&*w.store, "fleet").await.expect("a store").map(|(row, _)| row.holder)
    };
    while lease(&w).await.is_none() {
        w.step().await;
    }
    let first = lease(&w).await;
    let way = open(&config, w.site.site_id().clone(), w.clock.clone()).await;
    let (other, shaky) = w.other_process_on(way);
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("the one that leads gives it", |s| s.phase("T1") == Phase::Running).await;
    let cordon = |robot_id: &str| v1::CordonRobotRequest {
        robot_id: robot_id.to_owned(),
        reason: "wheel".to_owned(),
        request_id: "ask-1".to_owned(),
        ..Default::default()
    };
    other.cordon_robot(local(cordon("r1"))).await.expect("the other one writes it");
    w.fleet.cordon_robot(local(cordon("r1"))).await.expect("and the first one knows");
    assert_eq!(lease(&w).await, first);
    w.kill_first().await;
    w.robot("r2", "park-b").await;
    w.submit("T2", "A", "B").await;
    let seen = w.until("the other one leads and gives the next task", |s| s.robot_of("T2").is_some()).await;
    assert_ne!(lease(&w).await, first);
    assert_eq!((seen.robot_of("T2").as_deref(), seen.task("T1").epoch), (Some("r2"), 1));
    assert!(seen.control("r1").cordon.is_some());
    drop(shaky);
}
