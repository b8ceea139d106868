//! `midshift robot enroll|replace|revoke|identities`: which machine is which robot.

use super::client::{Call, Exit, unary};
use super::lookup::{self, Found, whole_id};
use super::out::Out;
use super::pages::{self, Listed, PAGE_SIZE};
use crate::stop_service;
use midshift_agent::program::ENROLL;
use midshift_core::site::{self, text};
use midshift_proto::convert::time_of;
use midshift_proto::identity::v1;

/// Which machine is to be which robot.
#[derive(clap::Args)]
pub struct Machine {
    #[command(flatten)]
    call: Call,
    /// Its name.
    robot_id: String,
    /// Where robots dial in, host:port, if not at the server that is asked: of a site in several processes the door of robots.
    #[arg(long, value_name = "ADDR")]
    link_server: Option<String>,
    /// Where machines are enrolled, host:port, if not at the server that is asked.
    #[arg(long, value_name = "ADDR")]
    identity_server: Option<String>,
    /// The site file on the robot's machine, on which a simulated body lives. Without it the built-in demo site.
    #[arg(long, value_name = "FILE")]
    site: Option<String>,
}

/// Hands out a secret, and the line that uses it.
pub async fn offer(machine: Machine, replace: bool, out: &Out) -> Result<(), Exit> {
    let call = &machine.call;
    let asked = v1::CreateEnrolmentRequest { robot_id: machine.robot_id.clone(), replace };
    let offered = call.identity().await?.create_enrolment(unary(asked)).await?.into_inner();
    let resolved = call.resolved()?;
    let (server, said) = (call.address()?, resolved.site().await);
    let unusual = || said.as_ref().and_then(|said| said.unusual_stop_server(&server));
    let stop_server = resolved.stop_server.clone().or_else(unusual);
    let line = || machine.line(&server, stop_server.as_deref(), &offered.secret);
    out.one(&offered, &offered.secret, line)?;
    let other_site = said.map(|said| said.site_id).filter(|site_id| machine.site.is_none() && !is_demo(site_id));
    if let Some(site_id) = other_site {
        out.inform(&format!(
            "warning: a simulated body lives on the built-in demo site, and this one is {site_id}; --site FILE puts its file into the line"
        ));
    }
    let until = offered.expire_time.as_ref().map_or_else(String::new, |time| time_of(time).rfc3339());
    if is_loopback(&server) {
        out.inform(&format!(
            "warning: {server} is this machine; on another one put an address there under which it finds the server"
        ));
    }
    out.next(&format!("run it on the robot, once, before {until}; the secret is shown once"));
    Ok(())
}

/// Whether a server is only found from its own machine.
fn is_loopback(server: &str) -> bool {
    let host = stop_service::beside(server).unwrap_or_default();
    host.starts_with("127.") || host.starts_with("localhost:") || host.starts_with("[::1]")
}

fn is_demo(site_id: &str) -> bool {
    text::parse(site::DEMO).is_ok_and(|demo| demo.site_id().as_str() == site_id)
}

impl Machine {
    /// Whom it is asked of.
    pub const fn call(&self) -> &Call {
        &self.call
    }
    /// Its name.
    pub fn robot_id(&self) -> &str {
        &self.robot_id
    }

    /// What is run on the robot by a shell: the secret goes by the environment, where other users of the machine do not see it. Where stops are is said if it is not
    /// the usual port of the server, and where identities are if robots dial in elsewhere.
    pub fn line(&self, server: &str, stop_server: Option<&str>, secret: &str) -> String {
        let robot_id = &self.robot_id;
        let link = self.link_server.as_deref().unwrap_or(server);
        let identity = self.identity_server.as_deref().unwrap_or(server);
        let identity = (identity != link).then_some(identity);
        let more = [("--identity-server", identity), ("--stop-server", stop_server), ("--site", self.site.as_deref())];
        let more: String =
            more.iter().filter_map(|(flag, word)| Some(format!(" {flag} {}", quoted((*word)?)))).collect();
        let link = quoted(link);
        format!(
            "{ENROLL}={secret} midshift agent run --robot-id {robot_id} --server {link}{more} --data midshift-{robot_id}"
        )
    }
}

