//! Rows of tokens, of the site's authority, and of certificates of servers.

use super::grant::HeldGrant;
use super::token::{Digest, TokenId};
use crate::limits;
use crate::rows::{Index, Record, Table, body_is_json};
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Who did something, and when.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Act {
    /// The actor.
    pub actor: String,
    /// UTC, unix ms.
    pub at_unix_ms: i64,
}

impl Act {
    /// Somebody's, at that moment.
    pub fn new(actor: &str, at_unix_ms: i64) -> Self {
        Self { actor: actor.to_owned(), at_unix_ms }
    }
}

/// A token of a person or a program: what is kept of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenRecord {
    /// Its id, by which it is listed and revoked.
    pub token_id: TokenId,
    /// Who it stands for, as an actor. Of those that stand no two have one name, but for one that was rotated and its
    /// successor, and those of an old store.
    pub name: String,
    /// The person who has it, who may have several; none: the name stands for itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub person: Option<Arc<str>>,
    /// Of its secret.
    pub digest: Digest,
    /// Its rights.
    pub grants: Vec<HeldGrant>,
    /// UTC, unix ms.
    pub created_unix_ms: i64,
    /// Who made it.
    pub created_by: String,
    /// UTC, unix ms. There is no token without.
    pub expires_unix_ms: i64,
    /// Who took it back, and from when on; none: it is good until it expires. A moment that is to come: it was rotated,
    /// and is good until then.
    pub revoked: Option<Act>,
    /// What made it out of another one of its name; none: it was created.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<Rotation>,
}

impl TokenRecord {
    /// Whether it lets its holder in.
    pub fn stands(&self, now: Utc) -> bool {
        self.expires_unix_ms > now.0 && !self.is_revoked(now)
    }
    /// Whether it was taken back, and the moment of that is here.
    pub fn is_revoked(&self, now: Utc) -> bool {
        self.revoked.as_ref().is_some_and(|act| act.at_unix_ms <= now.0)
    }
    /// Whether its row may go: its time, and the time in which it would still stop robots, have been over for as long as something that is gone is
    /// kept. That it was revoked makes this no earlier.
    pub fn is_past(&self, now: Utc) -> bool {
        let kept_ms = limits::TOKEN_STOPS_AFTER_EXPIRY.as_ms() + limits::GONE_KEPT.as_ms();
        now.ms_since(Utc(self.expires_unix_ms)) > kept_ms
    }
}

/// How a token took the place of another one of its name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rotation {
    /// Of which.
    pub of: TokenId,
    /// The request that asked for it; empty: none was named.
    pub request_id: String,
    /// What it asked for, so that the same id with something else is told.
    pub asked: String,
}

/// The token that has a name: whoever makes another one of that name must find this row as it was read. It goes with
/// its token; one that only expired leaves it to the next.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenName {
    /// The name.
    pub name: String,
    /// The newest token of that name.
    pub token_id: TokenId,
}

impl Record for TokenName {
    const TABLE: Table = Table::TokenName;
    body_is_json!();
    fn id(&self) -> String {
        self.name.clone()
    }
}

impl Record for TokenRecord {
    const TABLE: Table = Table::Token;
    body_is_json!();
    fn id(&self) -> String {
        self.token_id.to_string()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.created_unix_ms), ..Index::default() }
    }
}

/// The certificate authority of the site: the public half. Its key is in a file of the process with role identity.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RootCertificate {
    /// Which site.
    pub site_id: crate::ids::SiteId,
    /// The root certificate, PEM.
    pub certificate_pem: String,
}

impl Record for RootCertificate {
    const TABLE: Table = Table::RootCertificate;
    body_is_json!();
    fn id(&self) -> String {
        self.site_id.to_string()
    }
}

/// What one server process proves itself with: asked for by the process, answered by identity.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServerCertificate {
    /// Digest of the process's public key.
    pub key: Digest,
    /// What it asks to be called: host names and addresses.
    pub names: Vec<String>,
    /// The signing request, PEM.
    pub request_pem: String,
    /// The certificate and its chain, PEM; none: not answered yet.
    pub chain_pem: Option<String>,
    /// UTC, unix ms; when the certificate's time is over.
    pub expires_unix_ms: i64,
}

impl Record for ServerCertificate {
    const TABLE: Table = Table::ServerCertificate;
    body_is_json!();
    fn id(&self) -> String {
        self.key.to_string()
    }
}
