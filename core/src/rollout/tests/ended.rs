//! What the projection holds of roll-outs that have ended.

use super::*;
use crate::rollout::projection::ended;
use crate::rows::RowSelection;

/// Rows of a roll-out, as whoever asks for it reads them.
fn read(rig: &Rig, id: &str) -> Vec<Row> {
    let of = |row: &&Row| match row.key.table {
        Table::Rollout => &*row.key.id == id,
        Table::RolloutRobot => row.key.id.split('/').next() == Some(id),
        _ => false,
    };
    rig.rows.values().filter(of).cloned().collect()
}

fn wanted(rig: &Rig) -> Vec<RolloutId> {
    rig.ota.wanted().into_iter().collect()
}

/// A roll-out of which nothing is left to do, and a projection that has let go of it.
fn let_go() -> Rig {
    let mut rig = Rig::new(4);
    // The rows hold more than the projection does.
    rig.checks_rebuild = false;
    rig.start(spec());
    rig.must("ro", Verb::Abort);
    rig.until(100, |r| r.phase() == Phase::Aborted);
    rig.ticks(4);
    rig.ota_turn();
    assert_eq!((rig.ota.rollouts.len(), rig.ota.robots.len()), (1, 4));
    rig.ota.let_go();
    rig
}

#[test]
fn a_roll_out_that_has_ended_is_let_go_of_with_all_its_robots_and_nobody_asks_for_it() {
    let rig = let_go();
    assert!(rig.ota.rollouts.is_empty() && rig.ota.robots.is_empty() && rig.ota.wave_sizes.is_empty());
    assert!(wanted(&rig).is_empty());
}

#[test]
fn one_that_the_feed_speaks_of_is_not_taken_in_part_and_comes_back_whole() {
    let mut rig = let_go();
    let tried_again = RolloutRobot { step: Step::Waiting, again: true, ..rig.robot_in("ro", 2) };
    rig.put_row(tried_again);
    let entries = rig.feed[rig.ota_at..].to_vec();
    rig.ota_at = rig.feed.len();
    absorb(&mut rig.ota, rig.now, &entries, &mut Plan::default());
    assert!(rig.ota.robots.is_empty(), "one robot of four");
    assert_eq!(wanted(&rig), [rollout_id("ro")]);
    let rows = read(&rig, "ro");
    rig.ota.absorb_past(rig.ota.wanted(), &rows).expect("rows read");
    assert_eq!((rig.ota.rollouts.len(), rig.ota.robots.len(), rig.ota.open.len()), (1, 4, 1));
    rig.ota.let_go();
    assert_eq!(rig.ota.robots.len(), 4, "something is due for one of them");
}

#[test]
fn one_that_newcomers_get_and_one_that_another_takes_back_stay() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    rig.ota_turn();
    rig.ota.let_go();
    assert_eq!(rig.ota.robots.len(), 4, "newcomers get it");
    rig.ask(&Command::Rollback { of: rollout_id("ro"), rollout_id: rollout_id("back") }).expect("it is allowed");
    rig.ota.area_bundles.clear();
    rig.ota.let_go();
    assert_eq!(rig.ota.rollouts.keys().collect::<Vec<_>>(), ["back", "ro"], "another takes it back");
    rig.ota.rollouts.remove("back");
    rig.ota.let_go();
    assert!(rig.ota.rollouts.is_empty());
}

#[test]
fn one_that_is_named_and_is_not_there_is_asked_for_once() {
    let mut rig = let_go();
    let rollouts = BTreeMap::from([("m1".to_owned(), rollout_id("gone"))]);
    rig.put_row(AreaBundle { area_id: AreaId::parse("quality").expect("an id"), rollouts });
    rig.ota_turn();
    assert_eq!(wanted(&rig), [rollout_id("gone")]);
    rig.ota.absorb_past(rig.ota.wanted(), &[]).expect("nothing to read");
    assert!(wanted(&rig).is_empty());
}

#[test]
fn a_reading_begins_with_what_is_alive_and_names_the_rest() {
    let rig = let_go();
    let rows: Vec<Row> = rig.rows.values().cloned().collect();
    assert!(ended::named(&rows).is_empty(), "of what ended nothing");
    let parts = ended::alive();
    assert!(parts.iter().all(|part| !matches!(part, RowSelection::Whole(Table::Rollout | Table::RolloutRobot))));
    let mut open = rig.robot_in("ro", 1);
    open.step = Step::Stuck;
    let row = Row { key: open.key(), revision: Revision(1), index: open.index(), body: open.body() };
    assert_eq!(ended::named(&[row]), [Key::new(Table::Rollout, "ro")]);
}
