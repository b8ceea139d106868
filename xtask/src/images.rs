//! Images of what is on this machine, for where no image can be pulled: a base is the libraries that a program names and nothing else.
//!
//! Invariant: the images of midshift are built by deploy/Dockerfile, the same stages as anywhere; only bases and the database come from here. Called
//! by [`crate::docker`].

use crate::run;
use crate::stack::postgresql;
use anyhow::{Context, Result, ensure};
use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Who is who in a container; 999 is PostgreSQL's user in the public image too.
const PASSWD: &str = "root:x:0:0:root:/root:/sbin/nologin\npostgres:x:999:999::/var/lib/postgresql:/sbin/nologin\nnonroot:x:65532:65532::/:/sbin/nologin\n";
const GROUP: &str = "root:x:0:\npostgres:x:999:\nnonroot:x:65532:\n";
/// Makes the files at the first start, as the public image does; everything in it is of the shell itself.
const START: &str = r#"#!/bin/sh
set -eu
data=/var/lib/postgresql/data/files
if [ ! -e "$data/PG_VERSION" ]; then
    (umask 077; printf '%s' "$POSTGRES_PASSWORD" > /tmp/password)
    initdb -A scram-sha-256 -E UTF8 --locale=C.UTF-8 -U "$POSTGRES_USER" --pwfile /tmp/password -D "$data"
    echo "CREATE DATABASE \"$POSTGRES_DB\"" | postgres --single -D "$data" postgres
    echo "host all all all scram-sha-256" >> "$data/pg_hba.conf"
fi
program=$1
shift
exec "$program" -D "$data" -h '*' "$@"
"#;

/// A folder that becomes the root of an image.
struct Root {
    context: PathBuf,
    put: BTreeSet<PathBuf>,
}

impl Root {
    fn new(context: &Path) -> Result<Self> {
        let mut root = Self { context: context.to_owned(), put: BTreeSet::new() };
        root.write("etc/passwd", PASSWD)?;
        root.write("etc/group", GROUP)?;
        root.write("tmp/.keep", "")?;
        // A tmpfs over a folder gets the folder's mode, whatever it was told.
        std::fs::set_permissions(root.inside(Path::new("/tmp")), PermissionsExt::from_mode(0o1777))?;
        Ok(root)
    }

    fn inside(&self, path: &Path) -> PathBuf {
        self.context.join("root").join(path.strip_prefix("/").unwrap_or(path))
    }

    fn write(&mut self, path: &str, text: &str) -> Result<()> {
        let to = self.inside(Path::new(path));
        std::fs::create_dir_all(to.parent().context("a folder")?)?;
        std::fs::write(&to, text).with_context(|| format!("writing {}", to.display()))
    }

    /// A file of this machine at the same path, and the libraries it names.
    fn copy_in(&mut self, path: &Path) -> Result<()> {
        if !self.put.insert(path.to_owned()) {
            return Ok(());
        }
        let to = self.inside(path);
        std::fs::create_dir_all(to.parent().context("a folder")?)?;
        std::fs::copy(path, &to).with_context(|| format!("copying {}", path.display()))?;
        self.libraries(path)
    }

    /// Only what it names.
    fn libraries(&mut self, path: &Path) -> Result<()> {
        let said = run::output(Command::new("ldd").arg(path)).unwrap_or_default();
        said.lines().filter_map(library).try_for_each(|library| self.copy_in(&library))
    }

    /// All files of a folder of this machine.
    fn put_folder(&mut self, folder: &Path) -> Result<()> {
        for entry in std::fs::read_dir(folder).with_context(|| format!("reading {}", folder.display()))? {
            let path = entry?.path();
            if path.is_dir() {
                self.put_folder(&path)?
            } else if path.exists() {
                self.copy_in(&path)?
            }
        }
        Ok(())
    }

    fn build(&self, docker: &dyn Fn() -> Command, name: &str, lines: &str) -> Result<()> {
        let file = self.context.join("Dockerfile");
        std::fs::write(&file, format!("FROM scratch\nCOPY root/ /\n{lines}")).context("writing a Dockerfile")?;
        build(docker().args(["build", "-q", "-t", name]).arg(&self.context))
    }
}

/// The library of a line of ldd: `name => /path (0x…)` or `/path (0x…)`.
fn library(line: &str) -> Option<PathBuf> {
    let line = line.split_once("=> ").map_or(line, |(_, after)| after).trim();
    let path = line.split(' ').next().filter(|path| path.starts_with('/'))?;
    Some(path.into())
}

fn build(command: &mut Command) -> Result<()> {
    ensure!(run::succeeds(command)?, "an image does not build");
    Ok(())
}

/// Names of the images.
pub struct Images {
    /// The image of midshift.
    pub midshift: &'static str,
    /// The proxy.
    pub proxy: &'static str,
    /// The database.
    pub postgresql: &'static str,
}

/// What images stand on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bases {
    /// The public images that deploy/Dockerfile names: docker pulls them.
    AsWritten,
    /// The libraries of this machine.
    OfThisMachine,
}

