//! Reads a compose file: the subset that the files in deploy/compose are written in.
//!
//! Invariant: a key whose meaning without docker is not known here is an error, not ignored. What only docker can do (limits of memory, a read-only
//! root) is named in [`CONTAINERS_ONLY`]. Called by [`super::plan`].

use anyhow::{Context, Result, bail, ensure};
use std::collections::BTreeMap;
use std::time::Duration;
use yaml_rust2::yaml::Hash;
use yaml_rust2::{Yaml, YamlLoader};

/// Keys of a service that mean something in a container only.
const CONTAINERS_ONLY: [&str; 12] = [
    "cap_drop",
    "image",
    "logging",
    "mem_limit",
    "networks",
    "pids_limit",
    "read_only",
    "restart",
    "security_opt",
    "shm_size",
    "tmpfs",
    "user",
];
/// What compose does without the key.
const GRACE: Duration = Duration::from_secs(10);
const INTERVAL: Duration = Duration::from_secs(30);

/// One service, with variables replaced.
#[derive(Clone, Debug, PartialEq)]
pub struct Service {
    /// Its name, which is also its host.
    pub name: String,
    /// The target of its image in deploy/Dockerfile; none: an image of others.
    pub target: Option<String>,
    /// Its program, if not that of its image.
    pub entrypoint: Option<String>,
    /// Arguments of its program.
    pub command: Vec<String>,
    /// Its environment.
    pub environment: BTreeMap<String, String>,
    /// Services that must be healthy, or have done their work, before.
    pub depends_on: Vec<String>,
    /// Of these, those that end.
    pub after: Vec<String>,
    /// It does its work once and ends.
    pub once: bool,
    /// Folders outside and their paths inside.
    pub volumes: Vec<(String, String)>,
    /// Ports of the machine and inside.
    pub ports: Vec<(u16, u16)>,
    /// How to ask whether it is healthy: program, arguments, and how often.
    pub health: Option<(Vec<String>, Duration)>,
    /// The signal that asks it to end.
    pub stop_signal: String,
    /// How long it has for that.
    pub grace: Duration,
}

/// Values of variables.
pub type Variables = BTreeMap<String, String>;

/// Services of a compose file, in the order of the file.
pub fn read(text: &str, variables: &Variables) -> Result<Vec<Service>> {
    let documents = YamlLoader::load_from_str(text).context("reading YAML")?;
    let [Yaml::Hash(top)] = documents.as_slice() else { bail!("it is not one document of keys and values") };
    let mut services = Vec::new();
    for (key, value) in top {
        match word(key)? {
            "services" => {
                for (name, service) in hash(value)? {
                    let name = word(name)?;
                    let service = Reader(variables).service(name, &merged(hash(service)?)?);
                    services.push(service.with_context(|| format!("service {name}"))?);
                }
            }
            "networks" | "volumes" => {}
            key if key.starts_with("x-") => {}
            other => bail!("`{other}` is not known here"),
        }
    }
    ensure!(!services.is_empty(), "it has no services");
    let once: Vec<String> = services.iter().flat_map(|service| service.after.clone()).collect();
    services.iter_mut().for_each(|service| service.once = once.contains(&service.name));
    Ok(services)
}

/// Lines `NAME=VALUE`; comments and empty lines aside.
pub fn variables_of(text: &str) -> Variables {
    let lines = text.lines().map(str::trim).filter(|line| !line.starts_with('#'));
    let pairs = lines.filter_map(|line| line.split_once('='));
    pairs.map(|(name, value)| (name.trim().to_owned(), value.trim().to_owned())).collect()
}

struct Reader<'v>(&'v Variables);

