//! What happened: entries of the feed, and what robots say of their software.

pub mod feed;
pub mod reports;
