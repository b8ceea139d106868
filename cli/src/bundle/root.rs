//! `midshift bundle root …` and `bundle trust`: who signs from the next root on, and what robots are given of that. Nothing here needs a server.

use super::files::{print_json, public_key, read_keys, read_signatures};
use crate::client::Exit;
use crate::out::{Format, Out, columns};
use clap::{Subcommand, ValueEnum};
use midshift_agent::clock;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::folder::{Error, Folder, Signed, WaitingRoot};
use midshift_bundle::keys::{KeyId, PublicKey, SecretKey};
use midshift_bundle::repository::RootDraft;
use midshift_bundle::roots::{Change, Role, message};
use midshift_core::ids::SiteId;
use midshift_core::reason::Refusal;
use std::fs;
use std::path::{Path, PathBuf};

/// Verbs of roots.
#[derive(Subcommand)]
pub enum Verb {
    /// Draft the next root with other keys, or with nothing but a new year. It counts once enough people have signed it. Again: change the draft.
    Rotate {
        /// The repository.
        #[arg(long)]
        repository: PathBuf,
        /// Whose keys. Without it only the year is new.
        #[arg(long, value_enum)]
        role: Option<Named>,
        /// A key that signs no more: its file, or its id as `show` tells it.
        #[arg(long, requires = "role")]
        drop: Vec<String>,
        /// A key that signs from then on, secret or public. A file that is not there becomes a new secret key.
        #[arg(long = "key", requires = "role")]
        keys: Vec<PathBuf>,
        /// How many keys of the role must sign. Without it as many as before.
        #[arg(long, requires = "role")]
        threshold: Option<u64>,
    },
    /// Draft the next root with one key more. It counts once enough people have signed it.
    AddKey {
        /// The repository.
        #[arg(long)]
        repository: PathBuf,
        /// Whose key.
        #[arg(long, value_enum)]
        role: Named,
        /// The key, secret or public. A file that is not there becomes a new secret key.
        #[arg(long)]
        key: PathBuf,
        /// How many keys of the role must sign. Without it as many as before.
        #[arg(long)]
        threshold: Option<u64>,
    },
    /// Sign the root that waits, or add signatures that others made. With enough of them it is the newest root.
    Sign {
        /// The repository.
        #[arg(long)]
        repository: PathBuf,
        /// A secret key of root, of those before or after the change; more than one if you hold more.
        #[arg(long, required_unless_present = "signature")]
        key: Vec<PathBuf>,
        /// What another person handed over: their pending.root.json, or the 64 bytes that a tool made of what `show --message` writes.
        #[arg(long)]
        signature: Vec<PathBuf>,
    },
    /// Show who signs what, and what the root that waits would change and still lacks.
    Show {
        /// The repository.
        #[arg(long)]
        repository: PathBuf,
        /// Write the bytes that are signed of the root that waits into this file, for tools that sign plain bytes.
        #[arg(long)]
        message: Option<PathBuf>,
    },
}

/// A role by its name.
#[derive(Clone, Copy, ValueEnum)]
pub enum Named {
    /// The next root.
    Root,
    /// What bundles there are.
    Targets,
    /// Which targets document is the newest.
    Snapshot,
    /// That this is still so.
    Timestamp,
}

impl From<Named> for Role {
    fn from(named: Named) -> Self {
        match named {
            Named::Root => Self::Root,
            Named::Targets => Self::Targets,
            Named::Snapshot => Self::Snapshot,
            Named::Timestamp => Self::Timestamp,
        }
    }
}

/// Runs one verb.
pub fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Rotate { repository, role, drop, keys, threshold } => {
            let change = role.map(|role| change(role.into(), &drop, &keys, threshold, out)).transpose()?;
            draft(&repository, change.as_ref(), out)
        }
        Verb::AddKey { repository, role, key, threshold } => {
            draft(&repository, Some(&change(role.into(), &[], &[key], threshold, out)?), out)
        }
        Verb::Sign { repository, key, signature } => sign(&repository, &key, &signature, out),
        Verb::Show { repository, message } => show(&repository, message.as_deref(), out),
    }
}

