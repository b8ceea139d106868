//! Principals of a port with login: robots by the certificates of the site, people and programs by their tokens.
//!
//! Invariant: answers come from memory alone, from the newest directory that was published; nothing of the store lies on the way of a request. Before the first
//! one no token is known, while robots with a genuine certificate come in: the stop line of a robot must not wait for anybody.

use crate::peer::{Denied, Peer, Principals};
use http::HeaderMap;
use http::header::AUTHORIZATION;
use midshift_core::identity::{Caller, Digest, Directory, Secret, TokenId};
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::time::Clock;
use rustls::pki_types::CertificateDer;
use sha2::Digest as _;
use std::sync::Arc;
use tokio::sync::watch;
use webpki::EndEntityCert;

/// Everybody a directory knows.
pub struct SitePrincipals {
    site_id: SiteId,
    clock: Arc<dyn Clock>,
    directory: watch::Sender<Arc<Directory>>,
    changed: watch::Sender<u64>,
}

impl SitePrincipals {
    /// Of this site; nobody but its robots before [`SitePrincipals::publish`].
    pub fn new(site_id: SiteId, clock: Arc<dyn Clock>) -> Self {
        let (directory, changed) = (watch::Sender::new(Arc::default()), watch::Sender::new(0));
        Self { site_id, clock, directory, changed }
    }

    /// What holds from now on. Whoever it denies is cut at once.
    pub fn publish(&self, directory: Directory) {
        let is_new = self.directory.send_if_modified(|known| {
            let differs = **known != directory;
            if differs {
                *known = Arc::new(directory);
            }
            differs
        });
        if is_new {
            self.changed.send_modify(|n| *n += 1);
        }
    }

    fn robot(&self, leaf: &CertificateDer<'_>) -> Result<(RobotId, Digest), Denied> {
        let (robot_id, key) = robot_of(leaf, &self.site_id).ok_or(Denied::Unknown)?;
        if self.directory.borrow().denies(&key) { Err(Denied::Revoked) } else { Ok((robot_id, key)) }
    }

    /// What whoever shows a certificate that is denied is told.
    fn refusal(&self, leaf: &CertificateDer<'_>, denied: Denied) -> Refusal {
        let reason = match (denied, robot_of(leaf, &self.site_id)) {
            (Denied::Revoked, Some((robot_id, _))) => {
                let text = format!(
                    "{robot_id} was revoked or replaced, and the key of this machine lets nobody in any more; `midshift robot \
                     identities` says by whom and when. To let the machine in again: `midshift robot enroll {robot_id}`, and \
                     start the agent with the line that it prints and an empty --data folder"
                );
                Reason::new(Code::KeyDenied, text).with("robot_id", robot_id)
            }
            _ => {
                let text = format!("the certificate of this machine names no robot of site {}", self.site_id);
                Reason::new(Code::KeyDenied, text)
            }
        };
        Refusal::new(Kind::Unauthenticated, reason)
    }
}

impl Principals for SitePrincipals {
    fn admit(&self, peer: &Peer) -> Result<(), Denied> {
        if let Some(leaf) = &peer.certificate {
            return self.robot(leaf).map(drop);
        }
        // Who shows none shows a token with each request: streams of one that was taken back or is over do not go on.
        // A wall that jumped far ahead ends none of them before somebody could look.
        let (directory, now) = (self.directory.borrow(), self.clock.now().standing_wall());
        let is_good = |token: &TokenId, was_expired| directory.is_good(token, was_expired, now);
        if peer.showed_all(is_good) { Ok(()) } else { Err(Denied::Token) }
    }

