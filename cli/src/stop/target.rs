//! Finds the stop service that is meant: its address, and the site that it must be of.
//!
//! Invariant: what is known without asking is used without asking: a named address or a context costs no time. A guessed address is used only where a person types, who
//! is shown the site first. The stop service itself refuses whoever means another site.

use crate::client::{ANSWER_BYTES_MAX, Exit, Login, Resolved, unary};
use crate::door::Found;
use crate::endpoint::Line;
use crate::out::Out;
use crate::site_answer::SiteAnswer;
use crate::stop_service;
use clap::Args;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use std::io::IsTerminal;
use std::time::Duration;
use tokio::time::timeout;

/// A server has so long to say where its stop service is, and a stop service to say its site: a stop must not wait for longer.
const SAID_WITHIN: Duration = Duration::from_secs(1);
/// Dialed so often before it is said that there is none.
const DIALS: u32 = 4;
/// Between two of them.
pub const AGAIN_AFTER: Duration = Duration::from_millis(200);

/// Which stop service, and as whom.
#[derive(Clone, Debug, Args)]
pub struct StopCall {
    /// The business server, host:port, which says where the stop service is. Without it that of the context, or 127.0.0.1:7420.
    #[arg(long, env = "MIDSHIFT_SERVER")]
    server: Option<String>,
    /// The stop service, host:port. A script without a context names it: it must not depend on the server.
    #[arg(long, env = "MIDSHIFT_STOP_SERVER", value_name = "HOST:PORT")]
    stop_server: Option<String>,
    /// As whom.
    #[command(flatten)]
    login: Login,
}

/// Who gives the command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Giver {
    /// Somebody at a terminal, who reads what is shown.
    Person,
    /// A program.
    Script,
}

impl Giver {
    fn of_process() -> Self {
        match std::io::stdin().is_terminal() && std::io::stderr().is_terminal() {
            true => Self::Person,
            false => Self::Script,
        }
    }
}

/// The stop service that is meant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Target {
    /// Where it listens, as `host:port`.
    pub address: String,
    /// The site that it must be of. Empty: nobody has said.
    pub site_id: String,
}

/// The host of the server with the usual port of a stop service, or with this one.
fn beside(server: &str, port: Option<u16>) -> Result<String, Exit> {
    let beside = stop_service::beside_on(server, port.unwrap_or(stop_service::PORT));
    beside.ok_or_else(|| Exit::usage(format!("--server {server} names no host")))
}

/// Where the stop service is as far as nobody has to be asked: as it was named, as the context has it, or on the host of the server.
pub fn address(named: Option<&str>, resolved: &Resolved) -> Result<String, Exit> {
    match named.or(resolved.stop_server.as_deref()) {
        Some(stop_server) => Ok(stop_server.to_owned()),
        None => beside(&resolved.server, None),
    }
}

/// Decides which one is meant. `said`: what the server says of its site, if it was asked and has answered in time.
fn decide(named: Option<&str>, resolved: &Resolved, said: Option<SiteAnswer>, giver: Giver) -> Result<Target, Exit> {
    let address = address(named, resolved)?;
    if is_known(named, resolved) {
        return Ok(Target { address, site_id: resolved.site_id.clone().unwrap_or_default() });
    }
    match (said, giver) {
        (Some(said), _) => Ok(Target { address: beside(&resolved.server, said.stop_port)?, site_id: said.site_id }),
        (None, Giver::Person) => Ok(Target { address, site_id: String::new() }),
        (None, Giver::Script) => Err(Exit::usage(format!(
            "nobody says which stop service is meant: no address was named, nobody has signed in, and the server at {} has not answered within {} s. Nothing was stopped or reset\n  try: the same with --stop-server {address}, if that is the one",
            resolved.server,
            SAID_WITHIN.as_secs()
        ))),
    }
}

/// Whether the address is known without asking anybody.
fn is_known(named: Option<&str>, resolved: &Resolved) -> bool {
    named.is_some() || resolved.from_context
}

impl StopCall {
    /// Finds it; a person who types is shown the site, if only the stop service itself can say it.
    pub async fn target(&self, out: &Out) -> Result<Target, Exit> {
        let (resolved, named) = (self.resolved()?, self.stop_server.as_deref());
        let giver = Giver::of_process();
        let said = match is_known(named, &resolved) {
            true => None,
            false => timeout(SAID_WITHIN, resolved.site()).await.ok().flatten(),
        };
        let mut target = decide(named, &resolved, said, giver)?;
        if target.site_id.is_empty() && giver == Giver::Person {
            target.site_id = timeout(SAID_WITHIN, self.named(&target)).await.ok().flatten().unwrap_or_default();
            let site = if target.site_id.is_empty() { "a site that it does not name" } else { &target.site_id };
            out.inform(&format!("the stop service at {} is that of {site}", target.address));
        }
        Ok(target)
    }

    fn resolved(&self) -> Result<Resolved, Exit> {
        self.login.resolve(self.server.as_deref())
    }

    /// The site that the stop service itself names.
    async fn named(&self, target: &Target) -> Option<String> {
        let mut client = self.client(target).await.ok()?;
        let answer = client.get_status(unary(v1::GetStatusRequest {})).await.ok()?.into_inner();
        answer.status.map(|status| status.site_id)
    }

