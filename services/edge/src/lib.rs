//! Accepts, authenticates, limits and ends the connections of a port, in front of its services.
//!
//! Build with [`Edge::new`] around the services and [`Edge::with_tls`]; then [`Edge::serve`] runs over a listener.
//! Invariants:
//! 1. No peer holds anything for longer than a limit of [`Config`].
//! 2. No peer costs another peer its connection.
//! 3. After its stop, `serve` returns within the drain's time, whatever is open.
//!
//! tonic's own server does not suffice. It keeps a silent peer connected for ever, spins without a free descriptor, and
//! waits for open streams for ever when stopped. It neither renews its certificate nor cuts a peer off.
//! [`Principals`] identifies callers; the .proto files say what each path needs. Absent on purpose: rules about a
//! single robot, task or area.

mod accept;
mod activity;
mod answer;
mod config;
mod connection;
mod deadline;
mod denials;
mod descriptor_budget;
mod faults;
mod features;
mod frame_heads;
mod listen;
mod peer;
mod principals;
mod quota;
mod quota_key;
mod rates;
mod requests;
pub mod tls;
mod unauthenticated;

pub use config::{Age, Config, Rate};
pub use denials::{Denial, Denials};
pub use descriptor_budget::{TooFew, connections_max};
pub use listen::{Incoming, Listen, Listener};
pub use peer::{Anybody, ConnectionId, Denied, Peer, Principals};
pub use principals::{SitePrincipals, robot_of, serial_of};

use accept::Accept;
use config::std;
use connection::{End, Port};
use http::{Request, Response};
use midshift_core::overload::Class;
use midshift_core::{Boxed, limits};
use quota::{Full, Quota, Slot, network};
use requests::{Rules, Services};
use rustls::ServerConfig;
use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::Arc;
use tokio::sync::watch;
use tokio::task::{JoinError, JoinSet};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tonic::body::Body;
use tower::{Service, ServiceExt};
use unauthenticated::Unauthenticated;

/// One port: its services and its limits.
pub struct Edge {
    port: Port,
}

/// How serving ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Served {
    /// Connections that were open at the stop and ended by themselves.
    pub left: usize,
    /// Connections that were cut when the drain's time was over.
    pub cut: usize,
}

impl Edge {
    /// `services` (tonic's `Routes`) behind the limits of `config`, for whom `principals` lets in. Plain text without [`Edge::with_tls`].
    pub fn new<S>(config: Config, principals: Arc<dyn Principals>, services: S) -> Self
    where
        S: Service<Request<Body>, Response = Response<Body>, Error = Infallible> + Clone + Send + Sync + 'static,
        S::Future: Send,
    {
        let (rules, http) = (Arc::new(Rules::new(&config)), connection::http(&config));
        let services: Services = Arc::new(move |request| {
            let answer = services.clone().oneshot(request);
            Box::pin(async {
                let Ok(response) = answer.await;
                response
            })
        });
        Self { port: Port { config, services, principals, denials: None, tls: None, rules, http } }
    }

    /// TLS as [`tls::server_config`] makes it. Each new connection takes the newest one; live ones keep theirs.
    #[must_use]
    pub fn with_tls(self, newest: watch::Receiver<Arc<ServerConfig>>) -> Self {
        Self { port: Port { tls: Some(newest), ..self.port } }
    }

    /// Who is denied is told there.
    #[must_use]
    pub fn with_denials(self, denials: Denials) -> Self {
        Self { port: Port { denials: Some(Arc::new(denials)), ..self.port } }
    }

    /// Serves until `stop`, or until `listener` has no more; then each connection is asked to go, and what is left after the drain's time
    /// is cut. Dropping the future cuts everything.
    pub fn serve(self, listener: impl Listen, stop: CancellationToken) -> Boxed<'static, Served> {
        Box::pin(self.serve_all(Listener::new(listener), stop))
    }

    async fn serve_all(self, listener: Listener, stop: CancellationToken) -> Served {
        let shared = Arc::new(self.port);
        let (config, name) = (&shared.config, shared.config.port);
        let places = Places::new(config, shared.tls.is_some());
        let gauge = metrics::gauge!("midshift_edge_connections", "port" => name);
        let (mut accept, mut connections, mut last) = (Accept::new(listener, name), JoinSet::new(), 0);
        let leave = stop.child_token();
        loop {
            let accepted = tokio::select! {
                biased;
                () = stop.cancelled() => break,
                Some(ended) = connections.join_next() => {
                    count(name, ended);
                    gauge.set(connections.len() as f64);
                    continue;
                }
                accepted = accept.next() => accepted,
            };
            let Some((io, address)) = accepted else { break };
            match places.claim(network(address.ip())) {
                Ok((slot, unauthenticated)) => {
                    last += 1;
                    let who = (ConnectionId(last), unauthenticated);
                    let connection = shared.clone().run(io, address, who, leave.clone());
                    connections.spawn(async move {
                        let end = connection.await;
                        drop(slot);
                        end
                    });
                    gauge.set(connections.len() as f64);
                }
                // Dropped with `io`: closed at once, before a byte of it is read.
                Err(reason) => {
                    tracing::info!(port = name, peer = %network(address.ip()), limit = reason, "a connection was refused");
                    metrics::counter!("midshift_edge_refused_total", "port" => name, "reason" => reason).increment(1);
                }
            }
        }
        drop(accept);
        leave.cancel();
        let open = connections.len();
        let drained = timeout(std(config.drain), async {
            while let Some(ended) = connections.join_next().await {
                count(name, ended);
            }
        });
        // An error says that the time is over; what is left is what is counted.
        let _ = drained.await;
        let cut = connections.len();
        connections.shutdown().await;
        gauge.set(0.0);
        tracing::info!(port = name, left = open - cut, cut, "the port is closed");
        Served { left: open - cut, cut }
    }
}

/// Places of connections: of all, and, where there is a login, of those that have not shown yet who they are. One network has the same part of what the others
/// leave of the unauthenticated as it may have of all.
struct Places {
    all: Arc<Quota<IpAddr>>,
    unauthenticated: Option<Arc<Quota<IpAddr>>>,
}

impl Places {
    fn new(config: &Config, has_login: bool) -> Self {
        let (all, each) = (config.connections_max, config.connections_per_network_max);
        let most = (all / limits::STRANGERS_PART).max(1);
        Self { all: Quota::new(all, each), unauthenticated: has_login.then(|| Quota::sharing(most, each, all)) }
    }

    /// One of each, or what is full, as metrics name it.
    fn claim(&self, network: IpAddr) -> Result<(Slot<IpAddr>, Unauthenticated), &'static str> {
        let slot = self.all.claim(network, Class::Stop).map_err(|full| match full {
            Full::Total => "connections_max",
            Full::Kind => "connections_per_network_max",
        })?;
        let unauthenticated = self.unauthenticated.as_ref().map(|quota| quota.claim(network, Class::Stop)).transpose();
        let unauthenticated = unauthenticated.map_err(|full| match full {
            Full::Total => "strangers_max",
            Full::Kind => "strangers_per_network_max",
        })?;
        Ok((slot, Unauthenticated::new(unauthenticated)))
    }
}

fn count(port: &'static str, ended: Result<End, JoinError>) {
    let reason = match ended {
        Ok(end) => end.as_str(),
        Err(error) => {
            tracing::error!(port, peer = "any", %error, "a connection's task ended with a fault");
            "fault"
        }
    };
    metrics::counter!("midshift_edge_closed_total", "port" => port, "reason" => reason).increment(1);
}
