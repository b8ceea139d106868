//! A place, or a seat of it, that is closed because nobody knows what a robot does there.

use super::Rig;
use crate::fleet::rows::{HolderState, Incident, Place, PlaceHolder};
use crate::fleet::traffic::closed_places;
use crate::fleet::{Pace, Plan, incidents};
use crate::ids::{PlaceId, RobotId};
use crate::reason::Code;
use crate::task::AttemptPhase;

/// `r1` was given up with its task while it held `wait-a`, in which there is room for two.
fn silent(state: HolderState) -> Rig {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Sweep);
    let id = rig.task("T1").attempt_id().expect("given").to_string();
    let attempt = &mut rig.view.attempts.get_mut(id.as_str()).expect("a row").row;
    (attempt.phase, attempt.ended) = (AttemptPhase::Lost, Some(rig.now.utc));
    let ix = rig.view.site.find_place(&wait_a()).expect("a place");
    let mut place = Place::unheld(rig.view.site.place(ix));
    let (robot_id, since) = (RobotId::parse("r1").expect("an id"), rig.now.utc);
    place.holders.push(PlaceHolder { robot_id, grant_id: 7, state, since, claimed: false });
    Plan::default().decide(&mut rig.view, rig.now, "fleet", |tx| tx.put_row(place, "place.granted"));
    rig
}

fn wait_a() -> PlaceId {
    PlaceId::parse("wait-a").expect("an id")
}

/// Open incidents of the place after so many seconds.
fn open_after(rig: &mut Rig, secs: u64) -> Vec<Incident> {
    for _ in 0..secs {
        rig.pass(1_000);
        closed_places::keep_incidents(&mut rig.view, rig.now, &mut Plan::default());
    }
    let open = rig.view.incidents.values().map(|i| &i.row).filter(|i| i.closed.is_none());
    open.filter(|i| i.reason.code == Code::PlaceQuarantined).cloned().collect()
}

#[test]
fn a_robot_that_was_only_let_in_closes_its_own_seat_and_one_that_entered_the_whole_place() {
    for (state, is_whole) in
        [(HolderState::Granted, false), (HolderState::Revoking, false), (HolderState::Inside, true)]
    {
        let rig = silent(state);
        let place = &rig.view.places["wait-a"].row;
        assert_eq!(place.is_closed_whole_by(&place.holders[0]), is_whole, "{state:?}");
        let narrow = Place { capacity: 1, ..place.clone() };
        assert!(narrow.is_closed_whole_by(&narrow.holders[0]), "there is no other seat");
    }
}

#[test]
fn a_closed_seat_has_one_incident_with_robot_and_command_that_closes_once_the_place_is_open() {
    let mut rig = silent(HolderState::Granted);
    assert_eq!(open_after(&mut rig, 14), [], "the robot may be about to say where it is");
    let open = open_after(&mut rig, 60);
    assert_eq!(open.len(), 1);
    let reason = &open[0].reason;
    let facts = ["place_id", "robots", "seats"].map(|key| reason.metadata[key].as_str());
    assert_eq!(facts, ["wait-a", "r1", "1"]);
    assert!(reason.message.contains("`midshift zone clear wait-a --reason TEXT --if-match ETAG`"), "{reason:?}");
    let mut place = rig.view.places["wait-a"].row.clone();
    place.holders.clear();
    Plan::default().decide(&mut rig.view, rig.now, "fleet", |tx| tx.put_row(place, "place.left"));
    assert_eq!(open_after(&mut rig, 1), []);
}

#[test]
fn a_place_that_stays_closed_after_a_person_closed_its_incident_is_told_again_after_a_minute() {
    let mut rig = silent(HolderState::Granted);
    let id = open_after(&mut rig, 16)[0].id.clone();
    let now = rig.now;
    Plan::default().decide(&mut rig.view, now, "anna", |tx| incidents::close(tx, &id, "seen", "anna"));
    assert_eq!(open_after(&mut rig, 59), []);
    assert_eq!(open_after(&mut rig, 2).len(), 1);
}
