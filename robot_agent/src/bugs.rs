//! Naive rules of the agent, for twins of tests. Only with the feature `seeded-bugs`.

midshift_core::seeded_bugs! {
    /// An offer or a resume is valid from its receipt, whatever heartbeat anchors it.
    AuthorityFromReceipt authority_from_receipt;
    /// A place may be entered for its validity from the receipt of the grant.
    GrantFromReceipt grant_from_receipt;
    /// The ledger refuses no passed epoch and no finished task.
    NoEpochFence no_epoch_fence;
    /// A second attempt is taken while another holds the robot.
    IgnoreHolder ignore_holder;
    /// A session is kept however long the server is silent.
    PatientSession patient_session;
    /// A robot that any drain holds may change its software.
    AnyDrainWillDo any_drain_will_do;
    /// A robot changes its software whatever it does, and stopped or not.
    ActivatesAnyway activates_anyway;
    /// A reset takes away every stop that the robot knows, and not only the one that it names.
    ResetClearsAll reset_clears_all;
    /// A stop that comes while the ledger is being written is left for the next message.
    StopYieldsToDisk stop_yields_to_disk;
    /// A task's speed counts instead of the lower one of its lane and area.
    LastWordIsTheLimit last_word_is_the_limit;
    /// A directive is taken whether or not a release lists its bundle.
    UnlistedIsFine unlisted_is_fine;
    /// A directive is taken whichever came before it.
    ReplaysAreTaken replays_are_taken;
    /// Work that cannot be read is passed over, and the robot goes on as before.
    NewerWorkIsIgnored newer_work_is_ignored;
}
