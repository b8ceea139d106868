//! Stands still for a reason, and goes on once it is gone.
//!
//! Invariant: permissions of before a pause are not given any more; drains that wait are taken back in the item that
//! pauses.

use crate::fleet::Board;
use crate::reason::{Code, Reason};
use crate::rollout::decision::plan::{Tx, incident};
use crate::rollout::judgement::{infrastructure, refusals, verdict};
use crate::rollout::projection::rows::{Pause, Rollout};
use crate::rollout::robots::due::{is_gone, is_keyless};
use crate::rollout::robots::moves;
use std::collections::BTreeSet;

/// Sets and lifts the pauses that nobody has to ask for. A bundle that a later release lists again may go on.
pub(super) fn update_pauses(tx: &mut Tx, board: &Board, rollout: &Rollout) {
    let asked = rollout.pauses.contains(&Pause::Operator).then_some(Pause::Operator);
    let gone = is_gone(tx.view, rollout).then_some(Pause::Revoked);
    let network = infrastructure::find_pause(tx.view, board, &tx.now, rollout);
    let keyless = is_keyless(tx.view, rollout).then_some(Pause::Keyless);
    let content = refusals::find_pause(tx.view, rollout);
    let pauses: BTreeSet<Pause> = asked.into_iter().chain(gone).chain(network).chain(keyless).chain(content).collect();
    if pauses != rollout.pauses {
        if content.is_some() && !rollout.pauses.contains(&Pause::Content) {
            tell_refusals(tx, rollout);
        }
        set_pauses(tx, rollout.clone(), pauses, "rollout.pauses_changed");
    }
}

/// Names robots that refused the content of a roll-out.
fn tell_refusals(tx: &mut Tx, rollout: &Rollout) {
    let robots: Vec<&str> =
        refusals::refused_content(tx.view, rollout).map(|r| r.robot_id.as_str()).take(verdict::NAMED_MAX).collect();
    let told = Reason::from(Code::ContentRefused).with("rollout_id", &rollout.rollout_id);
    let told = told.with("robot_ids", robots.join(" "));
    incident(tx, None, &told);
}

/// Stands still for these reasons, or goes on if there is none. Permissions of before are not given any more.
pub fn set_pauses(tx: &mut Tx, mut rollout: Rollout, pauses: BTreeSet<Pause>, kind: &'static str) {
    let served = tx.view.served_ms(&tx.now);
    let runs = pauses.is_empty();
    for countdown in [&mut rollout.soak, &mut rollout.exposure] {
        *countdown = countdown.map(|c| c.set_running(served, runs));
    }
    rollout.generation += 1;
    rollout.version += 1;
    rollout.pauses = pauses;
    rollout.resumed = runs.then_some(tx.now.utc).or(rollout.resumed);
    let id = rollout.rollout_id.clone();
    tx.put_row(rollout, kind);
    if !runs && !tx.view.bugs.pause_is_forgotten() {
        moves::take_back_asked(tx, &id);
    }
}

/// Its bundle is taken back: it stands still in the same item.
pub fn revoke(tx: &mut Tx, rollout: Rollout) {
    if rollout.phase.runs() {
        let mut pauses = rollout.pauses.clone();
        if pauses.insert(Pause::Revoked) {
            set_pauses(tx, rollout, pauses, "rollout.pauses_changed");
        }
    } else {
        moves::take_back_asked(tx, &rollout.rollout_id);
    }
}