impl Reader<'_> {
    fn service(&self, name: &str, keys: &[(String, Yaml)]) -> Result<Service> {
        let mut service = Service {
            name: name.to_owned(),
            target: None,
            entrypoint: None,
            command: Vec::new(),
            environment: BTreeMap::new(),
            depends_on: Vec::new(),
            after: Vec::new(),
            once: false,
            volumes: Vec::new(),
            ports: Vec::new(),
            health: None,
            stop_signal: "SIGTERM".to_owned(),
            grace: GRACE,
        };
        for (key, value) in keys {
            self.set(&mut service, key, value).with_context(|| key.clone())?;
        }
        Ok(service)
    }

    fn set(&self, service: &mut Service, key: &str, value: &Yaml) -> Result<()> {
        match key {
            "build" => {
                let target = merged(hash(value)?)?.into_iter().find(|(key, _)| key == "target");
                service.target = target.map(|(_, target)| self.text(&target)).transpose()?;
            }
            "entrypoint" => match self.texts(value)?.as_slice() {
                [program] => service.entrypoint = Some(program.clone()),
                _ => bail!("must be [program]; its arguments are `command`"),
            },
            "command" => service.command = self.texts(value)?,
            "depends_on" => {
                for (on, how) in merged(hash(value)?)? {
                    let condition = merged(hash(&how)?)?.into_iter().find(|(key, _)| key == "condition");
                    let condition = condition.map(|(_, condition)| self.text(&condition)).transpose()?;
                    match condition.as_deref() {
                        Some("service_healthy") => {}
                        Some("service_completed_successfully") => service.after.push(on.clone()),
                        _ => bail!("only `service_healthy` and `service_completed_successfully` are known here"),
                    }
                    service.depends_on.push(on);
                }
            }
            "environment" => {
                for (name, value) in merged(hash(value)?)? {
                    service.environment.insert(name, self.text(&value)?);
                }
            }
            "healthcheck" => service.health = Some(self.health(value)?),
            "stop_grace_period" => service.grace = duration(&self.text(value)?)?,
            "stop_signal" => service.stop_signal = self.text(value)?,
            "ports" => service.ports = self.texts(value)?.iter().map(|port| published(port)).collect::<Result<_>>()?,
            "volumes" => service.volumes = self.texts(value)?.iter().map(|v| volume(v)).collect::<Result<_>>()?,
            key if CONTAINERS_ONLY.contains(&key) => {}
            _ => bail!("the key is not known here"),
        }
        Ok(())
    }

    fn health(&self, value: &Yaml) -> Result<(Vec<String>, Duration)> {
        let (mut test, mut interval) = (Vec::new(), INTERVAL);
        for (key, value) in merged(hash(value)?)? {
            match key.as_str() {
                "test" => test = self.texts(&value)?,
                "interval" => interval = duration(&self.text(&value)?)?,
                // How long a container may be unhealthy before docker says so.
                "timeout" | "retries" | "start_period" => {}
                _ => bail!("`{key}` is not known here"),
            }
        }
        ensure!(test.len() > 1 && test[0] == "CMD", "`test` must be [CMD, program, arguments…]");
        Ok((test.split_off(1), interval))
    }

    fn texts(&self, value: &Yaml) -> Result<Vec<String>> {
        let Yaml::Array(items) = value else { bail!("must be a list") };
        items.iter().map(|item| self.text(item)).collect()
    }

    fn text(&self, value: &Yaml) -> Result<String> {
        match value {
            Yaml::String(text) => self.replaced(text),
            Yaml::Integer(number) => Ok(number.to_string()),
            Yaml::Boolean(truth) => Ok(truth.to_string()),
            Yaml::Real(number) => Ok(number.clone()),
            _ => bail!("must be a text"),
        }
    }

    /// With `${NAME}`, `${NAME:-default}` and `${NAME:?why}` replaced.
    fn replaced(&self, text: &str) -> Result<String> {
        let (mut whole, mut rest) = (String::new(), text);
        while let Some((before, after)) = rest.split_once("${") {
            let (inside, after) = after.split_once('}').with_context(|| format!("no }} in {text}"))?;
            let (name, otherwise) = inside.split_at(inside.find(':').unwrap_or(inside.len()));
            let value = self.0.get(name).filter(|value| !value.is_empty());
            whole += before;
            whole += match (value, otherwise.get(..2)) {
                (Some(value), _) => value,
                (None, Some(":-")) => &otherwise[2..],
                (None, Some(":?")) => bail!("{name} is not set: {}", &otherwise[2..]),
                (None, _) => bail!("{name} is not set"),
            };
            rest = after;
        }
        ensure!(!rest.contains('$'), "a $ without braces in {text}");
        Ok(whole + rest)
    }
}

fn hash(value: &Yaml) -> Result<&Hash> {
    value.as_hash().context("must have keys and values")
}

fn word(value: &Yaml) -> Result<&str> {
    value.as_str().context("a key must be a text")
}

/// Keys with those of `<<` beneath them.
fn merged(own: &Hash) -> Result<Vec<(String, Yaml)>> {
    let mut keys = Vec::new();
    for (key, value) in own.iter().filter(|(key, _)| key.as_str() != Some("<<")) {
        keys.push((word(key)?.to_owned(), value.clone()));
    }
    if let Some(beneath) = own.get(&Yaml::String("<<".to_owned())) {
        for (key, value) in merged(hash(beneath)?)? {
            if !keys.iter().any(|(own, _)| *own == key) {
                keys.push((key, value));
            }
        }
    }
    Ok(keys)
}

