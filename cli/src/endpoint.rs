//! The endpoint of a server for people, programs and tests: its address, the site's root if it speaks TLS, and the
//! token that is shown with each request.
//!
//! Invariant: a token is sent over TLS alone, and never printed: nothing here has a Debug that shows it.

use anyhow::Context;
use midshift_agent::dial::{Dial, TcpDial, Wire};
use midshift_agent::tls::{self, Tls};
use midshift_core::identity::Secret;
use std::time::Duration;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{self, Channel};
use tonic::{Request, Status};

pub use midshift_agent::dial::with_scheme;

/// A server that does not answer a connection within this is not there.
const CONNECT_WITHIN: Duration = Duration::from_secs(3);
/// A connection with a call under way on which nothing came for so long is asked for a sign of life, and is gone if
/// none comes within [`ALIVE_WITHIN`].
const QUIET: Duration = Duration::from_secs(30);
const ALIVE_WITHIN: Duration = Duration::from_secs(20);

/// The address with its scheme, for plain text.
pub fn uri(server: &str) -> String {
    with_scheme("http", server)
}

/// A channel that shows the token, if there is one.
pub type Line = InterceptedService<Channel, Bearer>;

/// The token of one channel.
#[derive(Clone)]
pub struct Bearer(Option<MetadataValue<Ascii>>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.0 {
            request.metadata_mut().insert("authorization", token.clone());
        }
        Ok(request)
    }
}

/// One server, and what is shown to it.
#[derive(Clone)]
pub struct Endpoint {
    dial: TcpDial,
    bearer: Bearer,
}

impl Endpoint {
    /// To `server` (host:port), in plain text and without a token.
    ///
    /// # Errors
    /// The address is none.
    pub fn plain(server: &str) -> anyhow::Result<Self> {
        Ok(Self { dial: dial(&uri(server))?, bearer: Bearer(None) })
    }

    /// To `server` of the site with this root (PEM), with a token if one is given.
    ///
    /// # Errors
    /// The address is none, the root cannot be read, or the token is none.
    pub fn secure(server: &str, authority_pem: &str, token: Option<&str>) -> anyhow::Result<Self> {
        let tls = Tls::fixed(tls::config(authority_pem, None)?);
        let bare = server.split_once("://").map_or(server, |(_, bare)| bare);
        let dial = dial(&format!("https://{bare}"))?.with_tls(tls);
        let bearer = token.map(|token| {
            let token = token.trim();
            Secret::read(Secret::TOKEN, token).context("the token is none: it looks like mst.ID.DIGITS")?;
            let mut value: MetadataValue<Ascii> = format!("Bearer {token}").parse()?;
            value.set_sensitive(true);
            anyhow::Ok(value)
        });
        Ok(Self { dial, bearer: Bearer(bearer.transpose()?) })
    }

    /// A channel that stands.
    ///
    /// # Errors
    /// Nobody is there, or it is none of the site.
    pub async fn connect(&self) -> Result<Line, midshift_agent::dial::Error> {
        Ok(InterceptedService::new(self.dial.dial().await?, self.bearer.clone()))
    }

    /// A connection without HTTP.
    ///
    /// # Errors
    /// Nobody is there, or it is none of the site.
    pub async fn wire(&self) -> std::io::Result<Wire> {
        self.dial.wire().await
    }

    /// A channel that connects when it is used.
    pub fn lazy(&self) -> Line {
        InterceptedService::new(self.dial.lazy(), self.bearer.clone())
    }
}

fn dial(uri: &str) -> anyhow::Result<TcpDial> {
    let endpoint =
        transport::Endpoint::from_shared(uri.to_owned()).with_context(|| format!("reading the address {uri}"))?;
    let endpoint = endpoint.connect_timeout(CONNECT_WITHIN);
    Ok(TcpDial::over(endpoint.http2_keep_alive_interval(QUIET).keep_alive_timeout(ALIVE_WITHIN), None)?)
}
