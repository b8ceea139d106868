//! A PostgreSQL server of the tests' own: the machine's server programs on a new directory, as a user without rights.
//!
//! Invariant: it ends when the test program does, however that ends: a shell beside it waits for the end of a pipe that this
//! process holds. It keeps its promises (`fsync` is on) and orders text by a language unless a column says otherwise.
//! Uses nothing but the standard library and `tempfile`, so that any crate's tests can include this file.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};

/// Where Debian and others have the server programs.
const PLACES: [&str; 3] = ["/usr/lib/postgresql", "/usr/local/pgsql", "/opt/postgresql"];
/// Runs the server and ends it at the end of the pipe.
const SUPERVISOR: &str = "exec 3<&0; \"$@\" 3<&- >>log 2>&1 & server=$!; (read -r _ <&3; kill -QUIT $server) & wait $server; \
     if [ -n \"$REMOVED\" ]; then cd /; rm -rf \"$REMOVED\"; fi";
const USER: &str = "postgres";
/// Part of every URL. The server asks nobody for it; no program may write it into its log.
pub const PASSWORD: &str = "kept-from-every-log";

/// A running server.
pub struct PostgresServer {
    programs: PathBuf,
    dir: tempfile::TempDir,
    supervisor: Option<Child>,
    databases: AtomicU32,
    is_shared: bool,
    /// Where it listens on loopback over TLS too; none: on its socket alone.
    secured: Option<u16>,
}

/// What a server proves itself with, and whom it lets in; PEM.
pub struct Proof<'p> {
    /// Its certificate.
    pub chain: &'p str,
    /// Its key.
    pub key: &'p str,
    /// Who signs for clients.
    pub root: &'p str,
}

