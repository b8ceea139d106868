//! Naive rules of fleet, for twins of tests. Only with the feature `seeded-bugs`.

crate::seeded_bugs! {
    /// A robot that is not heard for a moment loses its task to another, and nobody waits after a start.
    SilenceFreesTask silence_frees_task;
    /// Places of a robot that is not heard are given on.
    TimeoutFreesPlace timeout_frees_place;
    /// What a heartbeat does not list is gone, whatever events are still on their way.
    HeartbeatOvertakesEvents heartbeat_overtakes_events;
    /// Robots leave their work for a roll-out however many of the area have left it.
    BudgetIsForgotten budget_is_forgotten;
    /// Every process plans, whoever leads: two that decide the same conflict for ever.
    EverybodyLeads everybody_leads;
    /// What a robot says of an attempt counts for its task, whoever has been given the task since.
    LateReportsCount late_reports_count;
    /// A state of an attempt that this build does not know moves its task forward like any other.
    UnknownStatesAreTaken unknown_states_are_taken;
    /// A place takes everybody who asks for it.
    CapacityIsForgotten capacity_is_forgotten;
    /// Of the places of a stretch each is granted as soon as it is free, and kept until the others are.
    GrantsOneByOne grants_one_by_one;
    /// No task is promoted, however long it waits.
    NobodyIsPromoted nobody_is_promoted;
    /// Nobody is told of a report that cannot be.
    DoubtIsKeptQuiet doubt_is_kept_quiet;
    /// What a robot works on is no reason.
    StepsAreNotTold steps_are_not_told;
    /// A robot that stands where nobody sent it is blamed for it, with a grant or without.
    ClaimsAreBlamed claims_are_blamed;
    /// Whatever stops a robot says hold it are one decision.
    HoldsComeAtOnce holds_come_at_once;
    /// Each word of a robot that people are told of opens an incident of its own.
    EachWordIsTold each_word_is_told;
    /// A robot that says that its work is done was where that is done.
    SuccessIsBelieved success_is_believed;
    /// After a report that counts for nothing everything is read anew.
    FencedReportsRebuild fenced_reports_rebuild;
}
