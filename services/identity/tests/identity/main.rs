//! Identity over a store in memory and real files: the site's authority, enrolment, tokens.

mod authority;
mod enrolled;
mod rotated;
mod tokens;
mod world;
