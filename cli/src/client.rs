//! Calls of the command line: which server, what an error means for a person and for the exit code.

use crate::contexts::{Contexts, Unknown};
use crate::door::Found;
use crate::out::Out;
use crate::site_answer::SiteAnswer;
use crate::way::{Line, Way};
use midshift_bundle::build;
use midshift_bundle::folder::Error;
use midshift_core::reason::{self, Kind, Refusal};
use midshift_proto::convert::time_of;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::identity::v1::audit_service_client::AuditServiceClient;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::sim::v1::sim_service_client::SimServiceClient;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use std::io::ErrorKind;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;
use tokio::time::Instant;
use tonic::{Code, Request, Status, Streaming};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// Longest unary call.
const CALL_WITHIN: Duration = Duration::from_secs(30);
/// A server that says nothing for so long on a new connection hangs, or is none.
const SAID_WITHIN: Duration = Duration::from_secs(5);
/// Exit code of a server that is not there.
const NO_SERVER: u8 = 5;
/// Exit code of what nobody reads any more, as of a program that SIGPIPE has ended.
const UNREAD: u8 = 141;
/// A server that is gone while something is followed may stay away so long.
const AWAY_MAX: Duration = Duration::from_secs(600);
/// Pauses between looks for it.
const PAUSE_MIN: Duration = Duration::from_millis(250);
const PAUSE_MAX: Duration = Duration::from_secs(5);

/// What a server says to a call that it does not know.
const NOT_THERE: &str = "this server does not know the call\n  try: look at the port: stops are at 7421, everything else is at 7420. Faults and worlds are with `midshift dev` or \
     `midshift sim run --listen`; for anything else look at the server's version";

/// What is said of a server that takes a call and does not answer.
const LATE: &str = "the server took the connection and has not answered in time\n  try: look at that process: it may hang, or be no midshift at all. What was asked may have been done: ask \
     again with the same --request-id";

/// What a connection says that ended before anything was answered.
const BROKE_OFF: &str = "the server broke the connection off before it answered\n  try: sign in, if it speaks TLS: midshift login SERVER --pin DIGEST, with the \
     digest that it printed at its first start";

/// Which server, and as whom.
#[derive(Clone, Debug, clap::Args)]
pub struct Call {
    /// The server, host:port. Without it that of the context, or 127.0.0.1:7420.
    #[arg(long, env = "MIDSHIFT_SERVER")]
    server: Option<String>,
    /// As whom.
    #[command(flatten)]
    login: Login,
}

/// As whom a server is asked.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Login {
    /// Which of the remembered sites (`midshift context ls`). Without it the current one.
    #[arg(long, env = "MIDSHIFT_CONTEXT", value_name = "NAME")]
    context: Option<String>,
    /// The site's root certificate, PEM. Without it that of the context; where there is neither, plain text.
    #[arg(long, env = "MIDSHIFT_CA", value_name = "FILE")]
    ca: Option<PathBuf>,
    /// Where the token is. Without it MIDSHIFT_TOKEN, or that of the context.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

/// Where the business server is if nobody says otherwise.
const SERVER: &str = "127.0.0.1:7420";

/// What flags, environment and context come to.
pub struct Resolved {
    /// The server, host:port.
    pub server: String,
    /// The stop service, host:port, if the context names one.
    pub stop_server: Option<String>,
    /// The site, if the context says so.
    pub site_id: Option<String>,
    /// A context stands behind these.
    pub from_context: bool,
    authority_pem: Option<String>,
    token: Option<String>,
}

impl Login {
    /// With `server` if it was named. A context stands for its own server alone: another one gets neither its root nor its token.
    pub fn resolve(&self, server: Option<&str>) -> Result<Resolved, Exit> {
        let contexts = Contexts::read()?;
        let known = contexts.pick(self.context.as_deref())?;
        let known = known.filter(|known| server.is_none_or(|server| server == known.server) || self.context.is_some());
        let read = |file: &PathBuf| {
            std::fs::read_to_string(file).map_err(|error| Exit::usage(format!("reading {}: {error}", file.display())))
        };
        let from_environment = || std::env::var("MIDSHIFT_TOKEN").ok().filter(|token| !token.is_empty());
        let token = match &self.token_file {
            Some(file) => Some(read(file)?),
            None => from_environment().or_else(|| known.map(|known| known.token.clone())),
        };
        let authority_pem = match &self.ca {
            Some(file) => Some(read(file)?),
            None => known.map(|known| known.authority_pem.clone()),
        };
        let server = server.map(str::to_owned).or_else(|| known.map(|known| known.server.clone()));
        Ok(Resolved {
            server: server.unwrap_or_else(|| SERVER.to_owned()),
            stop_server: known.and_then(|known| known.stop_server.clone()),
            site_id: known.and_then(|known| known.site_id.clone()),
            from_context: known.is_some(),
            authority_pem,
            token,
        })
    }
}

