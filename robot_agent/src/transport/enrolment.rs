//! How a machine becomes a robot of a site, and stays one: a secret once, a certificate each few days.
//!
//! Invariant: the key is the machine's own and never leaves it; what comes from the site is a certificate of it. A
//! certificate is renewed at half of its life, so that a site may be out of reach for days.

use super::dial::{self, Dial, TcpDial};
use super::tls;
use crate::storage::DeviceKey;
use midshift_core::Boxed;
use midshift_core::identity::{Digest, Secret};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::time::{Clock, Utc};
use midshift_proto::convert::common::time_of;
use midshift_proto::identity::v1::enrolment_service_client::EnrolmentServiceClient;
use midshift_proto::identity::v1::{EnrolRequest, RenewCertificateRequest};
use rcgen::{CertificateParams, KeyPair};
use rustls::ClientConfig;
use serde::{Deserialize, Serialize};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tonic::Status;

/// What the machine keeps of the site, in its folder.
const FILE: &str = "identity.json";
/// A renewal that failed is tried again so often, link clock.
const AGAIN: Duration = Duration::from_secs(60);
/// How often it is looked whether a renewal is due, link clock.
const LOOK: Duration = Duration::from_secs(60);

/// Why the machine is no robot of the site.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// What was given to enrol with.
    #[error("this is no enrolment: it looks like mse.ID.SECRET.DIGEST and comes from `midshift robot enroll`")]
    NoLine,
    /// TLS cannot be set up with what it has.
    #[error(transparent)]
    Tls(#[from] tls::Error),
    /// The way to the server.
    #[error(transparent)]
    Dial(#[from] dial::Error),
    /// The server's answer.
    #[error("the site answered: {}", .0.message())]
    Refused(Box<Status>),
    /// The file.
    #[error("{path}: {source}", path = path.display())]
    File {
        /// The file that was read or written.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// A file with a secret that others may read.
    #[error("{path} has a secret and is open to others (mode {mode:03o}): enrol the robot again, and type `chmod go= {path}` before the new secret is in it", path = path.display())]
    Open {
        /// The file with the secret.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// The machine's key.
    #[error("using the machine's key: {0}")]
    Key(#[source] rcgen::Error),
    /// It was enrolled under another name.
    #[error("this machine is enrolled as {known}: give it a data folder of its own for {asked}")]
    OtherRobot {
        /// As it is.
        known: RobotId,
        /// As it was asked to be.
        asked: RobotId,
    },
    /// It has no certificate and was given nothing to get one with.
    #[error(
        "this machine is not enrolled: run `midshift robot enroll {0}` where you are signed in, and start it with the line that is printed"
    )]
    NotEnrolled(RobotId),
}

impl From<Status> for Error {
    fn from(status: Status) -> Self {
        Self::Refused(Box::new(status))
    }
}

/// What `robot enroll` printed: a secret, and the digest of the site's root.
pub struct Invitation {
    secret: Secret,
    /// Digest of the public key of the root.
    pub pin: Digest,
}

impl FromStr for Invitation {
    type Err = Error;
    fn from_str(text: &str) -> Result<Self, Error> {
        let (secret, pin) = text.trim().rsplit_once('.').ok_or(Error::NoLine)?;
        let secret = Secret::read(Secret::ENROLMENT, secret).ok_or(Error::NoLine)?;
        Ok(Self { secret, pin: pin.parse().map_err(|_| Error::NoLine)? })
    }
}

impl Invitation {
    /// Reads the line from a file of its owner's alone.
    ///
    /// # Errors
    /// The file, that others may read it, or that it holds no such line.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let file = |source| Error::File { path: path.to_owned(), source };
        let text = std::fs::read_to_string(path).map_err(file)?;
        let mode = path.metadata().map_err(file)?.permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            return Err(Error::Open { path: path.to_owned(), mode });
        }
        text.parse()
    }
}

/// Without the secret.
impl std::fmt::Debug for Invitation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Invitation").field("id", self.secret.id()).field("pin", &self.pin).finish()
    }
}

