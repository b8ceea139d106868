//! Records as the wire says them. Digests of secrets are left out.

use midshift_core::identity::{RobotIdentity, TokenRecord};
use midshift_core::time::Utc;
use midshift_proto::convert::common::timestamp;
use midshift_proto::identity::v1;

/// A token.
pub fn token(record: &TokenRecord) -> v1::Token {
    v1::Token {
        token_id: record.token_id.to_string(),
        name: record.name.clone(),
        grants: record.grants.iter().map(ToString::to_string).collect(),
        create_time: Some(timestamp(Utc(record.created_unix_ms))),
        created_by: record.created_by.clone(),
        expire_time: Some(timestamp(Utc(record.expires_unix_ms))),
        revoke_time: record.revoked.as_ref().map(|act| timestamp(Utc(act.at_unix_ms))),
        revoked_by: record.revoked.as_ref().map(|act| act.actor.clone()).unwrap_or_default(),
        person: record.person.as_ref().map(ToString::to_string).unwrap_or_default(),
        rotated_from: record.rotation.as_ref().map(|rotation| rotation.of.to_string()).unwrap_or_default(),
    }
}

/// A robot.
pub fn robot(record: &RobotIdentity) -> v1::RobotIdentity {
    let open = record.enrolment.as_ref().filter(|open| open.used_unix_ms.is_none());
    v1::RobotIdentity {
        robot_id: record.robot_id.to_string(),
        key_sha256: record.key.map(|key| key.to_string()).unwrap_or_default(),
        enrol_time: record.key.and(record.enrolled_unix_ms).map(|at| timestamp(Utc(at))),
        expire_time: record.expires_unix_ms.map(|at| timestamp(Utc(at))),
        enrolment_expire_time: open.map(|open| timestamp(Utc(open.expires_unix_ms))),
        revoke_time: record.revoked.as_ref().map(|act| timestamp(Utc(act.at_unix_ms))),
        revoked_by: record.revoked.as_ref().map(|act| act.actor.clone()).unwrap_or_default(),
    }
}
