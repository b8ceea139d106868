//! Naive rules of what is believed of bundles, for twins of tests. Only with the feature `seeded-bugs`.

midshift_core::seeded_bugs! {
    /// A directive is taken whoever signed it.
    StrangersSign strangers_sign;
    /// A directive is taken by whichever robot it reaches.
    AnyRobotWillDo any_robot_will_do;
    /// A directive is taken however old it is.
    DirectivesLiveForEver directives_live_for_ever;
    /// A directive is read however long it is.
    LengthIsForgotten length_is_forgotten;
    /// What a repository says is believed however old it is.
    RepositoriesLiveForEver repositories_live_for_ever;
    /// A component fits a robot however far it goes back.
    FloorIsForgotten floor_is_forgotten;
}