/// What a machine has of its site. A newer version's fields are not looked at: it may have renewed the certificate
/// before it was gone back from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Enrolled {
    /// Who it is there.
    pub robot_id: RobotId,
    /// Its certificate, PEM.
    pub certificate_pem: String,
    /// The site's root, PEM.
    pub authority_pem: String,
    /// When the certificate is over, UTC unix ms.
    pub expires_unix_ms: i64,
    /// What it may take as software: its trust file; empty: nothing was said.
    #[serde(default)]
    pub trust_json: String,
    /// Name of the line that it was enrolled with; empty: nobody knows.
    #[serde(default)]
    pub line_id: String,
}

impl Enrolled {
    /// What was kept in `folder`; none: nothing.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn read(folder: &Path) -> Result<Option<Self>, Error> {
        let path = folder.join(FILE);
        let text = match std::fs::read(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(Error::File { path, source }),
        };
        serde_json::from_slice(&text).map(Some).map_err(|error| Error::File { path, source: error.into() })
    }

    /// Keeps it in `folder`.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), Error> {
        let path = folder.join(FILE);
        let text = serde_json::to_vec_pretty(self).map_err(io::Error::from);
        let written =
            midshift_durable::make_folder(folder).and(text).and_then(|text| midshift_durable::replace(&path, &text));
        written.map_err(|source| Error::File { path, source })
    }

    /// How the machine speaks to the site.
    ///
    /// # Errors
    /// Certificate and key do not fit.
    pub fn config(&self, key: &DeviceKey) -> Result<Arc<ClientConfig>, Error> {
        Ok(tls::config(&self.authority_pem, Some((&self.certificate_pem, &key.tls_pem())))?)
    }

    /// Whether this line gave it.
    fn is_from(&self, invited: &Invitation) -> Result<bool, Error> {
        Ok(tls::pin_of(&self.authority_pem)? == invited.pin && self.line_id == invited.secret.id().as_str())
    }

    fn is_due(&self, now: Utc) -> bool {
        let half = limits::ROBOT_CERTIFICATE_VALID.as_ms().cast_signed() / 2;
        self.expires_unix_ms - half <= now.0
    }
}

fn request(key: &DeviceKey) -> Result<String, Error> {
    let pair = KeyPair::from_pem(&key.tls_pem()).map_err(Error::Key)?;
    // Names are the site's to give.
    let params = CertificateParams::default();
    params.serialize_request(&pair).and_then(|request| request.pem()).map_err(Error::Key)
}

/// Becomes `robot_id` at the server at `address` (host:port).
///
/// # Errors
/// The server is none of the invitation's site, or says no.
pub fn enrol<'a>(
    address: &'a str,
    robot_id: &'a RobotId,
    invitation: &'a Invitation,
    key: &'a DeviceKey,
) -> Boxed<'a, Result<Enrolled, Error>> {
    Box::pin(async move {
        let authority_pem = tls::authority_of(address, invitation.pin).await?;
        let believes = tls::Tls::fixed(tls::config(&authority_pem, None)?);
        let channel = TcpDial::new(&format!("https://{address}"), None)?.with_tls(believes).dial().await?;
        let asked = EnrolRequest {
            robot_id: robot_id.to_string(),
            secret: invitation.secret.reveal(Secret::ENROLMENT),
            request_pem: request(key)?,
        };
        let answer = EnrolmentServiceClient::new(channel).enrol(asked).await?.into_inner();
        Ok(Enrolled {
            robot_id: robot_id.clone(),
            certificate_pem: answer.certificate_pem,
            authority_pem,
            expires_unix_ms: answer.expire_time.map_or(0, |time| time_of(&time).0),
            trust_json: answer.trust_json,
            line_id: invitation.secret.id().to_string(),
        })
    })
}

/// A machine's identity while it runs.
pub struct Identity {
    folder: Option<PathBuf>,
    key: DeviceKey,
    enrolled: Enrolled,
    config: watch::Sender<Arc<ClientConfig>>,
}

impl Identity {
    /// Of what was kept or just given; kept in `folder`, if one is named.
    ///
    /// # Errors
    /// Certificate and key do not fit.
    pub fn new(enrolled: Enrolled, key: DeviceKey, folder: Option<PathBuf>) -> Result<Self, Error> {
        let config = watch::Sender::new(enrolled.config(&key)?);
        Ok(Self { folder, key, enrolled, config })
    }

