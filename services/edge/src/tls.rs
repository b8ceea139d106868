//! TLS of a port: version 1.3, one provider, and who must show a certificate.
//!
//! Invariant: each connection proves its certificate anew; there are no tickets and no early data, so neither a revocation nor an expiry can
//! be slept through. The provider is named here and never installed for the process: a second one would make rustls panic.

use rustls::crypto::aws_lc_rs;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::server::danger::ClientCertVerifier;
use rustls::version::TLS13;
use rustls::{RootCertStore, ServerConfig};
use std::sync::Arc;

/// HTTP/2 for gRPC; HTTP/1.1 for gRPC-Web, metrics and pages.
const PROTOCOLS: [&[u8]; 2] = [b"h2", b"http/1.1"];

/// Why there is no TLS of this certificate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Certificate or key.
    #[error("taking the server's certificate: {0}")]
    Certificate(#[source] rustls::Error),
    /// A root.
    #[error("taking a root for clients: {0}")]
    Root(#[source] rustls::Error),
    /// All of them.
    #[error("verifying clients: {0}")]
    Clients(#[source] rustls::server::VerifierBuilderError),
}

/// Who must show a certificate.
#[derive(Clone, Debug)]
pub enum Clients {
    /// Nobody is asked for one.
    NotAsked,
    /// Who has one of these roots shows it; others come in without.
    Asked(Vec<CertificateDer<'static>>),
    /// Nobody comes in without one of these roots.
    Required(Vec<CertificateDer<'static>>),
}

/// What a port proves itself with, as rustls takes it. Sent to an edge again with another certificate, new connections take that one.
///
/// # Errors
/// If certificate and key do not fit each other, or a root is none.
pub fn server_config(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    clients: Clients,
) -> Result<Arc<ServerConfig>, Error> {
    let provider = Arc::new(aws_lc_rs::default_provider());
    let builder = ServerConfig::builder_with_provider(provider.clone())
        .with_protocol_versions(&[&TLS13])
        .map_err(Error::Certificate)?;
    let builder = match clients {
        Clients::NotAsked => builder.with_no_client_auth(),
        Clients::Asked(roots) => builder.with_client_cert_verifier(verifier(roots, provider, false)?),
        Clients::Required(roots) => builder.with_client_cert_verifier(verifier(roots, provider, true)?),
    };
    let mut config = builder.with_single_cert(chain, key).map_err(Error::Certificate)?;
    config.alpn_protocols = PROTOCOLS.map(<[u8]>::to_vec).into();
    config.send_tls13_tickets = 0;
    config.max_early_data_size = 0;
    Ok(Arc::new(config))
}

fn verifier(
    certificates: Vec<CertificateDer<'static>>,
    provider: Arc<rustls::crypto::CryptoProvider>,
    required: bool,
) -> Result<Arc<dyn ClientCertVerifier>, Error> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates {
        roots.add(certificate).map_err(Error::Root)?;
    }
    let builder = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
    let builder = if required { builder } else { builder.allow_unauthenticated() };
    builder.build().map_err(Error::Clients)
}
