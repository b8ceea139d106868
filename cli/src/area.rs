//! `midshift area …`: live rules of areas.

mod software;

use super::client::{Call, Change, Exit, unary};
use super::out::Out;
use clap::Subcommand;
use midshift_proto::fleet::v1;
use std::time::Duration;

/// Verbs of areas.
#[derive(Subcommand)]
pub enum Verb {
    /// Show the rules of an area.
    Get {
        #[command(flatten)]
        call: Call,
        /// Id of the area.
        area_id: String,
    },
    /// Change rules of an area; what is not named stays. Pushed to every robot.
    Put {
        #[command(flatten)]
        call: Call,
        /// Id of the area.
        area_id: String,
        /// Millimetres per second.
        #[arg(long)]
        speed_limit: Option<u32>,
        /// Millimetres kept to people and things.
        #[arg(long)]
        avoidance_distance: Option<u32>,
        /// Below this a robot must charge, percent.
        #[arg(long)]
        charge_below: Option<u32>,
        /// Below this an idle robot charges when nothing waits, percent.
        #[arg(long)]
        charge_idle_below: Option<u32>,
        /// Charging ends here, percent.
        #[arg(long)]
        charge_to: Option<u32>,
        /// Above this a charging robot may be called to work, percent.
        #[arg(long)]
        charge_callable_above: Option<u32>,
        /// A robot that says so long that it is stopped, driven by a person or faulty, or that the breaker took out, is an incident. Link time.
        #[arg(long, value_parser = super::duration)]
        incident_after: Option<Duration>,
        #[command(flatten)]
        software: software::Rules,
        #[command(flatten)]
        change: Change,
    },
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Get { call, area_id } => {
            let request = v1::GetAreaPolicyRequest { area_id };
            let policy =
                call.fleet().await?.get_area_policy(unary(request)).await?.into_inner().policy.unwrap_or_default();
            show(&policy, out)
        }
        Verb::Put {
            call,
            area_id,
            speed_limit,
            avoidance_distance,
            charge_below,
            charge_idle_below,
            charge_to,
            charge_callable_above,
            incident_after,
            software,
            change,
        } => {
            let permille = |percent: Option<u32>| percent.map(|p| p.saturating_mul(10));
            let mut client = call.fleet().await?;
            let request = v1::GetAreaPolicyRequest { area_id };
            let old = client.get_area_policy(unary(request)).await?.into_inner().policy.unwrap_or_default();
            let policy = v1::AreaPolicy {
                speed_limit_mm_s: speed_limit.or(old.speed_limit_mm_s),
                avoidance_distance_mm: avoidance_distance.or(old.avoidance_distance_mm),
                charge_mandatory_permille: permille(charge_below).or(old.charge_mandatory_permille),
                charge_opportunistic_permille: permille(charge_idle_below).or(old.charge_opportunistic_permille),
                charge_stop_permille: permille(charge_to).or(old.charge_stop_permille),
                charge_preemptible_permille: permille(charge_callable_above).or(old.charge_preemptible_permille),
                incident_after: incident_after.map(milliseconds).or(old.incident_after),
                software: Some(software.over(old.software.unwrap_or_default())),
                ..old
            };
            let request = v1::PutAreaPolicyRequest {
                policy: Some(policy),
                request_id: change.request_id,
                validate_only: change.dry_run,
            };
            let answer = client.put_area_policy(unary(request)).await?.into_inner();
            show(&answer.policy.unwrap_or_default(), out)?;
            out.inform(&format!("pushed to {} robots", answer.robots));
            Ok(())
        }
    }
}

/// A time as the wire has it.
pub(crate) fn milliseconds(time: Duration) -> prost_types::Duration {
    midshift_proto::convert::duration(u64::try_from(time.as_millis()).unwrap_or(u64::MAX))
}

fn show(policy: &v1::AreaPolicy, out: &Out) -> Result<(), Exit> {
    let or_none = |v: Option<u32>, unit: &str| v.map_or_else(|| "none".to_owned(), |v| format!("{v} {unit}"));
    let percent = |v: Option<u32>| v.map_or_else(|| "default".to_owned(), |v| format!("{} %", f64::from(v) / 10.0));
    out.one(policy, &policy.area_id, || {
        format!(
            "{}  speed limit {}  avoidance {}  charge: must below {}, may below {}, to {}, may be called above {}  incident after {}",
            policy.area_id,
            or_none(policy.speed_limit_mm_s, "mm/s"),
            or_none(policy.avoidance_distance_mm, "mm"),
            percent(policy.charge_mandatory_permille),
            percent(policy.charge_opportunistic_permille),
            percent(policy.charge_stop_permille),
            percent(policy.charge_preemptible_permille),
            policy.incident_after.as_ref().map(|after| format!("{} s", after.seconds)).unwrap_or_default()
        ) + &software::shown(&policy.software.clone().unwrap_or_default())
    })?;
    Ok(())
}
