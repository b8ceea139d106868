//! How a swarm starts its agents, crashes one, and ends.

use async_trait::async_trait;
use midshift_agent::dial::{Dial, Error};
use midshift_core::ids::RobotId;
use midshift_core::site::{CORRIDOR, text};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_sim::faults::{FaultRates, Injected};
use midshift_sim::fleet::{Fleet, FleetConfig};
use midshift_sim::swarm::{Swarm, SwarmConfig, SwarmEnd};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;

/// A network that leads nowhere.
struct Nowhere;

#[async_trait]
impl Dial for Nowhere {
    async fn dial(&self) -> Result<Channel, Error> {
        Err(Error("nobody is there".into()))
    }
}

fn clock() -> Arc<dyn Clock> {
    let start = tokio::time::Instant::now();
    Arc::new(ScaledClock::new(move || start.elapsed().as_micros() as u64, Utc(1_000_000), 20_000))
}

/// How often each agent was started.
type Starts = Arc<Mutex<BTreeMap<RobotId, u32>>>;

/// A swarm of three without a server, and how often each agent was started.
fn swarm() -> (Arc<Fleet>, Swarm, Starts) {
    let site = Arc::new(text::parse(CORRIDOR).expect("a site"));
    let clock = clock();
    let quiet = FleetConfig { faults: FaultRates::none(), ..FleetConfig::new(site, 3, 7) };
    let fleet = Arc::new(Fleet::open(&quiet, &clock.now()).expect("opens"));
    let starts = Arc::new(Mutex::new(BTreeMap::new()));
    let counted = starts.clone();
    let mut config = SwarmConfig::tcp(fleet.clone(), clock, "http://127.0.0.1:1", 7);
    config.dial = Arc::new(move |robot, _| {
        *counted.lock().expect("no panic").entry(robot.clone()).or_insert(0) += 1;
        Ok(Arc::new(Nowhere))
    });
    (fleet, Swarm::new(config), starts)
}

#[tokio::test(start_paused = true)]
async fn a_crashed_agent_is_started_again_and_the_others_go_on() {
    let (_, swarm, starts) = swarm();
    let (crash, shutdown) = (swarm.crash(), CancellationToken::new());
    let running = tokio::spawn(swarm.run(shutdown.clone()));
    tokio::time::sleep(Duration::from_secs(5)).await;
    let robot = RobotId::parse("rbt-02").expect("a robot");
    assert!(crash(&robot) && !crash(&RobotId::parse("rbt-77").expect("a robot")));
    tokio::time::sleep(Duration::from_secs(5)).await;
    let counts: Vec<u32> = starts.lock().expect("no panic").values().copied().collect();
    assert_eq!(counts, [1, 2, 1]);
    shutdown.cancel();
    let end = running.await.expect("no panic").expect("ends well");
    assert_eq!(end, SwarmEnd { fenced: Vec::new(), crashes: 1 });
}

#[tokio::test(start_paused = true)]
async fn a_person_walks_the_hall_while_a_swarm_runs() {
    let (fleet, swarm, _) = swarm();
    let shutdown = CancellationToken::new();
    let running = tokio::spawn(swarm.run(shutdown.clone()));
    fleet.robots()[0].inject(midshift_core::time::SiteTime(0), Injected::Jam);
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(fleet.robots()[0].lock().broken().is_some(), "100 s of site time: nobody came yet");
    tokio::time::sleep(Duration::from_secs(11)).await;
    assert!(fleet.robots()[0].lock().broken().is_none(), "320 s of site time");
    shutdown.cancel();
    running.await.expect("no panic").expect("ends well");
}
