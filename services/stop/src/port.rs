//! The port of the stop service: its faces, its metrics, and the door in front of them.
//!
//! Invariant: whom the door denies something is recorded in the service's own file.

use crate::service::{self, StopService};
use anyhow::Context;
use axum::routing::get;
use midshift_core::Boxed;
use midshift_core::time::{LinkDuration, Utc};
use midshift_edge::{Config, Denial};
use midshift_process::door::{self, Login};
use midshift_process::recorder;
use tokio::net::TcpListener;
use tokio::sync::mpsc::Receiver;
use tokio::sync::watch;
use tonic::service::Routes;

/// As metrics and logs name it.
pub const NAME: &str = "stop";
/// Pings on a quiet connection of a watcher: one that is gone is found out twice as fast as on the business port.
const KEEPALIVE_EVERY: LinkDuration = LinkDuration::from_secs(10);

/// What a port with login follows, whom it denied what, and when who is known was last written down or said to be so still.
pub type Followed = (Login, Receiver<Denial>, watch::Receiver<Utc>);

/// Serves until the service has ended. Without a login everybody may do everything, in plain text.
///
/// # Errors
/// A part ended by itself, or what the port is to prove itself with cannot be used.
pub fn serve(
    service: StopService,
    guard: (Config, Option<Followed>),
    listener: TcpListener,
) -> Boxed<'static, anyhow::Result<()>> {
    Box::pin(serve_all(service, guard, listener))
}

async fn serve_all(
    service: StopService,
    (config, login): (Config, Option<Followed>),
    listener: TcpListener,
) -> anyhow::Result<()> {
    let metrics = || async { recorder::handle().map(|handle| handle.render()).unwrap_or_default() };
    let pages = service.routes().await?.into_axum_router().layer(tonic_web::GrpcWebLayer::new());
    let routes = Routes::from(pages.route("/metrics", get(metrics)));
    let config = Config { keepalive_every: KEEPALIVE_EVERY, ..config };
    let (login, denials) = match login {
        Some((login, denials, told)) => {
            service.show_principals(told);
            (Some(login), Some(denials))
        }
        None => (None, None),
    };
    let port = door::serve(config, login, routes, listener, service.drained());
    let recording = record(service.clone(), denials);
    let port = async {
        tokio::select! {
            served = port => served,
            () = recording => Ok(()),
        }
    };
    service::serve(service, port).await.context("serving stops")?
}

/// Records whom the port denies what in the stop service's own file, until it is dropped.
async fn record(service: StopService, denials: Option<Receiver<Denial>>) {
    if let Some(mut denials) = denials {
        while let Some(Denial { actor, network, path, robot_id, code, left_out }) = denials.recv().await {
            service.denied(&actor, network, &path, robot_id.as_deref(), code, left_out);
        }
    }
    std::future::pending().await
}
