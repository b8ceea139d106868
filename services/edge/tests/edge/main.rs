//! The edge under peers that mean no good and under operators that change their mind: real sockets, raw frames, real services of tonic.
//!
//! Each test fails without the mechanism that it is about. Times are made tiny in `Config` and then waited for as conditions; nothing is
//! asserted about how long anything took.

mod asking;
mod crowds;
mod frame_floods;
mod frames;
mod hostile;
mod leaving;
mod login;
mod principals;
mod proofs;
mod readings;
mod services;
mod unauthenticated;
mod world;
