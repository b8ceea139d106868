//! A database for the stack: PostgreSQL's server programs of this machine, as a user without rights.
//!
//! Invariant: the server refuses root, so as root it is run as `postgres` or `nobody`, and its folder is given away.

use super::plan::Process;
use crate::run;
use anyhow::{Context, Result, ensure};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Where Debian and others have the server's programs, by version.
const PLACES: [&str; 3] = ["/usr/lib/postgresql", "/usr/local/pgsql", "/opt/postgresql"];
const VERSION_MIN: u32 = 15;

/// The folder with the newest programs.
pub fn programs() -> Result<PathBuf> {
    let versions = PLACES.iter().filter_map(|place| std::fs::read_dir(place).ok()).flatten().flatten();
    let version = |path: &Path| path.file_name().and_then(|name| name.to_str()?.parse::<u32>().ok());
    let found = versions.map(|entry| entry.path()).filter_map(|path| Some((version(&path)?, path)));
    let newest = found.filter(|(version, path)| *version >= VERSION_MIN && path.join("bin/initdb").is_file()).max();
    let (_, path) = newest.with_context(|| {
        format!("no PostgreSQL {VERSION_MIN} or newer in {PLACES:?}; next: install the package postgresql")
    })?;
    Ok(path.join("bin"))
}

/// Makes its files and its database before the first start.
pub fn prepare(process: &Process) -> Result<()> {
    let (folder, others) = process.folders.split_first().context("it needs a folder")?;
    let data = folder.join("data");
    for other in others {
        give_keys(other)?;
    }
    if data.join("PG_VERSION").exists() {
        return Ok(());
    }
    let of = |name: &str| process.environment.get(name).with_context(|| format!("{name} is not set"));
    let (user, database, password) = (of("POSTGRES_USER")?, of("POSTGRES_DB")?, of("POSTGRES_PASSWORD")?);
    if let Some((uid, gid)) = unprivileged()? {
        std::os::unix::fs::chown(folder, Some(uid), Some(gid)).context("giving the folder of the database away")?;
    }
    let secret = folder.join("password");
    std::fs::write(&secret, password).context("writing the password")?;
    let mut init = Command::new(process.program.with_file_name("initdb"));
    init.args(["-A", "scram-sha-256", "-E", "UTF8", "--locale=C.UTF-8", "-U", user, "-D"]).arg(&data);
    init.arg("--pwfile").arg(&secret);
    let made = run_quietly(as_user(init.current_dir(folder)));
    std::fs::remove_file(&secret).context("removing the password")?;
    made?;
    // A server without a door makes the database.
    let mut single = Command::new(&process.program);
    single.args(["--single", "-D"]).arg(&data).arg("postgres").current_dir(folder);
    let script = folder.join("create.sql");
    std::fs::write(&script, format!("CREATE DATABASE \"{database}\"\n")).context("writing a statement")?;
    single.stdin(std::fs::File::open(&script).context("reading a statement")?);
    run_quietly(as_user(&mut single))?;
    std::fs::remove_file(&script).context("removing a statement")
}

/// The server takes a key only from a file of its own user.
fn give_keys(folder: &Path) -> Result<()> {
    if let Some((uid, gid)) = unprivileged()? {
        for entry in std::fs::read_dir(folder).with_context(|| format!("reading {}", folder.display()))? {
            let path = entry.context("an entry")?.path();
            std::os::unix::fs::chown(&path, Some(uid), Some(gid)).context("giving a key of the database away")?;
        }
    }
    Ok(())
}

fn run_quietly(command: &mut Command) -> Result<()> {
    let output = command.output().with_context(|| format!("running {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr).trim());
    Ok(())
}

/// Lets it run as whom the server accepts.
pub fn as_user(command: &mut Command) -> &mut Command {
    if let Ok(Some((uid, gid))) = unprivileged() {
        command.uid(uid).gid(gid);
    }
    command
}

/// Whom the server runs as; none: as whoever runs this.
pub fn unprivileged() -> Result<Option<(u32, u32)>> {
    let id = |args: &[&str]| run::output(Command::new("id").args(args)).and_then(|text| text.trim().parse().ok());
    if id(&["-u"]) != Some(0) {
        return Ok(None);
    }
    let of = |user: &str| Some((id(&["-u", user])?, id(&["-g", user])?));
    Ok(Some(of("postgres").or_else(|| of("nobody")).context("a user postgres or nobody")?))
}
