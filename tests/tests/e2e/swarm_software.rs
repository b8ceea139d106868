//! Robots of a swarm that change their software: a real repository in this process, over pipes and on tokio's paused clock, and a server of
//! sessions that the test plays, since it says when.

use anyhow::Context;
use async_trait::async_trait;
use hyper_util::rt::TokioIo;
use midshift_agent::dial::{self, Cut, Dial};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::build;
use midshift_bundle::digest::Digest;
use midshift_bundle::directive::{Directive, LIFE_MS};
use midshift_bundle::encoded_target::EncodedTarget;
use midshift_bundle::folder::{Folder, Signed};
use midshift_bundle::installed;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{Profile, listed};
use midshift_cli::samples::{self, Made, Signer};
use midshift_core::authority::Authority;
use midshift_core::desired_state::DesiredWork;
use midshift_core::ids::{DrainId, SetId};
use midshift_core::reason::Code;
use midshift_core::robot::Lane;
use midshift_core::robot_events::{InboxItem, RobotEvent, SampleBody};
use midshift_core::site::{CORRIDOR, text};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_core::update::{ActivationGrant, DesiredUpdate, Goal, Installed, UpdateEvent, UpdateReport, UpdateState};
use midshift_ota::content::Room;
use midshift_ota::folder::Owner;
use midshift_ota::{OtaService, Parts};
use midshift_proto::convert::parse;
use midshift_proto::link::v1;
use midshift_proto::link::v1::link_service_server::{LinkService, LinkServiceServer};
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::{PublishRepositoryRequest, UploadTargetRequest};
use midshift_proto::session::{
    ClockSample, Downlink, Echo, FromRobot, Heartbeat, LaneAck, LaneBatch, PROTOCOL_VERSION, ToRobot, Welcome,
};
use midshift_sim::behaviour::{Behaviour, COMPONENT};
use midshift_sim::body::MODEL;
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig};
use midshift_sim::swarm::{DialFor, Swarm, SwarmConfig};
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tempfile::TempDir;
use tokio::io::DuplexStream;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::io::InspectReader;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::AbortOnDropHandle;
use tonic::service::Routes;
use tonic::transport::{Channel, Endpoint, Server, Uri};
use tonic::{Request, Response, Status, Streaming};

/// When everything begins.
const BEGIN: Utc = Utc(1_800_000_000_000);
/// Milliseconds of site time on probation.
const PROBATION_MS: u64 = 10_000;
/// Heartbeats within which an update must be over: 10 minutes.
const BEATS_MAX: u32 = 600;

type Ends = mpsc::Sender<io::Result<DuplexStream>>;

/// Pipes instead of a network.
struct Pipes {
    endpoint: Endpoint,
    ends: Ends,
    network: Option<watch::Receiver<bool>>,
    /// Bytes that came out of them.
    came: Arc<AtomicU64>,
}

#[async_trait]
impl Dial for Pipes {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        let (ends, network, came) = (self.ends.clone(), self.network.clone(), self.came.clone());
        let connect = tower::service_fn(move |_: Uri| {
            let (ends, network, came) = (ends.clone(), network.clone(), came.clone());
            async move {
                let (near, far) = tokio::io::duplex(64 * 1024);
                ends.send(Ok(far)).await.map_err(io::Error::other)?;
                let count = move |bytes: &[u8]| {
                    came.fetch_add(bytes.len() as u64, Ordering::Relaxed);
                };
                Ok::<_, io::Error>(TokioIo::new(Cut::new(InspectReader::new(near, count), network)))
            }
        });
        self.endpoint.connect_with_connector(connect).await.map_err(|e| dial::Error(e.into()))
    }
}

/// One session as the server has it.
struct Seen {
    up: Streaming<v1::SessionRequest>,
    down: mpsc::Sender<Result<v1::SessionResponse, Status>>,
}

struct Desk(mpsc::Sender<Seen>);

#[async_trait]
impl LinkService for Desk {
    type SessionStream = ReceiverStream<Result<v1::SessionResponse, Status>>;
    async fn session(
        &self,
        request: Request<Streaming<v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (down, queue) = mpsc::channel(16);
        let seen = Seen { up: request.into_inner(), down };
        self.0.send(seen).await.map_err(|_| Status::unavailable("the test is over"))?;
        Ok(Response::new(ReceiverStream::new(queue)))
    }
}

