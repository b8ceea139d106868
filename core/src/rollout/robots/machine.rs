//! The table of a robot in a roll-out: from which steps a move may be made, and to which it leads.
//!
//! [`super::due`] finds the move, [`super::moves`] writes what follows of it. Invariant: nothing else changes the step
//! of a robot that has a row; what a person has tried again gets a new one.

use crate::reason::Reason;
use crate::rollout::projection::rows::Step;

/// What is due for a robot, or what happened to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Move {
    /// It is told to fetch the bundle.
    Stage,
    /// It was told so long ago that its directive must be signed anew.
    SignAnew,
    /// It has the bundle, or needs none.
    IsStaged,
    /// It is left out, or tried no more.
    Skip(Reason),
    /// It did not take the directive.
    Refused(Reason),
    /// It is tried once more.
    Again,
    /// It was skipped, and keeps the bundle for nothing.
    Forget,
    /// Fleet is asked to take it out of work.
    AskDrain,
    /// Its drain holds it: it may ask for permission.
    Held,
    /// It gets permission.
    Grant,
    /// Its permission was not used and can be used no more.
    NotUsed,
    /// Its drain was given up before it could do anything.
    LeaveDrain,
    /// It was heard with the bundle.
    Switched,
    /// It works with the bundle.
    OnTrial,
    /// It counts against the bundle.
    Fail(Reason),
    /// It was not lost.
    Found,
    /// It is to keep the bundle.
    Commit,
    /// It keeps the bundle.
    Committed,
    /// It is to go back, and first out of work.
    Revert,
    /// It stands where it may go back.
    GoBack,
    /// It did not take the order to go back, or has not for so long that it must be signed anew.
    OrderBackAnew,
    /// It runs what it ran before.
    RolledBack(Reason),
    /// Somebody set it up anew, without the bundle: nothing is left to go back from.
    SetUpAnew,
    /// It could not go back.
    Stuck(Reason),
    /// A person mended what kept it from going back.
    Unstick,
    /// It is out of work and not heard for longer than the roll-out bears.
    Lost,
    /// It was lost, and is heard.
    Heard,
}

/// Steps of robots whose part is not over.
const UNFINISHED: [Step; 9] = [
    Step::Waiting,
    Step::Staging,
    Step::Staged,
    Step::Draining,
    Step::Activating,
    Step::Trial,
    Step::Committing,
    Step::Reverting,
    Step::Stuck,
];

/// The table: where a move leads from a step. `None`: there is no such move there, and nothing is written.
pub fn next(at: Step, by: &Move) -> Option<Step> {
    let (may_come_from, to): (&[Step], Step) = match by {
        // The way to the bundle.
        Move::Stage => (&[Step::Waiting, Step::Staging], Step::Staging),
        Move::SignAnew => (&[Step::Staging], Step::Staging),
        Move::IsStaged => (&[Step::Waiting, Step::Staging], Step::Staged),
        Move::AskDrain => (&[Step::Staged], Step::Draining),
        Move::Held => (&[Step::Draining], Step::Activating),
        Move::Grant | Move::NotUsed | Move::Switched => (&[Step::Activating], Step::Activating),
        Move::OnTrial => (&[Step::Activating], Step::Trial),
        Move::Commit => (&[Step::Trial], Step::Committing),
        Move::Committed => (&[Step::Committing], Step::Committed),
        // What counts for and against the bundle.
        Move::Fail(_) | Move::Found => (&[Step::Activating, Step::Trial], at),
        // Out of the way.
        Move::Refused(_) => (&[Step::Staging, Step::Staged], Step::Skipped),
        Move::Skip(_) => (&UNFINISHED, Step::Skipped),
        Move::Forget => (&[Step::Skipped], Step::Skipped),
        Move::Again => (&[Step::Skipped], Step::Waiting),
        Move::LeaveDrain if at == Step::Reverting => (&[Step::Reverting], Step::Reverting),
        Move::LeaveDrain => (&[Step::Draining, Step::Activating], Step::Staged),
        // The way back.
        Move::Revert => {
            let from = &[Step::Activating, Step::Trial, Step::Committing, Step::Reverting, Step::Committed];
            (from, Step::Reverting)
        }
        Move::GoBack => (&[Step::Activating, Step::Reverting], Step::Reverting),
        Move::OrderBackAnew => (&[Step::Reverting], Step::Reverting),
        Move::RolledBack(_) => {
            let from = &[Step::Activating, Step::Trial, Step::Committing, Step::Reverting, Step::Stuck];
            (from, Step::RolledBack)
        }
        Move::SetUpAnew => (&[Step::Reverting], Step::RolledBack),
        Move::Stuck(_) => (&[Step::Activating, Step::Trial, Step::Committing, Step::Reverting], Step::Stuck),
        Move::Unstick => (&[Step::Stuck], Step::Reverting),
        // Whether it is heard is another matter than how far it is.
        Move::Lost | Move::Heard => (&Step::ALL, at),
    };
    may_come_from.contains(&at).then_some(to)
}

#[cfg(test)]
mod tests {
    use super::{Move, next};
    use crate::reason::Code;
    use crate::rollout::projection::rows::Step;

