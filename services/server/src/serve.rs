//! `midshift serve`: everything persistent, for a real site: in one process on SQLite or PostgreSQL, or some of the services in each of several
//! processes on one PostgreSQL database.

use crate::changed_map;
use crate::keep_limits::KeepLimits;
use crate::planning::Planning;
use crate::server::Server;
use crate::storage::{Database, Storage};
use crate::{Components, NaiveRules};
use crate::{clock_doubt, clock_jump, stop_follower, stop_service};
use anyhow::{Context, bail};
use midshift_agent::tls;
use midshift_cli::roles::{Role, Roles};
use midshift_cli::site_file;
use midshift_core::Boxed;
use midshift_core::limits;
use midshift_core::stop::{FOLDER, PORT};
use midshift_core::time::Clock;
use midshift_identity::{Duty, IdentityService};
use midshift_ota::content::Room;
use midshift_ota::folder::Owner;
use midshift_ota::rollouts::known_bundles;
use midshift_ota::{OtaReader, OtaService};
use midshift_process::door::Share;
use midshift_process::{clock, logs};
use midshift_store::Store;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, UdpSocket};
use tokio::process::Child;
use tokio_util::sync::CancellationToken;

/// Robots change gateways in a second or two when they are told to; this is for those that are slow to answer.
const DRAIN_DEFAULT_S: u64 = 20;

/// A gateway waits so long for the folder that processes with role ota make, and looks so often.
const SOFTWARE_WITHIN: Duration = Duration::from_secs(60);
const SOFTWARE_LOOK: Duration = Duration::from_secs(1);

/// What `serve` was asked for.
#[derive(Clone, Debug, clap::Args)]
pub struct Serve {
    /// The site file (or a .map grid, or an LIF .json). Without it the built-in demo site.
    #[arg(long)]
    pub site: Option<PathBuf>,
    /// Where the databases and software of robots are; made with mode 0700.
    #[arg(long, default_value = "midshift-data")]
    pub data: PathBuf,
    /// Rows and samples elsewhere.
    #[command(flatten)]
    pub database: Database,
    /// Services of this process; all without it. Several processes with the rest share one PostgreSQL database, and any number may have
    /// the same.
    #[arg(long, value_delimiter = ',', value_name = "ROLE,…")]
    pub roles: Vec<Role>,
    /// Seconds that robots have to move to another gateway when this process is asked to end. 0: their sessions end at once. Without it 20
    /// with --roles, else 0.
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(0..=600))]
    pub drain_seconds: Option<u64>,
    /// Address to listen on.
    #[arg(long, default_value = "127.0.0.1:7420")]
    pub listen: SocketAddr,
    /// No TLS and no login: whoever reaches the port may move robots.
    #[arg(long)]
    pub insecure: bool,
    /// Host name or address under which clients that are not ours reach this server, for its certificate; more than one may be given. midshift, localhost, the
    /// loopback addresses and that of --listen are always in it.
    #[arg(long = "name", value_name = "NAME", conflicts_with = "insecure")]
    pub names: Vec<String>,
    /// Where the first token of a new site goes, a new file for its owner alone. Without it standard output.
    #[arg(long, value_name = "FILE", conflicts_with = "insecure")]
    pub first_token_file: Option<PathBuf>,
    /// Where the site's root certificate goes too, for everybody to read: what robots, people and the proxy hold the site's servers against.
    #[arg(long, value_name = "FILE", conflicts_with = "insecure")]
    pub root_file: Option<PathBuf>,
    /// Where the keys and the certificate of this process are; made with mode 0700. Without it the folder identity of --data. Processes that share --data need
    /// one each.
    #[arg(long, value_name = "DIR", env = "MIDSHIFT_IDENTITY")]
    pub identity: Option<PathBuf>,
    /// Make one more token that may do everything, for whoever has lost the first one.
    #[arg(long, conflicts_with = "insecure")]
    pub spare_token: bool,
    /// Take a changed site file whatever is in its way: each task, robot and held place that does not fit it is an incident. Without it the stored map goes on
    /// until a start finds nothing in the way.
    #[arg(long)]
    pub force_map: bool,
    /// How much of samples and logs is kept.
    #[command(flatten)]
    pub keep: KeepLimits,
    /// What one peer may take.
    #[command(flatten)]
    pub share: Share,
    /// UDP address to hear launchers of robots on whose agent does not run, e.g. 0.0.0.0:7422. What is heard is a hint that anybody in the
    /// network can send: it is shown and decides nothing. Without it nobody listens.
    #[arg(long, value_name = "ADDR")]
    pub beacon_listen: Option<SocketAddr>,
    /// Where its stop service listens: a process of its own that is started unless one answers there, and that stays when this one ends.
    #[arg(long, value_name = "ADDR", default_value_t = SocketAddr::from(([127, 0, 0, 1], PORT)))]
    pub stop_listen: SocketAddr,
    /// Start no stop service: it runs elsewhere, or under a unit of its own. With --roles none is started either; the role stop-follower belongs beside it.
    #[arg(long, env = "MIDSHIFT_NO_STOP")]
    pub no_stop: bool,
    /// The stop service of this site never began: let it begin with nothing engaged. Refused where the store has a session, a stop or an enrolled robot. A start that makes
    /// the store says so by itself; any other stop service that finds its folder empty begins with the fleet stopped.
    #[arg(long)]
    pub init_stop: bool,
    /// Where software of robots comes from.
    #[command(flatten)]
    pub software: Software,
    /// What enrolled robots are told to trust as software: the trust file of a robot of the site.
    #[arg(long, value_name = "FILE", conflicts_with = "insecure")]
    pub trust: Option<PathBuf>,
    /// Of a gateway without role ota: hand out no software. Without it the folder ota of --data must be the volume that the processes with
    /// role ota keep, and this process waits a minute for it.
    #[arg(long, env = "MIDSHIFT_NO_SOFTWARE")]
    pub no_software: bool,
    /// How log lines look, as the program was told.
    #[arg(skip)]
    pub log: logs::Format,
}