/// A swarm of one, its repository, and the test's side of its sessions.
struct Bench {
    dir: TempDir,
    made: Made,
    hall: Arc<Fleet>,
    sessions: mpsc::Receiver<Seen>,
    session: Option<Seen>,
    epoch: u64,
    generation: u64,
    directives: u64,
    /// What the robot said of its newest update, and the states it said since [`Bench::update`] began.
    newest: Option<UpdateReport>,
    states: Vec<UpdateState>,
    /// What it said at its last Hello that it has installed.
    installed: Option<Installed>,
    /// Bytes of releases and of their documents that came to the robot, as they were on the way.
    fetched: Arc<AtomicU64>,
    _server: AbortOnDropHandle<Result<(), tonic::transport::Error>>,
    _robots: DropGuard,
}

/// Brings every file of the newest targets document, and the documents.
async fn publish(channel: Channel, made: &Made) -> anyhow::Result<()> {
    let folder = Folder::open(&made.repository)?;
    let document = |name: String| folder.document(&name)?.with_context(|| format!("no {name}"));
    let targets = document(format!("{}.targets.json", made.targets_version))?;
    let mut client = BundleServiceClient::new(channel);
    for file in listed(&targets)? {
        let data = std::fs::read(folder.file(&file.name, file.digest))?;
        let (digest, length) = (file.digest.to_string(), file.length);
        let piece = UploadTargetRequest { digest, length, offset: 0, data };
        anyhow::ensure!(client.upload_target(tokio_stream::iter([piece])).await?.into_inner().is_complete);
    }
    let roots = vec![document("1.root.json".to_owned())?];
    client.publish_repository(PublishRepositoryRequest { roots, targets, expected_targets_version: 0 }).await?;
    Ok(())
}

fn trust(made: &Made, keys: &Path, hall: &FleetConfig) -> anyhow::Result<TrustAnchors> {
    let root = Folder::open(&made.repository)?.document("1.root.json")?.context("no root")?;
    let key = SecretKey::read(&keys.join("directive-1.pem"))?.public();
    Ok(TrustAnchors { root, directive_keys: [(key.id(), key)].into(), site: hall.site.site_id().clone() })
}

impl Bench {
    /// With all samples.
    async fn open() -> anyhow::Result<Self> {
        Self::make_with(|dir| Ok(samples::make(dir, None, Signer::Throwaway, BEGIN)?)).await
    }

    /// With what is made in a folder.
    async fn make_with(make: impl FnOnce(&Path) -> anyhow::Result<Made>) -> anyhow::Result<Self> {
        let dir = tempfile::tempdir()?;
        let start = tokio::time::Instant::now();
        let clock: Arc<dyn Clock> =
            Arc::new(ScaledClock::new(move || start.elapsed().as_micros() as u64, BEGIN, 1_000));
        let made = make(&dir.path().join("samples"))?;
        let keys = made.keys.clone().context("has keys")?;
        let folder = dir.path().join("server");
        let parts = Parts {
            folder,
            keys: keys.clone(),
            room: Room::with_quota(1 << 20),
            clock: clock.clone(),
            owner: Owner::Nobody,
        };
        let ota = OtaService::open(parts).await?;
        let (ends, incoming) = mpsc::channel(4);
        let (seen, sessions) = mpsc::channel(4);
        let server = Server::builder()
            .add_routes(ota.add_chunks_to(ota.add_bundles_to(Routes::new(LinkServiceServer::new(Desk(seen))))))
            .serve_with_incoming(ReceiverStream::new(incoming));
        let server = AbortOnDropHandle::new(tokio::spawn(server));
        let endpoint = dial::endpoint("http://server")?;
        let people = Pipes { endpoint, ends: ends.clone(), network: None, came: Arc::default() };
        publish(people.dial().await?, &made).await?;

        let site = Arc::new(text::parse(CORRIDOR)?);
        let quiet = FleetConfig { faults: FaultRates::none(), drains: false, ..FleetConfig::new(site, 1, 7) };
        let hall = Arc::new(Fleet::open(&quiet, &clock.now())?);
        let fetched: Arc<AtomicU64> = Arc::default();
        let to = |make: fn(&str) -> Result<Endpoint, dial::Error>, came: Arc<AtomicU64>| -> DialFor {
            let ends = ends.clone();
            Arc::new(move |_, network| {
                let (endpoint, network) = (make("http://server")?, Some(network));
                Ok(Arc::new(Pipes { endpoint, ends: ends.clone(), network, came: came.clone() }))
            })
        };
        let mut config = SwarmConfig::tcp(hall.clone(), clock, "http://server", 7);
        config.dial = to(dial::endpoint, Arc::default());
        config.bulk = to(dial::bulk_endpoint, fetched.clone());
        config.software = Some(trust(&made, &keys, &quiet)?);
        let shutdown = CancellationToken::new();
        tokio::spawn(Swarm::new(config).run(shutdown.clone()));
        Ok(Self {
            dir,
            made,
            hall,
            sessions,
            session: None,
            epoch: 0,
            generation: 0,
            directives: 0,
            newest: None,
            states: Vec::new(),
            installed: None,
            fetched,
            _server: server,
            _robots: shutdown.drop_guard(),
        })
    }