/// `ADDRESS:OUTSIDE:INSIDE`; without docker the address is loopback.
fn published(port: &str) -> Result<(u16, u16)> {
    let mut parts = port.rsplitn(3, ':');
    let inside = parts.next().and_then(|port| port.parse().ok());
    let outside = parts.next().and_then(|port| port.parse().ok());
    outside.zip(inside).with_context(|| format!("{port} is not ADDRESS:PORT:PORT"))
}

/// `SOURCE:TARGET` with or without a mode.
fn volume(text: &str) -> Result<(String, String)> {
    let mut parts = text.split(':');
    let both = parts.next().zip(parts.next()).with_context(|| format!("{text} is not SOURCE:TARGET"))?;
    Ok((both.0.to_owned(), both.1.to_owned()))
}

fn duration(text: &str) -> Result<Duration> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len()));
    let number: u64 = number.parse().with_context(|| format!("{text} is no duration"))?;
    match unit {
        "ms" => Ok(Duration::from_millis(number)),
        "s" => Ok(Duration::from_secs(number)),
        "m" => Ok(Duration::from_secs(number * 60)),
        _ => bail!("{text} is no duration in ms, s or m"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = r#"
x-service: &service
  read_only: true
  environment: {STORE: "postgres://u:${PASSWORD:?set it}@postgres:5432/d"}
  stop_grace_period: 30s
services:
  one: &one
    <<: *service
    build: {context: ., target: midshift}
    entrypoint: [/usr/local/bin/other]
    command: [serve, --site, "/sites/${SITE:-demo}", --only, 1..5]
    healthcheck: {test: [CMD, midshift, health], interval: 500ms, retries: 3}
    volumes: ["${SITES:-../sites}:/sites:ro"]
  two:
    <<: *one
    environment: {OTHER: 7}
    ports: ["127.0.0.1:${PORT:-7400}:7401"]
    depends_on:
      one: {condition: service_healthy}
"#;

    fn variables(pairs: &[(&str, &str)]) -> Variables {
        pairs.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
    }

    #[test]
    fn keys_are_merged_and_variables_replaced() {
        let services = read(FILE, &variables(&[("PASSWORD", "p"), ("SITE", "my")])).unwrap();
        let [one, two] = services.as_slice() else { panic!("{services:?}") };
        assert_eq!(one.command, ["serve", "--site", "/sites/my", "--only", "1..5"]);
        assert_eq!(one.environment["STORE"], "postgres://u:p@postgres:5432/d");
        assert_eq!(one.health, Some((vec!["midshift".to_owned(), "health".to_owned()], Duration::from_millis(500))));
        assert_eq!((one.grace, one.target.as_deref()), (Duration::from_secs(30), Some("midshift")));
        assert_eq!(one.volumes, [("../sites".to_owned(), "/sites".to_owned())]);
        assert_eq!(one.entrypoint.as_deref(), Some("/usr/local/bin/other"));
        assert_eq!(two.command, one.command, "merged through two levels");
        assert_eq!(two.environment, variables(&[("OTHER", "7")]), "own keys win whole");
        assert_eq!((two.ports.as_slice(), two.depends_on.as_slice()), (&[(7400, 7401)][..], &["one".to_owned()][..]));
    }

    #[test]
    fn what_is_not_known_is_an_error() {
        let why = |text: &str| format!("{:#}", read(text, &Variables::new()).unwrap_err());
        assert!(why(FILE).contains("PASSWORD is not set: set it"));
        assert!(why("services: {a: {privileged: true}}").contains("service a: privileged: the key is not known"));
        assert!(why("services: {a: {depends_on: {b: {condition: service_started}}}}").contains("service_healthy"));
        let ends = "services: {a: {}, b: {depends_on: {a: {condition: service_completed_successfully}}}}";
        let once: Vec<bool> = read(ends, &Variables::new()).unwrap().iter().map(|service| service.once).collect();
        assert_eq!(once, [true, false]);
        assert!(why("services: {a: {healthcheck: {test: [CMD-SHELL, x]}}}").contains("[CMD, program"));
        assert!(why("services: {a: {command: [\"$HOME\"]}}").contains("without braces"));
        assert!(why("services: {a: {entrypoint: [midshift, serve]}}").contains("must be [program]"));
        assert!(why("configs: {}").contains("`configs` is not known"));
        assert!(why("services: {}").contains("no services"));
    }

    #[test]
    fn variables_are_read_as_lines() {
        assert_eq!(variables_of("# A=1\n\nB = two words\n"), variables(&[("B", "two words")]));
    }
}
