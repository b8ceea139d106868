//! Naive rules of the link, for twins of tests. Only with the feature `seeded-bugs`.

midshift_core::seeded_bugs! {
    /// Events are acknowledged when they arrive, before their commit.
    AckBeforeCommit ack_before_commit;
    /// Every session of a robot has work, whether or not it proved its succession.
    NoCloneFence no_clone_fence;
    /// Events are taken whichever came before them: what was lost on the way is never missed.
    HolesAreTaken holes_are_taken;
    /// STATUS is acknowledged when it arrives, before it is written.
    StatusAckBeforeWrite status_ack_before_write;
}