    /// Signs the order to take a sample.
    fn directive(&mut self, version: &str) -> anyhow::Result<(Digest, String)> {
        let bundles = &self.made.bundles;
        let (_, manifest) = bundles.iter().find(|(_, m)| m.version == version).context("no such sample")?;
        let bytes = manifest.to_bytes();
        let key = SecretKey::read(&self.dir.path().join("samples/keys/directive-1.pem"))?;
        self.directives += 1;
        let directive = Directive {
            robot_id: self.hall.robots()[0].robot_id().clone(),
            key_id: key.public().id(),
            generation: self.directives,
            manifest: Digest::of_content(&bytes),
            manifest_length: bytes.len() as u64,
            rollback_floor: 0,
            issued_at: BEGIN,
            expires: BEGIN.plus_ms(LIFE_MS),
            rollout: "walk".to_owned(),
        };
        Ok((directive.manifest, String::from_utf8(directive.sign(&key))?))
    }

    /// Directs the robot to a sample until that update is over: staged, granted, and kept once it is on trial. The states it said.
    async fn update(&mut self, version: &str) -> anyhow::Result<(Vec<UpdateState>, UpdateReport)> {
        let (bundle, directive) = self.directive(version)?;
        self.states.clear();
        for _ in 0..BEATS_MAX {
            self.beat(&directive).await?;
            let newest = self.newest.as_ref().filter(|u| u.bundle.as_str() == bundle.to_string());
            if let Some(over) = newest.filter(|u| u.state.is_over()) {
                return Ok((self.states.clone(), over.clone()));
            }
        }
        anyhow::bail!("never over: {:?}", self.newest)
    }

    /// As [`Bench::update`], to the end that it keeps it; the bytes that came for it.
    async fn fetched_for(&mut self, version: &str) -> anyhow::Result<u64> {
        let before = self.fetched.load(Ordering::Relaxed);
        let (_, over) = self.update(version).await?;
        anyhow::ensure!(over.state == UpdateState::Committed, "{over:?}");
        Ok(self.fetched.load(Ordering::Relaxed) - before)
    }

    /// How long the encoded target is that was signed from the one release to the other, or to a robot that has none.
    fn way(&self, from: Option<usize>, to: usize) -> anyhow::Result<u64> {
        let targets =
            Folder::open(&self.made.repository)?.document(&format!("{}.targets.json", self.made.targets_version));
        let files = listed(&targets?.context("no targets")?)?;
        let behaviour = |nth: usize| self.made.bundles[nth].1.components[0].digest;
        let name = EncodedTarget { to: behaviour(to), from: from.map(behaviour) }.target();
        Ok(files.into_iter().find(|file| file.name == name).with_context(|| format!("no {name}"))?.length)
    }

    /// Hears the robot up to its next heartbeat and answers that one.
    async fn beat(&mut self, directive: &str) -> anyhow::Result<()> {
        loop {
            let message = match &mut self.session {
                Some(seen) => seen.up.message().await.ok().flatten(),
                None => {
                    self.session = Some(self.sessions.recv().await.context("the robot dials")?);
                    continue;
                }
            };
            match message.map(parse::<FromRobot, _>).transpose()? {
                None => self.session = None,
                Some(FromRobot::Hello(hello)) => {
                    self.epoch += 1;
                    self.installed = Some(installed::open(&hello.installed, &hello.robot_id, &hello.boot_id)?);
                    self.note(hello.reported.update);
                    self.send(ToRobot::Welcome(welcome(self.epoch))).await?;
                }
                Some(FromRobot::Uplink(uplink)) => {
                    let acks = uplink.batches.iter().filter_map(|batch| self.heard(batch)).collect();
                    if let Some(heartbeat) = uplink.heartbeat {
                        return self.answer(&heartbeat, acks, directive).await;
                    }
                    self.send(ToRobot::Downlink(Box::new(Downlink { acks, ..Downlink::default() }))).await?;
                }
            }
        }
    }

