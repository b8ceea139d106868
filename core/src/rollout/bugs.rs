//! Naive rules of roll-outs, for twins of tests. Only with the feature `seeded-bugs`.

crate::seeded_bugs! {
    /// A drain is released when its permission has had its time, whatever the robot's ledger says.
    TimeReleasesDrain time_releases_drain;
    /// A robot that waits in another drain is given permission too.
    AnyDrainWillDo any_drain_will_do;
    /// A roll-out that is paused or aborted goes on with the drains that it asked for, and giving permissions.
    PauseIsForgotten pause_is_forgotten;
    /// Robots are taken out of work for a roll-out however many are.
    InFlightIsForgotten in_flight_is_forgotten;
    /// Every process plans, whoever leads: two that decide the same conflict for ever.
    EverybodyLeads everybody_leads;
}
