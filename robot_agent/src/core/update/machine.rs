//! The updater's table: in which state which condition is asked, in which order, and which step follows the first that
//! holds.
//!
//! Invariant: nothing else decides the next step of an update. Level-triggered: a step may be decided at any moment and
//! any number of times. The table is pure; `conditions` answers what it asks, and `steps` does what it says.

use midshift_core::update::UpdateState;

/// What may be asked before the next step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Condition {
    /// What the repository lists is not known since the start.
    Unlisted,
    /// The update names no set.
    NoSet,
    /// The server wants the update no more, before it ran.
    Unwanted,
    /// Content of the set is not there.
    ContentMissing,
    /// A newer directive has come.
    NewerOrder,
    /// The newest section does not ask for activation in a drain.
    NotToActivate,
    /// Something keeps the robot from changing its software now.
    ActivationBlocked,
    /// The grant came too late.
    GrantStale,
    /// A grant that was not used is there.
    Granted,
    /// The switch record names the set as the one that runs.
    SetRuns,
    /// What let the switch begin does not hold any more.
    SwitchBlocked,
    /// The maker's own test failed at the start of the agent.
    SelfTestFailed,
    /// The server wants the set that runs gone.
    WantedBack,
    /// The server was not reached for long.
    ServerLost,
    /// The probation lasts.
    ProbationRuns,
    /// The server did not answer lately.
    ServerNotHeard,
    /// The server says that the set is kept for good.
    CommitWanted,
    /// The switch record has the set on trial.
    OnTrialInRecord,
    /// The switch record has another set.
    RecordNamesAnother,
    /// The kept set runs by a record that this process wrote.
    WentBack,
    /// The kept set runs and fails its maker's test.
    KeptSetUnfit,
    /// The kept set runs.
    KeptSetRuns,
    /// The robot moves, or works and may go on with that.
    Busy,
    /// No set is kept to go back to.
    NothingKept,
    /// The kept set is none that was signed and committed.
    KeptSetUnproven,
    /// The committed set is wanted gone, and the switch record keeps none before it.
    WayBackClosed,
    /// Nothing before it in the table holds.
    Otherwise,
}

/// What is done next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Nothing: something else must happen first.
    Wait,
    /// Asks the repository again what it lists.
    RefreshAgain,
    /// Fetches the manifest.
    FetchManifest,
    /// Fetches the next content that is missing.
    FetchContent,
    /// Makes the set of its content.
    StageSet,
    /// Refuses the update.
    Refuse,
    /// Looks at the newer directive, which replaces what has not run.
    TakeNewerOrder,
    /// Reports what blocks the activation.
    ReportBlock,
    /// Leaves the grant, and asks for another.
    LeaveGrant,
    /// Asks for a grant.
    AskForGrant,
    /// Uses the grant.
    BeginSwitch,
    /// Ends the process: the launcher starts the set that the switch record names.
    EndProcess,
    /// Takes the switch back before it was written.
    TakeSwitchBack,
    /// Writes the switch record with the set on trial.
    WriteTrial,
    /// Begins to go back to the kept set.
    GoBack,
    /// Waits for the end of the probation.
    AwaitProbation,
    /// Waits for an answer of the server.
    AwaitServer,
    /// The probation is over: the robot works with the set.
    BeginTrial,
    /// Has the switch record say that the set came through its probation.
    Prove,
    /// Begins to commit the set.
    BeginCommit,
    /// Writes the switch record with the set as the committed one.
    WriteCommit,
    /// The set was put away before it was committed.
    NotePutAway,
    /// The set is committed: floors rise, and migrations become due.
    Commit,
    /// The kept set runs again.
    EndRollBack,
    /// The kept set cannot be gone back to.
    GetStuck,
    /// Reads the kept set before it is gone back to.
    VerifyKeptSet,
    /// Tells the server that there is no way back.
    RefuseWayBack,
    /// Nothing is on its way: looks for a directive, then tidies up.
    Settle,
}

