//! Naive rules of the intake, for twins of tests. Only with the feature `seeded-bugs`.

crate::seeded_bugs! {
    /// Nobody writes down which request_id a task was admitted by.
    ForgetsRequests forgets_requests;
}
