//! What a server proves itself with.

/// Certificate, key and root of a server, PEM.
#[derive(Clone, PartialEq, Eq)]
pub struct ServerProof {
    /// The leaf, and the root behind it.
    pub chain_pem: String,
    /// Its private key.
    pub key_pem: String,
    /// The root that robots are held against.
    pub authority_pem: String,
}

/// Without the key.
impl std::fmt::Debug for ServerProof {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ServerProof").field("authority_pem", &self.authority_pem).finish_non_exhaustive()
    }
}
