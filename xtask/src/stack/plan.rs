//! From services of a compose file to processes of this machine: hosts become loopback ports, volumes become folders.
//!
//! Invariant: nothing is started and nothing but ports is looked at; what a service may reach is the same as in containers, but for networks.

use super::compose::Service;
use anyhow::{Context, Result, ensure};
use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Where the programs of services are.
#[derive(Clone, Debug)]
pub struct Programs {
    /// The program midshift; beside it are our other programs.
    pub midshift: PathBuf,
    /// The program HAProxy.
    pub haproxy: PathBuf,
    /// The folder with PostgreSQL's server programs.
    pub postgresql: PathBuf,
}

/// What a service is here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A program of ours.
    Midshift,
    /// HAProxy with the shipped configuration.
    Proxy,
    /// PostgreSQL's server.
    Postgresql,
}

/// One process.
#[derive(Clone, Debug)]
pub struct Process {
    /// Its service.
    pub name: String,
    /// What it is.
    pub kind: Kind,
    /// Its program.
    pub program: PathBuf,
    /// The program's arguments.
    pub arguments: Vec<String>,
    /// Beside the environment of xtask.
    pub environment: BTreeMap<String, String>,
    /// Folders to be made before.
    pub folders: Vec<PathBuf>,
    /// Which must be healthy, or have done their work, before.
    pub depends_on: Vec<String>,
    /// It does its work once and ends.
    pub once: bool,
    /// Program and arguments that succeed when it is healthy, and how often to ask; none: running is healthy.
    pub health: Option<(PathBuf, Vec<String>, Duration)>,
    /// The signal that asks it to end, without SIG.
    pub stop_signal: String,
    /// How long it has for that.
    pub grace: Duration,
}

/// A port of a service: its name and the port inside.
type Door = (String, u16);

/// Processes of these services. `file` is the compose file, `state` the folder for volumes, `root` that of the repository.
pub fn plan(services: &[Service], programs: &Programs, file: &Path, state: &Path, root: &Path) -> Result<Vec<Process>> {
    let doors = doors(services)?;
    let here = file.parent().context("the file is in a folder")?;
    services.iter().map(|service| process(service, programs, &doors, here, state, root)).collect()
}

fn kind(service: &Service) -> Result<Kind> {
    match (service.target.as_deref(), service.command.first().map(String::as_str)) {
        (Some("midshift"), _) => Ok(Kind::Midshift),
        (Some("proxy"), _) => Ok(Kind::Proxy),
        (None, Some("postgres")) => Ok(Kind::Postgresql),
        _ => anyhow::bail!("service {}: what it is without docker is not known here", service.name),
    }
}

fn process(
    service: &Service,
    programs: &Programs,
    doors: &BTreeMap<Door, u16>,
    here: &Path,
    state: &Path,
    root: &Path,
) -> Result<Process> {
    let kind = kind(service)?;
    let volumes: Vec<(PathBuf, &str)> =
        service.volumes.iter().map(|(source, target)| (folder(source, here, state), target.as_str())).collect();
    let local = |text: &String| outside(&reached(text, &service.name, doors), &volumes);
    let environment = service.environment.iter().map(|(name, value)| (name.clone(), local(value))).collect();
    let command: Vec<String> = service.command.iter().map(local).collect();
    let (program, arguments) = match kind {
        Kind::Midshift => {
            let other = service.entrypoint.as_deref().and_then(|program| Path::new(program).file_name());
            (other.map_or_else(|| programs.midshift.clone(), |name| programs.midshift.with_file_name(name)), command)
        }
        Kind::Proxy => {
            let configuration = root.join("deploy/proxy/haproxy.cfg").to_string_lossy().into_owned();
            (programs.haproxy.clone(), vec!["-W".into(), "-db".into(), "-f".into(), configuration])
        }
        Kind::Postgresql => {
            let port = *doors.get(&(service.name.clone(), 5432)).context("nothing names the port of PostgreSQL")?;
            let (data, _) = volumes.first().context("PostgreSQL needs a volume")?;
            let mut arguments = vec!["-D".to_owned(), data.join("data").to_string_lossy().into_owned()];
            arguments.extend(["-h", "127.0.0.1", "-p"].map(str::to_owned));
            arguments.extend([port.to_string(), "-k".to_owned(), data.to_string_lossy().into_owned()]);
            arguments.extend(command.into_iter().skip(1));
            (programs.postgresql.join("postgres"), arguments)
        }
    };
    let health = service.health.as_ref().map(|(test, every)| {
        let mut arguments: Vec<String> = test.iter().skip(1).map(local).collect();
        let asks = Path::new(&test[0]).file_name().unwrap_or_default();
        let program = if asks == "midshift" { programs.midshift.clone() } else { programs.postgresql.join(asks) };
        if kind == Kind::Postgresql {
            arguments.extend(doors.get(&(service.name.clone(), 5432)).map(|port| format!("--port={port}")));
        }
        (program, arguments, *every)
    });
    Ok(Process {
        name: service.name.clone(),
        kind,
        program,
        arguments,
        environment,
        folders: volumes.into_iter().map(|(folder, _)| folder).collect(),
        depends_on: service.depends_on.clone(),
        once: service.once,
        health,
        stop_signal: service.stop_signal.trim_start_matches("SIG").to_owned(),
        grace: service.grace,
    })
}