/// Conditions of a state in the order in which they are asked, each with the step that follows the first that holds.
const fn rules(state: UpdateState) -> &'static [(Condition, Step)] {
    use Condition as If;
    match state {
        UpdateState::Directed => &[(If::Unlisted, Step::RefreshAgain), (If::Otherwise, Step::FetchManifest)],
        UpdateState::Downloading => &[
            (If::NoSet, Step::Refuse),
            (If::Unwanted, Step::Refuse),
            (If::ContentMissing, Step::FetchContent),
            (If::Otherwise, Step::StageSet),
        ],
        UpdateState::Staged => &[
            (If::Unwanted, Step::Refuse),
            (If::NewerOrder, Step::TakeNewerOrder),
            (If::NotToActivate, Step::Wait),
            (If::ActivationBlocked, Step::ReportBlock),
            (If::GrantStale, Step::LeaveGrant),
            (If::Granted, Step::BeginSwitch),
            (If::Otherwise, Step::AskForGrant),
        ],
        UpdateState::Switching => &[
            (If::NoSet, Step::Wait),
            (If::SetRuns, Step::EndProcess),
            (If::SwitchBlocked, Step::TakeSwitchBack),
            (If::Otherwise, Step::WriteTrial),
        ],
        UpdateState::Probation => &[
            (If::SelfTestFailed, Step::GoBack),
            (If::WantedBack, Step::GoBack),
            (If::ServerLost, Step::GoBack),
            (If::ProbationRuns, Step::AwaitProbation),
            (If::ServerNotHeard, Step::AwaitServer),
            (If::Otherwise, Step::BeginTrial),
        ],
        UpdateState::Trial => {
            &[(If::WantedBack, Step::GoBack), (If::CommitWanted, Step::BeginCommit), (If::Otherwise, Step::Prove)]
        }
        UpdateState::Committing => &[
            (If::OnTrialInRecord, Step::WriteCommit),
            (If::RecordNamesAnother, Step::NotePutAway),
            (If::Otherwise, Step::Commit),
        ],
        UpdateState::RollingBack => &[
            (If::NoSet, Step::Wait),
            (If::WentBack, Step::EndProcess),
            (If::KeptSetUnfit, Step::GetStuck),
            (If::KeptSetRuns, Step::EndRollBack),
            (If::Busy, Step::Wait),
            (If::NothingKept, Step::GetStuck),
            (If::KeptSetUnproven, Step::GetStuck),
            (If::Otherwise, Step::VerifyKeptSet),
        ],
        UpdateState::Committed => {
            &[(If::WayBackClosed, Step::RefuseWayBack), (If::WantedBack, Step::GoBack), (If::Otherwise, Step::Settle)]
        }
        UpdateState::RolledBack | UpdateState::Refused | UpdateState::Stuck => &[(If::Otherwise, Step::Settle)],
    }
}

/// The first condition of a state that holds, and the step that follows. `holds` is asked in the order of the table,
/// and no further.
pub(super) fn decide(state: UpdateState, holds: impl Fn(Condition) -> bool) -> (Condition, Step) {
    let mut asked = rules(state).iter().copied();
    let first = asked.find(|(condition, _)| *condition == Condition::Otherwise || holds(*condition));
    first.unwrap_or((Condition::Otherwise, Step::Wait))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every condition that is asked in some state.
    fn conditions() -> Vec<Condition> {
        let mut all: Vec<Condition> = Vec::new();
        for (condition, _) in UpdateState::ALL.into_iter().flat_map(rules) {
            if !all.contains(condition) {
                all.push(*condition);
            }
        }
        all
    }

    /// State that a step leads to at once; none: it stays, or a job decides.
    const fn leads_to(step: Step) -> Option<UpdateState> {
        match step {
            Step::Refuse => Some(UpdateState::Refused),
            Step::BeginSwitch => Some(UpdateState::Switching),
            Step::TakeSwitchBack => Some(UpdateState::Staged),
            Step::GoBack => Some(UpdateState::RollingBack),
            Step::BeginTrial => Some(UpdateState::Trial),
            Step::BeginCommit => Some(UpdateState::Committing),
            Step::NotePutAway | Step::EndRollBack => Some(UpdateState::RolledBack),
            Step::Commit => Some(UpdateState::Committed),
            Step::GetStuck => Some(UpdateState::Stuck),
            _ => None,
        }
    }

    #[test]
    fn each_state_ends_with_what_holds_otherwise_and_asks_nothing_twice() {
        for state in UpdateState::ALL {
            let asked: Vec<Condition> = rules(state).iter().map(|(condition, _)| *condition).collect();
            assert_eq!(asked.last(), Some(&Condition::Otherwise), "{state:?}");
            for (at, condition) in asked.iter().enumerate() {
                assert!(!asked[..at].contains(condition), "{state:?} asks {condition:?} twice");
            }
        }
    }

    #[test]
    fn each_pair_of_state_and_condition_is_decided() {
        let (mut asked, mut passed_over) = (0, 0);
        for state in UpdateState::ALL {
            for condition in conditions() {
                let (first, step) = decide(state, |other| other == condition);
                match rules(state).iter().find(|(other, _)| *other == condition) {
                    Some(rule) => {
                        assert_eq!((first, step), *rule, "{state:?} {condition:?}");
                        asked += 1;
                    }
                    None => {
                        assert_eq!(first, Condition::Otherwise, "{state:?} passes {condition:?} over");
                        passed_over += 1;
                    }
                }
            }
        }
        assert_eq!((asked, asked + passed_over), (43, 12 * 27), "a rule came or went: say here that it was meant");
    }

    #[test]
    fn each_step_leads_where_an_update_may_go() {
        for state in UpdateState::ALL {
            for (condition, step) in rules(state) {
                let is_legal = leads_to(*step).is_none_or(|to| state.transitions().contains(&to));
                assert!(is_legal, "{state:?} {condition:?} {step:?}");
            }
        }
    }

    #[test]
    fn of_conditions_that_hold_together_the_first_counts() {
        let all = |state| decide(state, |_| true).1;
        assert_eq!(all(UpdateState::Staged), Step::Refuse);
        assert_eq!(all(UpdateState::Probation), Step::GoBack);
        assert_eq!(all(UpdateState::RollingBack), Step::Wait);
    }
}
