//! TLS of a port: version 1.3, one provider, and who must show a certificate.
//!
//! Invariant: each connection proves its certificate anew; there are no tickets and no early data, so neither a revocation nor an expiry can
//! be slept through. The provider is named here and never installed for the process: a second one would make rustls panic. A wall clock that jumped far
//! ahead ends no certificate of a robot: it counts for as long as it would have without the jump.

use midshift_core::time::Clock;
use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::aws_lc_rs;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::version::TLS13;
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, RootCertStore, ServerConfig, SignatureScheme,
};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

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

/// What a port proves itself with, as rustls takes it. Sent to an edge again with another certificate, new connections take that one. `clock` says
/// whether the wall jumped.
///
/// # Errors
/// If certificate and key do not fit each other, or a root is none.
pub fn server_config(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    clients: Clients,
    clock: &Arc<dyn Clock>,
) -> Result<Arc<ServerConfig>, Error> {
    let provider = Arc::new(aws_lc_rs::default_provider());
    let builder = ServerConfig::builder_with_provider(provider.clone())
        .with_protocol_versions(&[&TLS13])
        .map_err(Error::Certificate)?;
    let builder = match clients {
        Clients::NotAsked => builder.with_no_client_auth(),
        Clients::Asked(roots) => builder.with_client_cert_verifier(verifier(roots, provider, false, clock)?),
        Clients::Required(roots) => builder.with_client_cert_verifier(verifier(roots, provider, true, clock)?),
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
    clock: &Arc<dyn Clock>,
) -> Result<Arc<dyn ClientCertVerifier>, Error> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates {
        roots.add(certificate).map_err(Error::Root)?;
    }
    let builder = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
    let builder = if required { builder } else { builder.allow_unauthenticated() };
    let verifier = builder.build().map_err(Error::Clients)?;
    Ok(Arc::new(SteadyVerifier { verifier, clock: clock.clone() }))
}

/// Verifies certificates of clients as rustls does, except that a jump of the wall makes none expire.
struct SteadyVerifier {
    verifier: Arc<dyn ClientCertVerifier>,
    clock: Arc<dyn Clock>,
}

impl fmt::Debug for SteadyVerifier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.verifier.fmt(f)
    }
}

impl ClientCertVerifier for SteadyVerifier {
    fn verify_client_cert(
        &self,
        leaf: &CertificateDer<'_>,
        between: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, rustls::Error> {
        let verified = self.verifier.verify_client_cert(leaf, between, now);
        let skipped_ms = self.clock.now().jump.map_or(0, |jump| jump.skipped_ms);
        match verified {
            Err(error) if skipped_ms > 0 && is_expired(&error) => {
                let steady = Duration::from_secs(now.as_secs()).saturating_sub(Duration::from_millis(skipped_ms));
                self.verifier.verify_client_cert(leaf, between, UnixTime::since_unix_epoch(steady))
            }
            verified => verified,
        }
    }
    fn offer_client_auth(&self) -> bool {
        self.verifier.offer_client_auth()
    }
    fn client_auth_mandatory(&self) -> bool {
        self.verifier.client_auth_mandatory()
    }
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        self.verifier.root_hint_subjects()
    }
    fn verify_tls12_signature(
        &self,
        message: &[u8],
        leaf: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.verifier.verify_tls12_signature(message, leaf, signed)
    }
    fn verify_tls13_signature(
        &self,
        message: &[u8],
        leaf: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.verifier.verify_tls13_signature(message, leaf, signed)
    }
    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.verifier.supported_verify_schemes()
    }
}

fn is_expired(error: &rustls::Error) -> bool {
    use CertificateError::{Expired, ExpiredContext};
    matches!(error, rustls::Error::InvalidCertificate(Expired | ExpiredContext { .. }))
}