/// A word as a shell takes it.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:@[]".contains(c);
    if word.chars().all(is_plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

/// Takes a robot's key out.
pub async fn revoke(call: &Call, typed: &str, reason: String, out: &Out) -> Result<(), Exit> {
    let robot_id = find(call, typed).await?;
    let request = v1::RevokeRobotRequest { robot_id, reason };
    let revoked = call.identity().await?.revoke_robot(unary(request)).await?.into_inner();
    let robot = revoked.robot.clone().unwrap_or_default();
    out.one(&revoked, &robot.robot_id, || format!("{} is let in nowhere until it is enrolled anew", robot.robot_id))?;
    out.next(
        "it stands when its silence ladder says so; its places stay taken until it reports or a person clears them",
    );
    Ok(())
}

/// The whole id of a robot that may be enrolled, whether or not it was ever heard.
async fn find(call: &Call, typed: &str) -> Result<String, Exit> {
    let mut client = call.identity().await?;
    let listed = async {
        let (page_size, robot_id_prefix) = (lookup::SHOWN, typed.to_owned());
        let request = v1::ListRobotIdentitiesRequest { page_size, robot_id_prefix, page_token: String::new() };
        let page = client.list_robot_identities(unary(request)).await?.into_inner();
        Ok(Found::page(&page, |robot| vec![state(robot)]))
    };
    whole_id("robot", typed, listed).await
}

fn state(robot: &v1::RobotIdentity) -> String {
    match (robot.key_sha256.is_empty(), &robot.revoke_time, &robot.enrolment_expire_time) {
        (false, _, Some(_)) => "enrolled, replacement open".to_owned(),
        (false, _, None) => "enrolled".to_owned(),
        (true, _, Some(_)) => "waits for its machine".to_owned(),
        (true, Some(at), None) => format!("revoked by {} at {}", robot.revoked_by, time_of(at).rfc3339()),
        (true, None, None) => "never enrolled".to_owned(),
    }
}

/// Lists who is enrolled.
pub async fn list(call: &Call, out: &Out) -> Result<(), Exit> {
    let mut client = call.identity().await?;
    let read = async |page_token| {
        let request = v1::ListRobotIdentitiesRequest { page_size: PAGE_SIZE, page_token, ..Default::default() };
        client.list_robot_identities(unary(request)).await
    };
    Ok(out.list(&pages::all(read).await?)?)
}

impl Listed for v1::RobotIdentity {
    const HEADER: &'static [&'static str] = &["ROBOT", "STATE", "SINCE", "CERTIFICATE UNTIL"];
    fn name(&self) -> String {
        self.robot_id.clone()
    }
    fn row(&self) -> Vec<String> {
        let at = |time: &Option<prost_types::Timestamp>| {
            time.as_ref().map_or_else(|| "-".to_owned(), |t| time_of(t).rfc3339())
        };
        vec![self.robot_id.clone(), state(self), at(&self.enrol_time), at(&self.expire_time)]
    }
}

#[cfg(test)]
mod tests {
    use super::{Call, Machine, quoted};

    fn machine() -> Machine {
        let call = Call::to("hub:7420".to_owned());
        Machine { call, robot_id: "r7".to_owned(), link_server: None, identity_server: None, site: None }
    }

    #[test]
    fn the_line_of_a_robot_says_where_stops_are_if_its_site_has_them_elsewhere() {
        assert!(!machine().line("hub:7420", None, "s").contains("--stop-server"));
        let printed = machine().line("hub:7420", Some("hub:18421"), "s");
        assert!(printed.contains(" --server hub:7420 --stop-server hub:18421 "), "{printed}");
    }

    #[test]
    fn a_word_with_a_blank_or_a_quote_is_one_word_of_the_shell() {
        for word in ["plain-1.toml", "my hall.toml", "it's", "$HOME"] {
            let echoed = std::process::Command::new("sh").args(["-c", &format!("printf %s {}", quoted(word))]).output();
            assert_eq!(echoed.expect("a shell").stdout, word.as_bytes(), "{word}");
        }
    }
}
