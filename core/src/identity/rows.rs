//! Rows of tokens, of the site's authority, and of certificates of servers.

use super::grant::Grant;
use super::token::{Digest, TokenId};
use crate::rows::{Index, Record, Table};
use serde::{Deserialize, Serialize};

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
    /// Which.
    pub token_id: TokenId,
    /// Who it stands for, as an actor; one person may have several.
    pub name: String,
    /// Of its secret.
    pub digest: Digest,
    /// Its rights.
    pub grants: Vec<Grant>,
    /// UTC, unix ms.
    pub created_unix_ms: i64,
    /// Who made it.
    pub created_by: String,
    /// UTC, unix ms. There is no token without.
    pub expires_unix_ms: i64,
    /// Who took it back; none: it is good until it expires.
    pub revoked: Option<Act>,
}

impl Record for TokenRecord {
    const TABLE: Table = Table::Token;
    fn id(&self) -> String {
        self.token_id.to_string()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.created_unix_ms), ..Index::default() }
    }
}

/// The certificate authority of the site: the public half. Its key is in a file of the process with role identity.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Authority {
    /// Which site.
    pub site_id: crate::ids::SiteId,
    /// The root certificate, PEM.
    pub certificate_pem: String,
}

impl Record for Authority {
    const TABLE: Table = Table::Authority;
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
    fn id(&self) -> String {
        self.key.to_string()
    }
}
