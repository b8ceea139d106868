//! Whom a request counts for: its rate, its slots, and what is written down when it is denied.
//!
//! Invariant: what cannot be proven is never counted for anybody but the address that it came from.

use crate::quota::network;
use midshift_core::identity::{Caller, Principal, TokenId};
use midshift_core::ids::RobotId;
use midshift_core::reason::Refusal;
use std::fmt;
use std::net::IpAddr;

/// Whom a request counts for.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum QuotaKey {
    /// A robot.
    Robot(RobotId),
    /// The holder of a token.
    Token(TokenId),
    /// Everybody of one address, on a port where nobody needs to say who it is.
    Network(IpAddr),
    /// Everybody of one address who has not shown who it is, or something worthless.
    Unauthenticated(IpAddr),
}

impl QuotaKey {
    pub fn from_caller(caller: Result<&Caller, &Refusal>, address: IpAddr) -> Self {
        match caller.map(Caller::principal) {
            Ok(Principal::Robot(robot_id)) => Self::Robot(robot_id.clone()),
            Ok(Principal::Holder { token, .. }) => Self::Token(token.clone()),
            Ok(Principal::Local) => Self::Network(network(address)),
            Ok(Principal::Nobody) | Err(_) => Self::Unauthenticated(network(address)),
        }
    }
}

impl fmt::Display for QuotaKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Robot(robot_id) => write!(f, "robot:{robot_id}"),
            Self::Token(token) => write!(f, "token:{token}"),
            Self::Network(network) | Self::Unauthenticated(network) => network.fmt(f),
        }
    }
}
