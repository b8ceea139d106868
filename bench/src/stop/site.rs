//! The site of the measurement: its authority, a person who may stop, and robots that are enrolled, as the real service makes them.
//!
//! Invariant: made once for all robots of a run, before anything is measured; nothing of it runs then. Called by the parent; children read theirs.

use anyhow::Context;
use midshift_agent::tls::{self, Tls};
use midshift_cli::endpoint::Endpoint;
use midshift_core::ids::SiteId;
use midshift_core::time::Clock;
use midshift_identity::{Duty, IdentityService, Parts, ServerProof};
use midshift_process::door;
use midshift_proto::access::local;
use midshift_proto::identity::v1::enrolment_service_server::EnrolmentService as _;
use midshift_proto::identity::v1::identity_service_server::IdentityService as _;
use midshift_proto::identity::v1::{CreateEnrolmentRequest, EnrolRequest};
use midshift_stop::{Principals, announce_first_start};
use midshift_store::{MemoryStore, StoreId};
use rcgen::{CertificateParams, KeyPair};
use serde::{Deserialize, Serialize};
use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;
use std::sync::Arc;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// As the built-in demo site is named: the stop service of the measurement serves it.
const SITE: &str = "demo";

/// What one robot shows, and what it believes.
#[derive(Serialize, Deserialize)]
pub struct Proof {
    certificate_pem: String,
    key_pem: String,
    authority_pem: String,
}

impl Proof {
    /// For its connections.
    pub fn tls(&self) -> anyhow::Result<Tls> {
        let shown = Some((self.certificate_pem.as_str(), self.key_pem.as_str()));
        Ok(Tls::fixed(tls::config(&self.authority_pem, shown)?))
    }
    /// Those of the robots of one process.
    pub fn read(robots: &Path) -> anyhow::Result<Vec<Self>> {
        let text = std::fs::read(robots).with_context(|| format!("reading {}", robots.display()))?;
        Ok(serde_json::from_slice(&text)?)
    }
}

/// Name of a robot of a run, from 0.
pub fn robot_id(at: usize) -> String {
    format!("rbt-{at:05}")
}

/// A site.
pub struct Site {
    principals: Principals,
    token: String,
    proofs: Vec<Proof>,
}

impl Site {
    /// With so many robots; its keys are below `room`.
    pub async fn with(robots: usize, room: &Path) -> anyhow::Result<Self> {
        let clock: Arc<dyn Clock> = midshift_process::clock::clock(1000);
        let store = MemoryStore::new(SiteId::parse(SITE)?, StoreId::fresh(), clock.clone());
        let (duty, names) = (Duty::CertificateAuthority, Vec::new());
        let folder = room.join("identity");
        let parts = Parts { folder, store: Arc::new(store), clock, duty, names, trust_json: String::new() };
        let identity = IdentityService::open(parts, &CancellationToken::new()).await?;
        let token = identity.first_token().await?.context("a site without a first token")?;
        let mut proofs = Vec::new();
        for at in 0..robots {
            proofs.push(enrolled(&identity, robot_id(at)).await?);
        }
        let (directory, proof) = (identity.directory().borrow().as_ref().clone(), identity.proof().borrow().clone());
        let ServerProof { chain_pem, key_pem, authority_pem } = proof;
        Ok(Self { principals: Principals { directory, chain_pem, key_pem, authority_pem }, token, proofs })
    }
    /// Writes down who is known for a stop service with this data folder.
    pub fn admit(&self, data: &Path) -> anyhow::Result<()> {
        let folder = data.join(midshift_core::stop::FOLDER);
        // A folder that others may look into is refused.
        DirBuilder::new().recursive(true).mode(0o700).create(&folder)?;
        announce_first_start(&folder)?;
        Ok(self.principals.write(&folder)?)
    }
    /// Writes down what these robots show.
    pub fn hand_out(&self, robots: std::ops::Range<usize>, to: &Path) -> anyhow::Result<()> {
        let proofs = self.proofs.get(robots).context("robots that were not enrolled")?;
        Ok(std::fs::write(to, serde_json::to_vec(proofs)?)?)
    }
    /// The way of the person who stops.
    pub fn way(&self, address: &str) -> anyhow::Result<Endpoint> {
        Endpoint::secure(address, &self.principals.authority_pem, Some(&self.token))
    }
}

/// Makes TLS as the port of the stop service with this data folder speaks it: with the same certificate, and asking robots for theirs.
pub fn make_acceptor(data: &Path) -> anyhow::Result<TlsAcceptor> {
    let folder = data.join(midshift_core::stop::FOLDER);
    let known = Principals::read(&folder)?.context("a data folder that does not say who is known")?;
    let Principals { chain_pem, key_pem, authority_pem, .. } = known;
    let proof = ServerProof { chain_pem, key_pem, authority_pem };
    Ok(door::configure_tls(&proof, &midshift_process::clock::clock(1000))?.into())
}

async fn enrolled(identity: &IdentityService, robot_id: String) -> anyhow::Result<Proof> {
    let asked = CreateEnrolmentRequest { robot_id: robot_id.clone(), replace: false };
    let offered = identity.create_enrolment(local(asked)).await?.into_inner();
    // Without the digest of the root, which whoever is in this process need not hold against anything.
    let secret = offered.secret.rsplit_once('.').context("a secret without a root")?.0.to_owned();
    let key = KeyPair::generate()?;
    let request_pem = CertificateParams::default().serialize_request(&key)?.pem()?;
    let answer = identity.enrol(local(EnrolRequest { robot_id, secret, request_pem })).await?.into_inner();
    Ok(Proof {
        certificate_pem: answer.certificate_pem,
        key_pem: key.serialize_pem(),
        authority_pem: answer.authority_pem,
    })
}