    fn heard(&mut self, batch: &LaneBatch) -> Option<LaneAck> {
        let mut seq = None;
        for item in &batch.items {
            if let InboxItem::Sample(sample) = item {
                seq = Some(sample.seq);
                if let SampleBody::Event(RobotEvent::Update(UpdateEvent::Changed(report))) = &sample.body {
                    self.note(Some(report.clone()));
                }
            }
        }
        seq.filter(|_| batch.lane != Lane::Status).map(|seq| LaneAck { lane: batch.lane, seq, expect: None })
    }

    fn note(&mut self, report: Option<UpdateReport>) {
        if let Some(report) = report {
            if self.states.last() != Some(&report.state) {
                self.states.push(report.state);
            }
            self.newest = Some(report);
        }
    }

    /// What a server would want now, whatever was lost.
    async fn answer(&mut self, heartbeat: &Heartbeat, acks: Vec<LaneAck>, directive: &str) -> anyhow::Result<()> {
        let (robot_id, hb) = (self.hall.robots()[0].robot_id().clone(), heartbeat.reported.hb);
        let state = heartbeat.reported.update.as_ref().map(|u| u.state);
        let drain_id = Some(DrainId::parse(&format!("drain-{}", self.directives))?);
        let works = matches!(state, Some(UpdateState::Trial | UpdateState::Committing));
        self.generation += 1;
        let authority = Authority { session_epoch: self.epoch, hb, valid_ms: 5_000 };
        let grant = drain_id.clone().filter(|_| state == Some(UpdateState::Staged));
        let update = DesiredUpdate {
            robot_id: robot_id.clone(),
            generation: self.generation,
            goal: if works { Goal::Commit } else { Goal::Activate },
            directive: directive.to_owned(),
            drain_id: drain_id.clone(),
            grant: grant.map(|drain_id| ActivationGrant { grant_id: self.generation, drain_id, authority }),
            rate_bytes_s: 0,
            probation_ms: PROBATION_MS,
        };
        let work = DesiredWork {
            robot_id,
            generation: self.generation,
            assignment: None,
            grants: Vec::new(),
            held: false,
            resume: None,
            closed: Vec::new(),
            maintenance: drain_id.filter(|_| !works),
            resumed: Vec::new(),
            load_word: None,
        };
        let echo = Some(Echo { hb, clock: ClockSample::default(), is_clock_doubted: false });
        let down = Downlink { echo, acks, work: Some(work), update: Some(update), ..Downlink::default() };
        self.send(ToRobot::Downlink(Box::new(down))).await
    }

    /// A robot that has gone meanwhile hears nothing.
    async fn send(&mut self, message: ToRobot) -> anyhow::Result<()> {
        let seen = self.session.as_ref().context("no session")?;
        if seen.down.send(Ok(v1::SessionResponse::from(&message))).await.is_err() {
            self.session = None;
        }
        Ok(())
    }

    /// What drives the body, and the version that it says.
    fn software(&self) -> (Behaviour, String) {
        let body = self.hall.robots()[0].lock();
        let (behaviour, version) = body.software();
        (behaviour.clone(), version.to_owned())
    }
}

fn welcome(session_epoch: u64) -> Welcome {
    Welcome {
        session_epoch,
        session_secret: format!("s{session_epoch}").into(),
        store_id: "store-1".to_owned(),
        acks: Vec::new(),
        heartbeat_period_ms: 1_000,
        status_period_ms: 2_000,
        authority_ms: 30_000,
        status_credit_bytes: 64 * 1024,
        protocol_version: PROTOCOL_VERSION,
        clock_rate_permille: 1_000,
        observed: false,
    }
}

fn of_sample(version: &str) -> (Behaviour, String) {
    let sample = samples::SAMPLES.iter().find(|s| s.version == version).expect("there is one");
    (Behaviour::parse(sample.behaviour).expect("can be read"), version.to_owned())
}

