//! Finds the robot that a person names.

use crate::client::{Call, Exit, unary};
use crate::lookup::{self, Found, whole_id};
use crate::presence::presence;
use midshift_proto::telemetry::v1;

/// One robot.
#[derive(clap::Args)]
pub struct RobotTarget {
    /// Of which server.
    #[command(flatten)]
    pub call: Call,
    /// Its id, or a prefix that only one robot has.
    pub robot_id: String,
}

/// The whole id of a robot that the server has heard of.
pub async fn find_robot(call: &Call, typed: &str) -> Result<String, Exit> {
    let mut client = call.telemetry().await?;
    let listed = async {
        let filter = Some(v1::RobotFilter { robot_id_prefix: typed.to_owned(), ..v1::RobotFilter::default() });
        let request = v1::ListRobotsRequest { filter, page_size: lookup::SHOWN, page_token: String::new() };
        let page = client.list_robots(unary(request)).await?.into_inner();
        let row = |robot: &v1::Robot| (robot.robot_id.clone(), vec![presence(robot)]);
        Ok(Found::new(page.robots.iter().map(row), page.next_page_token.is_empty()))
    };
    whole_id("robot", typed, listed).await
}
