//! Software of robots on the server: keeps files of signed releases, says which release is the newest, hands out metadata and bytes.
//!
//! Called by the server: [`OtaService::open`], its two gRPC faces, its pages over HTTP/1.1 and [`OtaService::run`]; and [`OtaReader`] where only
//! bytes are handed out. Several processes may share one folder. Invariant: nothing is signed here that says what software is good; only files
//! that the newest signed release lists are handed out; none of those is ever taken away.

mod collect;
pub mod content;
#[cfg(test)]
#[path = "../../../tests/src/counted.rs"]
mod counted;
mod disk;
mod downloads;
#[cfg(test)]
mod fixture;
pub mod folder;
mod grpc;
mod http1;
mod integrity;
#[cfg(test)]
#[expect(dead_code, reason = "shared with tests that need tasks too")]
#[path = "../../../tests/src/old_site.rs"]
mod old_site;
mod open_folder;
mod pages;
mod reader;
mod refusal;
pub mod repository;
mod retention;
pub mod rollouts;
mod service;
mod threads;
#[cfg(test)]
#[path = "together/tests.rs"]
mod together;
#[cfg(test)]
mod wrong_clock;

pub use reader::OtaReader;
pub use retention::prune;
pub use service::{OtaService, Parts};