impl PostgresServer {
    /// The one server of this test program, started at first use.
    pub fn shared() -> &'static Self {
        static SERVER: OnceLock<PostgresServer> = OnceLock::new();
        SERVER.get_or_init(|| Self::start_new(true, None, None))
    }

    /// A new server with no databases but its own.
    ///
    /// # Panics
    /// If the machine has no server programs or they do not run.
    pub fn start() -> Self {
        Self::start_new(false, None, None)
    }

    /// As [`PostgresServer::start`], with its files below `dir`.
    pub fn start_in(dir: Option<&Path>) -> Self {
        Self::start_new(false, dir, None)
    }

    /// A server that also listens on loopback, over TLS alone, and lets nobody in there who shows no certificate of its root with the user's name.
    pub fn secured(proof: &Proof<'_>) -> Self {
        Self::start_new(false, None, Some(proof))
    }

    /// Its port on loopback, of one with TLS.
    pub const fn port(&self) -> Option<u16> {
        self.secured
    }

    /// Whether the machine has server programs.
    pub fn is_installed() -> bool {
        newest_programs().is_some()
    }

    fn start_new(is_shared: bool, dir: Option<&Path>, proof: Option<&Proof<'_>>) -> Self {
        let programs = programs();
        let below = dir.map_or_else(std::env::temp_dir, Path::to_path_buf);
        let dir = tempfile::Builder::new().prefix("midshift-pg-").tempdir_in(below).expect("a directory");
        let mut server =
            Self { programs, dir, supervisor: None, databases: AtomicU32::new(0), is_shared, secured: None };
        if let Some((uid, gid)) = unprivileged() {
            std::os::unix::fs::chown(server.dir.path(), Some(uid), Some(gid)).expect("giving the directory away");
        }
        let mut init = server.command("initdb");
        init.args(["-U", USER, "-A", "trust", "-E", "UTF8", "--no-sync", "--locale=C.UTF-8"]);
        init.args(["--locale-provider=icu", "--icu-locale=en-US", "-D"]).arg(server.dir.path().join("data"));
        run(&mut init);
        if let Some(proof) = proof {
            server.secure(proof);
        }
        server.start_again();
        server
    }

    fn secure(&mut self, proof: &Proof<'_>) {
        let data = self.dir.path().join("data");
        let access = "local all all trust\nhostssl all all 127.0.0.1/32 trust clientcert=verify-full\n";
        let files =
            [("pg_hba.conf", access), ("proof.crt", proof.chain), ("proof.key", proof.key), ("root.crt", proof.root)];
        for (name, text) in files {
            let path = data.join(name);
            std::fs::write(&path, text).expect("a file");
            std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its mode");
            if let Some((uid, gid)) = unprivileged() {
                std::os::unix::fs::chown(&path, Some(uid), Some(gid)).expect("giving the file away");
            }
        }
        let free = std::net::TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a free port");
        self.secured = Some(free.port());
    }

    /// Ends the server at once, as if its power went: nothing is finished, the log is replayed at the next start.
    ///
    /// # Panics
    /// If it does not run.
    pub fn cut(&mut self) {
        let mut supervisor = self.supervisor.take().expect("a running server");
        drop(supervisor.stdin.take());
        supervisor.wait().expect("the end of the server");
    }

    /// Starts the server again on the same files and waits until it takes connections.
    ///
    /// # Panics
    /// If it does not come up.
    pub fn start_again(&mut self) {
        let dir = self.dir.path();
        let mut command = Command::new("sh");
        command.args(["-c", SUPERVISOR, "supervisor"]).arg(self.programs.join("postgres"));
        command.arg("-D").arg(dir.join("data")).arg("-k").arg(dir).args(["-h", ""]);
        command.args(["-c", "fsync=on", "-c", "max_connections=300", "-c", "shared_buffers=32MB"]);
        command.args(["-c", "log_line_prefix=%d: "]).current_dir(dir).stdin(Stdio::piped());
        if let Some(port) = self.secured {
            command.args(["-h", "127.0.0.1", "-p", &port.to_string(), "-c", "ssl=on", "-c", "ssl_ca_file=root.crt"]);
            command.args(["-c", "ssl_cert_file=proof.crt", "-c", "ssl_key_file=proof.key"]);
        }
        if self.is_shared {
            // It is never dropped.
            command.env("REMOVED", dir);
        }
        as_user(&mut command);
        self.supervisor = Some(command.spawn().expect("sh"));
        while !self.is_ready() {
            let ended = self.supervisor.as_mut().and_then(|s| s.try_wait().expect("the supervisor"));
            assert!(ended.is_none(), "the server does not start: {}", self.log());
            std::thread::yield_now();
        }
    }

    /// A new empty database, as a URL.
    pub fn database(&self) -> String {
        self.database_from("template0")
    }

    /// A copy of `template`, a small database of this server that nobody uses.
    pub fn database_from(&self, template: &str) -> String {
        self.create(template, &self.new_name(), "wal_log")
    }

    /// The same of a large one: its files are copied.
    pub fn large_database_from(&self, template: &str) -> String {
        self.create(template, &self.new_name(), "file_copy")
    }

    fn new_name(&self) -> String {
        format!("test_{}", self.databases.fetch_add(1, Ordering::Relaxed))
    }

    /// A new empty database of this name, as a URL; it can be the template of others once nobody uses it.
    pub fn database_named(&self, name: &str) -> String {
        self.create("template0", name, "wal_log")
    }

    /// Drops a database, whoever uses it, and makes an empty one of the same name.
    pub fn emptied(&self, name: &str) {
        run(self.client("dropdb").args(["--force", name]));
        self.database_named(name);
    }

    /// Drops the database at a URL of this server, whoever uses it. One that is gone already, and a server that has ended, are no errors.
    pub fn drop_database(&self, url: &str) {
        let name = url.split('/').nth(3).and_then(|rest| rest.split('?').next()).unwrap_or_default();
        let mut drop = self.client("dropdb");
        let _ended = drop.args(["--force", "--if-exists", name]).stdout(Stdio::null()).stderr(Stdio::null()).status();
    }

    /// A log of the copy is cheaper than the two checkpoints of the other way, if the template is small.
    fn create(&self, template: &str, name: &str, strategy: &str) -> String {
        let mut create = self.client("createdb");
        run(create.args(["-T", template, "--strategy", strategy]).arg(name));
        self.url(name)
    }

    /// The URL of a database.
    pub fn url(&self, database: &str) -> String {
        let port = self.secured.map_or_else(String::new, |port| format!("&port={port}"));
        format!("postgres://{USER}:{PASSWORD}@localhost/{database}?host={}{port}", self.dir.path().display())
    }

    /// What a statement answers in a database, as text without ornaments.
    ///
    /// # Panics
    /// If it fails.
    pub fn ask(&self, url: &str, sql: &str) -> String {
        let output = self.command("psql").args(["-X", "-At", "-d", url, "-c", sql]).output().expect("psql");
        assert!(output.status.success(), "{sql}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8_lossy(&output.stdout).trim().to_owned()
    }

    /// A whole database as SQL text, without what only this version of the server would understand.
    ///
    /// # Panics
    /// If it cannot be read.
    pub fn text(&self, url: &str) -> String {
        let mut dump = self.command("pg_dump");
        let output = dump.args(["--inserts", "--no-owner", "--no-privileges", "-d", url]).output().expect("pg_dump");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let text = String::from_utf8(output.stdout).expect("text");
        let own = ["--", "SET ", "SELECT pg_catalog.set_config", "\\"];
        let lines = text.lines().filter(|line| !line.is_empty() && !own.iter().any(|begin| line.starts_with(begin)));
        lines.map(|line| format!("{line}\n")).collect()
    }

    /// Runs such a text in an empty database, all of it or nothing.
    ///
    /// # Panics
    /// If something of it is refused.
    pub fn load(&self, url: &str, text: &Path) {
        let file = std::fs::File::open(text).unwrap_or_else(|e| panic!("opening {}: {e}", text.display()));
        let mut psql = self.command("psql");
        run(psql.args(["-X", "-q", "-1", "-v", "ON_ERROR_STOP=1", "-d", url]).stdin(Stdio::from(file)));
    }

    /// Number of the server's first process, the parent of all others.
    pub fn pid(&self) -> Option<u32> {
        let file = std::fs::read_to_string(self.dir.path().join("data/postmaster.pid")).ok()?;
        file.lines().next()?.trim().parse().ok()
    }

    /// The server's socket, for a proxy in front of it.
    pub fn socket(&self) -> PathBuf {
        self.dir.path().join(format!(".s.PGSQL.{}", self.secured.unwrap_or(5432)))
    }

    fn is_ready(&self) -> bool {
        let mut ready = self.client("pg_isready");
        ready.stdout(Stdio::null()).status().is_ok_and(|status| status.success())
    }

    /// What the server has said so far; each line begins with the name of its database.
    pub fn log(&self) -> String {
        std::fs::read_to_string(self.dir.path().join("log")).unwrap_or_default()
    }

    /// A program of the server's, as its user.
    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(self.programs.join(program));
        command.current_dir(self.dir.path());
        if let Some(port) = self.secured {
            command.env("PGPORT", port.to_string());
        }
        as_user(&mut command);
        command
    }

    fn client(&self, program: &str) -> Command {
        let mut command = self.command(program);
        command.arg("-h").arg(self.dir.path()).args(["-U", USER]);
        command
    }
}