    /// Of the machine with this folder: as it was kept, or with this invitation at `address`.
    ///
    /// # Errors
    /// It is neither enrolled nor invited, or is another robot.
    pub fn open<'a>(
        folder: &'a Path,
        robot_id: &'a RobotId,
        key: DeviceKey,
        address: &'a str,
        invitation: Option<&'a Invitation>,
    ) -> Boxed<'a, Result<Self, Error>> {
        Box::pin(async move {
            let enrolled = match (Enrolled::read(folder)?, invitation) {
                (Some(known), _) if known.robot_id != *robot_id => {
                    return Err(Error::OtherRobot { known: known.robot_id, asked: robot_id.clone() });
                }
                (Some(known), None) => known,
                // A line that was used already stays in a unit file: what it gave is there.
                (Some(known), Some(invited)) if known.is_from(invited)? => known,
                (known, Some(invited)) => match (enrol(address, robot_id, invited, &key).await, known) {
                    (Ok(enrolled), _) => {
                        enrolled.write(folder)?;
                        enrolled
                    }
                    (Err(error), Some(known)) if tls::pin_of(&known.authority_pem)? == invited.pin => {
                        tracing::warn!(%robot_id, %error, "not enrolled anew: it goes on with the certificate that it has");
                        known
                    }
                    (Err(error), _) => return Err(error),
                },
                (None, None) => return Err(Error::NotEnrolled(robot_id.clone())),
            };
            Self::new(enrolled, key, Some(folder.to_owned()))
        })
    }

    /// What the machine was given.
    pub const fn enrolled(&self) -> &Enrolled {
        &self.enrolled
    }

    /// How it speaks to servers of the site.
    pub fn tls(&self) -> tls::Tls {
        tls::Tls::newest(self.config.subscribe())
    }

    /// Renews the certificate in its time, over ways of its own, until it is dropped.
    pub fn renew_when_due(mut self, dial: Arc<dyn Dial>, clock: Arc<dyn Clock>) -> Boxed<'static, ()> {
        Box::pin(async move {
            loop {
                let pause = if self.enrolled.is_due(clock.now().wall) {
                    match self.renew(&*dial).await {
                        Ok(()) => LOOK,
                        Err(error) => {
                            tracing::warn!(%error, "the certificate was not renewed");
                            AGAIN
                        }
                    }
                } else {
                    LOOK
                };
                tokio::time::sleep(pause).await;
            }
        })
    }

    async fn renew(&mut self, dial: &dyn Dial) -> Result<(), Error> {
        let asked =
            RenewCertificateRequest { robot_id: self.enrolled.robot_id.to_string(), request_pem: request(&self.key)? };
        let answer = EnrolmentServiceClient::new(dial.dial().await?).renew_certificate(asked).await?.into_inner();
        let renewed = Enrolled {
            certificate_pem: answer.certificate_pem,
            expires_unix_ms: answer.expire_time.map_or(0, |time| time_of(&time).0),
            ..self.enrolled.clone()
        };
        let config = renewed.config(&self.key)?;
        if let Some(folder) = &self.folder {
            renewed.write(folder)?;
        }
        self.enrolled = renewed;
        self.config.send_replace(config);
        tracing::info!(robot_id = %self.enrolled.robot_id, "the certificate was renewed");
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_in_a_file_is_taken_if_its_owner_alone_may_read_it_and_is_never_shown() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("enroll");
        let digits = "5a".repeat(32);
        std::fs::write(&path, format!("mse.k3f9.{digits}.{digits}\n")).expect("written");
        let close = |mode| std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).expect("a mode");
        close(0o600);
        let read = Invitation::read(&path).expect("its owner's alone");
        assert_eq!((read.secret.id().as_str(), read.pin.to_string()), ("k3f9", digits.clone()));
        for mode in [0o640, 0o604, 0o660] {
            close(mode);
            let refused = Invitation::read(&path).expect_err("others may read it").to_string();
            assert!(refused.contains(&format!("(mode {mode:03o})")) && refused.contains("chmod go= "), "{refused}");
            assert!(!refused.contains(&digits), "{refused}");
        }
        close(0o600);
        std::fs::write(&path, "something else").expect("written");
        assert!(matches!(Invitation::read(&path), Err(Error::NoLine)));
        assert!(matches!(Invitation::read(&dir.path().join("none")), Err(Error::File { .. })));
    }
}