    /// Where each move leads from each step, by the first letters of its name; `.`: the move does not exist there.
    const MATRIX: [(&str, &str); 27] = [
        //                Waiti Stagi Stage Drain Activ Trial Commi Rever Kept  Rolle Skipp Stuck
        ("Stage", "        Stagi Stagi .     .     .     .     .     .     .     .     .     .    "),
        ("SignAnew", "     .     Stagi .     .     .     .     .     .     .     .     .     .    "),
        ("IsStaged", "     Stage Stage .     .     .     .     .     .     .     .     .     .    "),
        ("Skip", "         Skipp Skipp Skipp Skipp Skipp Skipp Skipp Skipp .     .     .     Skipp"),
        ("Refused", "      .     Skipp Skipp .     .     .     .     .     .     .     .     .    "),
        ("Again", "        .     .     .     .     .     .     .     .     .     .     Waiti .    "),
        ("Forget", "       .     .     .     .     .     .     .     .     .     .     Skipp .    "),
        ("AskDrain", "     .     .     Drain .     .     .     .     .     .     .     .     .    "),
        ("Held", "         .     .     .     Activ .     .     .     .     .     .     .     .    "),
        ("Grant", "        .     .     .     .     Activ .     .     .     .     .     .     .    "),
        ("NotUsed", "      .     .     .     .     Activ .     .     .     .     .     .     .    "),
        ("LeaveDrain", "   .     .     .     Stage Stage .     .     Rever .     .     .     .    "),
        ("Switched", "     .     .     .     .     Activ .     .     .     .     .     .     .    "),
        ("OnTrial", "      .     .     .     .     Trial .     .     .     .     .     .     .    "),
        ("Fail", "         .     .     .     .     Activ Trial .     .     .     .     .     .    "),
        ("Found", "        .     .     .     .     Activ Trial .     .     .     .     .     .    "),
        ("Commit", "       .     .     .     .     .     Commi .     .     .     .     .     .    "),
        ("Committed", "    .     .     .     .     .     .     Kept  .     .     .     .     .    "),
        ("Revert", "       .     .     .     .     Rever Rever Rever Rever Rever .     .     .    "),
        ("GoBack", "       .     .     .     .     Rever .     .     Rever .     .     .     .    "),
        ("OrderBackAnew", ".     .     .     .     .     .     .     Rever .     .     .     .    "),
        ("RolledBack", "   .     .     .     .     Rolle Rolle Rolle Rolle .     .     .     Rolle"),
        ("SetUpAnew", "    .     .     .     .     .     .     .     Rolle .     .     .     .    "),
        ("Stuck", "        .     .     .     .     Stuck Stuck Stuck Stuck .     .     .     .    "),
        ("Unstick", "      .     .     .     .     .     .     .     .     .     .     .     Rever"),
        ("Lost", "         Waiti Stagi Stage Drain Activ Trial Commi Rever Kept  Rolle Skipp Stuck"),
        ("Heard", "        Waiti Stagi Stage Drain Activ Trial Commi Rever Kept  Rolle Skipp Stuck"),
    ];

    /// One of each kind, in the order in which they are declared.
    fn moves() -> Vec<Move> {
        let why = || Code::RevertAsked.into();
        vec![
            Move::Stage,
            Move::SignAnew,
            Move::IsStaged,
            Move::Skip(why()),
            Move::Refused(why()),
            Move::Again,
            Move::Forget,
            Move::AskDrain,
            Move::Held,
            Move::Grant,
            Move::NotUsed,
            Move::LeaveDrain,
            Move::Switched,
            Move::OnTrial,
            Move::Fail(why()),
            Move::Found,
            Move::Commit,
            Move::Committed,
            Move::Revert,
            Move::GoBack,
            Move::OrderBackAnew,
            Move::RolledBack(why()),
            Move::SetUpAnew,
            Move::Stuck(why()),
            Move::Unstick,
            Move::Lost,
            Move::Heard,
        ]
    }

    fn short(step: Step) -> String {
        let name = if step == Step::Committed { "Kept".to_owned() } else { format!("{step:?}") };
        name.chars().take(5).collect()
    }

    #[test]
    fn each_move_is_decided_at_each_step() {
        let moves = moves();
        assert_eq!(moves.len(), MATRIX.len());
        for (by, (name, row)) in moves.iter().zip(MATRIX) {
            assert!(format!("{by:?}").starts_with(name), "{by:?} stands where {name} should");
            let found: Vec<String> = Step::ALL.map(|at| next(at, by).map_or(".".to_owned(), short)).to_vec();
            assert_eq!(found, row.split_whitespace().collect::<Vec<_>>(), "{name}");
        }
    }

    #[test]
    fn a_robot_whose_part_is_over_is_only_tried_again_or_goes_back() {
        for at in Step::ALL.into_iter().filter(|step| step.is_over()) {
            for by in moves() {
                let leaves = next(at, &by).is_some_and(|to| to != at);
                assert_eq!(leaves, matches!((at, &by), (Step::Skipped, Move::Again) | (Step::Committed, Move::Revert)));
            }
        }
    }
}