fn change(role: Role, drop: &[String], keys: &[PathBuf], threshold: Option<u64>, out: &Out) -> Result<Change, Exit> {
    let drop = drop.iter().map(|named| key_id(named)).collect::<Result<Vec<_>, _>>()?;
    let add = keys.iter().map(|path| public_key(path, out)).collect::<Result<Vec<_>, _>>()?;
    Ok(Change { role, drop, add, threshold })
}

/// A key that may be lost: by its id if there is no file.
fn key_id(named: &str) -> Result<KeyId, Exit> {
    if let Ok(digest) = named.parse() {
        return Ok(KeyId(digest));
    }
    let path = Path::new(named);
    let public = || SecretKey::read(path).map(|key| key.public());
    Ok(PublicKey::read(path).or_else(|_| public()).map_err(Error::from)?.id())
}

fn draft(repository: &Path, change: Option<&Change>, out: &Out) -> Result<(), Exit> {
    let folder = Folder::open(repository)?;
    let gone = folder.draft_root(change, clock::wall())?;
    if gone > 0 {
        out.inform(&format!("the draft had {gone} signatures: they went with this change, so each must sign again"));
    }
    tell_waiting(&folder, repository, out)
}

fn sign(repository: &Path, keys: &[PathBuf], signatures: &[PathBuf], out: &Out) -> Result<(), Exit> {
    let folder = Folder::open(repository)?;
    let (keys, handed) = (read_keys(keys)?, read_signatures(signatures)?);
    let keys: Vec<&SecretKey> = keys.iter().collect();
    match folder.sign_root(&keys, &handed)? {
        Signed::Pending => tell_waiting(&folder, repository, out),
        Signed::Published(version) => {
            print_json(&serde_json::json!({"rootVersion": version}), out);
            out.inform(&format!("signed by enough people: metadata/{version}.root.json is the newest root"));
            let repository = repository.display();
            out.next(&format!("midshift bundle sign --renew --repository {repository} --key targets-1.pem"));
            Ok(())
        }
    }
}

fn tell_waiting(folder: &Folder, repository: &Path, out: &Out) -> Result<(), Exit> {
    let Some(waiting) = folder.waiting_root()? else { return Ok(()) };
    let before = RootDraft::from_root(&folder.root()?.1).map_err(Error::from)?;
    print_json(&waiting_page(&waiting), out);
    say_waiting(&before, &waiting, out);
    let repository = repository.display();
    out.inform(
        "hand over metadata/pending.root.json: it has no secrets, and each signer looks at it with bundle root show",
    );
    out.next(&format!("midshift bundle root sign --repository {repository} --key root-1.pem"));
    Ok(())
}

fn say_waiting(before: &RootDraft, waiting: &WaitingRoot, out: &Out) {
    let version = waiting.draft.version;
    out.inform(&format!(
        "root {version} waits in metadata/pending.root.json; it is signed by {}",
        ids(&waiting.signed_by)
    ));
    for line in differences(before, &waiting.draft) {
        out.inform(&format!("  {line}"));
    }
    out.inform(&format!(
        "  lacks {} signatures of the keys of root {}, and {} of its own",
        waiting.lacks_of_before, before.version, waiting.lacks_of_own
    ));
}

/// What another root says otherwise.
fn differences(before: &RootDraft, next: &RootDraft) -> Vec<String> {
    let mut lines = vec![format!("valid until {}", next.expires.rfc3339())];
    for role in Role::ALL {
        let (old, new) = (before.signers(role), next.signers(role));
        let gone = old.keys.iter().filter(|key| !new.keys.contains(key));
        lines.extend(gone.map(|key| format!("{role}: without key {}", key.id())));
        let come = new.keys.iter().filter(|key| !old.keys.contains(key));
        lines.extend(come.map(|key| format!("{role}: with key {}", key.id())));
        if (old.threshold, old.keys.len()) != (new.threshold, new.keys.len()) {
            lines.push(format!("{role}: {} of {} keys must sign", new.threshold, new.keys.len()));
        }
    }
    lines
}

fn ids(keys: &[KeyId]) -> String {
    if keys.is_empty() {
        return "nobody".to_owned();
    }
    keys.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")
}

