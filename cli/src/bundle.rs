//! `midshift bundle …`: what release people do with keys and bundles. Only `push`, `ls` and `revoke` need a server.

mod files;
mod root;

use super::client::{Call, Change, Exit};
use super::out::{Format, Out};
use super::{push, released};
use crate::samples::{self, Signer};
use clap::{Subcommand, ValueEnum};
use files::{bytes_of, print_json, public_key, read_keys, read_signatures};
use indicatif::{ProgressBar, ProgressStyle};
use midshift_agent::clock;
use midshift_bundle::build;
use midshift_bundle::folder::{Error, Folder, Signed};
use midshift_bundle::key_set::{ENVELOPE_BYTES_MAX, KeySet};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::manifest::Manifest;
use midshift_bundle::repository::Profile;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// Verbs of bundles.
#[derive(Subcommand)]
pub enum Verb {
    /// Make the keys and the repository of a project. Secret keys are files that only you can read: keep copies of them elsewhere.
    Keygen {
        /// Who signs releases.
        #[arg(long, value_enum, default_value_t = ProfileArg::Solo)]
        profile: ProfileArg,
        /// A new folder for the secret keys.
        #[arg(long)]
        keys: PathBuf,
        /// A new folder for the repository.
        #[arg(long)]
        repository: PathBuf,
    },
    /// Build a bundle of a folder with a bundle.toml and the files it names.
    Build {
        /// The folder.
        folder: PathBuf,
        /// A new folder for the bundle.
        #[arg(long)]
        out: PathBuf,
    },
    /// Make the next set of keys that sign orders to robots, signed by one of those that do until now. Robots take it once `sign` has listed it.
    Rekey {
        /// A secret key that robots take orders of now, e.g. directive-1.pem.
        #[arg(long)]
        by: PathBuf,
        /// A key of the set, secret or public; the server signs with the first that it has. A file that is not there becomes a new secret key.
        /// A key that is not named has ended.
        #[arg(long = "key", required = true)]
        keys: Vec<PathBuf>,
        /// Number of the set: one more than that of the newest, which `verify` tells.
        #[arg(long, default_value_t = 1)]
        number: u64,
        /// A new file for the set.
        #[arg(long)]
        out: PathBuf,
    },
    /// Add a bundle, or a set of directive keys, to the repository and sign it; or sign what waits for one more signature.
    Sign {
        /// The built bundle, or the file that `rekey` made.
        #[arg(required_unless_present_any = ["pending", "renew"])]
        bundle: Option<PathBuf>,
        /// Sign what waits for signatures instead.
        #[arg(long, conflicts_with = "bundle")]
        pending: bool,
        /// Sign what is listed already once more instead, for another year: after a change of root, or before it ends.
        #[arg(long, conflicts_with_all = ["bundle", "pending"])]
        renew: bool,
        /// The repository.
        #[arg(long)]
        repository: PathBuf,
        /// A secret key of targets; more than one if you hold more.
        #[arg(long, required_unless_present = "signature")]
        key: Vec<PathBuf>,
        /// A release, as NAME-VERSION, from which robots come beside the newest three: what they lack is made and signed too, so that they fetch less.
        #[arg(long, requires = "bundle")]
        from: Vec<String>,
        /// With --pending, what another person handed over: their pending.targets.json.
        #[arg(long, requires = "pending")]
        signature: Vec<PathBuf>,
        /// Sign only if the repository has all that this server shows, host:port, so that versions never fork.
        #[arg(long, conflicts_with = "upstream")]
        server: Option<String>,
        /// Sign only if the repository has all that this copy of it has.
        #[arg(long)]
        upstream: Option<PathBuf>,
    },
    /// Change who signs: a next root, that people of the one before and of its own sign where each of them is.
    Root {
        #[command(subcommand)]
        verb: root::Verb,
    },
    /// Write the file that robots are given when they are set up: the newest root, whose orders they take, and the id of their site.
    Trust {
        /// The repository.
        #[arg(long)]
        repository: PathBuf,
        /// A key that signs orders, secret or public, beside those of the set that the repository lists.
        #[arg(long)]
        directive: Vec<PathBuf>,
        /// The id of the site.
        #[arg(long)]
        site: String,
        /// The file.
        #[arg(long)]
        out: PathBuf,
    },
    /// Sign a release without a bundle, for good: robots that run it go on, and the server takes its files away some days after no roll-out and
    /// no robot names it any more. Push it afterwards.
    Withdraw {
        /// As NAME-VERSION or by its SHA-256.
        bundle: String,
        /// The repository.
        #[arg(long)]
        repository: PathBuf,
        /// A secret key of targets; more than one if you hold more.
        #[arg(long, required = true)]
        key: Vec<PathBuf>,
    },
    /// Make sample releases of the simulator's behaviour, two good and three bad ones, signed with throw-away keys: to try roll-outs with.
    Samples {
        /// A new folder for bundles, keys and repository.
        dir: PathBuf,
        /// The program that robots start. Without it this one.
        #[arg(long, conflicts_with = "config_only")]
        program: Option<PathBuf>,
        /// Only behaviour.toml: all that robots simulated in one process read.
        #[arg(long)]
        config_only: bool,
        /// Sign into this repository instead of a new one, e.g. that of a running dev.
        #[arg(long, requires = "key")]
        repository: Option<PathBuf>,
        /// A secret key of targets of that repository.
        #[arg(long, requires = "repository")]
        key: Option<PathBuf>,
    },
    /// Show a built bundle, and hold its files against its manifest.
    Inspect {
        /// The bundle.
        bundle: PathBuf,
    },
    /// Hold a repository against itself: signatures, chain of roots, every file.
    Verify {
        /// The repository.
        repository: PathBuf,
    },
    /// Bring what the server does not have yet and make it the newest. What was cut off goes on where it was.
    Push {
        /// The repository.
        repository: PathBuf,
        #[command(flatten)]
        call: Call,
    },
    /// List the bundles that the server has, with the robots that keep or try each.
    Ls {
        #[command(flatten)]
        call: Call,
    },
    /// Take a bundle back: its roll-outs stand still and nobody gets it any more. Robots that run it go on.
    ///
    /// It signs nothing and cannot be undone; `bundle withdraw` takes it out of the releases too. With --dry-run it only names the roll-outs that
    /// would stand still.
    Revoke {
        #[command(flatten)]
        call: Call,
        /// As NAME-VERSION or by its SHA-256.
        bundle: String,
        /// Why it is taken back, for the audit.
        #[arg(long)]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
}

/// How many people and keys sign releases, as `--profile` says it.
#[derive(Clone, Copy, ValueEnum)]
pub enum ProfileArg {
    /// One person with one key.
    Solo,
    /// One of two keys, and a spare in a safe.
    Team,
    /// Two of three people.
    Release,
}

impl From<ProfileArg> for Profile {
    fn from(profile: ProfileArg) -> Self {
        match profile {
            ProfileArg::Solo => Self::Solo,
            ProfileArg::Team => Self::Team,
            ProfileArg::Release => Self::Release,
        }
    }
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Keygen { profile, keys, repository } => keygen(profile, &keys, &repository, out),
        Verb::Build { folder, out: into } => build_one(&folder, &into, out),
        Verb::Rekey { by, keys, number, out: into } => rekey(&by, &keys, number, &into, out),
        Verb::Root { verb } => root::run(verb, out),
        Verb::Trust { repository, directive, site, out: into } => {
            root::trust(&repository, &directive, &site, &into, out)
        }
        Verb::Sign { bundle, pending, renew: _, from, repository, key, signature, server, upstream } => {
            if let Some(server) = server {
                push::has_all_of_server(Folder::open(&repository)?, &Call::to(server)).await?;
            }
            if let Some(copy) = upstream {
                push::has_all_of_copy(&Folder::open(&repository)?, &Folder::open(&copy)?)?;
            }
            let what = match bundle {
                Some(bundle) => What::New(bundle, from),
                None if pending => What::Pending(read_signatures(&signature)?),
                None => What::Again,
            };
            sign(&what, &repository, &key, out)
        }
        Verb::Withdraw { bundle, repository, key } => withdraw(&bundle, &repository, &key, out),
        Verb::Samples { dir, program, config_only, repository, key } => {
            let program = match program {
                None if !config_only => Some(std::env::current_exe().map_err(anyhow::Error::from)?),
                named => named,
            };
            let signer = match (&repository, &key) {
                (Some(repository), Some(key)) => Signer::Named { repository, key },
                _ => Signer::Throwaway,
            };
            samples(&dir, program.as_deref(), signer, out)
        }
        Verb::Inspect { bundle } => show(&build::inspect(&bundle).map_err(|e| Exit::of_finding(e.into()))?, out),
        Verb::Verify { repository } => verify(&repository, out),
        Verb::Push { repository, call } => push::run(&repository, &call, out).await,
        Verb::Ls { call } => released::list(&call, out).await,
        Verb::Revoke { call, bundle, reason, change } => released::revoke(&call, bundle, reason, change, out).await,
    }
}

