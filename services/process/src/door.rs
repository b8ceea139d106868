//! The door of a port: an edge around its services, and who may come in: everybody in plain text (`dev`), or whom identity knows, over TLS.
//!
//! Invariant: every port of our programs has this door and no other; what a request may do was decided before a service sees it.

use anyhow::Context;
use midshift_core::Boxed;
use midshift_core::identity::{Directory, ServerProof};
use midshift_core::ids::SiteId;
use midshift_core::limits;
use midshift_core::time::Clock;
use midshift_edge::tls::{Clients, server_config};
use midshift_edge::{Anybody, Config, Denials, Edge, Listen, Listener, Rate, SitePrincipals, connections_max};
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use std::num::NonZeroU32;
use std::sync::Arc;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;

/// How much one peer may take of a port.
#[derive(Clone, Copy, Debug, Default, clap::Args)]
pub struct Share {
    /// Connections from one address, or one /64 of IPv6, at a time. A proxy in front is one address. Without it a quarter of what the port takes: 4096, or fewer
    /// if the process may not have as many files open; with --insecure all.
    #[arg(long, value_name = "N")]
    pub connections_per_address: Option<usize>,
    /// Requests that one robot, token or address may begin a second, for long; twice as many at once. Without it 1000; with --insecure as many as there are.
    #[arg(long, value_name = "N")]
    pub requests_per_second: Option<NonZeroU32>,
    /// Watches that one robot, token or address may have at once: calls that go on to tell what is new. Without it 256; with --insecure the 4096 of the port.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=limits::WATCHES_MAX as i64))]
    pub watches_per_caller: Option<u32>,
}

impl Share {
    /// The limits of a port with this name, as far as the descriptors of this process go, of which it asks for all that it may have.
    ///
    /// # Errors
    /// There are too few for a port; it says what to type.
    pub fn config(self, port: &'static str) -> anyhow::Result<Config> {
        const PART: usize = limits::CONNECTIONS_MAX / limits::CONNECTIONS_PER_NETWORK_MAX;
        let connections_max = connections_max()?;
        let usual = Config { port, connections_max, ..Config::default() };
        Ok(self.apply_to(Config { connections_per_network_max: connections_max / PART, ..usual }))
    }

    /// Makes the limits of a port without login: those that were asked for, beside the port's own.
    pub fn config_without_login(self, port: &'static str) -> Config {
        self.apply_to(alone(port))
    }

    fn apply_to(self, usual: Config) -> Config {
        const BURST: NonZeroU32 = NonZeroU32::new(limits::REQUESTS_BURST / limits::REQUESTS_PER_SECOND).unwrap();
        let rate = |per_second: NonZeroU32| Rate { per_second, burst: per_second.saturating_mul(BURST) };
        let connections = self.connections_per_address.map(|asked| asked.min(usual.connections_max));
        Config {
            connections_per_network_max: connections.unwrap_or(usual.connections_per_network_max),
            rate: self.requests_per_second.map_or(usual.rate, rate),
            watches_per_principal_max: self.watches_per_caller.map_or(usual.watches_per_principal_max, |n| n as usize),
            ..usual
        }
    }

    /// The same as arguments of a program of ours.
    pub fn arguments(self) -> Vec<String> {
        let Self { connections_per_address, requests_per_second, watches_per_caller } = self;
        let connections = connections_per_address.map(|n| format!("--connections-per-address={n}"));
        let requests = requests_per_second.map(|n| format!("--requests-per-second={n}"));
        let watches = watches_per_caller.map(|n| format!("--watches-per-caller={n}"));
        connections.into_iter().chain(requests).chain(watches).collect()
    }
}

/// Limits of a port without login, where all robots and people come from one address.
pub fn alone(port: &'static str) -> Config {
    let all = const { NonZeroU32::new(1_000_000).unwrap() };
    let rate = Rate { per_second: all, burst: all };
    let requests_per_principal_max = limits::REQUESTS_MAX;
    Config {
        port,
        connections_per_network_max: limits::CONNECTIONS_MAX,
        requests_per_principal_max,
        watches_per_principal_max: limits::WATCHES_MAX,
        rate,
        // Programs of the same machine dial long before they ask.
        first_request: limits::CONNECTION_IDLE,
        ..Config::default()
    }
}

/// What a port with login follows while it is open.
pub struct Login {
    /// Which site's robots.
    pub site_id: SiteId,
    /// For the expiry of tokens and of robots' certificates.
    pub clock: Arc<dyn Clock>,
    /// Who is known.
    pub directory: watch::Receiver<Arc<Directory>>,
    /// What the port proves itself with.
    pub proof: watch::Receiver<ServerProof>,
    /// Who is told whom it denies what.
    pub denials: Denials,
}