/// Builds all of them below `temporary`, with this binary and the one of the stop service beside it, on the libraries of
/// this machine.
pub fn make(docker: &dyn Fn() -> Command, temporary: &Path, repository: &Path, midshift: &Path) -> Result<Images> {
    let images =
        Images { midshift: "midshift:packed", proxy: "midshift-proxy:packed", postgresql: "midshift-postgres:packed" };
    packed(docker, temporary, repository, midshift, Bases::OfThisMachine, [images.midshift, images.proxy])?;
    database(docker, temporary, images.postgresql)?;
    Ok(images)
}

/// Builds midshift and the proxy by the packed stages of deploy/Dockerfile, with this binary and the one of the stop
/// service beside it, under these names.
pub fn packed(
    docker: &dyn Fn() -> Command,
    temporary: &Path,
    repository: &Path,
    midshift: &Path,
    bases: Bases,
    names: [&str; 2],
) -> Result<()> {
    let arguments = match bases {
        Bases::AsWritten => [None, None],
        Bases::OfThisMachine => {
            machine_bases(docker, temporary, midshift)?;
            [Some("BASE=midshift-base:machine"), Some("PROXY_BASE=midshift-proxy-base:machine")]
        }
    };
    // The context of the packed stages: the repository's own files and the binary.
    let context = temporary.join("packed");
    for folder in ["deploy/proxy", "deploy/data", "sites"] {
        let to = context.join(folder);
        std::fs::create_dir_all(&to)?;
        for entry in std::fs::read_dir(repository.join(folder)).with_context(|| format!("reading {folder}"))? {
            let entry = entry?;
            std::fs::copy(entry.path(), to.join(entry.file_name())).with_context(|| format!("copying {folder}"))?;
        }
    }
    for (name, program) in
        [("midshift", midshift.to_owned()), ("midshift-stop", midshift.with_file_name("midshift-stop"))]
    {
        std::fs::copy(&program, context.join(name)).with_context(|| format!("copying {}", program.display()))?;
        // Debug information is four fifths of it, and goes three times through the daemon.
        run::quietly(Command::new("strip").arg("-g").arg(context.join(name)));
    }
    for (target, name) in ["packed", "packed-proxy"].into_iter().zip(names) {
        let mut command = docker();
        command.args(["build", "-q"]);
        // An older docker builds the stages above the wanted one too.
        for argument in arguments.iter().flatten() {
            command.args(["--build-arg", argument]);
        }
        command.args(["--target", target, "-t", name, "-f"]).arg(repository.join("deploy/Dockerfile")).arg(&context);
        build(&mut command)?;
    }
    Ok(())
}

fn machine_bases(docker: &dyn Fn() -> Command, temporary: &Path, midshift: &Path) -> Result<()> {
    let mut base = Root::new(&temporary.join("base"))?;
    base.libraries(midshift)?;
    base.build(docker, "midshift-base:machine", "")?;
    let mut proxy = Root::new(&temporary.join("proxy-base"))?;
    proxy.libraries(midshift)?;
    let haproxy = run::output(Command::new("sh").args(["-c", "command -v haproxy"])).context("no haproxy")?;
    proxy.copy_in(Path::new(haproxy.trim()))?;
    proxy.build(docker, "midshift-proxy-base:machine", "")
}

fn database(docker: &dyn Fn() -> Command, temporary: &Path, name: &str) -> Result<()> {
    let programs = postgresql::programs()?;
    let version = programs.parent().context("programs have a folder")?;
    let mut root = Root::new(&temporary.join("database"))?;
    for program in ["postgres", "initdb", "pg_isready"] {
        root.copy_in(&programs.join(program))?;
    }
    for library in ["dict_snowball.so", "plpgsql.so"] {
        root.copy_in(&version.join("lib").join(library))?;
    }
    let number = version.file_name().context("a version")?;
    root.put_folder(&Path::new("/usr/share/postgresql").join(number))?;
    let locale = Path::new("/usr/lib/locale/C.utf8");
    if locale.exists() {
        root.put_folder(locale)?;
    }
    for zone in ["UTC", "GMT", "Etc/UTC"].map(|zone| Path::new("/usr/share/zoneinfo").join(zone)) {
        if zone.exists() {
            root.copy_in(&zone)?;
        }
    }
    root.copy_in(Path::new("/bin/sh"))?;
    root.write("usr/local/bin/start", START)?;
    root.write("var/lib/postgresql/data/.keep", "")?;
    let path = format!("ENV PATH={}:/usr/local/bin:/bin\n", programs.display());
    let own = "COPY --chown=999:999 root/var/lib/postgresql/ /var/lib/postgresql/\nUSER postgres\n";
    root.build(docker, name, &format!("{path}{own}ENTRYPOINT [\"/bin/sh\", \"/usr/local/bin/start\"]\n"))
}

#[cfg(test)]
mod tests {
    use super::{Path, library};

    #[test]
    fn libraries_are_read_from_what_ldd_says() {
        assert_eq!(library("\tlibm.so.6 => /lib/libm.so.6 (0x01)").as_deref(), Some(Path::new("/lib/libm.so.6")));
        assert_eq!(library("\t/lib64/ld-linux.so.2 (0x01)").as_deref(), Some(Path::new("/lib64/ld-linux.so.2")));
        assert_eq!(library("\tlinux-vdso.so.1 (0x01)"), None);
        assert_eq!(library("\tlibx.so => not found"), None);
        assert_eq!(library("\tnot a dynamic executable"), None);
    }
}
