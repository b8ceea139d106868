//! What one check of the doctor has found.

/// Milliseconds of a day.
pub const DAY_MS: u64 = 24 * 3_600_000;

/// What one check has found.
#[derive(Debug)]
pub struct Finding {
    /// Which check.
    pub what: &'static str,
    /// Nothing is wrong.
    pub good: bool,
    /// What is so, and what to try.
    pub text: String,
}

impl Finding {
    /// Nothing is wrong.
    pub fn good(what: &'static str, text: impl Into<String>) -> Self {
        Self { what, good: true, text: text.into() }
    }
    /// A person should look into it.
    pub fn wants_look(what: &'static str, text: impl Into<String>) -> Self {
        Self { what, good: false, text: text.into() }
    }
}