fn waiting_page(waiting: &WaitingRoot) -> serde_json::Value {
    let signed_by: Vec<String> = waiting.signed_by.iter().map(ToString::to_string).collect();
    serde_json::json!({
        "pending": true, "rootVersion": waiting.draft.version, "signedBy": signed_by,
        "lacksOfRootBefore": waiting.lacks_of_before, "lacksOfItsOwn": waiting.lacks_of_own,
        "roles": roles(&waiting.draft),
    })
}

fn roles(draft: &RootDraft) -> serde_json::Value {
    let role = |role: Role| {
        let signers = draft.signers(role);
        let keys: Vec<String> = signers.keys.iter().map(|key| key.id().to_string()).collect();
        (role.as_str().to_owned(), serde_json::json!({"threshold": signers.threshold, "keys": keys}))
    };
    Role::ALL.into_iter().map(role).collect::<serde_json::Map<String, serde_json::Value>>().into()
}

fn show(repository: &Path, message_file: Option<&Path>, out: &Out) -> Result<(), Exit> {
    let folder = Folder::open(repository)?;
    let (version, root) = folder.root()?;
    let (newest, waiting) = (RootDraft::from_root(&root).map_err(Error::from)?, folder.waiting_root()?);
    if let Some(path) = message_file {
        let waiting = waiting.as_ref().ok_or_else(|| Refusal::field("message", "no root waits for signatures"));
        let bytes = message(&waiting.map_err(Error::from)?.document).map_err(Error::from)?;
        let io = |source| Error::Io { doing: "writing", path: path.to_owned(), source };
        fs::write(path, bytes).map_err(io)?;
    }
    match out.format {
        Format::Json | Format::Jsonl => {
            let waiting = waiting.as_ref().map(waiting_page);
            let expires = newest.expires.rfc3339();
            let page = serde_json::json!({"rootVersion": version, "expires": expires, "roles": roles(&newest), "waiting": waiting});
            out.line(&page.to_string());
        }
        Format::Name => out.line(&version.to_string()),
        Format::Table => {
            let row = |role: Role| {
                let signers = newest.signers(role);
                let must = format!("{} of {}", signers.threshold, signers.keys.len());
                let ids: Vec<KeyId> = signers.keys.iter().map(PublicKey::id).collect();
                vec![role.to_string(), must, self::ids(&ids)]
            };
            let rows: Vec<_> = Role::ALL.into_iter().map(row).collect();
            out.line(columns(&["ROLE", "MUST SIGN", "KEYS"], &rows).trim_end());
            out.inform(&format!("root {version}, valid until {}", newest.expires.rfc3339()));
            if let Some(waiting) = &waiting {
                say_waiting(&newest, waiting, out);
            }
        }
    }
    Ok(())
}

/// Writes what robots are given on the day they are set up: the newest root, and whose orders they take.
pub fn trust(repository: &Path, directive: &[PathBuf], site: &str, into: &Path, out: &Out) -> Result<(), Exit> {
    let folder = Folder::open(repository)?;
    let checked = folder.check().map_err(Exit::of_finding)?;
    let mut directive_keys: Vec<PublicKey> = checked.key_set.map(|set| set.keys).unwrap_or_default();
    for path in directive {
        let public = || SecretKey::read(path).map(|key| key.public());
        let key = PublicKey::read(path).or_else(|_| public()).map_err(Error::from)?;
        if !directive_keys.contains(&key) {
            directive_keys.push(key);
        }
    }
    let site = SiteId::parse(site).map_err(|e| Refusal::field("site", e.to_string())).map_err(Error::from)?;
    // The newest one: a robot that began with an older would believe whoever has stolen keys that were changed since.
    let (version, root) = folder.root()?;
    let ids: Vec<KeyId> = directive_keys.iter().map(PublicKey::id).collect();
    let directive_keys = directive_keys.into_iter().map(|key| (key.id(), key)).collect();
    TrustAnchors { root, directive_keys, site }.write(into).map_err(|e| Exit::new(2, e.to_string()))?;
    let names: Vec<String> = ids.iter().map(ToString::to_string).collect();
    print_json(&serde_json::json!({"file": into, "rootVersion": version, "directiveKeys": names}), out);
    out.inform(&format!(
        "{}: root {version}, and orders signed by {}; it has no secrets",
        into.display(),
        self::ids(&ids)
    ));
    out.inform("robots get it before their first start, by hand or from a server that is started with --trust FILE");
    Ok(())
}
