//! The real reconciler over a store in memory, with robots and telemetry played by a script: what the law of the fleet promises,
//! one sentence a test. Time is tokio's paused clock; nothing here waits in real time.

mod harness;

mod arrivals;
mod blocks;
mod claims;
mod drains;
mod ended;
mod errands;
mod explain;
mod holds;
mod labels;
mod leads;
mod loads;
mod maps;
mod metrics;
mod offers;
#[path = "../../../../tests/src/old_site.rs"]
mod old_site;
mod people;
mod place_breaker;
mod places;
mod planner;
mod projection;
mod races;
mod reach;
mod refused;
mod reports;
mod restart;
mod retention;
mod retries;
#[expect(dead_code, reason = "other crates' tests use the rest of it")]
#[path = "../../../../tests/src/postgres.rs"]
mod server;
mod several_hosts;
mod starts;
mod stopping;
mod stops;
mod turns;
mod twins;
mod uncertain;
mod unknown;
mod waiting;
