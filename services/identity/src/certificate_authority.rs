//! The site's own certificate authority: made once, its key in one file, and what it signs.
//!
//! Invariant: what is signed is said here and never by who asks: of a request only the public key is taken. A robot's certificate is good as a client alone, a
//! server's as a server alone.

use crate::{Error, files};
use midshift_core::identity::Digest;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::limits;
use midshift_core::reason::Refusal;
use midshift_core::time::{LinkDuration, Utc};
use rcgen::{
    BasicConstraints, Certificate, CertificateParams, CertificateSigningRequestParams, DistinguishedName, DnType,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose, PublicKeyData, SanType, SerialNumber,
};
use sha2::Digest as _;
use std::path::Path;
use time::OffsetDateTime;

/// Key and certificate in one file, so that there is never one without the other.
const FILE: &str = "authority.pem";
/// The certificate alone, for whoever wants to hold the server against it.
pub const PUBLIC_FILE: &str = "ca.pem";

/// The certificate authority of a site, with its private key.
pub struct CertificateAuthority {
    issuer: Issuer<'static, KeyPair>,
    certificate_pem: String,
    pin: Digest,
    site_id: SiteId,
}

/// A certificate that the authority signed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SignedCertificate {
    /// PEM, the leaf first.
    pub chain_pem: String,
    /// When it is over.
    pub expires: Utc,
}

/// A signing request whose signature holds.
pub struct SigningRequest {
    parameters: CertificateSigningRequestParams,
    /// Digest of its public key.
    pub key: Digest,
}

/// Reads a signing request.
///
/// # Errors
/// It is none, or is not signed by the key in it.
pub fn read_signing_request(request_pem: &str) -> Result<SigningRequest, Refusal> {
    let bad = |text: String| Refusal::field("request_pem", text);
    if request_pem.len() > limits::SIGNING_REQUEST_BYTES {
        return Err(bad(format!("must be at most {} bytes", limits::SIGNING_REQUEST_BYTES)));
    }
    let parameters = CertificateSigningRequestParams::from_pem(request_pem)
        .map_err(|error| bad(format!("must be a PKCS #10 request in PEM, signed by its own key: {error}")))?;
    let key = digest(&parameters.public_key);
    Ok(SigningRequest { parameters, key })
}

impl CertificateAuthority {
    /// The one in `folder`; none if it has none.
    pub fn load(folder: &Path, site_id: &SiteId) -> Result<Option<Self>, Error> {
        let Some(text) = files::read(folder, FILE)? else { return Ok(None) };
        let read = || -> Result<Self, rcgen::Error> {
            let start = text.find("-----BEGIN CERTIFICATE").unwrap_or(text.len());
            let (key, certificate_pem) = text.split_at(start);
            let key = KeyPair::from_pem(key)?;
            let pin = digest(&key);
            let issuer = Issuer::from_ca_cert_pem(certificate_pem, key)?;
            Ok(Self { issuer, certificate_pem: certificate_pem.to_owned(), pin, site_id: site_id.clone() })
        };
        read().map(Some).map_err(|source| Error::Unreadable { path: folder.join(FILE), source })
    }

    /// A new one in `folder`.
    pub fn make(folder: &Path, site_id: &SiteId, now: Utc) -> Result<Self, Error> {
        let mut params = CertificateParams::default();
        params.distinguished_name = name(&format!("midshift {site_id}"));
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        last(&mut params, now, limits::AUTHORITY_VALID);
        let key = KeyPair::generate().map_err(Error::Signing)?;
        let certificate_pem = params.self_signed(&key).map_err(Error::Signing)?.pem();
        files::write(folder, FILE, &format!("{}{certificate_pem}", key.serialize_pem()), files::PRIVATE)?;
        let pin = digest(&key);
        Ok(Self { issuer: Issuer::new(params, key), certificate_pem, pin, site_id: site_id.clone() })
    }

    /// Its own certificate, PEM.
    pub fn certificate_pem(&self) -> &str {
        &self.certificate_pem
    }

    /// Digest of its public key: all that a machine must know of the site beforehand.
    pub const fn pin(&self) -> Digest {
        self.pin
    }

    /// For a robot: `spiffe://SITE/robot/ID`.
    ///
    /// # Errors
    /// The signature cannot be made.
    pub fn sign_robot(
        &self,
        request: SigningRequest,
        robot_id: &RobotId,
        now: Utc,
    ) -> Result<SignedCertificate, Error> {
        let uri = format!("spiffe://{}/robot/{robot_id}", self.site_id);
        let mut params = leaf(robot_id.as_str(), ExtendedKeyUsagePurpose::ClientAuth);
        params.subject_alt_names = vec![SanType::URI(uri.try_into().map_err(Error::Signing)?)];
        let expires = last(&mut params, now, limits::ROBOT_CERTIFICATE_VALID);
        Ok(SignedCertificate { chain_pem: self.sign(request, params)?.pem(), expires })
    }

    /// For a server process under these names and addresses. The root stands behind it, so that a machine that knows its digest alone can check it.
    ///
    /// # Errors
    /// A name is none, or the signature cannot be made.
    pub fn sign_server(&self, request: SigningRequest, names: &[String], now: Utc) -> Result<SignedCertificate, Error> {
        let mut params = leaf("midshift", ExtendedKeyUsagePurpose::ServerAuth);
        params.subject_alt_names = CertificateParams::new(names).map_err(Error::Signing)?.subject_alt_names;
        let expires = last(&mut params, now, limits::SERVER_CERTIFICATE_VALID);
        let leaf = self.sign(request, params)?;
        Ok(SignedCertificate { chain_pem: format!("{}{}", leaf.pem(), self.certificate_pem), expires })
    }

    fn sign(&self, mut request: SigningRequest, params: CertificateParams) -> Result<Certificate, Error> {
        request.parameters.params = params;
        request.parameters.signed_by(&self.issuer).map_err(Error::Signing)
    }
}

fn digest(key: &impl PublicKeyData) -> Digest {
    Digest(sha2::Sha256::digest(key.subject_public_key_info()).into())
}

fn leaf(common_name: &str, usage: ExtendedKeyUsagePurpose) -> CertificateParams {
    let mut params = CertificateParams::default();
    params.distinguished_name = name(common_name);
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![usage];
    params.use_authority_key_identifier_extension = true;
    // Each certificate its own, so that one can be told from the next of the same key. Positive and of full length, as every reader takes it.
    let mut serial: [u8; 16] = rand::random();
    serial[0] = serial[0] & 0x3f | 0x40;
    params.serial_number = Some(SerialNumber::from_slice(&serial));
    params
}

fn name(common: &str) -> DistinguishedName {
    let mut name = DistinguishedName::new();
    name.push(DnType::CommonName, common);
    name
}

/// From a day ago, for clocks that are slow, until `valid` from now.
fn last(params: &mut CertificateParams, now: Utc, valid: LinkDuration) -> Utc {
    let expires = now.0.saturating_add_unsigned(valid.as_ms());
    let at = |ms: i64| OffsetDateTime::from_unix_timestamp(ms.div_euclid(1000)).unwrap_or(OffsetDateTime::UNIX_EPOCH);
    params.not_before = at(now.0.saturating_sub_unsigned(limits::CERTIFICATE_BACKDATED.as_ms()));
    params.not_after = at(expires);
    Utc(expires)
}
