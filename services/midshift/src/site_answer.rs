//! Says in each answer to a health check of which site a server is and where its stop service listens; reads that on the other side.
//!
//! Whoever may ask for health may ask for this: nobody has to sign in for it, and it is needed most where nobody has.

use crate::stop;
use http::{HeaderValue, Response};
use tonic::body::Body;
use tonic::metadata::MetadataMap;
use tower::util::MapResponseLayer;

const SITE: &str = "midshift-site";
const STOP_PORT: &str = "midshift-stop-port";

/// What a server says of its site.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SiteAnswer {
    /// Which site.
    pub site_id: String,
    /// The port of its stop service, on the same host. None: it runs elsewhere.
    pub stop_port: Option<u16>,
}

impl SiteAnswer {
    /// Where the stop service beside `server` is, host:port, if it is not on the usual port.
    pub fn unusual_stop_server(&self, server: &str) -> Option<String> {
        let port = self.stop_port.filter(|port| *port != stop::PORT)?;
        stop::beside_on(server, port)
    }

    /// Reads it; none: that is no server of midshift.
    pub fn read(metadata: &MetadataMap) -> Option<Self> {
        let text = |name| metadata.get(name).and_then(|value| value.to_str().ok());
        Some(Self { site_id: text(SITE)?.to_owned(), stop_port: text(STOP_PORT).and_then(|port| port.parse().ok()) })
    }

    /// Adds it to each answer of a service.
    pub fn layer(self) -> MapResponseLayer<impl Fn(Response<Body>) -> Response<Body> + Clone + Send + Sync + 'static> {
        // The name of a site is letters, digits and dashes.
        let site = HeaderValue::from_str(&self.site_id).ok();
        let port = self.stop_port.map(HeaderValue::from);
        MapResponseLayer::new(move |mut response: Response<Body>| {
            let said = [(SITE, &site), (STOP_PORT, &port)];
            let said = said.into_iter().filter_map(|(name, value)| Some((name, value.clone()?)));
            said.for_each(|(name, value)| drop(response.headers_mut().insert(name, value)));
            response
        })
    }
}
