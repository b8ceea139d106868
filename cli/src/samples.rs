//! Sample releases of the simulator's own behaviour, so that a roll-out has something true to carry: two good ones that differ, one that
//! crashes at its start, one that hangs, one that goes wrong only under load.
//!
//! Invariant: nothing is written over, and no key of a real release is made or read here but one that the caller names.
//! Called by `midshift bundle samples`.

use midshift_bundle::build;
use midshift_bundle::digest::Digest;
use midshift_bundle::folder::{Error, Folder, Signed};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::manifest::{COMPONENT_BYTES_MAX, ComponentKind, Manifest};
use midshift_bundle::repository::Profile;
use midshift_core::reason::Refusal;
use midshift_core::time::Utc;
use midshift_sim::behaviour::COMPONENT;
use midshift_sim::body::MODEL;
use midshift_sim::faults::FAULT_LOAD_LOST;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// Name of every sample's bundle.
pub const NAME: &str = "walk";
/// The component that is the agent's program.
const AGENT: &str = "agent";
/// Digits of the program's digest in its version: another program never takes its name.
const DIGITS: usize = 12;

/// One sample.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Of the bundle and of its behaviour.
    pub version: &'static str,
    /// For people.
    pub description: &'static str,
    /// Its `behaviour.toml`.
    pub behaviour: &'static str,
}

/// All of them, in the order in which they are signed.
pub const SAMPLES: [Sample; 5] = [
    Sample {
        version: "1.5.0",
        description: "A calm walk.",
        behaviour: "speed_permille = 900\nenergy_permille = 900\n",
    },
    Sample {
        version: "1.5.1",
        description: "Full speed with less energy.",
        behaviour: "speed_permille = 1000\nenergy_permille = 800\n",
    },
    Sample {
        version: "1.6.0-bad-at-start",
        description: "Bad on purpose: its program ends at its start.",
        behaviour: "crash_on_start = true\n",
    },
    Sample {
        version: "1.6.1-hangs",
        description: "Bad on purpose: its program hangs on probation.",
        behaviour: "hang_in_probation_after_ms = 300\n",
    },
    Sample {
        version: "1.6.2-bad-with-load",
        description: "Bad on purpose: obstacles and jams, a thousand times as many, while it carries something.",
        behaviour: "faults_only_with_load = true\nfault_rate_permille = 1000000\n",
    },
];

/// Who signs the samples.
#[derive(Clone, Copy, Debug)]
pub enum Signer<'a> {
    /// New throw-away keys, and a new repository beside the bundles.
    Throwaway,
    /// A key of targets that a repository lists.
    Named {
        /// The repository.
        repository: &'a Path,
        /// A secret key.
        key: &'a Path,
    },
}

/// What was made.
#[derive(Clone, Debug)]
pub struct Made {
    /// Each bundle's folder with its manifest.
    pub bundles: Vec<(PathBuf, Manifest)>,
    /// Where they are signed.
    pub repository: PathBuf,
    /// The throw-away keys; none: the key was named.
    pub keys: Option<PathBuf>,
    /// Newest targets document.
    pub targets_version: u64,
}

fn io(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { doing, path, source }
}