fn keygen(profile: ProfileArg, keys: &Path, repository: &Path, out: &Out) -> Result<(), Exit> {
    Folder::create(repository, keys, profile.into(), clock::wall())?;
    let who = match profile {
        ProfileArg::Solo => "one key signs",
        ProfileArg::Team => "one of three keys signs; put the third into a safe",
        ProfileArg::Release => "two of three keys must sign; give each to another person",
    };
    print_json(&serde_json::json!({"keys": keys, "repository": repository, "rootVersion": 1}), out);
    out.inform(&format!("keys in {}, repository in {}: {who}", keys.display(), repository.display()));
    out.inform("root-*.pem change who may sign: take them off this machine. snapshot, timestamp and directive belong to the server");
    out.next("midshift bundle build FOLDER --out BUNDLE");
    Ok(())
}

fn build_one(folder: &Path, into: &Path, out: &Out) -> Result<(), Exit> {
    let bar = if std::io::stderr().is_terminal() { ProgressBar::new_spinner() } else { ProgressBar::hidden() };
    if let Ok(style) = ProgressStyle::with_template("{spinner} {binary_bytes} {binary_bytes_per_sec}") {
        bar.set_style(style);
    }
    let manifest = build::build(folder, into, &mut |bytes| bar.inc(bytes)).map_err(Error::from)?;
    bar.finish_and_clear();
    show(&manifest, out)?;
    out.next(&format!("midshift bundle sign {} --repository REPOSITORY --key targets-1.pem", into.display()));
    Ok(())
}

