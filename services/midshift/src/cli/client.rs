//! Calls of the command line: which server, what an error means for a person and for the exit code.

use crate::cli::out::Out;
use crate::robots::uri;
use midshift_bundle::build;
use midshift_bundle::folder::Error;
use midshift_core::reason::{Kind, Refusal};
use midshift_proto::convert::time_of;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::identity::v1::audit_service_client::AuditServiceClient;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::sim::v1::sim_service_client::SimServiceClient;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use std::ops::ControlFlow;
use std::process::ExitCode;
use std::time::Duration;
use tokio::time::Instant;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status, Streaming};
use tonic_health::pb::health_client::HealthClient;

/// A server that does not answer a connection within this is not there.
const CONNECT_WITHIN: Duration = Duration::from_secs(3);
/// Longest unary call.
const CALL_WITHIN: Duration = Duration::from_secs(30);
/// A server that is gone while something is followed may stay away so long.
const AWAY_MAX: Duration = Duration::from_secs(600);
/// Pauses between looks for it.
const PAUSE_MIN: Duration = Duration::from_millis(250);
const PAUSE_MAX: Duration = Duration::from_secs(5);

/// What a server says to a call that it does not know.
const NOT_THERE: &str = "this server does not know the call\n  try: faults and worlds are with `midshift dev` or `midshift sim run --listen`; \
     for anything else look at the server's version";

/// Which server.
#[derive(Clone, Debug, clap::Args)]
pub struct Call {
    /// The server, host:port.
    #[arg(long, env = "MIDSHIFT_SERVER", default_value = "127.0.0.1:7420")]
    pub server: String,
}

/// An end that is not success.
#[derive(Debug)]
pub struct Exit {
    code: u8,
    text: String,
}

impl Exit {
    /// With a code of the list in the README.
    pub fn new(code: u8, text: impl Into<String>) -> Self {
        Self { code, text: text.into() }
    }
    /// Bad arguments.
    pub fn usage(text: impl Into<String>) -> Self {
        Self::new(2, text)
    }
    /// The code.
    pub fn code(&self) -> u8 {
        self.code
    }
    /// The same end with the facts that the server sent beside its sentence: which roll-out, how many robots for which reason.
    pub fn with_facts(status: Status) -> Self {
        let facts = midshift_proto::refusal_of(&status).metadata;
        let mut exit = Self::from(status);
        let told: String = facts.iter().map(|(key, value)| format!("\n  {key}: {value}")).collect();
        let at = exit.text.find("\n  try: ").unwrap_or(exit.text.len());
        exit.text.insert_str(at, &told);
        exit
    }
    /// The same end with one more thing to try.
    pub fn or_try(mut self, what: &str) -> Self {
        self.text += &format!("\n  try: {what}");
        self
    }
    /// What was looked at does not hold: a finding, not a mistake of the caller.
    pub fn of_finding(error: Error) -> Self {
        match error {
            Error::Refused(refusal) | Error::Bundle(build::Error::Refused(refusal)) => {
                let lines = refusal.violations.iter().map(|v| format!("\n  {}: {}", v.field, v.description));
                Self::new(1, format!("it does not hold:{}", lines.collect::<String>()))
            }
            other => other.into(),
        }
    }
    /// Says why and gives the code.
    pub fn report(&self, out: &Out) -> ExitCode {
        out.say(&format!("error: {}", self.text));
        ExitCode::from(self.code)
    }
}

/// What was asked breaks rules, or could not be done.
impl From<Error> for Exit {
    fn from(error: Error) -> Self {
        match error {
            Error::Refused(refusal) | Error::Bundle(build::Error::Refused(refusal)) => {
                anyhow::Error::from(refusal).into()
            }
            other => Self::new(1, other.to_string()),
        }
    }
}

impl std::fmt::Display for Exit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.text)
    }
}

