//! What a run left as text, and back: every database as SQL, every latch as its blocks, all other files as they are.

use super::{Left, ROBOTS};
use crate::harness::tool;
use anyhow::{Context, ensure};
use midshift_tests::postgres::PostgresServer;
use std::fs;
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

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
/// The text of a store of PostgreSQL, beside the data directory.
const STORE: &str = "store.sql";
/// Bytes of a block of a latch in its text.
const BLOCK: usize = 512;
/// Ends of the names of what each start makes anew.
const MADE_ANEW: [&str; 5] = ["log", ".lock", "-wal", "-shm", ".sock"];

/// Writes down what is left of a run.
pub fn write(left: &Left, to: &Path) -> anyhow::Result<()> {
    copy(&left.dir.path().join("data"), &to.join("data"))?;
    for (id, _) in ROBOTS {
        copy(&left.dir.path().join(id), &to.join(id))?;
    }
    left.database.iter().try_for_each(|url| Ok(fs::write(to.join(STORE), PostgresServer::shared().text(url))?))
}

/// Makes `dir/data` and the robots' folders of what was written down; the URL of the database, if the store has one.
pub fn restore(from: &Path, dir: &Path) -> anyhow::Result<Option<String>> {
    copy(&from.join("data"), &dir.join("data"))?;
    for (id, _) in ROBOTS {
        copy(&from.join(id), &dir.join(id))?;
    }
    let store = from.join(STORE);
    if !store.exists() {
        return Ok(None);
    }
    let server = PostgresServer::shared();
    let url = server.database();
    server.load(&url, &store);
    Ok(Some(url))
}

/// Copies a folder, for its owner alone as servers and robots want it; databases and latches become text, and texts what
/// they are of.
fn copy(from: &Path, to: &Path) -> anyhow::Result<()> {
    fs::DirBuilder::new().recursive(true).mode(0o700).create(to)?;
    for entry in fs::read_dir(from).with_context(|| format!("reading {}", from.display()))? {
        let path = entry?.path();
        let name = path.file_name().context("a name")?.to_string_lossy().into_owned();
        let (stem, end) = name.rsplit_once('.').unwrap_or((&name, ""));
        let to = match (stem, end) {
            _ if path.is_dir() => {
                copy(&path, &to.join(&name))?;
                continue;
            }
            _ if MADE_ANEW.iter().any(|end| name.ends_with(end)) => continue,
            (_, "db") => written(&to.join(format!("{stem}.sql")), sqlite_text(&path)?.as_bytes())?,
            (_, "sql") => sqlite_file(&path, &to.join(format!("{stem}.db")))?,
            ("latch", "") | (_, "latch") => {
                written(&to.join(format!("{name}.blocks")), latch_text(&fs::read(&path)?).as_bytes())?
            }
            (_, "blocks") => written(&to.join(stem), &latch(&fs::read_to_string(&path)?)?)?,
            _ => written(&to.join(&name), &fs::read(&path).with_context(|| format!("reading {}", path.display()))?)?,
        };
        // What a clone of the tree has may be read by all.
        fs::set_permissions(to, fs::Permissions::from_mode(0o600))?;
    }
    Ok(())
}

fn written(path: &Path, bytes: &[u8]) -> anyhow::Result<PathBuf> {
    fs::write(path, bytes).with_context(|| format!("writing {}", path.display()))?;
    Ok(path.to_owned())
}

/// A file of slots, most of it zeros: its length, and each block that is not zeros, a line each.
fn latch_text(bytes: &[u8]) -> String {
    let blocks = bytes.chunks(BLOCK).zip(0..).filter(|(block, _)| block.iter().any(|byte| *byte != 0));
    let line = |(block, number): (&[u8], usize)| {
        block.iter().fold(format!("{number} "), |line, byte| line + &format!("{byte:02x}")) + "\n"
    };
    format!("{}\n", bytes.len()) + &blocks.map(line).collect::<String>()
}

fn latch(text: &str) -> anyhow::Result<Vec<u8>> {
    let mut lines = text.lines();
    let mut bytes = vec![0; lines.next().context("a length")?.parse()?];
    for line in lines {
        let (number, hex) = line.split_once(' ').context("a block")?;
        let from = number.parse::<usize>()? * BLOCK;
        for at in 0..hex.len() / 2 {
            bytes[from + at] = u8::from_str_radix(&hex[2 * at..2 * at + 2], 16)?;
        }
    }
    Ok(bytes)
}

fn python(verb: &str, file: &Path) -> anyhow::Result<Command> {
    let mut command = Command::new(tool("MIDSHIFT_TEST_PYTHON")?);
    command.args(["-c", SQLITE, verb]).arg(file);
    Ok(command)
}

/// A database of SQLite as text.
pub fn sqlite_text(file: &Path) -> anyhow::Result<String> {
    ensure!(file.is_file(), "there is no {}", file.display());
    let output = python("dump", file)?.output()?;
    ensure!(output.status.success(), "{}: {}", file.display(), String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}

fn sqlite_file(text: &Path, file: &Path) -> anyhow::Result<PathBuf> {
    let mut child = python("load", file)?.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
    child.stdin.take().context("stdin was piped")?.write_all(&fs::read(text)?)?;
    let output = child.wait_with_output()?;
    ensure!(output.status.success(), "{}: {}", file.display(), String::from_utf8_lossy(&output.stderr));
    Ok(file.to_owned())
}