    /// A connection to it that stands.
    pub async fn client(&self, target: &Target) -> Result<StopServiceClient<Line>, Exit> {
        let address = &target.address;
        let (endpoint, mut tries) = (self.resolved()?.endpoint(address)?, DIALS);
        let line = loop {
            tries -= 1;
            match endpoint.connect().await {
                Ok(line) => break line,
                Err(error) if tries == 0 => return Err(nobody(address, &*error.0)),
                Err(error) if Found::by(&*error.0) == Found::Silence => return Err(nobody(address, &*error.0)),
                // One that ends lets go of whoever has just come; the next one is there within moments.
                Err(_) => tokio::time::sleep(AGAIN_AFTER).await,
            }
        };
        Ok(StopServiceClient::new(line).max_decoding_message_size(ANSWER_BYTES_MAX))
    }
}

/// There is no way to it, and why: nothing listens, a certificate that is not of the site, plain text where TLS is spoken.
fn nobody(address: &str, error: &(dyn std::error::Error + 'static)) -> Exit {
    let causes = std::iter::successors(error.source(), |cause| cause.source());
    let why = causes.last().map_or_else(|| error.to_string(), ToString::to_string);
    let found = Found::by(error);
    let help = found.help().and_then(|help| help.split_once("\n  try: ")).map(|(_, help)| format!("{help}; or "));
    let text = format!(
        "no stop service at {address} ({why}): nothing was stopped or reset. Use the robots' own emergency stops if you must\n  try: {}name it with --stop-server, or start one with `midshift-stop`",
        help.unwrap_or_default()
    );
    Exit::new(found.exit_code(), text)
}

/// A status that comes from another stop service than the one that is meant.
pub fn is_of(target: &Target, status: &v1::Status) -> Result<(), Exit> {
    if target.site_id.is_empty() || target.site_id == status.site_id {
        return Ok(());
    }
    let Target { address, site_id } = target;
    let text = format!(
        "the stop service at {address} is that of site {}, not of {site_id}\n  try: name the right one with --stop-server, or sign in to that site",
        status.site_id
    );
    Err(Exit::new(9, text))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(site_id: &str, stop_port: Option<u16>) -> Option<SiteAnswer> {
        Some(SiteAnswer { site_id: site_id.to_owned(), stop_port })
    }

    fn remembered(stop_server: Option<&str>) -> Resolved {
        let mut resolved = Resolved::plain("fleet.local:9000");
        (resolved.stop_server, resolved.site_id) = (stop_server.map(str::to_owned), Some("north".to_owned()));
        resolved.from_context = true;
        resolved
    }

    fn found(target: Result<Target, Exit>) -> (String, String) {
        target.map(|target| (target.address, target.site_id)).unwrap_or_else(|exit| panic!("{exit}"))
    }

    fn at(address: &str, site_id: &str) -> (String, String) {
        (address.to_owned(), site_id.to_owned())
    }

    #[test]
    fn the_address_and_the_site_of_stops_come_from_the_context_then_the_server_then_the_stop_service() {
        for giver in [Giver::Person, Giver::Script] {
            let decided = |named, resolved: &Resolved, said| found(decide(named, resolved, said, giver));
            assert_eq!(decided(None, &remembered(None), None), at("fleet.local:7421", "north"));
            assert_eq!(decided(None, &remembered(Some("hub:1")), said("south", None)), at("hub:1", "north"));
            assert_eq!(decided(Some("b:2"), &remembered(Some("hub:1")), None), at("b:2", "north"), "B must be north");
            let plain = Resolved::plain("[::1]:7420");
            assert_eq!(decided(Some("b:2"), &plain, None), at("b:2", ""), "a wall panel names its own");
            assert_eq!(decided(None, &plain, said("south", Some(9))), at("[::1]:9", "south"));
            assert_eq!(decided(None, &plain, said("south", None)), at("[::1]:7421", "south"));
        }
        assert_eq!(found(decide(None, &Resolved::plain("h:1"), None, Giver::Person)), at("h:7421", ""));
    }

    #[test]
    fn a_script_whose_server_says_nothing_is_told_the_line_to_type() {
        let refused = decide(None, &Resolved::plain("h:7420"), None, Giver::Script).expect_err("no address");
        assert_eq!(refused.code(), 2);
        assert!(
            refused.to_string().ends_with("try: the same with --stop-server h:7421, if that is the one"),
            "{refused}"
        );
    }

    #[test]
    fn the_stop_service_is_on_the_host_of_the_server_unless_it_is_named() {
        let call = |server, stop_server| address(stop_server, &Resolved::plain(server)).expect("an address");
        assert_eq!(call("127.0.0.1:7420", None), "127.0.0.1:7421");
        assert_eq!(call("http://fleet.local:9000", None), "fleet.local:7421");
        assert_eq!(call("[::1]:7420", None), "[::1]:7421");
        assert_eq!(call("fleet.local:7420", Some("other:1")), "other:1");
    }

    #[test]
    fn the_status_of_another_site_is_not_shown_as_that_of_the_one_that_is_meant() {
        let status = |site_id: &str| v1::Status { site_id: site_id.to_owned(), ..v1::Status::default() };
        let target = |site_id: &str| Target { address: "b:2".to_owned(), site_id: site_id.to_owned() };
        assert!(is_of(&target("north"), &status("north")).is_ok() && is_of(&target(""), &status("south")).is_ok());
        assert_eq!(is_of(&target("north"), &status("south")).map_err(|exit| exit.code()), Err(9));
    }

    #[test]
    fn why_there_is_no_way_to_a_stop_service_is_told() {
        let cause = std::io::Error::other("invalid peer certificate: UnknownIssuer");
        let error = anyhow::Error::from(cause).context("transport error").into_boxed_dyn_error();
        let said = nobody("host:7421", &*error).to_string();
        assert!(said.contains("at host:7421 (invalid peer certificate: UnknownIssuer): nothing"), "{said}");
        let said = nobody("host:7421", &std::io::Error::other("refused")).to_string();
        assert!(said.contains("(refused)"), "{said}");
    }
}