fn rekey(by: &Path, keys: &[PathBuf], number: u64, into: &Path, out: &Out) -> Result<(), Exit> {
    let by = SecretKey::read(by).map_err(Error::from)?;
    let mut set = KeySet { number, keys: Vec::new() };
    for path in keys {
        set.keys.push(public_key(path, out)?);
    }
    let envelope = set.sign(&by).map_err(Error::from)?;
    let written = midshift_durable::create(into, &envelope, midshift_durable::OPEN);
    written.map_err(|source| Error::Io { doing: "writing", path: into.to_owned(), source })?;
    let ids: Vec<String> = set.keys.iter().map(|key| key.id().to_string()).collect();
    print_json(&serde_json::json!({"number": number, "keys": ids, "file": into}), out);
    out.inform(&format!("set {number} of directive keys in {}: it has no secrets", into.display()));
    out.next(&format!("midshift bundle sign {} --repository REPOSITORY --key targets-1.pem", into.display()));
    Ok(())
}

/// The bytes of a set of directive keys; none: it is a folder, a bundle.
fn key_set(path: &Path) -> Result<Option<Vec<u8>>, Exit> {
    if path.is_dir() {
        return Ok(None);
    }
    Ok(Some(bytes_of(path, ENVELOPE_BYTES_MAX)?))
}

/// What is signed.
enum What {
    /// This bundle, with patches from these releases too; or this set of directive keys.
    New(PathBuf, Vec<String>),
    /// What waits, with what others handed over.
    Pending(Vec<Vec<u8>>),
    /// What was signed before.
    Again,
}

fn sign(what: &What, repository: &Path, keys: &[PathBuf], out: &Out) -> Result<(), Exit> {
    let folder = Folder::open(repository)?;
    let keys = read_keys(keys)?;
    let keys: Vec<&SecretKey> = keys.iter().collect();
    let signed = match what {
        What::New(bundle, from) => match key_set(bundle)? {
            Some(set) => folder.add_keys(&set, &keys, clock::wall())?.1,
            None => folder.add_with_encoded_targets(bundle, from, &keys, clock::wall())?.1,
        },
        What::Pending(handed) => folder.cosign(&keys, handed)?,
        What::Again => folder.renew(&keys, clock::wall())?,
    };
    tell_signed(signed, repository, out);
    Ok(())
}

fn withdraw(bundle: &str, repository: &Path, keys: &[PathBuf], out: &Out) -> Result<(), Exit> {
    let keys = read_keys(keys)?;
    let keys: Vec<&SecretKey> = keys.iter().collect();
    let (withdrawn, signed) = Folder::open(repository)?.withdraw(bundle, &keys, clock::wall())?;
    tell_signed(signed, repository, out);
    out.inform(&format!("{} {} is in no release any more once that is pushed", withdrawn.name, withdrawn.version));
    Ok(())
}