impl Resolved {
    /// A server in plain text, without a context.
    #[cfg(test)]
    pub fn plain(server: &str) -> Self {
        let (stop_server, site_id, authority_pem, token) = (None, None, None, None);
        Self { server: server.to_owned(), stop_server, site_id, from_context: false, authority_pem, token }
    }
    /// Whether a root is known.
    pub const fn is_secure(&self) -> bool {
        self.authority_pem.is_some()
    }
    /// What the server says of its site; none: it does not answer, or says nothing. Waits for as long as a call may take.
    pub async fn site(&self) -> Option<SiteAnswer> {
        site_of(self.way(&self.server).ok()?.connect().await.ok()?).await
    }
    /// The way to `address` of this site.
    pub fn way(&self, address: &str) -> Result<Way, Exit> {
        let way = match &self.authority_pem {
            Some(root) => Way::secure(address, root, self.token.as_deref()),
            None => Way::plain(address),
        };
        way.map_err(|error| Exit::usage(format!("{error:#}")))
    }
}

/// What the server at the other end says of its site; none: it says nothing.
pub async fn site_of(line: Line) -> Option<SiteAnswer> {
    let answer = HealthClient::new(line).check(unary(HealthCheckRequest::default())).await.ok()?;
    SiteAnswer::read(answer.metadata())
}

/// An end that is not success.
#[derive(Debug)]
pub struct Exit {
    code: u8,
    text: String,
    remedy: Remedy,
}

/// What a program may do about an end that is not success.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Remedy {
    /// Nothing: a person must.
    None,
    /// The same again later.
    Later,
    /// The same from the beginning: the server does not know any more where it was.
    Anew,
}

