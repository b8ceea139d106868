//! Says in each answer to a health check of which site a server is, where its stop service listens, what its wall clock jumped and whether that is in doubt; reads it on
//! the other side.
//!
//! Whoever may ask for health may ask for this: nobody has to sign in for it, and it is needed most where nobody has.

use crate::stop_service;
use http::{HeaderValue, Response};
use midshift_core::time::{Clock, Utc};
use std::sync::Arc;
use tonic::body::Body;
use tonic::metadata::MetadataMap;
use tower::util::MapResponseLayer;

const SITE: &str = "midshift-site";
const STOP_PORT: &str = "midshift-stop-port";
const CLOCK_JUMP: &str = "midshift-clock-jump";
const CLOCK_DOUBT: &str = "midshift-clock-doubt";

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
        let port = self.stop_port.filter(|port| *port != stop_service::PORT)?;
        stop_service::beside_on(server, port)
    }

    /// Reads it; none: that is no server of midshift.
    pub fn read(metadata: &MetadataMap) -> Option<Self> {
        let text = |name| metadata.get(name).and_then(|value| value.to_str().ok());
        Some(Self { site_id: text(SITE)?.to_owned(), stop_port: text(STOP_PORT).and_then(|port| port.parse().ok()) })
    }

    /// Adds it, the newest jump of the wall and a doubt about it to each answer of a service; `before` is the jump of the run before.
    pub fn layer(
        self,
        clock: Arc<dyn Clock>,
        before: Option<(i64, Utc)>,
    ) -> MapResponseLayer<impl Fn(Response<Body>) -> Response<Body> + Clone + Send + Sync + 'static> {
        // The name of a site is letters, digits and dashes.
        let site = HeaderValue::from_str(&self.site_id).ok();
        let port = self.stop_port.map(HeaderValue::from);
        MapResponseLayer::new(move |mut response: Response<Body>| {
            let jump = clock.last_jump().map(|jump| (jump.step_ms(), jump.to)).or(before);
            let jump = jump.and_then(|(step_ms, to)| said_jump(step_ms, to).parse().ok());
            let doubt = clock.doubt().and_then(|doubt| said_jump(doubt.step_ms, doubt.at).parse().ok());
            let said = [(SITE, site.clone()), (STOP_PORT, port.clone()), (CLOCK_JUMP, jump), (CLOCK_DOUBT, doubt)];
            let said = said.into_iter().filter_map(|(name, value)| Some((name, value?)));
            said.for_each(|(name, value)| drop(response.headers_mut().insert(name, value)));
            response
        })
    }
}

fn said_jump(step_ms: i64, to: Utc) -> String {
    format!("{step_ms} {}", to.0)
}

/// Milliseconds that the wall clock of a server jumped ahead at last (negative: back), and UTC when it had.
pub fn clock_jump(metadata: &MetadataMap) -> Option<(i64, Utc)> {
    step(metadata, CLOCK_JUMP)
}

/// Milliseconds that the wall clock of a server is ahead of where it should be (negative: behind), and UTC when that was seen: it signs nothing by it.
pub fn clock_doubt(metadata: &MetadataMap) -> Option<(i64, Utc)> {
    step(metadata, CLOCK_DOUBT)
}

fn step(metadata: &MetadataMap, name: &str) -> Option<(i64, Utc)> {
    let (step_ms, to) = metadata.get(name)?.to_str().ok()?.split_once(' ')?;
    Some((step_ms.parse().ok()?, Utc(to.parse().ok()?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jump_is_read_as_it_was_said() {
        let mut answer = MetadataMap::new();
        assert_eq!(clock_jump(&answer), None);
        for jump in [(7_200_000, Utc(1_800_000_000_000)), (-6_000, Utc(5))] {
            answer.insert(CLOCK_JUMP, said_jump(jump.0, jump.1).parse().expect("text"));
            assert_eq!(clock_jump(&answer), Some(jump));
        }
        answer.insert(CLOCK_JUMP, "soon".parse().expect("text"));
        assert_eq!(clock_jump(&answer), None);
    }
}