impl From<anyhow::Error> for Exit {
    fn from(error: anyhow::Error) -> Self {
        if let Some(refusal) = error.downcast_ref::<Refusal>().filter(|r| r.kind() == Kind::Invalid) {
            let violations = refusal.violations.iter().map(|v| (v.field.as_str(), v.description.as_str()));
            return Self::new(2, broken_rules(violations).unwrap_or_else(|| refusal.to_string()));
        }
        match error.downcast::<Status>() {
            Ok(status) => status.into(),
            Err(error) => Self::new(1, format!("{error:#}")),
        }
    }
}

/// Each rule that a request breaks, on a line of its own; none of none.
fn broken_rules<'a>(violations: impl ExactSizeIterator<Item = (&'a str, &'a str)>) -> Option<String> {
    let headline = match violations.len() {
        0 => return None,
        1 => "the request breaks a rule".to_owned(),
        rules => format!("the request breaks {rules} rules"),
    };
    Some(violations.fold(headline, |text, (field, description)| format!("{text}\n  {field}: {description}")))
}

impl From<Status> for Exit {
    fn from(status: Status) -> Self {
        let answer = midshift_proto::refusal_of(&status);
        let code = match status.code() {
            Code::InvalidArgument | Code::OutOfRange => 2,
            Code::NotFound => 4,
            Code::Unavailable => 5,
            Code::PermissionDenied | Code::Unauthenticated => 6,
            Code::Aborted | Code::AlreadyExists | Code::FailedPrecondition => 9,
            Code::DeadlineExceeded => 10,
            _ => 1,
        };
        let violations = answer.violations.iter().map(|v| (v.field.as_str(), v.description.as_str()));
        let mut text = broken_rules(violations).unwrap_or_else(|| match status.message() {
            _ if status.code() == Code::Unimplemented => NOT_THERE.to_owned(),
            "" => status.code().to_string(),
            message => message.to_owned(),
        });
        // What to try next, unless the message said it already.
        if let Some(help) = answer.help().filter(|help| answer.violations.is_empty() && !text.contains(*help)) {
            text += &format!("\n  try: {help}");
        }
        Self::new(code, text)
    }
}

/// Takes the messages of a stream until `take` breaks, through restarts of the server: a stream that was cut is opened again, and says
/// again what is known then. `take` is given nothing when the server ended the stream in order.
///
/// # Errors
/// What `open` says the first time; what `take` says; a refusal; a server that stays away longer than [`AWAY_MAX`].
pub async fn follow<T, B>(
    out: &Out,
    open: impl AsyncFn() -> Result<Streaming<T>, Exit>,
    mut take: impl FnMut(Option<T>) -> Result<ControlFlow<B>, Exit>,
) -> Result<B, Exit> {
    let mut stream = open().await?;
    loop {
        let message = match stream.message().await {
            Ok(message) => message,
            Err(status) if was_cut(&status) => None,
            Err(status) => return Err(Exit::with_facts(status)),
        };
        let is_cut = message.is_none();
        if let ControlFlow::Break(end) = take(message)? {
            return Ok(end);
        }
        if is_cut {
            out.say("the server ended the stream; waiting until it is back");
            stream = again(&open).await?;
        }
    }
}

/// The connection is gone, and with it what the answer would have been.
fn was_cut(status: &Status) -> bool {
    matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled | Code::Internal)
}

/// Opens a stream as soon as there is a server for it.
async fn again<T>(open: &impl AsyncFn() -> Result<Streaming<T>, Exit>) -> Result<Streaming<T>, Exit> {
    let begun = Instant::now();
    let mut pause = PAUSE_MIN;
    loop {
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(PAUSE_MAX);
        match open().await {
            Err(exit) if exit.code == 5 && begun.elapsed() < AWAY_MAX => {}
            opened => return opened,
        }
    }
}

