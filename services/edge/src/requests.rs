//! What each request passes before its service sees it: how many and how fast its principal may ask, and until when it is answered.
//!
//! Invariant: a request is refused by its head alone; not a byte of its body was decoded. A service is told who asks ([`Peer`]).

use crate::activity::{Activity, OpenStream};
use crate::answer::Speech;
use crate::config::{Config, std};
use crate::deadline::{self, Bounded};
use crate::peer::{Peer, Principal};
use crate::rates::Rates;
use crate::seats::{Full, Seat, Seats};
use http::{HeaderMap, Request, Response};
use hyper::body::Incoming;
use hyper::service::Service as HyperService;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use std::convert::Infallible;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::{Instant, timeout_at};
use tonic::body::Body;
use tower::{Service, ServiceExt};

/// Whom a request counts for.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Asker {
    /// Who was admitted by name.
    Principal(Principal),
    /// Everybody else of one address.
    Network(IpAddr),
}

/// What all requests of a port share.
pub(crate) struct Rules {
    port: &'static str,
    head: Duration,
    rates: Rates<Asker>,
    seats: Arc<Seats<Asker>>,
}

impl Rules {
    pub fn new(config: &Config) -> Self {
        Self {
            port: config.port,
            head: std(config.head),
            rates: Rates::new(config.rate, config.rates_remembered),
            seats: Seats::new(config.requests_max, config.requests_per_principal_max),
        }
    }

    /// Its seat and its caller's own deadline, or why it goes no further.
    fn admit(&self, asker: &Asker, headers: &HeaderMap, speech: &Speech, now: Instant) -> Result<Admitted, Refusal> {
        if !self.rates.take(asker, now) {
            return Err(Refusal::new(Kind::Exhausted, Code::TooManyRequests));
        }
        let seat = self.seats.take(asker.clone()).map_err(|full| match full {
            Full::Kind => Refusal::new(Kind::Exhausted, Code::TooManyRequests),
            Full::Total => Refusal::new(
                Kind::Exhausted,
                Reason::new(Code::Overloaded, "as many requests are under way as this port takes"),
            ),
        })?;
        let given = if *speech == Speech::Http { None } else { deadline::given(headers)? };
        // A time that no clock reaches is none.
        Ok(Admitted { seat, deadline: given.and_then(|given| now.checked_add(given)) })
    }
}

struct Admitted {
    seat: Seat<Asker>,
    deadline: Option<Instant>,
}

/// What an answer keeps until its body is gone. Fields are never read.
type Held = (OpenStream, Option<Seat<Asker>>);

/// The services, as one connection reaches them.
pub(crate) struct Door<S> {
    pub services: S,
    pub rules: Arc<Rules>,
    pub activity: Activity,
    pub peer: Peer,
    pub principal: Option<Principal>,
    pub asker: Asker,
}

impl<S> HyperService<Request<Incoming>> for Door<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible> + Clone + Send + 'static,
    S::Future: Send,
{
    type Response = Response<Bounded<Held>>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Infallible>> + Send>>;

    fn call(&self, mut request: Request<Incoming>) -> Self::Future {
        let (stream, now) = (self.activity.begin(), Instant::now());
        let speech = Speech::of(request.headers());
        let admitted = self.rules.admit(&self.asker, request.headers(), &speech, now);
        let Admitted { seat, deadline } = match admitted {
            Ok(admitted) => admitted,
            Err(refusal) => {
                let (port, reason) = (self.rules.port, refusal.reason.code.as_str());
                metrics::counter!("midshift_edge_requests_refused_total", "port" => port, "reason" => reason)
                    .increment(1);
                let refused = speech.refuse(&refusal).map(|body| Bounded::new(body, None, speech, (stream, None)));
                return Box::pin(std::future::ready(Ok(refused)));
            }
        };
        request.extensions_mut().insert(self.peer.clone());
        if let Some(principal) = &self.principal {
            request.extensions_mut().insert(principal.clone());
        }
        let head = deadline.map_or(now + self.rules.head, |deadline| deadline.min(now + self.rules.head));
        let answer = self.services.clone().oneshot(request.map(Body::new));
        Box::pin(async move {
            let Ok(Ok(response)) = timeout_at(head, answer).await else {
                let late = speech.refuse(&deadline::over());
                return Ok(late.map(|body| Bounded::new(body, None, speech, (stream, Some(seat)))));
            };
            Ok(response.map(|body| Bounded::new(body, deadline, speech, (stream, Some(seat)))))
        })
    }
}