impl Login {
    /// Whether a port can prove itself now.
    ///
    /// # Errors
    /// What it is to prove itself with cannot be used.
    pub fn proves(&self) -> anyhow::Result<()> {
        configure_tls(&self.proof.borrow(), &self.clock).map(drop)
    }
}

/// Serves `listener` until `stop`, then drains and cuts. Without a login everybody may do everything, in plain text.
///
/// # Errors
/// What the port is to prove itself with cannot be used.
pub fn serve(
    config: Config,
    login: Option<Login>,
    services: Routes,
    listener: impl Listen,
    stop: CancellationToken,
) -> Boxed<'static, anyhow::Result<()>> {
    Box::pin(serve_all(config, login, services, Listener::new(listener), stop))
}

async fn serve_all(
    config: Config,
    login: Option<Login>,
    services: Routes,
    listener: Listener,
    stop: CancellationToken,
) -> anyhow::Result<()> {
    let Some(login) = login else {
        Edge::new(config, Arc::new(Anybody::default()), services).serve(listener, stop).await;
        return Ok(());
    };
    let Login { site_id, clock, mut directory, mut proof, denials } = login;
    let known = Arc::new(SitePrincipals::new(site_id, clock.clone()));
    known.publish((**directory.borrow_and_update()).clone());
    let tls = watch::Sender::new(configure_tls(&proof.borrow_and_update().clone(), &clock)?);
    let edge = Edge::new(config, known.clone(), services).with_tls(tls.subscribe()).with_denials(denials);
    let following = async {
        while directory.changed().await.is_ok() {
            known.publish((**directory.borrow_and_update()).clone());
        }
        std::future::pending::<()>().await;
    };
    let renewing = async {
        while proof.changed().await.is_ok() {
            let newest = proof.borrow_and_update().clone();
            match configure_tls(&newest, &clock) {
                Ok(newest) => drop(tls.send_replace(newest)),
                Err(error) => tracing::error!(
                    error = format!("{error:#}"),
                    "a renewed certificate is of no use; the old one stays"
                ),
            }
        }
        std::future::pending::<()>().await;
    };
    tokio::select! {
        _ = edge.serve(listener, stop) => Ok(()),
        () = following => Ok(()),
        () = renewing => Ok(()),
    }
}

/// Makes the TLS of a port that proves itself with `proof` and asks whoever dials for a certificate of the site.
///
/// # Errors
/// What the port is to prove itself with cannot be used.
pub fn configure_tls(proof: &ServerProof, clock: &Arc<dyn Clock>) -> anyhow::Result<Arc<ServerConfig>> {
    let certificates = |pem: &str| -> anyhow::Result<Vec<CertificateDer<'static>>> {
        Ok(CertificateDer::pem_slice_iter(pem.as_bytes()).collect::<Result<_, _>>()?)
    };
    let chain = certificates(&proof.chain_pem).context("reading the server's certificate")?;
    let key = PrivateKeyDer::from_pem_slice(proof.key_pem.as_bytes()).context("reading the server's key")?;
    let roots = certificates(&proof.authority_pem).context("reading the site's root")?;
    server_config(chain, key, Clients::Asked(roots), clock).context("what the server proves itself with")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_one_peer_may_take_holds_with_a_login_and_without_and_nothing_else_does_unless_it_was_asked_for() {
        let asked = Share {
            connections_per_address: Some(7),
            requests_per_second: NonZeroU32::new(5),
            watches_per_caller: Some(3),
        };
        for config in [asked.config("business").expect("a port"), asked.config_without_login("business")] {
            let taken = (config.connections_per_network_max, config.rate.per_second.get(), config.rate.burst.get());
            assert_eq!((taken, config.watches_per_principal_max), ((7, 5, 10), 3));
        }
        let (usual, free) = (Share::default().config("business").expect("a port"), alone("business"));
        assert_eq!(usual.rate.per_second.get(), limits::REQUESTS_PER_SECOND);
        assert_eq!(usual.watches_per_principal_max, limits::WATCHES_PER_PRINCIPAL_MAX);
        let without = Share::default().config_without_login("business");
        let taken = |config: &Config| {
            let Config { connections_per_network_max, rate, watches_per_principal_max, .. } = *config;
            (connections_per_network_max, rate.per_second, watches_per_principal_max)
        };
        assert_eq!(taken(&without), taken(&free));
    }
}
