//! Identity over a store in memory and real files: the site's authority, enrolment, tokens, and what goes after its time.

mod certificate_authority;
mod enrolled;
mod retained;
mod rotated;
mod taken_back;
mod tokens;
mod world;
