//! The simulator's own face on the wire: faults in, bodies and the world of items out.
//!
//! Invariant: what it answers comes from the bodies and their journals, never from the server. Registered by `dev` and
//! `sim run` only.

use crate::body::SimBody;
use crate::faults::Injected;
use crate::fleet::Fleet;
use crate::handle::SimHandle;
use crate::judge::Verdict;
use crate::world::{lock, sku_of};
use midshift_agent::body::Body as _;
use midshift_core::ids::RobotId;
use midshift_core::limits::{CONTROL_MESSAGE_BYTES, PAGE_DEFAULT, PAGE_MAX};
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::time::{Clock, Now, SiteDuration};
use midshift_proto::convert::{At, parse_ms};
use midshift_proto::sim::v1;
use midshift_proto::sim::v1::inject_fault_request::Fault;
use midshift_proto::sim::v1::sim_service_server::{SimService, SimServiceServer};
use midshift_proto::status;
use std::collections::BTreeMap;
use std::sync::Arc;
use tonic::service::Routes;
use tonic::{Request, Response, Status};

/// An obstacle that stays until the body gives up.
const FOR_LONG: SiteDuration = SiteDuration::from_secs(3600);

/// Kills and restarts the agent of one robot; false: nobody here runs its agent.
pub type Crash = Arc<dyn Fn(&RobotId) -> bool + Send + Sync>;

/// The service.
#[derive(Clone)]
pub struct SimFace {
    fleet: Arc<Fleet>,
    clock: Arc<dyn Clock>,
    crash: Crash,
}

impl SimFace {
    /// For the robots of a fleet.
    pub fn new(fleet: Arc<Fleet>, clock: Arc<dyn Clock>, crash: Crash) -> Self {
        Self { fleet, clock, crash }
    }
    /// With this face.
    pub fn add_to(self, routes: Routes) -> Routes {
        routes.add_service(SimServiceServer::new(self).max_decoding_message_size(CONTROL_MESSAGE_BYTES))
    }
    fn inject(&self, request: v1::InjectFaultRequest) -> Result<(), Refusal> {
        let robot_id = RobotId::parse(&request.robot_id).map_err(|e| Refusal::field("robot_id", e.to_string()))?;
        let fault = request.fault.ok_or_else(|| Refusal::field("fault", "one fault must be named"))?;
        let robot = self.fleet.robot(&robot_id).ok_or_else(|| unknown(&robot_id))?;
        match read(fault, self.clock.rate_permille())? {
            Some(what) => robot.inject(self.clock.now().site, what),
            None if (self.crash)(&robot_id) => {}
            None => {
                let text = "no agent of this robot runs in this process";
                return Err(Refusal::new(Kind::Precondition, Reason::new(Code::NotAllowedNow, text)));
            }
        }
        Ok(())
    }
    fn bodies(&self, request: &v1::ListBodiesRequest) -> Result<v1::ListBodiesResponse, Refusal> {
        let size = match request.page_size as usize {
            0 => PAGE_DEFAULT,
            n if n <= PAGE_MAX => n,
            _ => return Err(Refusal::field("page_size", format!("must be 0..={PAGE_MAX}"))),
        };
        let after = |r: &SimHandle| r.robot_id().as_str() > request.page_token.as_str();
        let first = self.fleet.robots().partition_point(|r| !after(r));
        let page: Vec<_> = self.fleet.robots()[first..].iter().take(size + 1).collect();
        let more = page.len() > size;
        let page = &page[..page.len().min(size)];
        let last = page.last().filter(|_| more).map(|r| r.robot_id().to_string());
        let verdict = self.verdict()?;
        let now = self.clock.now();
        let bodies = page.iter().map(|robot| described(&mut robot.lock(), &now, &verdict)).collect();
        Ok(v1::ListBodiesResponse { bodies, next_page_token: last.unwrap_or_default() })
    }
    fn world(&self) -> Result<v1::GetWorldResponse, Refusal> {
        use v1::world_stock::Where;
        let mut stocks: BTreeMap<(bool, String, String), u64> = BTreeMap::new();
        for world in self.fleet.worlds() {
            let world = lock(world);
            let lying = world.lying().map(|(at, item)| (false, at.to_string(), sku_of(item).to_owned()));
            let carried = world.carrying().map(|(robot, c)| (true, robot.to_string(), sku_of(&c.item).to_owned()));
            lying.chain(carried).for_each(|key| *stocks.entry(key).or_insert(0) += 1);
        }
        let verdict = self.verdict()?;
        let stock = |((carried, at, item), count)| v1::WorldStock {
            r#where: Some(if carried { Where::RobotId(at) } else { Where::Waypoint(at) }),
            item,
            count,
        };
        Ok(v1::GetWorldResponse {
            stocks: stocks.into_iter().map(stock).collect(),
            items_created: verdict.items_made,
            items_found: verdict.items_at_places + verdict.items_on_robots + verdict.items_shipped,
            conserved: verdict.items_conserved(),
            exclusion_violations: verdict.exclusion_violations,
        })
    }
    fn verdict(&self) -> Result<Verdict, Refusal> {
        self.fleet.verdict().map_err(|error| {
            tracing::error!(%error, "journals not read");
            Refusal::new(Kind::Internal, Code::StoreUnavailable)
        })
    }
}

