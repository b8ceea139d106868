//! Who is who: the certificate authority of a site, enrolment of robots, tokens of people and programs, and the audit.
//!
//! Invariant: no secret leaves this crate but once, in the answer to whoever it was made for; what is stored of it is a digest.

pub mod audit;
