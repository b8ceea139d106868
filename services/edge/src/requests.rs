//! What each request passes before its service sees it: who asks, how many and how fast it may ask, whether it may ask for that at all, and until when it is
//! answered.
//!
//! Invariant: a request is refused by its head alone; not a byte of its body was decoded. A service is told who asks ([`Caller`], [`Peer`]).

use crate::activity::{Activity, OpenStream};
use crate::answer::Speech;
use crate::asker::Asker;
use crate::config::{Config, std};
use crate::deadline::{self, Bounded, Over};
use crate::denials::{self, Denials};
use crate::peer::{Peer, Principals};
use crate::rates::Rates;
use crate::seats::{Full, Seat, Seats, network};
use crate::stranger::Stranger;
use http::{HeaderMap, Request, Response, Uri};
use hyper::body::Incoming;
use hyper::service::Service as HyperService;
use midshift_core::identity::{Actor, Caller, Who};
use midshift_core::overload::Class;
use midshift_core::overload::bugs::Bugs;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::{Boxed, limits};
use midshift_proto::denying::Told;
use midshift_proto::{Denying, access};
use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout_at};
use tonic::body::Body;

/// What all requests of a port share.
pub(crate) struct Rules {
    port: &'static str,
    head: Duration,
    rates: Rates<Asker>,
    seats: Arc<Seats<Asker>>,
    /// Of all these, those of whoever has not shown who it is.
    strangers: Arc<Seats<Asker>>,
    watches: Arc<Seats<Asker>>,
    /// Requests under way.
    gauge: metrics::Gauge,
    bugs: Bugs,
}

impl Rules {
    pub fn new(config: &Config) -> Self {
        let (all, each) = (config.requests_max, config.requests_per_principal_max);
        let strangers = (all / limits::STRANGERS_PART).clamp(1, limits::STRANGER_REQUESTS_MAX);
        Self {
            port: config.port,
            head: std(config.head),
            rates: Rates::new(config.rate, config.rates_remembered),
            seats: Seats::new(all, each),
            strangers: Seats::sharing(strangers, each, all),
            watches: Seats::new(config.watches_max, config.watches_per_principal_max),
            gauge: metrics::gauge!("midshift_edge_requests", "port" => config.port),
            bugs: config.bugs,
        }
    }

    /// Its seat and its caller's own deadline, or why it goes no further.
    fn admit(&self, asker: &Asker, path: &str, headers: &HeaderMap, speech: &Speech) -> Result<Admitted, Refusal> {
        let (class, now) = (access::class(path).with(self.bugs), Instant::now());
        if !self.rates.admit(asker, now, class) {
            return Err(Refusal::new(Kind::Exhausted, Code::TooManyRequests));
        }
        let stranger = match asker {
            Asker::Stranger(_) => self.strangers.claim(asker.clone(), class).map(Some),
            _ => Ok(None),
        };
        let seat = stranger.and_then(|stranger| Ok((self.seats.claim(asker.clone(), class)?, stranger)));
        let seats = seat.map_err(|full| refused(full, "requests are under way"))?;
        // None goes before another: each may have the last seat.
        let watch = access::is_watch(path).then(|| self.watches.claim(asker.clone(), Class::Stop)).transpose();
        let watch = watch.map_err(|full| refused(full, "watches go on"))?;
        if self.bugs.seats_are_kept() {
            std::mem::forget(self.seats.claim(asker.clone(), Class::Stop));
        }
        let seat = Inside::new(&self.gauge, seats, watch);
        let given = if *speech == Speech::Http { None } else { deadline::given(headers)? };
        // A time that no clock reaches is none.
        Ok(Admitted { seat, deadline: given.and_then(|given| now.checked_add(given)) })
    }
}

/// No room, as this asker's share or the port's is used up.
fn refused(full: Full, what: &str) -> Refusal {
    let reason = match full {
        Full::Kind => Reason::new(Code::TooManyRequests, format!("as many {what} as one caller has room for here")),
        Full::Total => Reason::new(Code::Overloaded, format!("as many {what} as this port takes of such")),
    };
    Refusal::new(Kind::Exhausted, reason)
}

struct Admitted {
    seat: Inside,
    deadline: Option<Instant>,
}

/// What an answer keeps until its body is gone. Fields are never read.
type Held = (OpenStream, Option<Inside>);

/// One request under way, with its seat among all, and among strangers.
pub(crate) struct Inside {
    gauge: metrics::Gauge,
    _seats: (Seat<Asker>, Option<Seat<Asker>>),
    _watch: Option<Seat<Asker>>,
    /// Its place among the batches of its connection. Never read.
    batch: Option<OwnedSemaphorePermit>,
}

impl Inside {
    fn new(gauge: &metrics::Gauge, seats: (Seat<Asker>, Option<Seat<Asker>>), watch: Option<Seat<Asker>>) -> Self {
        gauge.increment(1.0);
        Self { gauge: gauge.clone(), _seats: seats, _watch: watch, batch: None }
    }
}

impl Drop for Inside {
    fn drop(&mut self) {
        self.gauge.decrement(1.0);
    }
}

/// The services of a port, of whatever kind: what is before them is compiled once, in this crate.
pub(crate) type Services = Arc<dyn Fn(Request<Body>) -> Boxed<'static, Response<Body>> + Send + Sync>;

/// The services, as one connection reaches them.
pub(crate) struct Door {
    pub services: Services,
    pub rules: Arc<Rules>,
    pub activity: Activity,
    pub peer: Peer,
    pub stranger: Stranger,
    pub principals: Arc<dyn Principals>,
    pub denials: Option<Arc<Denials>>,
    /// Room for batches of this connection.
    pub batches: Arc<Semaphore>,
}