fn unknown(robot_id: &RobotId) -> Refusal {
    Refusal::new(Kind::NotFound, Reason::from(Code::RobotNotFound).with("robot_id", robot_id))
}

/// A fault of the wire as an injection; none: a crash of the agent. Link time becomes site time by the clock's rate.
fn read(fault: Fault, rate_permille: u32) -> Result<Option<Injected>, Refusal> {
    let site = |name: &str, duration: Option<prost_types::Duration>| -> Result<SiteDuration, Refusal> {
        let mut bad = Violations::default();
        let ms = parse_ms(duration.as_ref(), At::top(name), &mut bad);
        bad.finish()?;
        match ms {
            Some(ms) if ms > 0 => Ok(SiteDuration(ms as u64)),
            _ => Err(Refusal::field(name, "is required and must be above 0")),
        }
    };
    let link = |name: &str, duration| {
        let asked: SiteDuration = site(name, duration)?;
        Ok(SiteDuration(asked.as_ms().saturating_mul(u64::from(rate_permille)) / 1000))
    };
    Ok(Some(match fault {
        Fault::DropNetwork(f) => Injected::DropNetwork(link("drop_network.duration", f.duration)?),
        Fault::Silence(f) => Injected::DropNetwork(link("silence.duration", f.duration)?),
        Fault::Obstacle(v1::ObstacleFault { duration: None }) => Injected::Obstacle(FOR_LONG),
        Fault::Obstacle(f) => Injected::Obstacle(site("obstacle.duration", f.duration)?),
        Fault::GripperMiss(f) => Injected::GripperMissed(f.count),
        Fault::Jam(_) => Injected::Jam,
        Fault::Manual(f) => Injected::Manual(site("manual.duration", f.duration)?),
        Fault::HardwareStop(f) => Injected::HardwareStop(site("hardware_stop.duration", f.duration)?),
        Fault::LowBattery(f) if f.permille > 1000 => {
            return Err(Refusal::field("low_battery.permille", "must be 0..=1000"));
        }
        Fault::LowBattery(f) => Injected::LowBattery(f.permille as u16),
        Fault::Crash(_) => return Ok(None),
    }))
}

fn described(body: &mut SimBody, now: &Now, verdict: &Verdict) -> v1::Body {
    body.advance(now.site);
    let state = body.state(now.site);
    let counts = body.counts();
    v1::Body {
        robot_id: body.robot_id().to_string(),
        pose: Some((&state.pose).into()),
        item: body.load().map(|l| l.item).unwrap_or_default(),
        picks: counts.picks,
        places: counts.places,
        exclusion_violations: verdict.violations_by_robot.get(body.robot_id()).copied().unwrap_or(0),
        path_mm: state.odometer_mm,
        loaded_path_mm: state.loaded_odometer_mm,
        battery_permille: u32::from(state.battery_permille),
        faults: body.faults_by_code().iter().map(|(code, times)| (*code, *times)).collect(),
    }
}

#[tonic::async_trait]
impl SimService for SimFace {
    async fn inject_fault(
        &self,
        request: Request<v1::InjectFaultRequest>,
    ) -> Result<Response<v1::InjectFaultResponse>, Status> {
        self.inject(request.into_inner()).map_err(|refusal| status(&refusal, None))?;
        Ok(Response::new(v1::InjectFaultResponse {}))
    }
    async fn list_bodies(
        &self,
        request: Request<v1::ListBodiesRequest>,
    ) -> Result<Response<v1::ListBodiesResponse>, Status> {
        self.bodies(request.get_ref()).map(Response::new).map_err(|refusal| status(&refusal, None))
    }
    async fn get_world(
        &self,
        _request: Request<v1::GetWorldRequest>,
    ) -> Result<Response<v1::GetWorldResponse>, Status> {
        self.world().map(Response::new).map_err(|refusal| status(&refusal, None))
    }
}