#[tokio::test(start_paused = true)]
async fn a_robot_of_a_swarm_takes_good_releases_and_behaves_as_they_say() -> anyhow::Result<()> {
    let mut bench = Bench::open().await?;
    assert_eq!(bench.software(), (Behaviour::default(), "1.0.0".to_owned()));
    for version in ["1.5.0", "1.5.1"] {
        let (states, over) = bench.update(version).await?;
        assert_eq!(over.state, UpdateState::Committed, "{over:?}");
        let way = [UpdateState::Staged, UpdateState::Switching, UpdateState::Probation, UpdateState::Trial];
        assert!(way.iter().all(|state| states.contains(state)), "{states:?}");
        assert_eq!(bench.software(), of_sample(version));
    }
    // It said so when it was on trial, and that it keeps the one before.
    let installed = bench.installed.context("was said")?;
    let version = |set: &SetId| installed.sets.iter().find(|s| s.set == *set).map(|s| s.version.as_str());
    assert_eq!((version(&installed.running), version(&installed.current)), (Some("walk 1.5.1"), Some("walk 1.5.0")));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_of_a_swarm_goes_back_to_what_it_kept_from_a_release_that_cannot_live() -> anyhow::Result<()> {
    for bad in ["1.6.0-bad-at-start", "1.6.1-hangs"] {
        let mut bench = Bench::open().await?;
        assert_eq!(bench.update("1.5.0").await?.1.state, UpdateState::Committed);
        let (states, over) = bench.update(bad).await?;
        assert_eq!(over.state, UpdateState::RolledBack, "{bad}: {over:?}");
        assert_eq!((over.reason.map(|r| r.code), over.tries), (Some(Code::ProgramCrashed), 2), "{bad}");
        assert!(!states.contains(&UpdateState::Trial), "{bad}: {states:?}");
        assert_eq!(bench.software(), of_sample("1.5.0"), "{bad}");
        assert_eq!(bench.update("1.5.1").await?.1.state, UpdateState::Committed, "it takes the next one");
    }
    Ok(())
}

/// Releases whose settings are long and differ in a word.
const LONG: [(&str, u32); 2] = [("1.5.0", 900), ("1.5.1", 800)];

/// Settings with this speed and comments that hardly become shorter by themselves.
fn long_settings(speed_permille: u32) -> String {
    let mut state = 7_u64;
    let mut letter = |_: i32| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        char::from(b'0' + (state >> 58) as u8)
    };
    let mut settings = format!("speed_permille = {speed_permille}\n");
    for _ in 0..400 {
        settings += "# ";
        settings.extend((0..100).map(&mut letter));
        settings += "\n";
    }
    settings
}

/// Builds and signs [`LONG`] as `bundle build` and `bundle sign` do: each with patches from those before it.
fn long_releases(dir: &Path) -> anyhow::Result<Made> {
    let (repository, keys) = (dir.join("repository"), dir.join("keys"));
    std::fs::create_dir_all(dir)?;
    let folder = Folder::create(&repository, &keys, Profile::Solo, BEGIN)?;
    let key = SecretKey::read(&keys.join("targets-1.pem"))?;
    let mut made = Made { bundles: Vec::new(), repository, keys: Some(keys), targets_version: 0 };
    for (version, speed_permille) in LONG {
        let (draft, bundle) = (dir.join(format!("draft-{version}")), dir.join(format!("walk-{version}")));
        std::fs::create_dir(&draft)?;
        let component = format!(
            "[[component]]\nname = \"{COMPONENT}\"\nversion = \"{version}\"\nkind = \"config\"\nfile = \"settings\"\n\
             hardware = [\"{MODEL}\"]\nneeds = \"restart\"\n"
        );
        std::fs::write(
            draft.join(build::DRAFT_FILE),
            format!("name = \"walk\"\nversion = \"{version}\"\n{component}"),
        )?;
        std::fs::write(draft.join("settings"), long_settings(speed_permille))?;
        let manifest = build::build(&draft, &bundle, &mut |_| {})?;
        let (_, signed) = folder.add_with_encoded_targets(&bundle, &[], &[&key], BEGIN)?;
        let Signed::Published(targets_version) = signed else { anyhow::bail!("one key is not enough") };
        made.targets_version = targets_version;
        made.bundles.push((bundle, manifest));
    }
    Ok(made)
}

#[tokio::test(start_paused = true)]
async fn a_release_that_was_signed_with_a_patch_from_the_one_before_is_installed_by_the_patch() -> anyhow::Result<()> {
    let mut bench = Bench::make_with(long_releases).await?;
    let [first, second] = [bench.way(None, 0)?, bench.way(None, 1)?];
    let patch = bench.way(Some(0), 1)?;
    // All that came: documents and what leads them too.
    let came = bench.fetched_for("1.5.0").await?;
    anyhow::ensure!(came >= first, "without a former release it came as {first} bytes at least, not {came}");
    let came = bench.fetched_for("1.5.1").await?;
    anyhow::ensure!((patch..second).contains(&came), "{came} bytes: the patch has {patch}, the file at least {second}");
    let slower = Behaviour { speed_permille: 800, ..Behaviour::default() };
    assert_eq!(bench.software(), (slower, "1.5.1".to_owned()));
    Ok(())
}