    fn changed(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    fn caller(&self, peer: &Peer, headers: &HeaderMap) -> Result<Caller, Refusal> {
        if let Some(leaf) = &peer.certificate {
            let (robot_id, key) = self.robot(leaf).map_err(|denied| self.refusal(leaf, denied))?;
            return Ok(Caller::robot(robot_id).with_certificate(serial_of(leaf)).with_key(key));
        }
        let Some(shown) = headers.get(AUTHORIZATION) else { return Ok(Caller::nobody()) };
        let text = shown.to_str().ok().and_then(|text| {
            let (scheme, text) = text.split_once(' ')?;
            scheme.eq_ignore_ascii_case("bearer").then_some(text)
        });
        let secret = text.and_then(|text| Secret::read(Secret::TOKEN, text));
        let Some(secret) = secret else { return Err(Refusal::new(Kind::Unauthenticated, Code::TokenUnknown)) };
        let digest = Digest(sha2::Sha256::digest(secret.bytes()).into());
        let holder = || self.directory.borrow().holder(secret.id(), &digest, self.clock.now().wall);
        let caller = holder()?;
        if peer.shows(secret.id(), caller.is_expired()) {
            // Whoever was taken back in between was not asked about with this connection.
            return holder();
        }
        Ok(caller)
    }
}

/// Serial number of a certificate, in hex; none: it cannot be read.
pub fn serial_of(leaf: &CertificateDer<'_>) -> Option<Arc<str>> {
    let certificate = EndEntityCert::try_from(leaf).ok()?;
    let hex: String = certificate.serial().iter().map(|byte| format!("{byte:02x}")).collect();
    Some(hex.into())
}

/// Which robot a certificate is of, and the digest of its public key; none: it is of no robot of this site. That it is genuine was proven in the handshake.
pub fn robot_of(leaf: &CertificateDer<'_>, site_id: &SiteId) -> Option<(RobotId, Digest)> {
    let certificate = EndEntityCert::try_from(leaf).ok()?;
    let prefix = format!("spiffe://{site_id}/robot/");
    let mut names = certificate.valid_uri_names();
    let robot_id = names.next()?.strip_prefix(&prefix).and_then(|id| RobotId::parse(id).ok())?;
    // A second name would be a second robot.
    if names.next().is_some() {
        return None;
    }
    let key = sha2::Sha256::digest(certificate.subject_public_key_info());
    Some((robot_id, Digest(key.into())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::peer::ConnectionId;
    use midshift_core::identity::DirectoryToken;
    use midshift_core::limits;
    use midshift_core::time::Utc;
    use midshift_core::wall_clock::WallClock;
    use std::collections::BTreeMap;
    use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

    #[test]
    fn what_a_token_began_stands_for_ten_minutes_after_the_wall_jumped_past_its_end() {
        const HOUR_MS: u64 = 3_600_000;
        let (us, stepped_ms) = (Arc::<AtomicU64>::default(), Arc::<AtomicU64>::default());
        let (mono, beside, ahead) = (us.clone(), us.clone(), stepped_ms.clone());
        let wall = move || Utc(1_000_000).plus_ms(beside.load(Relaxed) / 1000 + ahead.load(Relaxed));
        let clock = Arc::new(WallClock::new(move || mono.load(Relaxed), wall, |_| {}));
        let known = SitePrincipals::new(SiteId::parse("factory").expect("a site"), clock);
        let id = TokenId::new("t1").expect("an id");
        let expires_unix_ms = 1_000_000 + HOUR_MS.cast_signed();
        let (name, digest, person) = ("anna".into(), Digest([7; 32]), None);
        let token = DirectoryToken { name, person, digest, grants: Arc::from([]), expires_unix_ms };
        let directory = Directory { tokens: [(id.clone(), token)].into(), denied: BTreeMap::new() };
        known.publish(directory.clone());
        let peer = Peer::new(([127, 0, 0, 1], 1).into(), None, ConnectionId(1));
        peer.shows(&id, false);
        assert_eq!(known.admit(&peer), Ok(()));
        stepped_ms.store(2 * HOUR_MS, Relaxed);
        assert_eq!(known.admit(&peer), Ok(()));
        let standing_us = limits::CLOCK_JUMP_STANDING.as_ms() * 1_000;
        us.store(standing_us - 1_000, Relaxed);
        assert_eq!(known.admit(&peer), Ok(()));
        known.publish(Directory::default());
        assert_eq!(known.admit(&peer), Err(Denied::Token), "taken back, whatever the clock says");
        known.publish(directory);
        us.store(standing_us, Relaxed);
        assert_eq!(known.admit(&peer), Err(Denied::Token));
    }
}