impl Exit {
    /// With a code of the list in docs/cli.md.
    pub fn new(code: u8, text: impl Into<String>) -> Self {
        let remedy = if code == NO_SERVER { Remedy::Later } else { Remedy::None };
        Self { code, text: text.into(), remedy }
    }
    /// What was heard cannot be written. If nobody reads any more there is nobody to tell either, and the end is that of a program that wrote into a closed pipe.
    fn unwritten(why: ErrorKind) -> Self {
        match why {
            ErrorKind::BrokenPipe => Self::new(UNREAD, ""),
            other => Self::new(1, format!("writing what was heard: {other}")),
        }
    }
    /// The server does not know the place any more from which it was to go on.
    pub fn is_of_a_lost_place(&self) -> bool {
        self.remedy == Remedy::Anew
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
        if self.code != UNREAD {
            out.say(&format!("error: {}", self.text));
        }
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

impl From<Unknown> for Exit {
    fn from(Unknown(name): Unknown) -> Self {
        Self::new(4, format!("no context {name}\n  try: midshift context ls, or midshift login"))
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
            Code::Unavailable | Code::Unimplemented => NO_SERVER,
            Code::PermissionDenied | Code::Unauthenticated => 6,
            Code::Aborted | Code::AlreadyExists | Code::FailedPrecondition => 9,
            Code::DeadlineExceeded => 10,
            _ if is_late(&status) => 10,
            _ if has_broken_off(&status) => NO_SERVER,
            _ => 1,
        };
        let violations = answer.violations.iter().map(|v| (v.field.as_str(), v.description.as_str()));
        let mut text = broken_rules(violations).unwrap_or_else(|| match status.message() {
            _ if status.code() == Code::Unimplemented => NOT_THERE.to_owned(),
            _ if is_late(&status) => LATE.to_owned(),
            _ if has_broken_off(&status) => BROKE_OFF.to_owned(),
            "" => status.code().to_string(),
            message => message.to_owned(),
        });
        // A broken rule says by itself what to mend.
        let next_step = answer.code.filter(|_| answer.violations.is_empty()).map_or("", reason::Code::next_step);
        // The help of a code ends with it.
        let told = text.strip_suffix(next_step).unwrap_or(&text).trim_end().len();
        text.truncate(told);
        if answer.code == Some(reason::Code::Internal) && !answer.request_id.is_empty() {
            text += &format!("\n  request_id: {}", answer.request_id);
        }
        if !next_step.is_empty() {
            text += &format!("\n  try: {next_step}");
        }
        let remedy = match answer.code {
            Some(reason::Code::CursorExpired | reason::Code::CursorOfOtherStore) => Remedy::Anew,
            _ if was_cut(&status) || status.code() == Code::ResourceExhausted => Remedy::Later,
            _ => Remedy::None,
        };
        Self { code, text, remedy }
    }
}

/// Takes the messages of a stream until `take` breaks, through restarts of the server: a stream that was cut is opened again, and says
/// again what is known then. `take` is given nothing when the server ended the stream in order.
///
/// # Errors
/// What `open` says the first time; what `take` says; a refusal; a server that stays away, or cuts each stream soon, for longer than ten minutes; what it heard cannot be written.
pub async fn follow<T, B>(
    out: &Out,
    open: impl AsyncFn() -> Result<Streaming<T>, Exit>,
    mut take: impl FnMut(Option<T>) -> Result<ControlFlow<B>, Exit>,
) -> Result<B, Exit> {
    let mut stream = open().await?;
    let mut away: Option<Away> = None;
    // What a server said of it that cut a stream.
    let mut why = String::new();
    loop {
        let message = match stream.message().await {
            Ok(message) => message,
            Err(status) if was_cut(&status) => {
                why = status.message().to_owned();
                None
            }
            Err(status) => return Err(Exit::with_facts(status)),
        };
        let is_cut = message.is_none();
        if let ControlFlow::Break(end) = take(message)? {
            return Ok(end);
        }
        if let Some(why) = out.unwritten() {
            return Err(Exit::unwritten(why));
        }
        if is_cut {
            away = away.filter(|away| !away.is_over());
            if away.is_none() {
                out.say("the server ended the stream; waiting until it is back");
            }
            stream = away.get_or_insert_with(Away::begin).again(&open, &why).await?;
        }
    }
}

/// The server took the call and has not answered: the deadline was this program's own.
fn is_late(status: &Status) -> bool {
    status.code() == Code::Cancelled && status.message() == "Timeout expired"
}

/// What plain text hears of a port that speaks TLS.
fn has_broken_off(status: &Status) -> bool {
    let said = status.message();
    said.starts_with("h2 protocol error") || ["operation was canceled", "transport error"].contains(&said)
}

/// The connection is gone, and with it what the answer would have been.
pub fn was_cut(status: &Status) -> bool {
    matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled | Code::Internal)
}

/// A server that is gone while something is followed.
struct Away {
    begun: Instant,
    /// Until it is asked again.
    pause: Duration,
    /// When it answered last.
    answered: Option<Instant>,
}

impl Away {
    fn begin() -> Self {
        Self { begun: Instant::now(), pause: PAUSE_MIN, answered: None }
    }

    /// Its last stream went on for a while: a server that cuts each one soon is away all the same.
    fn is_over(&self) -> bool {
        self.answered.is_some_and(|at| at.elapsed() > PAUSE_MAX)
    }

    /// Opens a stream as soon as there is a server for it.
    async fn again<T>(
        &mut self,
        open: &impl AsyncFn() -> Result<Streaming<T>, Exit>,
        why: &str,
    ) -> Result<Streaming<T>, Exit> {
        loop {
            tokio::time::sleep(self.pause).await;
            self.pause = (self.pause * 2).min(PAUSE_MAX);
            match open().await {
                Err(exit) if exit.remedy == Remedy::Later && self.begun.elapsed() < AWAY_MAX => {}
                Ok(_) if self.answered.is_some() && self.begun.elapsed() >= AWAY_MAX => {
                    let text = format!("the server has ended each stream at once for {AWAY_MAX:?}: {why}");
                    return Err(Exit::new(NO_SERVER, text));
                }
                opened => {
                    let now = Instant::now();
                    // However long it was away: from here on it has as long to be of use.
                    self.begun = if self.answered.is_none() { now } else { self.begun };
                    self.answered = Some(now);
                    return opened;
                }
            }
        }
    }
}