impl Call {
    async fn channel(&self) -> Result<Channel, Exit> {
        let endpoint = Endpoint::from_shared(uri(&self.server))
            .map_err(|e| Exit::usage(format!("--server {}: {e}", self.server)))?;
        endpoint.connect_timeout(CONNECT_WITHIN).connect().await.map_err(|_| {
            Exit::new(
                5,
                format!(
                    "no server at {}\n  try: start one with `midshift dev`, or name another with --server",
                    self.server
                ),
            )
        })
    }
    /// Task intake.
    pub async fn task(&self) -> Result<TaskServiceClient<Channel>, Exit> {
        Ok(TaskServiceClient::new(self.channel().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Fleet.
    pub async fn fleet(&self) -> Result<FleetServiceClient<Channel>, Exit> {
        Ok(FleetServiceClient::new(self.channel().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Telemetry.
    pub async fn telemetry(&self) -> Result<TelemetryServiceClient<Channel>, Exit> {
        Ok(TelemetryServiceClient::new(self.channel().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Releases of software.
    pub async fn bundles(&self) -> Result<BundleServiceClient<Channel>, Exit> {
        Ok(BundleServiceClient::new(self.channel().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Roll-outs of software.
    pub async fn rollouts(&self) -> Result<RolloutServiceClient<Channel>, Exit> {
        Ok(RolloutServiceClient::new(self.channel().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Who decided what.
    pub async fn audit(&self) -> Result<AuditServiceClient<Channel>, Exit> {
        Ok(AuditServiceClient::new(self.channel().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Whether it serves.
    pub async fn health(&self) -> Result<HealthClient<Channel>, Exit> {
        Ok(HealthClient::new(self.channel().await?))
    }
    /// Faults of the simulator.
    pub async fn sim(&self) -> Result<SimServiceClient<Channel>, Exit> {
        Ok(SimServiceClient::new(self.channel().await?))
    }
}

/// A unary request with its deadline on the wire.
pub fn unary<T>(message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.set_timeout(CALL_WITHIN);
    request
}

/// What comes after a check that found nothing against it.
pub const WOULD: &str = "the same without --dry-run does it";

/// What is said where a call with the same request_id did it before; none: there was none.
pub fn done_before(at: Option<&prost_types::Timestamp>, change: DryRun) -> Option<String> {
    let does = match change {
        DryRun::Yes => "the same without --dry-run does nothing more",
        DryRun::No => "this one changed nothing",
    };
    at.map(|at| format!("it was done at {} under this --request-id: {does}", time_of(at).rfc3339()))
}

/// Says how a command ended that takes a request_id: that it was done before, that it would be done, or what comes `next`, if anything.
pub fn ended(done: Option<&prost_types::Timestamp>, change: DryRun, next: &str, out: &Out) {
    match (done_before(done, change), change) {
        (Some(told), _) => out.say(&told),
        (None, DryRun::Yes) => out.next(WOULD),
        (None, DryRun::No) if next.is_empty() => {}
        (None, DryRun::No) => out.next(next),
    }
}

/// Whether something was only checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DryRun {
    /// Nothing changes.
    Yes,
    /// It is done.
    No,
}

/// What every verb that changes something takes.
#[derive(Clone, Debug, clap::Args)]
pub struct Change {
    /// Check only; nothing changes.
    #[arg(long)]
    pub dry_run: bool,
    /// Protects against a double call: the same id and content are one request.
    #[arg(long, default_value = "")]
    pub request_id: String,
}

impl Change {
    /// Whether it is only checked.
    pub fn only(&self) -> DryRun {
        if self.dry_run { DryRun::Yes } else { DryRun::No }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_that_was_done_before_under_its_request_id_is_not_said_to_be_done_by_another_call() {
        let at = prost_types::Timestamp::default();
        assert_eq!(done_before(None, DryRun::Yes), None);
        let said = [DryRun::Yes, DryRun::No].map(|only| done_before(Some(&at), only).expect("it was done"));
        assert!(said.iter().all(|said| said.starts_with("it was done at 1970-01-01T00:00:00")), "{said:?}");
        assert!(said[0].ends_with("does nothing more") && said[1].ends_with("changed nothing"), "{said:?}");
    }
}
