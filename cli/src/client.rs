//! Calls of the command line: which server, what an error means for a person and for the exit code.

pub use crate::exit::{Exit, was_cut};

use crate::contexts::Contexts;
use crate::door::Found;
use crate::endpoint::{Endpoint, Line};
use crate::exit::{NO_SERVER, has_broken_off};
use crate::out::Out;
use crate::site_answer::SiteAnswer;
use midshift_proto::convert::time_of;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::identity::v1::audit_service_client::AuditServiceClient;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::sim::v1::sim_service_client::SimServiceClient;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Duration;
use tokio::time::Instant;
use tonic::{Request, Streaming};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// Every robot of a site in one message.
pub const ANSWER_BYTES_MAX: usize = 64 * 1024 * 1024;
/// Longest unary call.
const CALL_WITHIN: Duration = Duration::from_secs(30);
/// A server that says nothing for so long on a new connection hangs, or is none.
const SAID_WITHIN: Duration = Duration::from_secs(5);
/// A server that is gone while something is followed may stay away so long.
const AWAY_MAX: Duration = Duration::from_secs(600);
/// Pauses between looks for it.
const PAUSE_MIN: Duration = Duration::from_millis(250);
const PAUSE_MAX: Duration = Duration::from_secs(5);

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
        site_of(self.endpoint(&self.server).ok()?.connect().await.ok()?).await
    }
    /// The endpoint at `address` of this site.
    pub fn endpoint(&self, address: &str) -> Result<Endpoint, Exit> {
        let endpoint = match &self.authority_pem {
            Some(root) => Endpoint::secure(address, root, self.token.as_deref()),
            None => Endpoint::plain(address),
        };
        endpoint.map_err(|error| Exit::usage(format!("{error:#}")))
    }
}

/// What the server at the other end says of its site; none: it says nothing.
pub async fn site_of(line: Line) -> Option<SiteAnswer> {
    let answer = HealthClient::new(line).check(unary(HealthCheckRequest::default())).await.ok()?;
    SiteAnswer::read(answer.metadata())
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
                out.inform("the server ended the stream; waiting until it is back");
            }
            stream = away.get_or_insert_with(Away::begin).again(&open, &why).await?;
        }
    }
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
                Err(exit) if exit.may_pass() && self.begun.elapsed() < AWAY_MAX => {}
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
        let endpoint = resolved.endpoint(&resolved.server)?;
        let line = endpoint.connect().await.map_err(|error| no_server(&resolved, &*error.0))?;
        if !resolved.is_secure() {
            answers(&endpoint, line.clone()).await.map_err(|found| at_wrong_door(&resolved, found))?;
        }
        Ok(line)
    }
}

macro_rules! services {
    ($($(#[$doc:meta])* $name:ident: $client:ident)*) => {
        impl Call { $(
            $(#[$doc])*
            ///
            /// # Errors
            /// No server of the site answers.
            pub async fn $name(&self) -> Result<$client<Line>, Exit> {
                Ok($client::new(self.line().await?).max_decoding_message_size(ANSWER_BYTES_MAX))
            }
        )* }
    };
}

services! {
    /// Asks who is who.
    identity: IdentityServiceClient
    /// Asks who decided what.
    audit: AuditServiceClient
    /// Asks the intake of tasks.
    task: TaskServiceClient
    /// Asks what is decided about robots and places.
    fleet: FleetServiceClient
    /// Asks what robots said.
    telemetry: TelemetryServiceClient
    /// Asks for releases of software.
    bundles: BundleServiceClient
    /// Asks for roll-outs of software.
    rollouts: RolloutServiceClient
    /// Asks whether it serves.
    health: HealthClient
    /// Asks simulated robots.
    sim: SimServiceClient
}

/// Waits for any answer. In plain text a connection stands as soon as the system has taken it, whether a program looks at it or not.
async fn answers(endpoint: &Endpoint, line: Line) -> Result<(), Found> {
    let mut health = HealthClient::new(line);
    match tokio::time::timeout(SAID_WITHIN, health.check(HealthCheckRequest::default())).await {
        Err(_) => Err(Found::Silence),
        Ok(Err(status)) if has_broken_off(&status) => match Found::by_probe(endpoint).await {
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
        (Some(told), _) => out.inform(&told),
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

/// What every verb takes that changes something which has an etag.
#[derive(Clone, Debug, clap::Args)]
pub struct Guarded {
    /// Only if it is still as this etag says.
    #[arg(long, default_value = "")]
    pub if_match: String,
    /// As of every change.
    #[command(flatten)]
    pub change: Change,
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
    use tonic::Status;
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
