//! Of the ready tasks with one coalesce key the newest stays.

use super::*;
use crate::reason::Code;
use crate::task::Phase;
use crate::task::state::OPERATOR_HOLD;

impl Rig {
    fn keyed(&mut self, id: &str, change: impl FnOnce(&mut RawTask)) {
        self.submit(id, |raw| {
            raw.coalesce_key = "empty the bin".into();
            change(raw);
        });
    }

    /// A cycle, and the tasks that it ends, each with why and the task that is named.
    fn replace(&mut self) -> Vec<(String, Code, String)> {
        let items = self.cycle(Pace::Wake).items;
        let bodies = items.iter().flat_map(|item| &item.rows).filter_map(|row| match &row.write {
            Write::Put { body, .. } if row.key.table == crate::rows::Table::TaskState => Some(body),
            _ => None,
        });
        let tasks = bodies.map(|body| serde_json::from_str::<TaskState>(body).expect("a row of ours"));
        let ended = tasks.filter(|task| task.phase == Phase::Canceled).map(|task| {
            let reason = task.reason.expect("a reason");
            (task.task_id.to_string(), reason.code, reason.metadata["task_id"].clone())
        });
        ended.collect()
    }
}

fn ended(older: &str, newest: &str) -> (String, Code, String) {
    (older.to_owned(), Code::Coalesced, newest.to_owned())
}

#[test]
fn a_newer_task_replaces_those_that_no_robot_has_and_stands_where_the_first_stood() {
    let mut rig = Rig::new();
    rig.keyed("first", |_| {});
    rig.pass(1_000);
    rig.submit("other", |_| {});
    rig.pass(1_000);
    rig.keyed("second", |_| {});
    assert_eq!(rig.replace(), [ended("first", "second")]);
    rig.pass(1_000);
    rig.keyed("third", |_| {});
    rig.keyed("fourth", |_| {});
    assert_eq!(rig.replace(), [ended("second", "fourth"), ended("third", "fourth")]);
    assert_eq!(rig.order(), ["fourth", "other"], "what the first had waited for counts");
    rig.robot("r1", "park-a");
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["fourth"]);
}

#[test]
fn another_key_and_none_replace_nothing() {
    let mut rig = Rig::new();
    rig.keyed("first", |_| {});
    rig.submit("other", |raw| raw.coalesce_key = "fill the bin".into());
    rig.submit("plain", |_| {});
    rig.submit("as-plain", |_| {});
    assert_eq!(rig.replace(), []);
    assert_eq!(rig.order(), ["first", "other", "plain", "as-plain"]);
}

#[test]
fn a_task_that_a_robot_has_stays_until_it_is_given_back() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.keyed("first", |_| {});
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["first"]);
    rig.keyed("second", |_| {});
    rig.cycle(Pace::Wake);
    assert_eq!((rig.task("first").phase, rig.order()), (Phase::Assigned, vec!["second".to_owned()]));
    let mut back = rig.task("first").clone();
    back.phase = Phase::Queued;
    rig.change(&back);
    assert_eq!(rig.replace(), [ended("first", "second")]);
}

#[test]
fn what_a_person_holds_and_what_is_opened_stay() {
    let mut rig = Rig::new();
    rig.keyed("held", |_| {});
    let mut held = rig.task("held").clone();
    held.holds.insert(OPERATOR_HOLD.to_owned());
    rig.change(&held);
    rig.keyed("opened", |_| {});
    let mut opened = rig.task("opened").clone();
    opened.opened_robot_id = RobotId::parse("r1").ok();
    rig.change(&opened);
    rig.keyed("newest", |_| {});
    assert_eq!(rig.replace(), []);
}

#[test]
fn what_any_other_task_waits_for_stays() {
    let mut rig = Rig::new();
    rig.keyed("needed", |_| {});
    rig.submit("after", |raw| raw.depends_on = vec!["needed".into()]);
    rig.keyed("middle", |_| {});
    rig.keyed("newest", |_| {});
    assert_eq!(rig.replace(), [ended("middle", "newest")]);
}

#[test]
fn a_task_whose_time_has_not_come_replaces_none_and_is_replaced_by_none() {
    let mut rig = Rig::new();
    let at = |ms| move |raw: &mut RawTask| raw.not_before = Some(BEGIN.plus_ms(ms));
    rig.keyed("first", at(60_000));
    rig.pass(30_000);
    rig.keyed("second", at(90_000));
    assert_eq!(rig.replace(), [], "else a request each half minute would never come to its time");
    rig.pass(30_000);
    assert_eq!((rig.replace(), rig.order()), (vec![], vec!["first".to_owned()]));
    rig.pass(30_000);
    assert_eq!(rig.replace(), [ended("first", "second")]);
    assert_eq!(rig.order(), ["second"]);
}

#[test]
fn a_task_that_goes_to_other_areas_is_another_one() {
    let mut rig = Rig::on(crate::site::DEMO);
    let goes = |waypoint: &'static str| {
        move |raw: &mut RawTask| {
            let goto = crate::task::raw::RawStepKind::Goto(waypoint.into());
            raw.steps = vec![crate::task::raw::RawStep { kind: Some(goto), ..Default::default() }];
        }
    };
    for (id, to) in [("hall", "A01"), ("packing", "P01"), ("hall-too", "B03")] {
        rig.keyed(id, goes(to));
    }
    assert_eq!(rig.replace(), [ended("hall", "hall-too")], "whoever sends to one area ends nothing in another");
}
