//! A site with its identity, and machines that want to be robots of it.

use midshift_core::audit::AuditRow;
use midshift_core::identity::Caller;
use midshift_core::ids::SiteId;
use midshift_core::reason::{Code, Refusal};
use midshift_core::rows::Table;
use midshift_core::time::{Clock, Utc};
use midshift_core::wall_clock::WallClock;
use midshift_identity::{Duty, Error, IdentityService, Parts};
use midshift_proto::access::local;
use midshift_proto::denials::DenialSink;
use midshift_proto::identity::v1::enrolment_service_server::EnrolmentService as _;
use midshift_proto::identity::v1::identity_service_server::IdentityService as _;
use midshift_proto::identity::v1::{CreateEnrolmentRequest, EnrolRequest, EnrolResponse};
use midshift_proto::refusal_of;
use midshift_store::{MemoryStore, Query, SqliteStore, Store, StoreId};
use rcgen::{CertificateParams, KeyPair};
use std::path::PathBuf;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Status};

pub struct World {
    pub store: Arc<dyn Store>,
    pub clock: Arc<dyn Clock>,
    us: Arc<AtomicU64>,
    ahead_ms: Arc<AtomicI64>,
    pub dir: TempDir,
}

impl World {
    pub fn new() -> Self {
        let (us, ahead_ms) = (Arc::<AtomicU64>::default(), Arc::new(AtomicI64::new(1_800_000_000_000)));
        let (source, beside, ahead) = (us.clone(), us.clone(), ahead_ms.clone());
        let wall = move || Utc(ahead.load(Ordering::Relaxed)).plus_ms(beside.load(Ordering::Relaxed) / 1000);
        let clock: Arc<dyn Clock> = Arc::new(WallClock::new(move || source.load(Ordering::Relaxed), wall, |_| {}));
        let site = SiteId::parse("factory").expect("a site");
        let store = Arc::new(MemoryStore::new(site, StoreId::fresh(), clock.clone()));
        Self { store, clock, us, ahead_ms, dir: TempDir::new().expect("a folder") }
    }
    /// The same over a store in files.
    pub async fn in_files() -> Self {
        let mut world = Self::new();
        let (site, clock) = (world.store.site_id().clone(), world.clock.clone());
        world.store = Arc::new(SqliteStore::open(world.dir.path(), site, clock).await.expect("a new store"));
        world
    }
    pub fn pass_ms(&self, ms: u64) {
        self.us.fetch_add(ms * 1000, Ordering::Relaxed);
    }
    /// Somebody sets the wall.
    pub fn set_ms(&self, ms: i64) {
        self.ahead_ms.fetch_add(ms, Ordering::Relaxed);
    }
    /// Rows of the audit, the oldest first.
    pub async fn audited(&self) -> Vec<AuditRow> {
        let rows = self.store.list(Query::all(Table::IdentityAudit)).await.expect("rows");
        rows.iter().map(|row| serde_json::from_str(&row.body).expect("a row")).collect()
    }
    pub fn folder(&self) -> PathBuf {
        self.dir.path().join("identity")
    }
    pub async fn open(&self) -> Result<IdentityService, Error> {
        self.open_in(self.folder(), Duty::CertificateAuthority).await
    }
    pub async fn open_in(&self, folder: PathBuf, duty: Duty) -> Result<IdentityService, Error> {
        let parts = Parts {
            folder,
            store: self.store.clone(),
            clock: self.clock.clone(),
            duty,
            names: vec!["fleet.local".to_owned()],
            trust_json: "{}".to_owned(),
        };
        IdentityService::open(parts, &CancellationToken::new()).await
    }
}

/// A machine with a key of its own.
pub struct Machine(KeyPair);

impl Machine {
    pub fn new() -> Self {
        Self(KeyPair::generate_for(&rcgen::PKCS_ED25519).expect("a key"))
    }
    pub fn request(&self) -> String {
        // It may ask for any name: the site says which it gets.
        let params = CertificateParams::new(vec!["root.example".to_owned()]).expect("parameters");
        params.serialize_request(&self.0).and_then(|request| request.pem()).expect("a request")
    }
}

/// Whoever writes down what the service denies: codes, each with the robot that it is about.
#[derive(Default)]
pub struct Heard(pub Mutex<Vec<(Code, Option<String>)>>);

impl DenialSink for Heard {
    fn denied(&self, refusal: &Refusal) {
        let robot_id = refusal.reason.metadata.get("robot_id").cloned();
        self.0.lock().expect("not poisoned").push((refusal.reason.code, robot_id));
    }
}

pub fn asked_by<T>(caller: Caller, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.extensions_mut().insert(caller);
    request
}

pub fn code(status: &Status) -> Option<Code> {
    refusal_of(status).code
}

pub async fn secret(identity: &IdentityService, robot_id: &str, replace: bool) -> Result<String, Status> {
    let request = CreateEnrolmentRequest { robot_id: robot_id.to_owned(), replace };
    Ok(identity.create_enrolment(local(request)).await?.into_inner().secret)
}

/// What of the line is the secret's own.
pub fn shown(line: &str) -> String {
    line.rsplit_once('.').expect("a digest behind it").0.to_owned()
}

pub async fn enrol(
    identity: &IdentityService,
    robot: &str,
    line: &str,
    machine: &Machine,
) -> Result<EnrolResponse, Status> {
    let request = EnrolRequest { robot_id: robot.to_owned(), secret: shown(line), request_pem: machine.request() };
    Ok(identity.enrol(asked_by(Caller::nobody(), request)).await?.into_inner())
}
