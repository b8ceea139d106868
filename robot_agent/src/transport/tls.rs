//! The client's half of TLS: whom it believes, what it shows, and how it comes to believe a site of which it knows a
//! digest alone.
//!
//! Invariant: version 1.3 with the site's own root and no other: no certificate of the public web lets a server speak
//! to a robot. Every server of a site answers to one name, so an address may change without a new certificate. Called
//! by the agent, the CLI and the tests.

use midshift_core::Boxed;
use midshift_core::identity::Digest;
use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, aws_lc_rs, verify_tls12_signature, verify_tls13_signature};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::version::TLS13;
use rustls::{CertificateError, ClientConfig, DigitallySignedStruct, RootCertStore, SignatureScheme};
use sha2::Digest as _;
use std::io;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use webpki::EndEntityCert;

/// What every server of a site is called.
const SERVER_NAME: &str = "midshift";
/// A server that has not shown its certificate by then is not there, real time.
const SHOWN_WITHIN: Duration = Duration::from_secs(5);

/// Why there is no TLS.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A certificate or a key that cannot be read.
    #[error("reading {what}: {reason}")]
    Unreadable {
        /// What was being read.
        what: &'static str,
        /// What speaks against it, in words.
        reason: String,
    },
    /// Certificate and key.
    #[error("taking the certificate: {0}")]
    Proof(#[source] rustls::Error),
    /// The server was not reached, or is none of this site.
    #[error("the server did not prove that it is of the site: {0}")]
    NotShown(#[source] io::Error),
    /// The server is of another site than the digest.
    #[error(
        "the server at {address} is of another site than the secret or digest that was given: its root has another key. \
         Look at the address, or take the whole line anew from `midshift robot enroll` where you are signed in to that site"
    )]
    OtherRoot {
        /// The server.
        address: String,
    },
}

/// The newest way to speak TLS; clones are the same.
#[derive(Clone, Debug)]
pub struct Tls(watch::Receiver<Arc<ClientConfig>>);

impl Tls {
    /// One that never changes.
    pub fn fixed(config: Arc<ClientConfig>) -> Self {
        Self(watch::Sender::new(config).subscribe())
    }
    /// One whose certificate is renewed: each new connection takes the newest.
    pub const fn newest(config: watch::Receiver<Arc<ClientConfig>>) -> Self {
        Self(config)
    }
    /// Speaks TLS over `stream`.
    ///
    /// # Errors
    /// The server is none of the site, or the stream ended.
    pub async fn over<S: AsyncRead + AsyncWrite + Unpin>(&self, stream: S) -> io::Result<TlsStream<S>> {
        let config = self.0.borrow().clone();
        connect(config, stream).await
    }
}

async fn connect<S: AsyncRead + AsyncWrite + Unpin>(config: Arc<ClientConfig>, stream: S) -> io::Result<TlsStream<S>> {
    let name = ServerName::try_from(SERVER_NAME).map_err(io::Error::other)?;
    TlsConnector::from(config).connect(name, stream).await
}

/// Believes this root, and shows this certificate and key, if any; all PEM.
///
/// # Errors
/// One of them cannot be read, or they do not fit.
pub fn config(authority_pem: &str, proof: Option<(&str, &str)>) -> Result<Arc<ClientConfig>, Error> {
    let mut roots = RootCertStore::empty();
    for root in certificates(authority_pem, "the site's root")? {
        roots.add(root).map_err(Error::Proof)?;
    }
    let builder = ClientConfig::builder_with_provider(Arc::new(aws_lc_rs::default_provider()))
        .with_protocol_versions(&[&TLS13])
        .map_err(Error::Proof)?
        .with_root_certificates(roots);
    let config = match proof {
        None => builder.with_no_client_auth(),
        Some((chain_pem, key_pem)) => {
            let chain = certificates(chain_pem, "the certificate")?;
            let key = PrivateKeyDer::from_pem_slice(key_pem.as_bytes())
                .map_err(|error| Error::Unreadable { what: "the key", reason: error.to_string() })?;
            builder.with_client_auth_cert(chain, key).map_err(Error::Proof)?
        }
    };
    Ok(Arc::new(h2(config)))
}

fn h2(mut config: ClientConfig) -> ClientConfig {
    config.alpn_protocols = vec![b"h2".to_vec()];
    // Each connection proves itself anew: the server keeps no tickets either.
    config.resumption = rustls::client::Resumption::disabled();
    config
}

fn certificates(pem: &str, what: &'static str) -> Result<Vec<CertificateDer<'static>>, Error> {
    let unreadable = |reason: String| Error::Unreadable { what, reason };
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem.as_bytes()).collect();
    let read = read.map_err(|error| unreadable(error.to_string()))?;
    if read.is_empty() { Err(unreadable("no certificate in PEM".to_owned())) } else { Ok(read) }
}

