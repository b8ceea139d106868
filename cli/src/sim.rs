//! `midshift sim …`: simulated robots, and faults in them.

use super::client::{Call, Exit, unary};
use super::out::Out;
use clap::Subcommand;
use midshift_proto::sim::v1::{self, inject_fault_request::Fault};
use std::time::Duration;

/// Verbs that ask simulated robots.
#[derive(Subcommand)]
pub enum Verb {
    /// Make something go wrong with a simulated robot (of `midshift dev`, or of a `sim run --listen`).
    Fault(FaultArgs),
    /// What the bodies themselves say: items, picks, violations.
    World {
        /// Of which server.
        #[command(flatten)]
        call: Call,
    },
}

/// One fault.
#[derive(clap::Args)]
pub struct FaultArgs {
    #[command(flatten)]
    call: Call,
    /// The simulated robot.
    robot_id: String,
    #[command(flatten)]
    what: What,
}

#[derive(clap::Args)]
#[group(required = true, multiple = false)]
struct What {
    /// Its network carries nothing for so long.
    #[arg(long, value_parser = super::duration)]
    drop_network: Option<Duration>,
    /// Something stands in its way for so long.
    #[arg(long, value_parser = super::duration)]
    obstacle: Option<Duration>,
    /// Its next picks close on nothing.
    #[arg(long)]
    gripper_miss: Option<u32>,
    /// It jams; a person must look.
    #[arg(long)]
    jam: bool,
    /// It says nothing for so long.
    #[arg(long, value_parser = super::duration)]
    silence: Option<Duration>,
    /// A person drives it for so long.
    #[arg(long, value_parser = super::duration)]
    manual: Option<Duration>,
    /// Its own safety system stops it for so long.
    #[arg(long, value_parser = super::duration)]
    hardware_stop: Option<Duration>,
    /// Its battery falls to so many permille.
    #[arg(long)]
    low_battery: Option<u32>,
    /// Its agent is killed and started again.
    #[arg(long)]
    crash: bool,
}

fn wire(duration: Duration) -> Option<prost_types::Duration> {
    prost_types::Duration::try_from(duration).ok()
}

impl What {
    fn fault(&self) -> Option<Fault> {
        let timed = |d: Option<Duration>, make: fn(Option<prost_types::Duration>) -> Fault| d.map(|d| make(wire(d)));
        timed(self.drop_network, |duration| Fault::DropNetwork(v1::DropNetworkFault { duration }))
            .or_else(|| timed(self.obstacle, |duration| Fault::Obstacle(v1::ObstacleFault { duration })))
            .or_else(|| timed(self.silence, |duration| Fault::Silence(v1::SilenceFault { duration })))
            .or_else(|| timed(self.manual, |duration| Fault::Manual(v1::ManualFault { duration })))
            .or_else(|| timed(self.hardware_stop, |duration| Fault::HardwareStop(v1::HardwareStopFault { duration })))
            .or_else(|| self.gripper_miss.map(|count| Fault::GripperMiss(v1::GripperMissFault { count })))
            .or_else(|| self.low_battery.map(|permille| Fault::LowBattery(v1::LowBatteryFault { permille })))
            .or_else(|| self.jam.then_some(Fault::Jam(v1::JamFault {})))
            .or_else(|| self.crash.then_some(Fault::Crash(v1::CrashFault {})))
    }
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Fault(args) => {
            let request = v1::InjectFaultRequest { robot_id: args.robot_id.clone(), fault: args.what.fault() };
            let answer = args.call.sim().await?.inject_fault(unary(request)).await?.into_inner();
            out.one(&answer, &args.robot_id, || format!("{}: done", args.robot_id))?;
            out.next(&format!("midshift robot watch {}", args.robot_id));
            Ok(())
        }
        Verb::World { call } => {
            let answer = call.sim().await?.get_world(unary(v1::GetWorldRequest::default())).await?.into_inner();
            out.json(&answer)?;
            Ok(())
        }
    }
}
