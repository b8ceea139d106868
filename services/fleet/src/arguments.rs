//! What commands have in common as arguments: the thing that they are about, a request_id, a reason.
//!
//! Called by the gRPC face. Each gives back everything that is wrong with a request at once.

use midshift_core::ids::{PlaceId, RequestId, RobotId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal, Violations};

/// The request_id of a command; none: it is not protected against being sent twice.
pub fn request_id(text: &str, bad: &mut Violations) -> Option<String> {
    if !text.is_empty() {
        bad.accept("request_id", RequestId::parse(text));
    }
    (!text.is_empty()).then(|| text.to_owned())
}

/// Notes a reason that is missing or too long.
pub fn check_reason(text: &str, bad: &mut Violations) {
    if text.is_empty() || text.len() > limits::REASON_BYTES_MAX {
        bad.add("reason", "is required, 1-256 bytes");
    }
}

/// The place and the request_id of a command about one place, or everything that is wrong with the request.
pub fn place_and_request(
    place_id: &str,
    request: &str,
    reason: &str,
    mut bad: Violations,
) -> Result<(PlaceId, Option<String>), Refusal> {
    let place_id = bad.accept("place_id", PlaceId::parse(place_id));
    let request_id = request_id(request, &mut bad);
    check_reason(reason, &mut bad);
    bad.finish()?;
    Ok((place_id.ok_or_else(internal)?, request_id))
}

/// The robot and the request_id of a command about one robot, or everything that is wrong with the request.
/// `reason`: none where the command asks for none.
pub fn robot_and_request(
    robot_id: &str,
    request: &str,
    reason: Option<&str>,
    mut bad: Violations,
) -> Result<(RobotId, Option<String>), Refusal> {
    let robot_id = bad.accept("robot_id", RobotId::parse(robot_id));
    let request_id = request_id(request, &mut bad);
    if let Some(reason) = reason {
        check_reason(reason, &mut bad);
    }
    bad.finish()?;
    Ok((robot_id.ok_or_else(internal)?, request_id))
}

/// An id that could not be read without a violation: cannot happen.
pub fn internal() -> Refusal {
    Refusal::new(Kind::Internal, Code::Internal)
}
