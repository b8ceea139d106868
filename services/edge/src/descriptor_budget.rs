//! How many connections a port may take of the descriptors that this process may have.
//!
//! Invariant: what databases and files need is never given to connections, so that who is known can be read and a stop be written down while a port is full. Called
//! once for a port, before it opens. Absent on purpose: two ports in one process, which `dev` alone has, for a site on one machine.

use midshift_core::limits;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Too few descriptors for a port.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "this process may have {descriptors} files open at a time and needs {least} for a port at all, more for each robot: `ulimit -n 65536` in the shell that starts it, \
     LimitNOFILE=65536 in its unit, or --ulimit nofile=65536 for its container"
)]
pub struct TooFew {
    descriptors: u64,
    least: u64,
}

/// Raises the soft limit of descriptors to the hard one, and says how many connections a port may take then: at most
/// [`limits::CONNECTIONS_MAX`], without the [`limits::DESCRIPTORS_KEPT`].
///
/// # Errors
/// Fewer than [`limits::CONNECTIONS_LEAST`].
pub fn connections_max() -> Result<usize, TooFew> {
    let allowed = getrlimit(Resource::Nofile);
    // A system that does not let us is left as it is.
    let _ = setrlimit(Resource::Nofile, Rlimit { current: allowed.maximum, ..allowed });
    limit_connections(getrlimit(Resource::Nofile).current)
}

/// `descriptors`: none is without a limit.
fn limit_connections(descriptors: Option<u64>) -> Result<usize, TooFew> {
    let descriptors = descriptors.unwrap_or(u64::MAX);
    let room = usize::try_from(descriptors).unwrap_or(usize::MAX).saturating_sub(limits::DESCRIPTORS_KEPT);
    if room < limits::CONNECTIONS_LEAST {
        return Err(TooFew { descriptors, least: (limits::DESCRIPTORS_KEPT + limits::CONNECTIONS_LEAST) as u64 });
    }
    Ok(room.min(limits::CONNECTIONS_MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_keep_their_descriptors_and_what_is_too_small_says_what_to_type() {
        assert_eq!(
            [limit_connections(Some(1_024)), limit_connections(Some(65_536)), limit_connections(None)],
            [Ok(512), Ok(16_384), Ok(16_384)]
        );
        assert_eq!(limit_connections(Some(576)), Ok(64));
        let error = limit_connections(Some(575)).unwrap_err();
        assert!(error.to_string().contains("may have 575 files") && error.to_string().contains("ulimit -n"), "{error}");
    }
}