/// Builds all samples into `dir/bundles` and signs them. `program` is what robots start; none: only settings, which is all that a swarm reads.
///
/// # Errors
/// A `dir` that has samples already; a program that cannot be read; a key that is not enough to sign.
pub fn make(dir: &Path, program: Option<&Path>, signer: Signer<'_>, now: Utc) -> Result<Made, Error> {
    let bundles = dir.join("bundles");
    fs::create_dir_all(dir).map_err(io("making", dir))?;
    let (folder, repository, keys, key) = match signer {
        Signer::Throwaway => {
            let (repository, keys) = (dir.join("repository"), dir.join("keys"));
            let folder = Folder::create(&repository, &keys, Profile::Solo, now)?;
            let key = SecretKey::read(&keys.join("targets-1.pem"))?;
            (folder, repository, Some(keys), key)
        }
        Signer::Named { repository, key } => {
            (Folder::open(repository)?, repository.to_owned(), None, SecretKey::read(key)?)
        }
    };
    fs::create_dir(&bundles).map_err(io("making", &bundles))?;
    let program = program.map(Program::open).transpose()?;
    let mut made = Made { bundles: Vec::new(), repository, keys, targets_version: 0 };
    for sample in &SAMPLES {
        let path = bundles.join(format!("{NAME}-{}", sample.version));
        let built = build_one(sample, program.as_ref(), dir, &path)?;
        if let (Some(program), Some((first, _))) = (&program, made.bundles.first()) {
            share(&first.join(program.target()), &path.join(program.target()))?;
        }
        match folder.add(&path, &[&key], now)?.1 {
            Signed::Published(version) => made.targets_version = version,
            Signed::Pending => {
                let text = "this key alone is not enough to sign: samples need a repository that one person signs";
                return Err(Refusal::field("key", text).into());
            }
        }
        made.bundles.push((path, built));
    }
    Ok(made)
}

/// The program that robots start.
struct Program<'a> {
    path: &'a Path,
    version: String,
}

impl<'a> Program<'a> {
    fn open(path: &'a Path) -> Result<Self, Error> {
        let mut file = File::open(path).map_err(io("reading", path))?;
        let (digest, _) = Digest::of_reader(&mut file, COMPONENT_BYTES_MAX).map_err(io("reading", path))?;
        let digits = &digest.to_string()[..DIGITS];
        Ok(Self { path, version: format!("{}-{digits}", env!("CARGO_PKG_VERSION")) })
    }
    fn target(&self) -> String {
        format!("{AGENT}-{}.component", self.version)
    }
}

/// One bundle, by way of a draft that is gone afterwards.
fn build_one(sample: &Sample, program: Option<&Program<'_>>, dir: &Path, out: &Path) -> Result<Manifest, Error> {
    let draft = tempfile::Builder::new().prefix(".draft-").tempdir_in(dir).map_err(io("making a folder in", dir))?;
    let put = |name: &str, text: &str| {
        let path = draft.path().join(name);
        fs::write(&path, text).map_err(io("writing", &path))
    };
    if let Some(program) = program {
        let path = draft.path().join(AGENT);
        // Another file system has no links.
        fs::hard_link(program.path, &path)
            .or_else(|_| fs::copy(program.path, &path).map(drop))
            .map_err(io("writing", &path))?;
    }
    put("behaviour.toml", sample.behaviour)?;
    put(build::DRAFT_FILE, &draft_of(sample, program))?;
    Ok(build::build(draft.path(), out, &mut |_| {})?)
}

fn draft_of(sample: &Sample, program: Option<&Program<'_>>) -> String {
    let Sample { version, description, .. } = sample;
    let component = |name: &str, version: &str, kind: ComponentKind, file: &str| {
        let kind = kind.as_str();
        format!(
            "[[component]]\nname = \"{name}\"\nversion = \"{version}\"\nkind = \"{kind}\"\nfile = \"{file}\"\n\
             hardware = [\"{MODEL}\"]\nneeds = \"restart\"\n"
        )
    };
    let head = format!(
        "name = \"{NAME}\"\nversion = \"{version}\"\ndescription = \"{description}\"\nhard_stop_codes = [{FAULT_LOAD_LOST}]\n"
    );
    let agent = program.map(|program| component(AGENT, &program.version, ComponentKind::Process, AGENT));
    head + &agent.unwrap_or_default() + &component(COMPONENT, version, ComponentKind::Config, "behaviour.toml")
}

