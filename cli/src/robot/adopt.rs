//! `midshift robot adopt` and `robot replace --accept-key`: a person's word that a machine is the robot's.

use crate::client::{Call, Exit, unary};
use crate::out::Out;
use crate::pages::{self, PAGE_SIZE};
use anyhow::anyhow;
use midshift_core::reason::Code;
use midshift_proto::fleet::v1::ListIncidentsRequest;
use midshift_proto::identity::v1;
use midshift_proto::ota::v1::AcceptDeviceKeyRequest;
use midshift_proto::telemetry::v1::GetRobotRequest;
use std::collections::BTreeSet;

/// Takes a machine in that is not enrolled.
pub async fn run(call: &Call, robot_id: &str, key: Option<String>, replace: bool, out: &Out) -> Result<(), Exit> {
    let key_sha256 = match key {
        Some(key) => key,
        None => shown(call, robot_id).await?,
    };
    let asked = v1::AdoptRobotRequest { robot_id: robot_id.to_owned(), key_sha256: key_sha256.clone(), replace };
    let adopted = call.identity().await?.adopt_robot(unary(asked)).await?.into_inner();
    out.one(&adopted, robot_id, || format!("{robot_id} is the machine with key {key_sha256}"))?;
    out.next("it takes charge when it dials again, within a minute; then close the incident: midshift incident ls");
    Ok(())
}

/// The key that the robot's open incidents name, if it is one.
async fn shown(call: &Call, robot_id: &str) -> Result<String, Exit> {
    let mut client = call.fleet().await?;
    let read = async |page_token| {
        let robot_id = robot_id.to_owned();
        let asked = ListIncidentsRequest { robot_id, page_size: PAGE_SIZE, page_token, ..Default::default() };
        client.list_incidents(unary(asked)).await
    };
    let reasons = pages::all(read).await?.incidents.into_iter().filter_map(|incident| incident.reason);
    let named = reasons.filter(|reason| reason.code == Code::RobotNotEnrolled.as_str());
    let keys: BTreeSet<String> = named.filter_map(|mut reason| reason.metadata.remove("key")).collect();
    let mut all = keys.iter();
    match (all.next(), all.next()) {
        (Some(key), None) => Ok(key.clone()),
        (None, _) => Err(Exit::from(anyhow!(
            "no open incident ROBOT_NOT_ENROLLED names a machine of {robot_id}: it must be attached; `midshift incident ls --robot {robot_id}`"
        ))),
        _ => {
            let keys: Vec<&str> = keys.iter().map(String::as_str).collect();
            Err(Exit::from(anyhow!(
                "several machines say that they are {robot_id}: name one with --key: {}",
                keys.join(" ")
            )))
        }
    }
}

/// Takes the device key that a robot's machine shows.
pub async fn accept_key(call: &Call, robot_id: &str, key: &str, out: &Out) -> Result<(), Exit> {
    let device_key = match key {
        "" => offered(call, robot_id).await?,
        key => key.to_owned(),
    };
    let (name, key) = (robot_id.to_owned(), device_key.clone());
    let asked = AcceptDeviceKeyRequest { robot_id: name, device_key: key, ..Default::default() };
    let accepted = call.rollouts().await?.accept_device_key(unary(asked)).await?.into_inner();
    out.one(&accepted, robot_id, || format!("{robot_id} is believed with device key {device_key}"))?;
    out.next("it dials anew; a roll-out that left it out takes it with: midshift rollout retry ROLLOUT --failed");
    Ok(())
}

/// The other key that the robot showed last.
async fn offered(call: &Call, robot_id: &str) -> Result<String, Exit> {
    let request = GetRobotRequest { robot_id: robot_id.to_owned() };
    let robot = call.telemetry().await?.get_robot(unary(request)).await?.into_inner().robot.unwrap_or_default();
    match robot.other_device_key.as_str() {
        "" => Err(Exit::from(anyhow!("{robot_id} shows the device key that is known of it: there is nothing to take"))),
        key => Ok(key.to_owned()),
    }
}
