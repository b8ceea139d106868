//! Refuses a request that is not to be carried out by a version that lacks something.
//!
//! A version passes over a field that it does not know. Where that would do more than the caller meant, as with a filter,
//! the caller names the feature in the header `midshift-requires`, and an older version refuses the request whole.

use http::HeaderMap;
use midshift_core::reason::{Code, Kind, Reason, Refusal};

/// The header: names of features, apart by commas.
const REQUIRES: &str = "midshift-requires";
/// Features that came after 0.2.0 and that this version has.
const FEATURES: [&str; 0] = [];

/// # Errors
/// The first feature that this version does not have.
pub(crate) fn check(headers: &HeaderMap) -> Result<(), Refusal> {
    let values = headers.get_all(REQUIRES).into_iter();
    let mut names = values.flat_map(|value| value.to_str().unwrap_or("?").split(',')).map(str::trim);
    match names.find(|name| !name.is_empty() && !FEATURES.contains(name)) {
        None => Ok(()),
        Some(name) => {
            let text = format!("this server does not have {name:.64}, which {REQUIRES} asks for");
            Err(Refusal::new(Kind::Invalid, Reason::new(Code::NotSupportedYet, text)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{REQUIRES, check};
    use http::{HeaderMap, HeaderValue};

    fn headers(values: &[&'static str]) -> HeaderMap {
        values.iter().map(|value| (http::HeaderName::from_static(REQUIRES), HeaderValue::from_static(value))).collect()
    }

    #[test]
    fn a_request_that_needs_what_this_version_does_not_have_is_refused_by_name() {
        for values in [&[][..], &[""], &[" , "]] {
            assert!(check(&headers(values)).is_ok(), "{values:?}");
        }
        for values in [&["", "affinity"][..], &[" affinity"], &["affinity,robot-classes"]] {
            let refused = check(&headers(values)).expect_err("this version does not have it");
            assert!(refused.reason.message.contains("does not have affinity,"), "{values:?}: {refused:?}");
        }
    }
}