impl Drop for PostgresServer {
    fn drop(&mut self) {
        if self.supervisor.is_some() {
            self.cut();
        }
    }
}

/// The newest server programs of the machine, and their version.
fn newest_programs() -> Option<(u32, PathBuf)> {
    let versions = PLACES.iter().filter_map(|place| std::fs::read_dir(place).ok()).flatten().flatten();
    let version = |path: &Path| path.file_name().and_then(|n| n.to_str()?.parse::<u32>().ok());
    let found = versions.map(|entry| entry.path()).filter(|path| path.join("bin/initdb").is_file());
    found.filter_map(|path| Some((version(&path)?, path))).max()
}

fn programs() -> PathBuf {
    let (version, path) = newest_programs().unwrap_or_else(|| {
        panic!(
            "no PostgreSQL server programs in {PLACES:?}: install the package postgresql (cargo xtask test --install)"
        )
    });
    assert!(version >= 15, "PostgreSQL {version} in {}: 15 or newer is needed", path.display());
    path.join("bin")
}

/// Whom the server runs as: it refuses root. None: as whoever runs the tests.
fn unprivileged() -> Option<(u32, u32)> {
    let id = |args: &[&str]| {
        let output = Command::new("id").args(args).output().ok().filter(|o| o.status.success())?;
        String::from_utf8(output.stdout).ok()?.trim().parse::<u32>().ok()
    };
    if id(&["-u"]) != Some(0) {
        return None;
    }
    let of = |user: &str| Some((id(&["-u", user])?, id(&["-g", user])?));
    Some(of(USER).or_else(|| of("nobody")).expect("a user postgres or nobody"))
}

fn as_user(command: &mut Command) {
    if let Some((uid, gid)) = unprivileged() {
        std::os::unix::process::CommandExt::uid(command, uid);
        std::os::unix::process::CommandExt::gid(command, gid);
    }
}

fn run(command: &mut Command) {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("a program of PostgreSQL");
    let mut said = String::new();
    child.stderr.take().map(|mut stderr| stderr.read_to_string(&mut said));
    let status = child.wait().expect("its end");
    assert!(status.success(), "{command:?}: {said}");
}
