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
}