/// A port of this machine for each port that services have: the published one, or one that is free.
fn doors(services: &[Service]) -> Result<BTreeMap<Door, u16>> {
    let mut doors = BTreeMap::new();
    // Held until all are chosen, so that none is given twice.
    let mut held = Vec::new();
    for (outside, inside, service) in services.iter().flat_map(|s| s.ports.iter().map(move |p| (p.0, p.1, s))) {
        let taken = TcpListener::bind(("127.0.0.1", outside));
        held.push(taken.with_context(|| format!("{}: port {outside} of this machine", service.name))?);
        doors.insert((service.name.clone(), inside), outside);
    }
    let texts = |service: &Service| {
        let asked = service.health.iter().flat_map(|(test, _)| test.clone());
        service.command.iter().chain(service.environment.values()).cloned().chain(asked).collect::<Vec<_>>()
    };
    for service in services {
        for text in texts(service) {
            let named = services.iter().flat_map(|s| ports_after(&text, &s.name).map(|port| (s.name.clone(), port)));
            let own = own_port(&text).map(|port| (service.name.clone(), port));
            for door in named.chain(own) {
                if let std::collections::btree_map::Entry::Vacant(vacant) = doors.entry(door) {
                    let free = TcpListener::bind("127.0.0.1:0").context("a free port")?;
                    vacant.insert(free.local_addr().context("its number")?.port());
                    held.push(free);
                }
            }
        }
    }
    ensure!(!doors.is_empty(), "no service has a port");
    Ok(doors)
}

/// The port that a service itself listens on or asks: an address of its own and nothing else.
fn own_port(text: &str) -> Option<u16> {
    let (host, port) = text.rsplit_once(':')?;
    ["", "0.0.0.0", "127.0.0.1"].contains(&host).then(|| port.parse().ok()).flatten()
}

/// Ports in `HOST:PORT` wherever it stands as a whole.
fn ports_after<'t>(text: &'t str, host: &'t str) -> impl Iterator<Item = u16> + 't {
    text.match_indices(host).filter_map(move |(at, _)| {
        let whole = !text[..at].ends_with(|c: char| c.is_ascii_alphanumeric() || "-_.".contains(c));
        let digits = text[at + host.len()..].strip_prefix(':')?;
        let digits = &digits[..digits.find(|c: char| !c.is_ascii_digit()).unwrap_or(digits.len())];
        digits.parse().ok().filter(|_| whole)
    })
}

/// The same text with addresses of services as they are on this machine.
fn reached(text: &str, service: &str, doors: &BTreeMap<Door, u16>) -> String {
    if let Some(port) = own_port(text).and_then(|port| doors.get(&(service.to_owned(), port))) {
        return format!("127.0.0.1:{port}");
    }
    let mut text = text.to_owned();
    for ((host, inside), outside) in doors {
        while let Some(at) = address_at(&text, host, *inside) {
            text.replace_range(at..at + format!("{host}:{inside}").len(), &format!("127.0.0.1:{outside}"));
        }
    }
    text
}

fn address_at(text: &str, host: &str, port: u16) -> Option<usize> {
    let address = format!("{host}:{port}");
    text.match_indices(&address).map(|(at, _)| at).find(|at| {
        !text[..*at].ends_with(|c: char| c.is_ascii_alphanumeric() || "-_.".contains(c))
            && !text[at + address.len()..].starts_with(|c: char| c.is_ascii_digit())
    })
}

/// The folder of a volume: beside the compose file if it is a path, else in the state.
fn folder(source: &str, here: &Path, state: &Path) -> PathBuf {
    if source.starts_with(['.', '/']) { here.join(source) } else { state.join("volumes").join(source) }
}