/// Where software of robots comes from.
#[derive(Clone, Debug, clap::Args)]
pub struct Software {
    /// The folder with snapshot-*.pem, timestamp-*.pem and directive-*.pem of `bundle keygen`. Without it releases are neither taken nor given.
    #[arg(long, value_name = "DIR")]
    pub ota_keys: Option<PathBuf>,
    /// Room for software, GiB.
    #[arg(long, default_value_t = limits::SOFTWARE_BYTES_DEFAULT >> 30, value_parser = clap::value_parser!(u64).range(1..=1_048_576))]
    pub ota_quota_gib: u64,
    /// Free space of the disk that software must leave alone, GiB. 0: none.
    #[arg(long, default_value_t = limits::SOFTWARE_SPARE_BYTES_DEFAULT >> 30, value_parser = clap::value_parser!(u64).range(0..=1_048_576))]
    pub ota_spare_gib: u64,
    /// Days of serving that software is kept which no release lists, and no roll-out, rule for newcomers or robot names.
    #[arg(long, default_value_t = limits::SOFTWARE_UNNAMED_DAYS_DEFAULT, value_parser = clap::value_parser!(u64).range(1..=3_650))]
    pub ota_keep_days: u64,
}

impl Software {
    /// The service, with its files in `folder`, which is `owner`'s.
    pub fn open(&self, folder: PathBuf, owner: Owner, clock: Arc<dyn Clock>) -> Boxed<'_, anyhow::Result<OtaService>> {
        Box::pin(async move {
            let Some(keys) = self.ota_keys.clone() else { return Ok(OtaService::without_keys()) };
            let room = Room {
                quota_bytes: self.ota_quota_gib << 30,
                spare_bytes: self.ota_spare_gib << 30,
                unnamed_ms: self.ota_keep_days * 24 * 3_600_000,
            };
            let parts = midshift_ota::Parts { folder, keys, room, clock, owner };
            OtaService::open(parts).await.context("opening software of robots")
        })
    }
}

impl Serve {
    /// The folder of the keys of this process.
    fn own_keys(&self) -> PathBuf {
        self.identity.clone().unwrap_or_else(|| self.data.join(midshift_identity::FOLDER))
    }

    /// How long robots have to move to another gateway when this process is asked to end.
    fn drain(&self, roles: &Roles) -> Duration {
        let default_s = if roles.are_split() { DRAIN_DEFAULT_S } else { 0 };
        Duration::from_secs(self.drain_seconds.unwrap_or(default_s))
    }

    /// What holds for the stop service beside it too, as arguments: its port has the same peers, and its log goes where this one's does.
    pub fn for_stop(&self) -> Vec<String> {
        self.share.arguments().into_iter().chain(self.log.argument()).collect()
    }
}

