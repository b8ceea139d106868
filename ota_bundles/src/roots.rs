//! Changes of root: who signs from the next root on, and whose signatures a document that waits still lacks.
//!
//! Invariant: a next root is asked of the keys of the root before and of its own; a signature by any other key, or one that does not hold, is
//! refused and changes nothing. Called by `folder`.

use crate::keys::{KeyId, PublicKey, SecretKey, hex};
use crate::repository::{Error, RootDraft, Signers, canonical, read, rule, sign};
use midshift_core::reason::Refusal;
use midshift_core::time::Utc;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use std::fmt;
use tough::schema::{RoleType, Root, Signed, Targets};

/// Bytes of a signature that comes without a document, as `openssl pkeyutl -sign` writes it.
const BARE_SIGNATURE_BYTES: usize = 64;

/// What a root says who signs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The next root.
    Root,
    /// What bundles there are.
    Targets,
    /// Which targets document is the newest.
    Snapshot,
    /// That this is still so.
    Timestamp,
}

impl Role {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Root, Self::Targets, Self::Snapshot, Self::Timestamp];

    /// As TUF writes it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Root => "root",
            Self::Targets => "targets",
            Self::Snapshot => "snapshot",
            Self::Timestamp => "timestamp",
        }
    }
    fn of_tuf(self) -> RoleType {
        match self {
            Self::Root => RoleType::Root,
            Self::Targets => RoleType::Targets,
            Self::Snapshot => RoleType::Snapshot,
            Self::Timestamp => RoleType::Timestamp,
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// What shall be another way from the next root on.
#[derive(Clone, Debug)]
pub struct Change {
    /// Whose keys.
    pub role: Role,
    /// Keys that sign no more.
    pub drop: Vec<KeyId>,
    /// Keys that sign from then on.
    pub add: Vec<PublicKey>,
    /// How many of them must; none: as many as before.
    pub threshold: Option<u64>,
}

/// A root on its way.
#[derive(Clone, Debug)]
pub struct WaitingRoot {
    /// As it stands in `metadata/pending.root.json`.
    pub document: Vec<u8>,
    /// What it says.
    pub draft: RootDraft,
    /// Keys that have signed it.
    pub signed_by: Vec<KeyId>,
    /// Signatures that it lacks of the keys of the root before.
    pub lacks_of_before: u64,
    /// Signatures that it lacks of its own keys.
    pub lacks_of_own: u64,
}

impl RootDraft {
    /// What a root says, to make the next one of it.
    ///
    /// # Errors
    /// If it is none, or names keys that are not ed25519: those no root of ours can name.
    pub fn from_root(root: &[u8]) -> Result<Self, Error> {
        let root = read::<Root>("root", root)?.signed;
        let all = |role| {
            let signers = signers(&root, role);
            let named = root.roles.get(&role.of_tuf()).map_or(0, |keys| keys.keyids.len());
            if named == signers.keys.len() { Ok(signers) } else { Err(rule("root", "names keys that are not ed25519")) }
        };
        Ok(Self {
            version: root.version.get(),
            expires: Utc(root.expires.as_millisecond()),
            root: all(Role::Root)?,
            targets: all(Role::Targets)?,
            snapshot: all(Role::Snapshot)?,
            timestamp: all(Role::Timestamp)?,
        })
    }

    /// Who signs a role.
    pub fn signers(&self, role: Role) -> &Signers {
        match role {
            Role::Root => &self.root,
            Role::Targets => &self.targets,
            Role::Snapshot => &self.snapshot,
            Role::Timestamp => &self.timestamp,
        }
    }

    fn signers_mut(&mut self, role: Role) -> &mut Signers {
        match role {
            Role::Root => &mut self.root,
            Role::Targets => &mut self.targets,
            Role::Snapshot => &mut self.snapshot,
            Role::Timestamp => &mut self.timestamp,
        }
    }

    /// Makes a change.
    ///
    /// # Errors
    /// One that drops a key that is not there, adds one that is, leaves fewer keys than must sign, or changes nothing.
    pub fn change(&mut self, change: &Change) -> Result<(), Refusal> {
        let role = change.role;
        if change.drop.is_empty() && change.add.is_empty() && change.threshold.is_none() {
            return Err(Refusal::field("role", format!("nothing of {role} is changed: name a key or a threshold")));
        }
        let signers = self.signers_mut(role);
        for id in &change.drop {
            let before = signers.keys.len();
            signers.keys.retain(|key| key.id() != *id);
            if signers.keys.len() == before {
                return Err(Refusal::field("drop", format!("{role} names no key {id}")));
            }
        }
        for key in &change.add {
            if signers.keys.contains(key) {
                return Err(Refusal::field("key", format!("{role} names key {} already", key.id())));
            }
            signers.keys.push(key.clone());
        }
        signers.threshold = change.threshold.unwrap_or(signers.threshold);
        let (must, may) = (signers.threshold, signers.keys.len() as u64);
        if must == 0 || must > may {
            return Err(Refusal::field("threshold", format!("{must} of the {may} keys of {role} cannot sign")));
        }
        Ok(())
    }
}

/// Keys of a role that are ed25519.
fn signers(root: &Root, role: Role) -> Signers {
    let Some(named) = root.roles.get(&role.of_tuf()) else { return Signers { keys: Vec::new(), threshold: 1 } };
    let keys = named.keyids.iter().filter_map(|id| root.keys.get(id)).filter_map(|key| {
        let key = serde_json::to_value(key).ok()?;
        PublicKey::from_tuf(&key)
    });
    Signers { keys: keys.collect(), threshold: named.threshold.get() }
}

/// The keys that must sign a document: enough of each group.
#[derive(Clone, Debug)]
pub struct RequiredSigners(Vec<Signers>);

impl RequiredSigners {
    /// For a targets document.
    ///
    /// # Errors
    /// If `root` is none.
    pub fn for_targets(root: &[u8]) -> Result<Self, Error> {
        Ok(Self(vec![signers(&read::<Root>("root", root)?.signed, Role::Targets)]))
    }
    /// For the root after `before`: enough of those before, and enough of its own.
    ///
    /// # Errors
    /// If one of the two is none.
    pub fn for_root(before: &[u8], next: &[u8]) -> Result<Self, Error> {
        let of = |root: &[u8]| Ok::<_, Error>(signers(&read::<Root>("root", root)?.signed, Role::Root));
        Ok(Self(vec![of(before)?, of(next)?]))
    }

    fn keys(&self) -> impl Iterator<Item = &PublicKey> {
        self.0.iter().flat_map(|group| &group.keys)
    }

    /// Whether each of `keys` is asked for.
    ///
    /// # Errors
    /// The first that is not.
    pub fn must_name(&self, keys: &[&SecretKey]) -> Result<(), Refusal> {
        let foreign = keys.iter().map(|key| key.public()).find(|key| !self.keys().any(|required| required == key));
        foreign.map_or(Ok(()), |key| Err(not_required(key.id())))
    }

    /// Keys that signed a root, and how many signatures each group still lacks.
    ///
    /// # Errors
    /// If it is no root.
    pub fn standing(&self, root: &[u8]) -> Result<(Vec<KeyId>, Vec<u64>), Error> {
        let root = read::<Root>("root", root)?;
        let message = canonical(&root.signed);
        let mut by: Vec<&PublicKey> = Vec::new();
        for signature in &root.signatures {
            let key = self.keys().find(|key| hex(&signature.keyid) == key.id().to_string() && !by.contains(key));
            by.extend(key.filter(|key| key.verifies(&message, &signature.sig)));
        }
        let lacks = |group: &Signers| {
            let have = group.keys.iter().filter(|key| by.contains(key)).count() as u64;
            group.threshold.saturating_sub(have)
        };
        Ok((by.iter().map(|key| key.id()).collect(), self.0.iter().map(lacks).collect()))
    }
}

fn not_required(id: impl fmt::Display) -> Refusal {
    Refusal::field("signature", format!("key {id} is not asked for: the document gains nothing by it"))
}

/// A document with the signatures that others handed over: the same document as they signed it, or a bare signature.
///
/// # Errors
/// A file that is neither; another document; a signature by a key that is not asked for, or one that does not hold.
pub fn merge_root(document: &[u8], handed: &[u8], required: &RequiredSigners) -> Result<Vec<u8>, Refusal> {
    merge::<Root>("root", document, handed, required)
}

/// As [`merge_root`], for targets.
///
/// # Errors
/// As there.
pub fn merge_targets(document: &[u8], handed: &[u8], required: &RequiredSigners) -> Result<Vec<u8>, Refusal> {
    merge::<Targets>("targets", document, handed, required)
}

/// The bytes that are signed, for tools that sign plain bytes.
///
/// # Errors
/// If it is no root.
pub fn message(root: &[u8]) -> Result<Vec<u8>, Error> {
    Ok(canonical(&read::<Root>("root", root)?.signed))
}

fn merge<T>(role: &'static str, document: &[u8], handed: &[u8], required: &RequiredSigners) -> Result<Vec<u8>, Refusal>
where
    T: tough::schema::Role + Serialize + DeserializeOwned,
{
    let refused = |text: String| Refusal::field("signature", text);
    let unread = |error: Error| refused(error.to_string());
    let mut ours: Signed<T> = read(role, document).map_err(unread)?;
    let message = canonical(&ours.signed);
    let mut add = |key: &PublicKey, signature: &[u8]| {
        let page = json!({"keyid": key.id().to_string(), "sig": hex(signature)});
        let page: tough::schema::Signature =
            serde_json::from_value(page).unwrap_or_else(|e| unreachable!("hexadecimal digits: {e}"));
        ours.signatures.retain(|known| known.keyid != page.keyid);
        ours.signatures.push(page);
    };
    if handed.len() == BARE_SIGNATURE_BYTES {
        let key = required.keys().find(|key| key.verifies(&message, handed));
        add(key.ok_or_else(|| refused("is of no key that is asked for".to_owned()))?, handed);
    } else {
        let theirs: Signed<T> = read(role, handed).map_err(unread)?;
        if canonical(&theirs.signed) != message {
            return Err(refused(format!("was made for another {role} document than the one that waits here")));
        }
        for signature in &theirs.signatures {
            let id = hex(&signature.keyid);
            let Some(key) = required.keys().find(|key| key.id().to_string() == id) else {
                return Err(not_required(id));
            };
            if !key.verifies(&message, &signature.sig) {
                return Err(refused(format!("that of key {id} does not hold")));
            }
            add(key, &signature.sig);
        }
    }
    sign(ours, &[]).map_err(unread)
}