/// The same text with paths of volumes as they are on this machine, wherever they stand whole.
fn outside(text: &str, volumes: &[(PathBuf, &str)]) -> String {
    let mut text = text.to_owned();
    for (folder, target) in volumes {
        let mut from = 0;
        while let Some(at) = path_at(&text, target, from) {
            let path = folder.display().to_string();
            text.replace_range(at..at + target.len(), &path);
            from = at + path.len();
        }
    }
    text
}

fn path_at(text: &str, path: &str, from: usize) -> Option<usize> {
    let is_name = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let found = text.match_indices(path).map(|(at, _)| at).filter(|at| *at >= from);
    found.into_iter().find(|at| {
        !text[..*at].ends_with(|c: char| is_name(c) || c == '/') && !text[at + path.len()..].starts_with(is_name)
    })
}

#[cfg(test)]
mod tests {
    use super::super::compose::{Variables, read, variables_of};
    use super::*;

    fn shipped(name: &str) -> (PathBuf, Vec<Process>) {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let file = root.join("deploy/compose").join(name);
        let mut variables: Variables =
            variables_of(&std::fs::read_to_string(root.join("deploy/compose/.env.example")).unwrap());
        // Whatever else runs on this machine.
        let free = || TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port().to_string();
        for port in crate::stack::site::PORTS {
            variables.insert(port.to_owned(), free());
        }
        let services = read(&std::fs::read_to_string(&file).unwrap(), &variables).unwrap();
        let programs = Programs { midshift: "/m/midshift".into(), haproxy: "/h".into(), postgresql: "/p".into() };
        let processes = plan(&services, &programs, &file, Path::new("/state"), &root).unwrap();
        (file, processes)
    }

    #[test]
    fn the_shipped_stacks_become_processes_that_name_no_container() {
        for name in ["one-box.yaml", "split.yaml"] {
            let (_, processes) = shipped(name);
            let names: Vec<&str> = processes.iter().map(|p| p.name.as_str()).collect();
            for process in &processes {
                let health = process.health.iter().flat_map(|(_, arguments, _)| arguments);
                for text in process.arguments.iter().chain(process.environment.values()).chain(health) {
                    assert!(names.iter().all(|name| ports_after(text, name).next().is_none()), "{name}: {text}");
                    assert!(!text.contains("/var/lib") && !text.starts_with("/etc/midshift"), "{name}: {text}");
                    assert!(!text.contains("--insecure"), "{name}: {text}");
                    assert!(!text.contains("0.0.0.0"), "{name}: {text}");
                }
            }
        }
    }

    #[test]
    fn the_split_stack_has_each_part_of_its_kind() {
        let (_, processes) = shipped("split.yaml");
        let of = |kind| processes.iter().filter(|p| p.kind == kind).count();
        assert_eq!((of(Kind::Midshift), of(Kind::Proxy), of(Kind::Postgresql)), (14, 1, 1));
        let gateways: Vec<_> = processes.iter().filter(|p| p.name.starts_with("gateway")).collect();
        assert!(gateways.iter().all(|g| g.folders.contains(&PathBuf::from("/state/volumes/software"))));
        let mut listens: Vec<_> =
            processes.iter().flat_map(|p| &p.arguments).filter(|a| own_port(a).is_some()).collect();
        let all = listens.len();
        listens.sort();
        listens.dedup();
        // Three containers of robots dial the same three addresses, of which one is told to who listens there too.
        assert_eq!(listens.len(), all - 7);
        let once: Vec<&str> = processes.iter().filter(|p| p.once).map(|p| p.name.as_str()).collect();
        assert_eq!(once, ["database-keys", "proxy-certificate"]);
    }

    #[test]
    fn an_address_is_replaced_only_where_it_stands_whole() {
        let doors = BTreeMap::from([(("task".to_owned(), 7420), 9001), (("a".to_owned(), 5432), 9002)]);
        assert_eq!(reached("postgres://u:p@a:5432/d", "x", &doors), "postgres://u:p@127.0.0.1:9002/d");
        assert_eq!(reached("my-task:7420", "x", &doors), "my-task:7420");
        assert_eq!(reached("task:74200", "x", &doors), "task:74200");
        assert_eq!(reached("0.0.0.0:7420", "task", &doors), "127.0.0.1:9001");
        assert_eq!(reached(":7420", "task", &doors), "127.0.0.1:9001");
        assert_eq!(outside("/data/x", &[("/s".into(), "/data")]), "/s/x");
        assert_eq!(outside("/database", &[("/s".into(), "/data")]), "/database");
        assert_eq!(
            outside("a=/data/x&b=/data&c=/x/data", &[("/data/s".into(), "/data")]),
            "a=/data/s/x&b=/data/s&c=/x/data"
        );
    }
}