/// Where a program that runs talks to a person.
pub type Say<'a> = &'a (dyn Fn(&str) + Sync);

/// Runs until `shutdown`. The first token of a site is said, and nothing else.
pub fn run(args: Serve, shutdown: CancellationToken, say: Say<'_>) -> Boxed<'_, anyhow::Result<()>> {
    Box::pin(serve(args, shutdown, say))
}

async fn serve(args: Serve, shutdown: CancellationToken, say: Say<'_>) -> anyhow::Result<()> {
    let roles = Roles::from_names(&args.roles);
    check_arguments(&args, &roles)?;
    if !args.no_stop && !roles.are_split() {
        // Before rows are brought to this version, from which the one before could not go on.
        stop_service::check_program().await?;
    }
    // Before anything is opened: whoever finds the port taken leaves no trace.
    let listener = listen(args.listen).await?;
    if !args.insecure {
        // The databases have secrets of sessions, whichever process of the site they are of.
        midshift_identity::make_folder(&args.data).context("opening the data folder")?;
    }
    let loaded = load_site(&args)?;
    let clock = clock::clock(1000);
    midshift_process::recorder::handle();
    let site_id = loaded.site.site_id().clone();
    let storage = args.database.open(&args.data, site_id, clock.clone(), args.keep.status_log_bytes).await?;
    clock_doubt::check_start(&args.data, &*clock, &*storage.store()).await?;
    let (loaded, map) = match roles.has(Role::Fleet) {
        true => changed_map::choose(&*storage.store(), loaded, args.force_map, clock.now()).await?,
        false => (changed_map::follow(&*storage.store(), loaded).await?, Default::default()),
    };
    // Before anybody writes to the store, and before the stop service, which waits for who is known, can begin.
    announce_first_start(&args, &roles, &*storage.store()).await?;
    let identity = open_identity(&args, &roles, &storage, &clock, &shutdown).await?;
    let (ota, reader) = open_software(&args, &roles, &storage, &clock, &shutdown).await?;
    let beacons = match args.beacon_listen {
        Some(address) => Some(listen_for_beacons(address).await?),
        None => None,
    };
    let beside = start_stop(&args, &roles, &*storage.store(), identity.as_ref()).await?;
    tracing::info!(address = %listener.local_addr()?, site_id = %loaded.site.site_id(), data = %args.data.display(), store = storage.engine(), %roles, "midshift serves");
    let planning = Planning::start()?;
    let parts = Components {
        roles: roles.clone(),
        drain: args.drain(&roles),
        store: storage.store(),
        frames: storage.frames(),
        heard: storage.heard(),
        site: loaded.site,
        site_text: loaded.text,
        map,
        keep: args.keep,
        jumped_before: clock_jump::before(&args.data, clock.now().wall),
        clock: clock.clone(),
        ota,
        reader,
        sim: None,
        naive: NaiveRules::default(),
        stops: roles.has(Role::StopFollower).then(|| args.data.join(FOLDER)),
        stop_port: beside.is_some().then(|| args.stop_listen.port()),
        port: match identity {
            Some(_) => args.share.config("business")?,
            None => args.share.config_without_login("business"),
        },
        identity: identity.clone(),
        planning: planning.handle(),
    };
    if let Some(identity) = &identity {
        greet(&args, &roles, identity, listener.local_addr()?, say).await?;
    }
    let server = Server::new(parts, shutdown).await?.hearing(beacons);
    let rows = storage.store();
    let served = tokio::select! {
        served = server.serve(listener) => served,
        () = keep_stop(beside, &*rows) => Ok(()),
        () = midshift_backup::audit_notices::run(&args.data, &*rows) => Ok(()),
        () = clock_jump::save_jumps(&args.data, &*clock) => Ok(()),
        () = clock_doubt::run(&args.data, &*clock, &*rows) => Ok(()),
    };
    storage.close().await;
    served
}

/// Refuses arguments that do not go together with `roles`.
fn check_arguments(args: &Serve, roles: &Roles) -> anyhow::Result<()> {
    if args.insecure {
        tracing::warn!(address = %args.listen, "no TLS and no login: whoever reaches this port may move robots");
    }
    if roles.are_split() && args.database.store.is_none() {
        bail!(
            "--roles {roles} leaves services to other processes, and only PostgreSQL can be shared with them: add --store postgres://USER:PASSWORD@HOST/DATABASE, or leave --roles out to serve everything on SQLite"
        );
    }
    if args.identity.is_some() && roles.has(Role::Identity) {
        bail!(
            "--identity is for processes without role identity: the site's authority is in the folder identity of --data, where a backup finds it"
        );
    }
    Ok(())
}

/// The socket that clients and robots come to.
async fn listen(address: SocketAddr) -> anyhow::Result<TcpListener> {
    TcpListener::bind(address).await.with_context(|| {
        format!("listening on {address}; if another server has the port, end it or name another one with --listen")
    })
}

/// Reads the site file, and logs what its lint has to say.
fn load_site(args: &Serve) -> anyhow::Result<site_file::Loaded> {
    let loaded = site_file::load(args.site.as_deref(), None, None)?;
    for warning in &loaded.warnings {
        tracing::warn!(warning, "site");
    }
    Ok(loaded)
}

/// Tells the stop service beside this process whether it may begin with nothing engaged, if this process has its folder.
async fn announce_first_start(args: &Serve, roles: &Roles, store: &dyn Store) -> anyhow::Result<()> {
    match first_start(args, roles) {
        Some(occasion) => stop_service::announce(&args.data.join(FOLDER), store, occasion).await?,
        None if args.init_stop => {
            bail!("--init-stop is for a process with role stop-follower, which has the stop service's folder")
        }
        None => {}
    }
    Ok(())
}

/// On which occasion this process may announce a first start of the stop service beside it. None: it has not its folder.
fn first_start(args: &Serve, roles: &Roles) -> Option<stop_service::Occasion> {
    roles.has(Role::StopFollower).then_some(match (args.init_stop, roles.are_split()) {
        (true, _) => stop_service::Occasion::Person,
        (false, true) => stop_service::Occasion::Follower,
        (false, false) => stop_service::Occasion::Start,
    })
}

/// Opens the service of identity, with the site's authority if this process has the role, and with the certificate of this
/// process. None: no login.
async fn open_identity(
    args: &Serve,
    roles: &Roles,
    storage: &Storage,
    clock: &Arc<dyn Clock>,
    shutdown: &CancellationToken,
) -> anyhow::Result<Option<IdentityService>> {
    if args.insecure {
        return Ok(None);
    }
    let mut names = args.names.clone();
    if !args.listen.ip().is_unspecified() {
        names.push(args.listen.ip().to_string());
    }
    let parts = midshift_identity::Parts {
        folder: args.own_keys(),
        store: storage.store(),
        clock: clock.clone(),
        duty: if roles.has(Role::Identity) { Duty::CertificateAuthority } else { Duty::Member },
        names,
        trust_json: match &args.trust {
            Some(file) => std::fs::read_to_string(file).with_context(|| format!("reading {}", file.display()))?,
            None => String::new(),
        },
    };
    let identity = IdentityService::open(parts, shutdown).await.context("opening identity")?;
    if let Some(file) = &args.root_file {
        let root = identity.proof().borrow().authority_pem.clone();
        midshift_durable::replace(file, root.as_bytes()).with_context(|| format!("writing {}", file.display()))?;
    }
    Ok(Some(identity))
}

/// Hands out the first token of a new site, once.
async fn greet(
    args: &Serve,
    roles: &Roles,
    identity: &IdentityService,
    address: SocketAddr,
    say: Say<'_>,
) -> anyhow::Result<()> {
    if !roles.has(Role::Identity) {
        return Ok(());
    }
    let token = match identity.first_token().await? {
        Some(token) => token,
        None if args.spare_token => identity.spare_token().await?,
        None => return Ok(()),
    };
    if let Some(file) = &args.first_token_file {
        let line = format!("{token}\n");
        return midshift_durable::create(file, line.as_bytes(), midshift_durable::PRIVATE).with_context(|| {
            format!("writing the token to {}; it is lost: start again with --spare-token", file.display())
        });
    }
    let address = shown(address, &args.names);
    let pin = tls::pin_of(&identity.proof().borrow().authority_pem)?;
    let authority = args.own_keys().join(midshift_identity::PUBLIC_FILE);
    say(&format!(
        "A token that may do everything on this site, for a year. It is shown once:\n\n  {token}\n\n\
         Sign in:  midshift login {address} --pin {pin}\n\
         Or:       grpcurl -cacert {} -H \"authorization: Bearer $MIDSHIFT_TOKEN\" {address} midshift.identity.v1.IdentityService/WhoAmI\n\
         Narrower tokens for everybody else: midshift token create --help",
        authority.display()
    ));
    Ok(())
}

/// Where whoever reads this on the same machine finds the port by a name that its certificate has: one on every address of the machine is at its first name, or at the loopback.
fn shown(address: SocketAddr, names: &[String]) -> String {
    let loopback = if address.is_ipv6() { IpAddr::from(Ipv6Addr::LOCALHOST) } else { Ipv4Addr::LOCALHOST.into() };
    match names.first() {
        Some(name) if address.ip().is_unspecified() => format!("{name}:{}", address.port()),
        None if address.ip().is_unspecified() => SocketAddr::new(loopback, address.port()).to_string(),
        _ => address.to_string(),
    }
}

/// Opens the service of software, and of a gateway without role ota the folder of releases that other processes keep.
async fn open_software(
    args: &Serve,
    roles: &Roles,
    storage: &Storage,
    clock: &Arc<dyn Clock>,
    shutdown: &CancellationToken,
) -> anyhow::Result<(OtaService, Option<OtaReader>)> {
    let folder = args.data.join("ota");
    let ota = match roles.has(Role::Ota) {
        true => args.software.open(folder.clone(), owner(storage).await?, clock.clone()).await?,
        false => OtaService::without_keys(),
    };
    let hands_out = roles.has(Role::Telemetry) && !roles.has(Role::Ota) && !args.no_software;
    let reader = match hands_out {
        true => Some(reader(&folder, storage, shutdown).await?),
        false => None,
    };
    Ok((ota, reader))
}

/// A stop service beside this process. Its child is none where one answered already.
type StopBeside = (stop_service::Supervisor, Option<Child>);

/// Tells the stop service beside this process what is engaged and who is known, and starts it unless one answers. None: it runs elsewhere.
async fn start_stop(
    args: &Serve,
    roles: &Roles,
    store: &dyn Store,
    identity: Option<&IdentityService>,
) -> anyhow::Result<Option<StopBeside>> {
    if args.no_stop || roles.are_split() {
        return Ok(None);
    }
    let folder = args.data.join(FOLDER);
    stop_follower::tell_stops(&folder, store).await.context("telling the stop service what is engaged")?;
    if let Some(identity) = identity {
        stop_follower::tell_principals(&folder, identity).context("telling the stop service who is known")?;
    }
    let program = stop_service::Supervisor {
        site: args.site.clone(),
        data: args.data.clone(),
        listen: args.stop_listen,
        authority_pem: identity.map(|identity| identity.proof().borrow().authority_pem.clone()),
        arguments: args.for_stop(),
    };
    let child = program.start().await?;
    Ok(Some((program, child)))
}

/// Starts the stop service beside this process again whenever it is gone. Waits for ever where there is none.
async fn keep_stop(beside: Option<StopBeside>, store: &dyn Store) {
    match beside {
        Some((program, child)) => program.keep_running(child, store).await,
        None => std::future::pending().await,
    }
}

/// Whose the folder of releases is.
async fn owner(storage: &Storage) -> anyhow::Result<Owner> {
    let store = storage.store();
    let store_id = store.id().clone();
    Ok(match store.is_shared() {
        true => Owner::Shared { store_id, known_bundles: known_bundles(store.as_ref()).await? },
        false => Owner::Alone(store_id),
    })
}

/// The folder of releases that other processes keep: they may be starting too.
async fn reader(folder: &Path, storage: &Storage, shutdown: &CancellationToken) -> anyhow::Result<OtaReader> {
    let store_id = storage.store().id().clone();
    let mut waited = Duration::ZERO;
    loop {
        match OtaReader::open(folder.to_owned(), store_id.clone()).await {
            Ok(reader) => return Ok(reader),
            Err(error) if waited < SOFTWARE_WITHIN && !shutdown.is_cancelled() => {
                tracing::warn!(%error, "waiting for the folder of releases; --no-software does without it");
            }
            Err(error) => return Err(error).context("opening the folder of releases; --no-software does without it"),
        }
        tokio::time::sleep(SOFTWARE_LOOK).await;
        waited += SOFTWARE_LOOK;
    }
}

/// The socket that beacons come to.
pub async fn listen_for_beacons(address: SocketAddr) -> anyhow::Result<UdpSocket> {
    UdpSocket::bind(address).await.with_context(|| format!("listening for beacons on {address}"))
}
