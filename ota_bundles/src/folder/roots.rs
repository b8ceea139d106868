//! The next root, from its draft to enough signatures, in the folder of release people.
//!
//! Invariant: a root gets its number only once enough people of the root before and of its own have signed it; a change of the draft takes
//! along the signatures that it had.

use super::{Error, Folder, Signed, io, must_be_next};
use crate::keys::SecretKey;
use crate::repository::{PEOPLE_LIFE_MS, RootDraft, add_signatures, check_root, sign_root};
use crate::roots::{Change, RequiredSigners, WaitingRoot, merge_root};
use midshift_core::reason::Refusal;
use midshift_core::time::Utc;

/// A root that is not signed by enough people yet.
const PENDING: &str = "pending.root.json";

impl Folder {
    /// Drafts the next root, or changes the one that waits; none: only the year is new. How many signatures went with that.
    ///
    /// # Errors
    /// A change that breaks a rule; a root that names keys which are not ed25519.
    pub fn draft_root(&self, change: Option<&Change>, now: Utc) -> Result<usize, Error> {
        let (newest, root) = self.root()?;
        let waiting = self.waiting_root()?;
        let mut draft = match &waiting {
            Some(waiting) => waiting.draft.clone(),
            None => RootDraft { version: newest + 1, ..RootDraft::from_root(&root)? },
        };
        draft.expires = now.plus_ms(PEOPLE_LIFE_MS);
        change.map_or(Ok(()), |change| draft.change(change))?;
        self.write(PENDING, &sign_root(&draft, &[])?)?;
        Ok(waiting.map_or(0, |waiting| waiting.signed_by.len()))
    }

    /// The root that waits for signatures; none: none does.
    ///
    /// # Errors
    /// If it cannot be read, or was made for another root than the newest.
    pub fn waiting_root(&self) -> Result<Option<WaitingRoot>, Error> {
        let Some(document) = self.document(PENDING)? else { return Ok(None) };
        let (newest, root) = self.root()?;
        let draft = RootDraft::from_root(&document)?;
        must_be_next("root", draft.version, newest + 1)?;
        let (signed_by, lacks) = RequiredSigners::for_root(&root, &document)?.standing(&document)?;
        let lack = |group: usize| lacks.get(group).copied().unwrap_or_default();
        let (lacks_of_before, lacks_of_own) = (lack(0), lack(1));
        Ok(Some(WaitingRoot { document, draft, signed_by, lacks_of_before, lacks_of_own }))
    }

    /// Adds signatures to the root that waits for them: by `keys`, and those that others handed over. Where none waits yet, the first
    /// document that was handed over does from now on.
    ///
    /// # Errors
    /// If none waits; a key that is not asked for; what was handed over and is no signature of this root. Nothing is added then.
    pub fn sign_root(&self, keys: &[&SecretKey], handed: &[Vec<u8>]) -> Result<Signed, Error> {
        let (newest, before) = self.root()?;
        let waiting = self.waiting_root()?.map(|waiting| waiting.document);
        let Some(mut document) = waiting.or_else(|| handed.first().cloned()) else {
            let text = "no root waits for signatures: bundle root rotate or add-key makes one";
            return Err(Refusal::field("repository", text).into());
        };
        let version = RootDraft::from_root(&document)?.version;
        must_be_next("root", version, newest + 1)?;
        let required = RequiredSigners::for_root(&before, &document)?;
        required.must_name(keys)?;
        for handed in handed {
            document = merge_root(&document, handed, &required)?;
        }
        document = add_signatures(&document, keys)?;
        if check_root(&before, &document).is_err() {
            self.write(PENDING, &document)?;
            return Ok(Signed::Pending);
        }
        self.write(&format!("{version}.root.json"), &document)?;
        let pending = self.metadata().join(PENDING);
        midshift_durable::remove(&pending).map_err(io("removing", &pending))?;
        Ok(Signed::Published(version))
    }
}