impl Door {
    /// Its place among the batches of this connection, if it is one.
    fn batch(&self, path: &str) -> Result<Option<OwnedSemaphorePermit>, Refusal> {
        if !access::is_batch(path) {
            return Ok(None);
        }
        self.batches.clone().try_acquire_owned().map(Some).map_err(|_| {
            let most = limits::BATCHES_PER_CONNECTION_MAX;
            let text =
                format!("{most} batches are under way over this connection; wait for one, or open another connection");
            Refusal::new(Kind::Exhausted, Reason::new(Code::TooManyRequests, text))
        })
    }

    /// Who asks, and what it holds for that; or why it goes no further.
    fn admit(&self, request: &Request<Incoming>, speech: &Speech) -> Result<(Caller, Admitted), Refusal> {
        let (path, headers) = (request.uri().path(), request.headers());
        let caller = self.principals.caller(&self.peer, headers);
        let asker = Asker::from_caller(caller.as_ref(), self.peer.address.ip());
        if !matches!(asker, Asker::Stranger(_)) {
            self.stranger.is_known();
        }
        // Before anything else is said: guessing is limited too.
        let admitted = self.rules.admit(&asker, path, headers, speech);
        let mut admitted = admitted.inspect_err(|refusal| {
            let (port, code) = (self.rules.port, refusal.reason.code);
            tracing::info!(port, peer = %asker, path = denials::cut(path), %code, "a request was refused");
        })?;
        let allowed = match &caller {
            Ok(caller) => access::check(caller, path),
            Err(worthless) => Err(worthless.clone()),
        };
        if let Err(refusal) = &allowed {
            self.denied(&asker, caller.as_ref().ok(), path, refusal);
        }
        allowed?;
        admitted.seat.batch = self.batch(path)?;
        Ok((caller?, admitted))
    }

    /// Tells whoever writes it down. Somebody who showed nothing was denied nothing: it is asked to sign in.
    fn denied(&self, asker: &Asker, caller: Option<&Caller>, path: &str, refusal: &Refusal) {
        if caller.is_some_and(|caller| matches!(caller.who(), Who::Nobody)) {
            return;
        }
        let (actor, from) = (Actor::from(caller.unwrap_or(&Caller::nobody())), network(self.peer.address.ip()));
        report_denial(self.rules.port, self.denials.as_deref(), asker, actor, from, path, refusal);
    }

    /// For a service that denies what only it can judge.
    fn denying(&self, caller: &Caller, uri: &Uri) -> Denying {
        let Some(denials) = self.denials.clone() else { return Denying::default() };
        let asker = Asker::from_caller(Ok(caller), self.peer.address.ip());
        let (port, from, caller) = (self.rules.port, network(self.peer.address.ip()), caller.clone());
        Denying::new(Arc::new(Inward { port, denials, asker, caller, from, uri: uri.clone() }))
    }
}

fn report_denial(
    port: &'static str,
    denials: Option<&Denials>,
    asker: &Asker,
    actor: Actor,
    from: IpAddr,
    path: &str,
    refusal: &Refusal,
) {
    let (code, path) = (refusal.reason.code, denials::cut(path));
    tracing::info!(port, peer = %asker, %actor, path, %code, "a request was denied");
    if let Some(denials) = denials {
        denials.report(asker, actor, from, path, &refusal.reason);
    }
}

/// One request that the port let in, for whoever denies it then.
struct Inward {
    port: &'static str,
    denials: Arc<Denials>,
    asker: Asker,
    caller: Caller,
    from: IpAddr,
    uri: Uri,
}

impl Told for Inward {
    fn denied(&self, refusal: &Refusal) {
        let (port, reason) = (self.port, refusal.reason.code.as_str());
        metrics::counter!("midshift_edge_requests_denied_inside_total", "port" => port, "reason" => reason)
            .increment(1);
        let actor = Actor::from(&self.caller);
        report_denial(port, Some(&*self.denials), &self.asker, actor, self.from, self.uri.path(), refusal);
    }
}

impl HyperService<Request<Incoming>> for Door {
    type Response = Response<Bounded<Held>>;
    type Error = Infallible;
    type Future = Boxed<'static, Result<Self::Response, Infallible>>;

    fn call(&self, mut request: Request<Incoming>) -> Self::Future {
        let (stream, now) = (self.activity.begin(), Instant::now());
        let over = Over::new(&self.peer);
        let speech = Speech::from_headers(request.headers());
        let (caller, Admitted { seat, deadline }) = match self.admit(&request, &speech) {
            Ok(admitted) => admitted,
            Err(refusal) => {
                let (port, reason) = (self.rules.port, refusal.reason.code.as_str());
                metrics::counter!("midshift_edge_requests_refused_total", "port" => port, "reason" => reason)
                    .increment(1);
                let refused =
                    speech.refuse(&refusal).map(|body| Bounded::new(body, None, over, speech, (stream, None)));
                return Box::pin(std::future::ready(Ok(refused)));
            }
        };
        request.extensions_mut().insert(self.peer.clone());
        request.extensions_mut().insert(self.peer.leaving.clone());
        let denying = self.denying(&caller, request.uri());
        request.extensions_mut().insert(denying);
        request.extensions_mut().insert(caller);
        let head = deadline.map_or(now + self.rules.head, |deadline| deadline.min(now + self.rules.head));
        let answer = (self.services)(request.map(Body::new));
        Box::pin(async move {
            let Ok(response) = timeout_at(head, answer).await else {
                let late = speech.refuse(&deadline::over());
                return Ok(late.map(|body| Bounded::new(body, None, over, speech, (stream, Some(seat)))));
            };
            let response = speech.reasoned(response);
            Ok(response.map(|body| Bounded::new(body, deadline, over, speech, (stream, Some(seat)))))
        })
    }
}