/// The root that the server at `address` (host:port) shows, which must have a key with this digest; PEM.
///
/// # Errors
/// Nobody is there, or it shows another root, or its own certificate is not of it.
pub fn authority_of(address: &str, pin: Digest) -> Boxed<'_, Result<String, Error>> {
    Box::pin(async move {
        let shown = async {
            let stream = TcpStream::connect(address).await?;
            let provider = Arc::new(aws_lc_rs::default_provider());
            let config = ClientConfig::builder_with_provider(provider.clone())
                .with_protocol_versions(&[&TLS13])
                .map_err(io::Error::other)?
                .dangerous()
                .with_custom_certificate_verifier(Arc::new(Pinned { pin, provider }))
                .with_no_client_auth();
            let stream = connect(Arc::new(h2(config)), stream).await?;
            let chain = stream.get_ref().1.peer_certificates().unwrap_or_default();
            let root = chain.iter().find(|shown| digest_of(shown) == Some(pin)).cloned();
            root.ok_or_else(|| io::Error::other("the root is gone"))
        };
        let late = |_| Error::NotShown(io::ErrorKind::TimedOut.into());
        let not_shown = |error: io::Error| match is_other_root(&error) {
            true => Error::OtherRoot { address: address.to_owned() },
            false => Error::NotShown(error),
        };
        let root = timeout(SHOWN_WITHIN, shown).await.map_err(late)?.map_err(not_shown)?;
        Ok(pem("CERTIFICATE", &root))
    })
}

/// Whether a handshake failed since the server's root has another key than the pinned one.
fn is_other_root(error: &io::Error) -> bool {
    let inner = error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>());
    matches!(inner, Some(rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer)))
}

fn pem(label: &str, der: &[u8]) -> String {
    use base64::Engine;
    let text = base64::engine::general_purpose::STANDARD.encode(der);
    let lines = text.as_bytes().chunks(64).map(String::from_utf8_lossy);
    lines.fold(format!("-----BEGIN {label}-----\n"), |text, line| text + &line + "\n")
        + &format!("-----END {label}-----\n")
}

/// Digest of the public key of a certificate.
pub fn digest_of(certificate: &CertificateDer<'_>) -> Option<Digest> {
    let read = EndEntityCert::try_from(certificate).ok()?;
    Some(Digest(sha2::Sha256::digest(read.subject_public_key_info()).into()))
}

/// Digest of the public key of a root, PEM.
///
/// # Errors
/// It cannot be read.
pub fn pin_of(authority_pem: &str) -> Result<Digest, Error> {
    let what = "the site's root";
    let first = certificates(authority_pem, what)?.into_iter().next();
    let digest = first.as_ref().and_then(digest_of);
    digest.ok_or_else(|| Error::Unreadable { what, reason: "no public key in it".to_owned() })
}

/// Believes a server whose certificate is signed by a root that it shows and whose key has this digest.
#[derive(Debug)]
struct Pinned {
    pin: Digest,
    provider: Arc<CryptoProvider>,
}

impl ServerCertVerifier for Pinned {
    fn verify_server_cert(
        &self,
        leaf: &CertificateDer<'_>,
        chain: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let root = chain.iter().find(|shown| digest_of(shown) == Some(self.pin));
        let root = root.ok_or(rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer))?;
        let mut roots = RootCertStore::empty();
        roots.add(root.clone().into_owned())?;
        let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), self.provider.clone())
            .build()
            .map_err(|error| rustls::Error::General(error.to_string()))?;
        verifier.verify_server_cert(leaf, &[], name, ocsp, now)
    }
    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls12_signature(message, certificate, signed, &self.provider.signature_verification_algorithms)
    }
    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls13_signature(message, certificate, signed, &self.provider.signature_verification_algorithms)
    }
    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
    use tokio::net::TcpListener;
    use tokio_rustls::TlsAcceptor;

    #[tokio::test]
    async fn a_server_of_another_site_than_the_secret_is_told_as_such_and_not_as_a_matter_of_issuers() {
        let mut params = CertificateParams::new(Vec::new()).expect("parameters");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let root = CertifiedIssuer::self_signed(params, KeyPair::generate().expect("a key")).expect("a root");
        let key = KeyPair::generate().expect("a key");
        let leaf = CertificateParams::new(vec![SERVER_NAME.to_owned()]).expect("parameters");
        let leaf = leaf.signed_by(&key, &root).expect("a certificate").der().clone();
        let config = rustls::ServerConfig::builder_with_provider(Arc::new(aws_lc_rs::default_provider()))
            .with_protocol_versions(&[&TLS13])
            .expect("TLS 1.3")
            .with_no_client_auth()
            .with_single_cert(
                vec![leaf, root.der().clone()],
                PrivateKeyDer::try_from(key.serialize_der()).expect("a key"),
            );
        let mut config = config.expect("a server's TLS");
        config.alpn_protocols = vec![b"h2".to_vec()];
        let (acceptor, listener) = (TlsAcceptor::from(Arc::new(config)), TcpListener::bind("127.0.0.1:0").await);
        let listener = listener.expect("a port");
        let address = listener.local_addr().expect("an address").to_string();
        let serve = async {
            loop {
                let (stream, _) = listener.accept().await.expect("a connection");
                drop(acceptor.accept(stream).await);
            }
        };
        let own = digest_of(root.der()).expect("a key");
        let asked = async { (authority_of(&address, own).await, authority_of(&address, Digest([7; 32])).await) };
        let (right, wrong) = tokio::select! {
            () = serve => unreachable!("it goes on"),
            asked = asked => asked,
        };
        assert_eq!(pin_of(&right.expect("its own site")).expect("a root"), own);
        let wrong = wrong.expect_err("another site");
        assert!(matches!(&wrong, Error::OtherRoot { address: told } if *told == address), "{wrong:?}");
        assert!(wrong.to_string().contains("another site") && !wrong.to_string().contains("UnknownIssuer"), "{wrong}");
    }
}