fn tell_signed(signed: Signed, repository: &Path, out: &Out) {
    match signed {
        Signed::Published(version) => {
            print_json(&serde_json::json!({"targetsVersion": version}), out);
            out.inform(&format!("signed: metadata/{version}.targets.json"));
            out.next(&format!("midshift bundle verify {}", repository.display()));
        }
        Signed::Pending => {
            print_json(&serde_json::json!({"pending": true}), out);
            out.inform("not enough signatures yet: metadata/pending.targets.json waits for another person");
            out.next(&format!("midshift bundle sign --pending --repository {} --key KEY", repository.display()));
        }
    }
}

fn samples(dir: &Path, program: Option<&Path>, signer: Signer<'_>, out: &Out) -> Result<(), Exit> {
    let made = samples::make(dir, program, signer, clock::wall())?;
    match out.format {
        Format::Json | Format::Jsonl => {
            let bundles: Vec<_> = made.bundles.iter().map(|(path, _)| path).collect();
            let all = serde_json::json!({"bundles": bundles, "keys": made.keys, "repository": made.repository, "targetsVersion": made.targets_version});
            out.line(&all.to_string());
        }
        Format::Name => made.bundles.iter().for_each(|(path, _)| out.line(&path.display().to_string())),
        Format::Table => {
            let row = |(path, bundle): &(PathBuf, Manifest)| {
                vec![path.display().to_string(), bundle.version.clone(), bundle.description.clone()]
            };
            let rows: Vec<_> = made.bundles.iter().map(row).collect();
            out.line(super::out::columns(&["BUNDLE", "VERSION", "WHAT IT DOES"], &rows).trim_end());
            if let Some(keys) = &made.keys {
                out.inform(&format!("throw-away keys in {}: never use them in earnest", keys.display()));
            }
            out.next(&format!("midshift bundle push {}", made.repository.display()));
        }
    }
    Ok(())
}

fn verify(repository: &Path, out: &Out) -> Result<(), Exit> {
    let checked = Folder::open(repository)?.check().map_err(Exit::of_finding)?;
    match out.format {
        Format::Json | Format::Jsonl => {
            let bundles: Vec<_> = checked.bundles.iter().map(Manifest::target).collect();
            let found = serde_json::json!({"rootVersion": checked.root_version, "targetsVersion": checked.targets_version, "bundles": bundles, "directiveKeys": checked.key_set.as_ref().map(|set| set.number)});
            out.line(&found.to_string());
        }
        Format::Name => checked.bundles.iter().for_each(|bundle| out.line(&bundle.target())),
        Format::Table => {
            let rows: Vec<Vec<String>> = checked.bundles.iter().map(row).collect();
            out.line(super::out::columns(&["BUNDLE", "VERSION", "COMPONENTS", "BYTES", "HARDWARE"], &rows).trim_end());
            let targets = checked.targets_version.map_or("none".to_owned(), |v| v.to_string());
            out.inform(&format!(
                "root {}, targets {targets}: every signature and every file holds",
                checked.root_version
            ));
            if let Some(set) = &checked.key_set {
                let keys: Vec<String> = set.keys.iter().map(|key| key.id().to_string()).collect();
                out.inform(&format!("directive keys: set {}, {}", set.number, keys.join(" ")));
            }
            out.next(&format!("midshift bundle push {}", repository.display()));
        }
    }
    Ok(())
}

fn row(bundle: &Manifest) -> Vec<String> {
    let hardware: Vec<_> = bundle.hardware().into_iter().collect();
    let count = bundle.components.len().to_string();
    vec![bundle.name.clone(), bundle.version.clone(), count, bundle.length().to_string(), hardware.join(" ")]
}

fn show(manifest: &Manifest, out: &Out) -> Result<(), Exit> {
    match out.format {
        Format::Json | Format::Jsonl => out.line(&serde_json::to_string(manifest).map_err(anyhow::Error::from)?),
        Format::Name => out.line(&manifest.target()),
        Format::Table => {
            let rows: Vec<Vec<String>> = manifest
                .components
                .iter()
                .map(|c| {
                    let cells = [&c.name, &c.version, c.kind.as_str(), c.needs.as_str()].map(str::to_owned);
                    cells.into_iter().chain([c.length.to_string(), c.digest.to_string()]).collect()
                })
                .collect();
            out.line(format!("{} {}  {}", manifest.name, manifest.version, manifest.description).trim_end());
            out.line(
                super::out::columns(&["COMPONENT", "VERSION", "KIND", "NEEDS", "BYTES", "SHA-256"], &rows).trim_end(),
            );
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
