//! What a signed bundle is: how release people build and sign one, and how a robot decides whether to believe it.
//!
//! Rooms: `manifest` and `build` make a bundle of a draft; `keys`, `repository` and `directive` sign, and `key_set` says with which keys directives are; `roots` changes who signs; `folder` is where they keep it;
//! `encoding` makes files shorter on their way, and `ways` names them; `freshness` is what a server must know of documents that others signed; `trust` is what a robot believes, and `release`
//! what it keeps of that.
//! Called by the command line, by the rollout service and by agents. Invariant: nothing here runs, installs or downloads anything.

pub mod bugs;
pub mod build;
pub mod digest;
pub mod directive;
mod dsse;
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
pub mod ways;