impl Call {
    /// This server, as whom environment and context say.
    pub fn to(server: String) -> Self {
        Self { server: Some(server), login: Login::default() }
    }
    /// The server, host:port.
    pub fn address(&self) -> Result<String, Exit> {
        Ok(self.resolved()?.server)
    }
    /// What flags, environment and context come to.
    pub fn resolved(&self) -> Result<Resolved, Exit> {
        self.login.resolve(self.server.as_deref())
    }
    /// A channel that stands.
    pub async fn line(&self) -> Result<Line, Exit> {
        let resolved = self.resolved()?;
        let way = resolved.way(&resolved.server)?;
        let line = way.connect().await.map_err(|error| no_server(&resolved, &*error.0))?;
        if !resolved.is_secure() {
            answers(&way, line.clone()).await.map_err(|found| at_wrong_door(&resolved, found))?;
        }
        Ok(line)
    }
    /// Who is who.
    pub async fn identity(&self) -> Result<IdentityServiceClient<Line>, Exit> {
        Ok(IdentityServiceClient::new(self.line().await?))
    }
    /// Task intake.
    pub async fn task(&self) -> Result<TaskServiceClient<Line>, Exit> {
        Ok(TaskServiceClient::new(self.line().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Connects to the service of fleet.
    pub async fn fleet(&self) -> Result<FleetServiceClient<Line>, Exit> {
        Ok(FleetServiceClient::new(self.line().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Connects to the service of telemetry.
    pub async fn telemetry(&self) -> Result<TelemetryServiceClient<Line>, Exit> {
        Ok(TelemetryServiceClient::new(self.line().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Releases of software.
    pub async fn bundles(&self) -> Result<BundleServiceClient<Line>, Exit> {
        Ok(BundleServiceClient::new(self.line().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Roll-outs of software.
    pub async fn rollouts(&self) -> Result<RolloutServiceClient<Line>, Exit> {
        Ok(RolloutServiceClient::new(self.line().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Who decided what.
    pub async fn audit(&self) -> Result<AuditServiceClient<Line>, Exit> {
        Ok(AuditServiceClient::new(self.line().await?).max_decoding_message_size(64 * 1024 * 1024))
    }
    /// Whether it serves.
    pub async fn health(&self) -> Result<HealthClient<Line>, Exit> {
        Ok(HealthClient::new(self.line().await?))
    }
    /// Faults of the simulator.
    pub async fn sim(&self) -> Result<SimServiceClient<Line>, Exit> {
        Ok(SimServiceClient::new(self.line().await?))
    }
}

/// Waits for any answer. In plain text a connection stands as soon as the system has taken it, whether a program looks at it or not.
async fn answers(way: &Way, line: Line) -> Result<(), Found> {
    let mut health = HealthClient::new(line);
    match tokio::time::timeout(SAID_WITHIN, health.check(HealthCheckRequest::default())).await {
        Err(_) => Err(Found::Silence),
        Ok(Err(status)) if has_broken_off(&status) => match Found::by_probe(way).await {
            Found::Unknown => Ok(()),
            found => Err(found),
        },
        Ok(_) => Ok(()),
    }
}

/// Why nothing stands: nobody is there, it is of another site, or it is another door.
fn no_server(resolved: &Resolved, error: &(dyn std::error::Error + 'static)) -> Exit {
    at_wrong_door(resolved, Found::by(error))
}

fn at_wrong_door(resolved: &Resolved, found: Found) -> Exit {
    let server = &resolved.server;
    let text = match (found, found.help()) {
        (Found::OtherSite, _) => format!(
            "the server at {server} is not of the site that you signed in to\n  try: midshift login {server} --pin DIGEST, with the digest that this server printed"
        ),
        (_, Some(help)) => format!("no server of this site at {server}: {help}"),
        (_, None) => {
            format!("no server at {server}\n  try: start one with `midshift dev`, or name another with --server")
        }
    };
    Exit::new(found.exit_code(), text)
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
    use tokio_stream::StreamExt;
    use tonic::codec::{DecodeBuf, Decoder};

    /// Streams without a message.
    struct Nothing;

    impl Decoder for Nothing {
        type Item = ();
        type Error = Status;
        fn decode(&mut self, _: &mut DecodeBuf<'_>) -> Result<Option<()>, Status> {
            Ok(None)
        }
    }

    #[test]
    fn what_may_pass_is_waited_for_and_a_lost_place_is_begun_anew() {
        for code in [Code::Unavailable, Code::Unknown, Code::Internal, Code::Cancelled, Code::ResourceExhausted] {
            assert_eq!(Exit::from(Status::new(code, "")).remedy, Remedy::Later, "{code:?}");
        }
        for code in [Code::PermissionDenied, Code::Unauthenticated, Code::InvalidArgument, Code::NotFound] {
            assert_eq!(Exit::from(Status::new(code, "")).remedy, Remedy::None, "{code:?}");
        }
        for code in [reason::Code::CursorExpired, reason::Code::CursorOfOtherStore] {
            let refusal = Refusal::new(Kind::Precondition, code);
            assert!(Exit::from(midshift_proto::status(&refusal, None)).is_of_a_lost_place(), "{code:?}");
        }
    }

    #[test]
    fn an_error_says_what_it_means_and_then_what_to_try() {
        let told = |kind, reason: reason::Reason| {
            Exit::from(midshift_proto::status(&Refusal::new(kind, reason), Some("r-77"))).to_string()
        };
        let nobody = told(Kind::NotFound, reason::Code::RobotNotFound.into());
        assert_eq!(nobody, format!("No robot has this id.\n  try: {}", reason::Code::RobotNotFound.next_step()));
        let own = told(Kind::Denied, reason::Reason::new(reason::Code::NotPermitted, "it takes the role viewer"));
        assert_eq!(own, format!("it takes the role viewer\n  try: {}", reason::Code::NotPermitted.next_step()));
        let fault = told(Kind::Internal, reason::Code::Internal.into());
        assert_eq!(
            fault,
            "A fault of midshift.\n  request_id: r-77\n  try: Look for the request_id in the server's log."
        );
    }

    #[test]
    fn a_server_that_does_not_answer_in_time_and_a_port_that_speaks_tls_have_their_own_words_and_exit_codes() {
        let late = Exit::from(Status::cancelled("Timeout expired"));
        assert_eq!((late.code(), late.to_string()), (10, LATE.to_owned()));
        for message in ["h2 protocol error: http2 error", "operation was canceled"] {
            let broken = Exit::from(Status::unknown(message));
            assert_eq!((broken.code(), broken.to_string()), (NO_SERVER, BROKE_OFF.to_owned()));
        }
        let canceled = Exit::from(Status::cancelled("by whoever asked"));
        assert_eq!((canceled.code(), canceled.to_string().as_str()), (1, "by whoever asked"));
    }

    #[tokio::test(start_paused = true)]
    async fn a_server_that_cuts_each_stream_at_once_is_given_up_and_one_that_goes_on_is_not() {
        let out = Out::new(crate::out::Format::Name);
        for (lives, goes_on) in [(Duration::ZERO, false), (PAUSE_MAX * 2, true)] {
            let open = async || {
                let ends = tokio_stream::once(()).then(move |()| async move {
                    tokio::time::sleep(lives).await;
                    Ok::<_, Status>(axum::body::Bytes::new())
                });
                Ok(Streaming::new_empty(Nothing, axum::body::Body::from_stream(ends)))
            };
            let mut cuts = 0;
            let end = follow(&out, open, |_: Option<()>| {
                cuts += 1;
                Ok(if cuts < 300 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) })
            });
            assert_eq!(end.await.map_err(|exit| exit.code()), if goes_on { Ok(()) } else { Err(NO_SERVER) });
            assert!(cuts > 10, "{cuts} streams");
        }
    }

    #[test]
    fn a_command_that_was_done_before_under_its_request_id_is_not_said_to_be_done_by_another_call() {
        let at = prost_types::Timestamp::default();
        assert_eq!(done_before(None, DryRun::Yes), None);
        let said = [DryRun::Yes, DryRun::No].map(|only| done_before(Some(&at), only).expect("it was done"));
        assert!(said.iter().all(|said| said.starts_with("it was done at 1970-01-01T00:00:00")), "{said:?}");
        assert!(said[0].ends_with("does nothing more") && said[1].ends_with("changed nothing"), "{said:?}");
    }
}
