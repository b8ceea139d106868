//! Which sites this person knows, and the token for each, in a file.
//!
//! Invariant: the file is its owner's alone (0600), written whole or not at all.

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;

/// Where the file is, if not in the usual place.
const FILE_VARIABLE: &str = "MIDSHIFT_CONTEXTS";

/// What is known of one site.
#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Context {
    /// The server, host:port.
    pub server: String,
    /// The stop service, host:port, if it is not on port 7421 of the same host.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop_server: Option<String>,
    /// The site. None: it was remembered by hand.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub site_id: Option<String>,
    /// The site's root, PEM.
    pub authority_pem: String,
    /// What is shown there.
    pub token: String,
}

/// All of them.
#[derive(Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Contexts {
    /// Which one is used if none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub current: Option<String>,
    /// By name.
    #[serde(default)]
    pub context: BTreeMap<String, Context>,
}

fn path() -> anyhow::Result<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    if let Some(file) = set(FILE_VARIABLE) {
        return Ok(file);
    }
    let folder = set("XDG_CONFIG_HOME").or_else(|| set("HOME").map(|home| home.join(".config")));
    let folder =
        folder.with_context(|| format!("neither HOME nor {FILE_VARIABLE} is set: where would sites be remembered?"))?;
    Ok(folder.join("midshift/contexts.toml"))
}

impl Contexts {
    /// As they were written; empty if there is no file.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn read() -> anyhow::Result<Self> {
        let Ok(path) = path() else { return Ok(Self::default()) };
        let doing = || format!("reading {}", path.display());
        match std::fs::read_to_string(&path) {
            Ok(text) => {
                let found = std::fs::metadata(&path).with_context(doing)?;
                // Said, and no more: somebody may have to stop a fleet by it.
                if found.is_file() && found.permissions().mode() & 0o077 != 0 {
                    tracing::warn!(path = %path.display(), "it has tokens and is open to others: chmod 600 it");
                }
                toml::from_str(&text).with_context(doing)
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error).with_context(doing),
        }
    }

    /// Writes all of them.
    ///
    /// # Errors
    /// The file cannot be written; then it is as it was.
    pub fn write(&self) -> anyhow::Result<()> {
        let path = path()?;
        let folder = path.parent().context("the file is in no folder")?;
        std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
        let text = toml::to_string(self).with_context(|| format!("writing {}", path.display()))?;
        midshift_durable::replace_with(&path, text.as_bytes(), midshift_durable::PRIVATE)
            .with_context(|| format!("writing {}", path.display()))
    }

    /// The one with this name, or the current one; none: nobody has signed in.
    ///
    /// # Errors
    /// The name is not known.
    pub fn pick(&self, name: Option<&str>) -> Result<Option<&Context>, Unknown> {
        match name.or(self.current.as_deref()) {
            None => Ok(None),
            Some(name) => self.context.get(name).map(Some).ok_or_else(|| Unknown(name.to_owned())),
        }
    }
}

/// Nothing is known under this name.
pub struct Unknown(pub String);
