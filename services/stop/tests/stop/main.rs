//! The stop service over real connections and real files.

mod audit;
mod confirmed;
mod disk;
mod harness;
mod kept;
mod lines;
