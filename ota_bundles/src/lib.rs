//! Builds, signs and verifies software bundles: for release people, for the rollout service, and for robots.
//!
//! Modules:
//! 1. `build` makes a bundle of a draft; `manifest` lists its components.
//! 2. `keys`, `repository` and `directive` sign. `key_set` names keys that sign directives; `roots` changes root keys.
//! 3. `folder` stores the repository of release people. `encoding` compresses files and makes patches, which `encoded_target` names.
//! 4. `freshness` checks documents on the server. `trust` verifies them on a robot; `release` keeps the verified ones.
//!
//! Invariant: nothing here runs, installs or downloads anything.

pub mod bugs;
pub mod build;
pub mod digest;
pub mod directive;
mod dsse;
pub mod encoded_target;
pub mod encoding;
pub mod folder;
pub mod freshness;
pub mod installed;
pub mod key_set;
pub mod keys;
pub mod manifest;
pub mod release;
pub mod repository;
pub mod roots;
pub mod set;
pub mod trust;