/// All samples have the same program: one copy of it is enough.
fn share(first: &Path, other: &Path) -> Result<(), Error> {
    let link = other.with_extension("link");
    // Where there are no links, the copy stays.
    if fs::hard_link(first, &link).is_ok() {
        fs::rename(&link, other).map_err(io("writing", other))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::task::raw::parse_version;
    use midshift_sim::behaviour::Behaviour;

    const NOW: Utc = Utc(1_800_000_000_000);

    fn behaviour_of(bundle: &Path, manifest: &Manifest) -> Behaviour {
        let component = manifest.components.iter().find(|c| c.name == COMPONENT).expect("has one");
        assert_eq!((component.kind, &component.version), (ComponentKind::Config, &manifest.version));
        Behaviour::read(&bundle.join(component.target())).expect("can be read")
    }

    #[test]
    fn samples_are_signed_and_hold_and_behave_as_they_are_called() {
        let room = tempfile::tempdir().expect("a folder");
        let program = room.path().join("program");
        fs::write(&program, "walks").expect("written");
        let dir = room.path().join("samples");
        let made = make(&dir, Some(&program), Signer::Throwaway, NOW).expect("made");
        let checked = Folder::open(&dir.join("repository")).expect("there").check().expect("holds");
        assert_eq!((checked.bundles.len(), checked.targets_version), (SAMPLES.len(), Some(made.targets_version)));
        let mut behaviours = Vec::new();
        for ((path, manifest), sample) in made.bundles.iter().zip(&SAMPLES) {
            assert_eq!(path, &dir.join("bundles").join(format!("walk-{}", sample.version)));
            assert_eq!(&build::inspect(path).expect("holds"), manifest);
            assert_eq!((manifest.name.as_str(), manifest.version.as_str()), (NAME, sample.version));
            assert!(parse_version(&manifest.version).is_some() && manifest.hardware().contains(MODEL));
            assert_eq!(manifest.components[0].kind, ComponentKind::Process);
            assert_eq!(fs::read(path.join(manifest.components[0].target())).expect("there"), b"walks");
            behaviours.push(behaviour_of(path, manifest));
        }
        let [calm, quick, crashes, hangs, loaded] = &behaviours[..] else { panic!("{behaviours:?}") };
        assert!(quick.speed_permille > calm.speed_permille && quick.energy_permille < calm.energy_permille);
        for good in [calm, quick] {
            let same = Behaviour { speed_permille: 1_000, energy_permille: 1_000, ..good.clone() };
            assert_eq!(same, Behaviour::default(), "a good one goes wrong no more often");
        }
        assert!(crashes.crash_on_start && hangs.hang_in_probation_after_ms.is_some());
        assert!(loaded.faults_only_with_load && loaded.fault_rate_permille > 10_000);
        let left: Vec<_> = fs::read_dir(&dir).expect("there").map(|e| e.expect("an entry").file_name()).collect();
        assert_eq!(left.len(), 3, "no draft is left behind: {left:?}");
    }

    #[test]
    fn samples_for_a_swarm_are_settings_only_and_may_go_into_a_repository_that_is_there() {
        let room = tempfile::tempdir().expect("a folder");
        let (repository, keys) = (room.path().join("r"), room.path().join("k"));
        Folder::create(&repository, &keys, Profile::Solo, NOW).expect("made");
        let signer = Signer::Named { repository: &repository, key: &keys.join("targets-1.pem") };
        let dir = room.path().join("samples");
        let made = make(&dir, None, signer, NOW).expect("made");
        assert!(made.bundles.iter().all(|(_, m)| m.components.len() == 1) && made.keys.is_none());
        assert_eq!(Folder::open(&repository).expect("there").check().expect("holds").bundles.len(), SAMPLES.len());
        let again = make(&dir, None, signer, NOW);
        assert!(matches!(again, Err(Error::Io { doing: "making", .. })), "nothing is made over another");
    }

    #[test]
    fn a_key_that_needs_another_signs_no_samples() {
        let room = tempfile::tempdir().expect("a folder");
        let (repository, keys) = (room.path().join("r"), room.path().join("k"));
        Folder::create(&repository, &keys, Profile::Release, NOW).expect("made");
        let signer = Signer::Named { repository: &repository, key: &keys.join("targets-1.pem") };
        let made = make(&room.path().join("samples"), None, signer, NOW);
        assert!(matches!(made, Err(Error::Refused(_))));
    }
}
