//! What each request passes before its service sees it: who asks, how many and how fast it may ask, whether it may ask for that at all, and until when it is
//! answered.
//!
//! Invariant: a request is refused by its head alone; not a byte of its body was decoded. A service is told who asks ([`Caller`], [`Peer`]).

use crate::activity::{Activity, OpenStream};
use crate::answer::Speech;
use crate::config::{Config, std};
use crate::deadline::{self, Bounded, Over};
use crate::denials::{self, Denials};
use crate::peer::{Peer, Principals};
use crate::quota::{Full, Quota, Slot, network};
use crate::quota_key::QuotaKey;
use crate::rates::Rates;
use crate::unauthenticated::Unauthenticated;
use crate::{faults, features};
use http::{HeaderMap, Request, Response, Uri};
use hyper::body::Incoming;
use hyper::service::Service as HyperService;
use midshift_core::identity::{Actor, Caller, Principal};
use midshift_core::overload::Class;
use midshift_core::overload::bugs::Bugs;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::{Boxed, limits};
use midshift_proto::denials::DenialSink;
use midshift_proto::{DenialReporter, access};
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
    rates: Rates<QuotaKey>,
    slots: Arc<Quota<QuotaKey>>,
    /// Of all these, those of whoever has not shown who it is.
    unauthenticated: Arc<Quota<QuotaKey>>,
    watches: Arc<Quota<QuotaKey>>,
    /// Requests under way.
    gauge: metrics::Gauge,
    bugs: Bugs,
}

impl Rules {
    pub fn new(config: &Config) -> Self {
        let (all, each) = (config.requests_max, config.requests_per_principal_max);
        let most = (all / limits::STRANGERS_PART).clamp(1, limits::STRANGER_REQUESTS_MAX);
        Self {
            port: config.port,
            head: std(config.head),
            rates: Rates::new(config.rate, config.rates_remembered),
            slots: Quota::new(all, each),
            unauthenticated: Quota::sharing(most, each, all),
            watches: Quota::new(config.watches_max, config.watches_per_principal_max),
            gauge: metrics::gauge!("midshift_edge_requests", "port" => config.port),
            bugs: config.bugs,
        }
    }

    /// Its slot and its caller's own deadline, or why it goes no further.
    fn admit(
        &self,
        key: &QuotaKey,
        path: &str,
        headers: &HeaderMap,
        speech: &Speech,
    ) -> Result<AdmittedRequest, Refusal> {
        let (class, now) = (access::class(path).with(self.bugs), Instant::now());
        if !self.rates.admit(key, now, class) {
            return Err(Refusal::new(Kind::Exhausted, Code::TooManyRequests));
        }
        let unauthenticated = match key {
            QuotaKey::Unauthenticated(_) => self.unauthenticated.claim(key.clone(), class).map(Some),
            _ => Ok(None),
        };
        let slot =
            unauthenticated.and_then(|unauthenticated| Ok((self.slots.claim(key.clone(), class)?, unauthenticated)));
        let slots = slot.map_err(|full| refused(full, "requests are under way"))?;
        // None goes before another: each may have the last slot.
        let watch = access::is_watch(path).then(|| self.watches.claim(key.clone(), Class::Stop)).transpose();
        let watch = watch.map_err(|full| refused(full, "watches go on"))?;
        if self.bugs.seats_are_kept() {
            std::mem::forget(self.slots.claim(key.clone(), Class::Stop));
        }
        let slot = Inside::new(&self.gauge, slots, watch);
        let given = if *speech == Speech::Http { None } else { deadline::given(headers)? };
        // A time that no clock reaches is none.
        Ok(AdmittedRequest { slot, deadline: given.and_then(|given| now.checked_add(given)) })
    }
}

/// No room, as this key's share or the port's is used up.
fn refused(full: Full, what: &str) -> Refusal {
    let reason = match full {
        Full::Kind => Reason::new(Code::TooManyRequests, format!("as many {what} as one caller has room for here")),
        Full::Total => Reason::new(Code::Overloaded, format!("as many {what} as this port takes of such")),
    };
    Refusal::new(Kind::Exhausted, reason)
}

/// A request that may go on to its service, with its slot and its deadline.
struct AdmittedRequest {
    slot: Inside,
    deadline: Option<Instant>,
}

/// Guards that an answer holds until its body is gone. They are never read.
type AnswerGuards = (OpenStream, Option<Inside>);

/// One request under way, with its slot among all, and among those of unauthenticated callers.
pub(crate) struct Inside {
    gauge: metrics::Gauge,
    _slots: (Slot<QuotaKey>, Option<Slot<QuotaKey>>),
    _watch: Option<Slot<QuotaKey>>,
    /// Its place among the batches of its connection. Never read.
    batch: Option<OwnedSemaphorePermit>,
}

