//! What a run of each release left, as files of `tests/fixtures/VERSION`, and how a database becomes text and text a database.
//!
//! Invariant: a folder is written once, by `cargo xtask fixtures record` with programs of that release, and never changed afterwards.
//!
//! ```text
//! wire.txt                   frames that robots and server exchanged (crate::wire)
//! protos.binpb               descriptors of every .proto
//! ENGINE/                    sqlite or postgres: a run of its own each
//!   control.sql telemetry.sql, or store.sql   the store as SQL text
//!   shapes.txt               what its rows may be made of, as that release reads them (crate::shape)
//!   ota/                     signed software that the server kept
//!   robots/ID/               a robot's folder; agent.sql is its database
//! ```

use anyhow::{Context, ensure};
use std::ffi::OsStr;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Where this build writes what it leaves, if it is to.
pub const RECORD: &str = "MIDSHIFT_RECORD";

/// Folder of signed software, in a data directory and here.
pub const RELEASES: &str = "ota";

/// A database of SQLite as SQL text, and back; the version that its owner gave it goes with it.
const SQLITE: &str = r#"
import sqlite3, sys
verb, path = sys.argv[1:]
file = sqlite3.connect(path)
if verb == "dump":
    print(f"PRAGMA user_version={file.execute('PRAGMA user_version').fetchone()[0]};")
    for line in file.iterdump():
        print(line)
else:
    file.executescript(sys.stdin.read())
"#;

/// One release.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Release {
    /// Its folder; the name of it is the version.
    pub folder: PathBuf,
}

impl Release {
    /// All of them.
    ///
    /// # Errors
    /// If there is none: then nothing would be tested.
    pub fn all() -> anyhow::Result<Vec<Self>> {
        let under = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures");
        let entries = fs::read_dir(&under).with_context(|| format!("reading {}", under.display()))?;
        let folders = entries.map(|entry| Ok(entry?.path())).collect::<anyhow::Result<Vec<_>>>()?;
        // What begins with a dot is being made.
        let is_made = |path: &PathBuf| {
            path.is_dir() && !path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."))
        };
        let mut all: Vec<Self> = folders.into_iter().filter(is_made).map(|folder| Self { folder }).collect();
        all.sort();
        ensure!(!all.is_empty(), "no release is in {}", under.display());
        Ok(all)
    }
    /// What a run on this engine left.
    pub fn engine(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }
    /// A text of it.
    ///
    /// # Errors
    /// If it is not there.
    pub fn text(&self, name: &str) -> anyhow::Result<String> {
        let path = self.folder.join(name);
        fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))
    }
}

fn python(verb: &str, file: &Path) -> anyhow::Result<Command> {
    let python = std::env::var_os("MIDSHIFT_TEST_PYTHON")
        .context("MIDSHIFT_TEST_PYTHON is not set: run `cargo xtask test --install`")?;
    let mut command = Command::new(python);
    command.args(["-c", SQLITE, verb]).arg(file);
    Ok(command)
}

/// A file of SQLite that nobody uses, as text.
///
/// # Errors
/// If it cannot be read.
pub fn sqlite_text(file: &Path) -> anyhow::Result<String> {
    ensure!(file.is_file(), "there is no {}", file.display());
    let output = python("dump", file)?.output()?;
    ensure!(output.status.success(), "{}: {}", file.display(), String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}

/// The file of SQLite that such a text is of.
///
/// # Errors
/// If something is there already, or the text is not of such a file.
pub fn sqlite_file(text: &str, file: &Path) -> anyhow::Result<()> {
    ensure!(!file.exists(), "{} is there already", file.display());
    let mut command = python("load", file)?;
    let mut child = command.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
    child.stdin.take().context("stdin was piped")?.write_all(text.as_bytes())?;
    let output = child.wait_with_output()?;
    ensure!(output.status.success(), "{}: {}", file.display(), String::from_utf8_lossy(&output.stderr));
    Ok(())
}

/// Name of a robot's database, and of its text.
const AGENT: (&str, &str) = ("agent.db", "agent.sql");

/// Copies a folder; a robot's database becomes text, or a text its database.
///
/// # Errors
/// If something cannot be read or written.
pub fn copy(from: &Path, to: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from).with_context(|| format!("reading {}", from.display()))? {
        let (path, name) = entry.map(|entry| (entry.path(), entry.file_name()))?;
        if path.is_dir() {
            copy(&path, &to.join(&name))?;
        } else if name == AGENT.0 {
            fs::write(to.join(AGENT.1), sqlite_text(&path)?)?;
        } else if name == AGENT.1 {
            sqlite_file(&fs::read_to_string(&path)?, &to.join(AGENT.0))?;
        } else if !is_passing(&name) {
            fs::copy(&path, to.join(&name)).with_context(|| format!("copying {}", path.display()))?;
        }
    }
    Ok(())
}

/// What a start makes anew.
fn is_passing(name: &OsStr) -> bool {
    let name = name.to_string_lossy();
    name == "log" || [".lock", "-wal", "-shm"].iter().any(|end| name.ends_with(end))
}
