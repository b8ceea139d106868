//! `midshift robot enroll|replace|revoke|identities`: which machine is which robot.

use super::client::{Call, Exit, unary};
use super::out::Out;
use crate::stop;
use midshift_proto::convert::time_of;
use midshift_proto::identity::v1;

/// Hands out a secret, and the line that uses it.
pub async fn offer(call: &Call, robot_id: String, replace: bool, out: &Out) -> Result<(), Exit> {
    let asked = v1::CreateEnrolmentRequest { robot_id: robot_id.clone(), replace };
    let offered = call.identity().await?.create_enrolment(unary(asked)).await?.into_inner();
    let (server, mut stop_server) = (call.address()?, call.resolved()?.stop_server);
    if stop_server.is_none() {
        stop_server = call.resolved()?.site().await.and_then(|said| said.unusual_stop_server(&server));
    }
    out.one(&offered, &offered.secret, || line(&robot_id, &server, stop_server.as_deref(), &offered.secret))?;
    let until = offered.expire_time.as_ref().map_or_else(String::new, |time| time_of(time).rfc3339());
    if is_loopback(&server) {
        out.say(&format!(
            "warning: {server} is this machine; on another one put an address there under which it finds the server"
        ));
    }
    out.next(&format!("run it on the robot, once, before {until}; the secret is shown once"));
    Ok(())
}

/// Whether a server is only found from its own machine.
fn is_loopback(server: &str) -> bool {
    let host = stop::beside(server).unwrap_or_default();
    host.starts_with("127.") || host.starts_with("localhost:") || host.starts_with("[::1]")
}

/// What is run on the robot by a shell: the secret goes by the environment, where other users of the machine do not see it. Where stops are is said if it is not the usual port of the server.
fn line(robot_id: &str, server: &str, stop_server: Option<&str>, secret: &str) -> String {
    let stops = stop_server.map_or_else(String::new, |address| format!(" --stop-server {address}"));
    format!(
        "MIDSHIFT_ENROLL={secret} midshift agent run --robot-id {robot_id} --server {server}{stops} --data midshift-{robot_id}"
    )
}

/// Takes a robot's key out.
pub async fn revoke(call: &Call, robot_id: String, out: &Out) -> Result<(), Exit> {
    let revoked = call.identity().await?.revoke_robot(unary(v1::RevokeRobotRequest { robot_id })).await?.into_inner();
    let robot = revoked.robot.clone().unwrap_or_default();
    out.one(&revoked, &robot.robot_id, || format!("{} is let in nowhere until it is enrolled anew", robot.robot_id))?;
    out.next(
        "it stands when its silence ladder says so; its places stay taken until it reports or a person clears them",
    );
    Ok(())
}

/// Lists who is enrolled.
pub async fn list(call: &Call, out: &Out) -> Result<(), Exit> {
    let mut client = call.identity().await?;
    let mut asked = v1::ListRobotIdentitiesRequest { page_size: 1_000, ..Default::default() };
    let mut all = v1::ListRobotIdentitiesResponse::default();
    loop {
        let page = client.list_robot_identities(unary(asked.clone())).await?.into_inner();
        all.robots.extend(page.robots);
        if page.next_page_token.is_empty() {
            break;
        }
        asked.page_token = page.next_page_token;
    }
    let at =
        |time: &Option<prost_types::Timestamp>| time.as_ref().map_or_else(|| "-".to_owned(), |t| time_of(t).rfc3339());
    let row = |robot: &v1::RobotIdentity| {
        let state = match (robot.key_sha256.is_empty(), &robot.revoke_time, &robot.enrolment_expire_time) {
            (false, _, Some(_)) => "enrolled, replacement open".to_owned(),
            (false, _, None) => "enrolled".to_owned(),
            (true, _, Some(_)) => "waits for its machine".to_owned(),
            (true, Some(_), None) => format!("revoked by {}", robot.revoked_by),
            (true, None, None) => "never enrolled".to_owned(),
        };
        vec![robot.robot_id.clone(), state, at(&robot.enrol_time), at(&robot.expire_time)]
    };
    Ok(out.many(&all, &all.robots, |r| r.robot_id.clone(), &["ROBOT", "STATE", "SINCE", "CERTIFICATE UNTIL"], row)?)
}

#[cfg(test)]
mod tests {
    use super::line;
    use crate::robots::AgentRun;
    use clap::{Args, FromArgMatches};

    #[test]
    fn the_line_of_a_robot_is_taken_as_it_is_printed() {
        let printed = line("r7", "hub:7420", Some("hub:18421"), "mse.ID.SECRET.DIGEST");
        let (secret, words) = printed.split_once(" midshift agent run ").expect("an assignment and a command");
        let command = AgentRun::augment_args(clap::Command::new("run"));
        let variable = command.get_arguments().find(|a| a.get_id() == "enroll").and_then(clap::Arg::get_env);
        assert_eq!(variable.and_then(|name| name.to_str()), secret.strip_suffix("=mse.ID.SECRET.DIGEST"));
        let taken = command.try_get_matches_from(["run"].into_iter().chain(words.split(' ')));
        let taken = AgentRun::from_arg_matches(&taken.expect("words that are known")).expect("its arguments");
        assert_eq!((taken.robot_id.as_str(), taken.server.as_str()), ("r7", "hub:7420"));
        assert_eq!(taken.stop.stop_server.as_deref(), Some("hub:18421"));
    }

    #[test]
    fn the_line_of_a_robot_says_where_stops_are_if_its_site_has_them_elsewhere() {
        assert!(!line("r7", "hub:7420", None, "s").contains("--stop-server"));
        assert!(line("r7", "hub:7420", Some("hub:18421"), "s").contains(" --server hub:7420 --stop-server hub:18421 "));
    }
}