impl Inside {
    fn new(
        gauge: &metrics::Gauge,
        slots: (Slot<QuotaKey>, Option<Slot<QuotaKey>>),
        watch: Option<Slot<QuotaKey>>,
    ) -> Self {
        gauge.increment(1.0);
        Self { gauge: gauge.clone(), _slots: slots, _watch: watch, batch: None }
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
    pub unauthenticated: Unauthenticated,
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
    fn admit(&self, request: &Request<Incoming>, speech: &Speech) -> Result<(Caller, AdmittedRequest), Refusal> {
        let (path, headers) = (request.uri().path(), request.headers());
        let caller = self.principals.caller(&self.peer, headers);
        let key = QuotaKey::from_caller(caller.as_ref(), self.peer.address.ip());
        if !matches!(key, QuotaKey::Unauthenticated(_)) {
            self.unauthenticated.set_authenticated();
        }
        // Before anything else is said: guessing is limited too.
        let admitted = self.rules.admit(&key, path, headers, speech);
        let mut admitted = admitted.inspect_err(|refusal| {
            let (port, code) = (self.rules.port, refusal.reason.code);
            tracing::info!(port, peer = %key, path = denials::cut(path), %code, "a request was refused");
        })?;
        let allowed = match &caller {
            Ok(caller) => access::check(caller, path),
            Err(worthless) => Err(worthless.clone()),
        };
        if let Err(refusal) = &allowed {
            self.denied(&key, caller.as_ref().ok(), path, refusal);
        }
        allowed?;
        features::check(headers)?;
        admitted.slot.batch = self.batch(path)?;
        Ok((caller?, admitted))
    }

    /// Tells whoever writes it down. Somebody who showed nothing was denied nothing: it is asked to sign in.
    fn denied(&self, key: &QuotaKey, caller: Option<&Caller>, path: &str, refusal: &Refusal) {
        if caller.is_some_and(|caller| matches!(caller.principal(), Principal::Nobody)) {
            return;
        }
        let (actor, from) = (Actor::from(caller.unwrap_or(&Caller::nobody())), network(self.peer.address.ip()));
        report_denial(self.rules.port, self.denials.as_deref(), key, actor, from, path, refusal);
    }

    /// The reporter for a service that denies what only it can judge.
    fn denial_reporter(&self, caller: &Caller, uri: &Uri) -> DenialReporter {
        let Some(denials) = self.denials.clone() else { return DenialReporter::default() };
        let key = QuotaKey::from_caller(Ok(caller), self.peer.address.ip());
        let (port, from, caller) = (self.rules.port, network(self.peer.address.ip()), caller.clone());
        DenialReporter::new(Arc::new(PortDenials { port, denials, key, caller, from, uri: uri.clone() }))
    }
}

fn report_denial(
    port: &'static str,
    denials: Option<&Denials>,
    key: &QuotaKey,
    actor: Actor,
    from: IpAddr,
    path: &str,
    refusal: &Refusal,
) {
    let (code, path) = (refusal.reason.code, denials::cut(path));
    tracing::info!(port, peer = %key, %actor, path, %code, "a request was denied");
    if let Some(denials) = denials {
        denials.report(key, actor, from, path, &refusal.reason);
    }
}

/// Records denials of one request that the port let in.
struct PortDenials {
    port: &'static str,
    denials: Arc<Denials>,
    key: QuotaKey,
    caller: Caller,
    from: IpAddr,
    uri: Uri,
}

impl DenialSink for PortDenials {
    fn denied(&self, refusal: &Refusal) {
        let (port, reason) = (self.port, refusal.reason.code.as_str());
        metrics::counter!("midshift_edge_requests_denied_inside_total", "port" => port, "reason" => reason)
            .increment(1);
        let actor = Actor::from(&self.caller);
        report_denial(port, Some(&*self.denials), &self.key, actor, self.from, self.uri.path(), refusal);
    }
}

impl HyperService<Request<Incoming>> for Door {
    type Response = Response<Bounded<AnswerGuards>>;
    type Error = Infallible;
    type Future = Boxed<'static, Result<Self::Response, Infallible>>;

    fn call(&self, mut request: Request<Incoming>) -> Self::Future {
        let (stream, now) = (self.activity.begin(), Instant::now());
        let over = Over::new(&self.peer);
        let speech = Speech::from_headers(request.headers());
        let (caller, AdmittedRequest { slot, deadline }) = match self.admit(&request, &speech) {
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
        request.extensions_mut().insert(self.peer.go_away.clone());
        let reporter = self.denial_reporter(&caller, request.uri());
        request.extensions_mut().insert(reporter);
        request.extensions_mut().insert(caller);
        let head = deadline.map_or(now + self.rules.head, |deadline| deadline.min(now + self.rules.head));
        let services = self.services.clone();
        Box::pin(async move {
            let answer = faults::await_answer(async move { services(request.map(Body::new)).await });
            let answered = timeout_at(head, answer).await;
            let refusal = match answered {
                Ok(Ok(response)) => {
                    let response = speech.reasoned(response);
                    return Ok(response.map(|body| Bounded::new(body, deadline, over, speech, (stream, Some(slot)))));
                }
                Ok(Err(fault)) => fault,
                Err(_) => deadline::over(),
            };
            Ok(speech.refuse(&refusal).map(|body| Bounded::new(body, None, over, speech, (stream, Some(slot)))))
        })
    }
}
