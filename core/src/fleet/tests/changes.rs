//! People edit, hold and release tasks.

use super::*;
use crate::fleet::projection::rows::{HoldToken, Timer, TimerKind};
use crate::fleet::tasks::transitions::{News, apply_event};
use crate::fleet::{WAITS_FOR, absorb};
use crate::limits;
use crate::reason::Code;
use crate::rows::{Entry, Log, Seq, Table};
use crate::task::spec::Class;
use crate::task::state::OPERATOR_HOLD;
use crate::task::{Ask, Event, Phase, TaskEdit, TaskRequest};

const MINUTE_MS: u64 = 60_000;

fn id(text: &str) -> TaskId {
    TaskId::parse(text).expect("an id")
}

fn priority(priority: u8) -> TaskEdit {
    TaskEdit { priority: Some(priority), ..TaskEdit::default() }
}

fn pin(robot: Option<&str>) -> TaskEdit {
    let robot_id = robot.map(|id| RobotId::parse(id).expect("an id"));
    TaskEdit { robot_id: Some(robot_id), ..TaskEdit::default() }
}

fn not_before(at: Option<Utc>) -> TaskEdit {
    TaskEdit { not_before: Some(at), ..TaskEdit::default() }
}

fn deadline(at: Option<Utc>) -> TaskEdit {
    TaskEdit { deadline: Some(at), ..TaskEdit::default() }
}

fn edit(task: &str, edit: TaskEdit) -> Ask {
    Ask::Edit { task_id: id(task), seen: None, edit }
}

impl Rig {
    /// A request as it comes by the feed. Returns why it was refused, by the answer in the task's row.
    fn ask(&mut self, ask: Ask) -> Option<Code> {
        let seq = Seq(self.view.marks.get("fleet").map_or(0, |mark| mark.row.seq.0) + 1);
        let (reason, actor) = ("the aisle is wet".to_owned(), "anna".to_owned());
        let request = TaskRequest { id: format!("ask-{}", seq.0), ask, reason, actor, at_unix_ms: self.now.wall.0 };
        let entry = Entry {
            seq,
            log: Log::Task,
            table: Some(Table::TaskRequest),
            subject: request.id.as_str().into(),
            revision: Revision(1),
            index: request.index(),
            body: Some(request.body()),
            kind: "task.asked".into(),
            actor: "anna".into(),
            request_id: None,
            at_unix_ms: self.now.wall.0,
        };
        let mut plan = Plan::default();
        absorb(&mut self.view, self.now, &self.board, &[entry], &mut plan);
        assert!(plan.report.unreadable.is_empty(), "{:?}", plan.report);
        let task_id = request.index().parent.and_then(|id| TaskId::parse(&id).ok());
        let task = task_id.and_then(|id| self.view.task(&id))?;
        let answer = task.answer_to(&request.id).expect("each request is answered");
        answer.refusal.as_ref().map(|reason| reason.code)
    }

    fn hold(&mut self, task: &str) -> Option<Code> {
        self.ask(Ask::Hold { task_id: id(task) })
    }

    fn release(&mut self, task: &str) -> Option<Code> {
        self.ask(Ask::Release { task_id: id(task) })
    }

    /// What holds every robot and task after a reset goes.
    fn resume_all(&mut self) {
        let before = self.view.marks.get("fleet").map(|mark| mark.revision);
        self.ask(Ask::ResumeHeld { stop_id: None, area_id: None, task_ids: Vec::new(), robot_ids: Vec::new() });
        assert_ne!(self.view.marks.get("fleet").map(|mark| mark.revision), before, "it was obeyed");
    }

    /// The robot has taken the task that it was offered.
    fn accepts(&mut self, task: &str) {
        let mut plan = Plan::default();
        let task_id = id(task);
        plan.decide(&mut self.view, self.now, "r1", |tx| {
            assert!(apply_event(tx, &task_id, News::from_event(Event::Accepted, None)), "it was offered");
        });
    }

    fn robot_token(&mut self, token: &str) {
        let robot_id = RobotId::parse("r1").expect("an id");
        let mut plan = Plan::default();
        plan.decide(&mut self.view, self.now, "stop", |tx| {
            tx.put_row(HoldToken { robot_id: robot_id.clone(), token: token.to_owned(), since: tx.now.utc }, "tests");
            crate::fleet::facts::holds::holds_changed(tx, &robot_id);
        });
    }

    fn start_to_close(&self, task: &str) -> Timer {
        let attempt = self.task(task).attempt_id().expect("an attempt");
        self.view.timers.get(Timer::id_of(TimerKind::StartToClose, &attempt).as_str()).expect("armed").row.clone()
    }

    /// Another process, which reads the rows as this one has left them.
    fn rebuilt(&self) -> Self {
        fn copy<R: Record>(into: &mut FleetProjection, rows: &crate::fleet::projection::RowMap<R>) {
            for RevisedRow { revision, row } in rows.values() {
                let row = Row { key: row.key(), revision: *revision, index: row.index(), body: row.body() };
                into.absorb(&row.key, *revision, Some(&row)).expect("a row of ours");
            }
        }
        let mut view = FleetProjection::new(self.view.site.clone(), self.now, self.now);
        copy(&mut view, &self.view.sessions);
        copy(&mut view, &self.view.authority);
        copy(&mut view, &self.view.marks);
        copy(&mut view, &self.view.tasks);
        copy(&mut view, &self.view.intakes);
        copy(&mut view, &self.view.attempts);
        Self { view, board: self.board.clone(), now: self.now, number: self.number }
    }
}

/// A robot at work on T1.
fn at_work() -> Rig {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |raw| raw.deadline = Some(BEGIN.plus_ms(60 * MINUTE_MS)));
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["T1"]);
    rig.accepts("T1");
    assert_eq!(rig.task("T1").phase, Phase::Running);
    rig
}

#[test]
fn a_priority_that_changes_moves_the_task_in_the_queue_and_what_was_asked_for_stays() {
    let mut rig = Rig::new();
    rig.submit("first", |_| {});
    rig.submit("second", |_| {});
    rig.cycle(Pace::Wake);
    assert_eq!(rig.order(), ["first", "second"]);
    assert_eq!(rig.ask(edit("second", priority(1))), None);
    assert_eq!(rig.order(), ["second", "first"]);
    assert_eq!(rig.rebuilt().order(), ["second", "first"]);
    let (task, intake) = (rig.task("second"), rig.view.intake(&id("second")).expect("an intake"));
    assert_eq!((task.priority(intake), intake.spec.priority), (1, 5));
}

#[test]
fn a_priority_that_changes_ends_the_promotion_and_a_task_keeps_since_when_it_is_ready() {
    let mut rig = Rig::new();
    let class = |rig: &Rig| {
        let rank = rig.view.queue.rank(&id("T1")).expect("ready");
        (rank.class, rank.promoted, rank.since)
    };
    rig.submit("T1", |raw| raw.priority = Some(9));
    rig.pass(limits::MAX_WAIT.as_ms());
    rig.cycle(Pace::Wake);
    assert_eq!(class(&rig), (Class::Normal, true, BEGIN));
    assert_eq!(rig.ask(edit("T1", priority(9))), None);
    assert_eq!(class(&rig), (Class::Normal, true, BEGIN), "nothing changed");
    assert_eq!(rig.ask(edit("T1", priority(8))), None);
    assert_eq!(class(&rig), (Class::Background, false, BEGIN));
    rig.pass(limits::MAX_WAIT.as_ms() - 1);
    rig.cycle(Pace::Wake);
    assert_eq!(class(&rig), (Class::Background, false, BEGIN));
    rig.pass(1);
    rig.cycle(Pace::Wake);
    assert_eq!(class(&rig), (Class::Normal, true, BEGIN), "by the time with the new priority");
}

#[test]
fn an_edit_that_lost_to_an_assignment_is_refused_and_changes_nothing() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["T1"]);
    assert_eq!(rig.ask(edit("T1", priority(0))), Some(Code::TaskNotEditable));
    let task = rig.task("T1");
    assert_eq!((task.phase, task.edit.is_empty()), (Phase::Assigned, true));
    let told = task.answers[0].refusal.as_ref().expect("refused");
    assert_eq!((told.metadata["state"].as_str(), told.metadata["robot_id"].as_str()), ("ASSIGNED", "r1"));
}

#[test]
fn a_task_changes_only_while_no_robot_has_it_and_nobody_must_answer_it() {
    let mut taken = Vec::new();
    for phase in Phase::ALL.into_iter().filter(|phase| !phase.is_terminal()) {
        let mut rig = Rig::new();
        rig.submit("T1", |_| {});
        let task = TaskState { phase, ..rig.task("T1").clone() };
        rig.change(&task);
        match rig.ask(edit("T1", priority(0))) {
            None => taken.push(phase),
            Some(code) => assert_eq!(code, Code::TaskNotEditable, "{phase:?}"),
        }
    }
    assert_eq!(taken, [Phase::Queued, Phase::Suspended, Phase::RetryWait]);
}

#[test]
fn an_edit_of_a_task_that_moved_since_it_was_seen_is_refused() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    let seen = rig.view.tasks.get("T1").map(|row| row.revision);
    let over = |edit| Ask::Edit { task_id: id("T1"), seen, edit };
    assert_eq!(rig.ask(over(priority(1))), None);
    assert_eq!(rig.ask(over(priority(2))), Some(Code::EtagMismatch));
    assert_eq!(rig.task("T1").edit, priority(1));
}

#[test]
fn a_pin_that_changes_binds_the_task_to_its_robot_and_one_that_goes_frees_it_at_once() {
    for policy in [AssignmentPolicy::Rolling, AssignmentPolicy::FifoNearest] {
        let mut rig = Rig::new();
        rig.plan_as(policy);
        rig.robot("r1", "park-a");
        rig.robot("r2", "park-b");
        rig.submit("elsewhere", |raw| raw.robot_id = "r9".into());
        rig.submit("free", |_| {});
        assert_eq!(rig.ask(edit("free", pin(Some("r2")))), None);
        assert_eq!(given(&rig.cycle(Pace::Sweep).items), ["free"]);
        assert_eq!(rig.task("free").robot_id.as_ref().map(RobotId::as_str), Some("r2"), "the other one is nearer");
        let told = rig.why(&id("elsewhere"));
        assert_eq!(told, None, "no robot that it may go to");
        assert_eq!(given(&rig.cycle(Pace::Wake).items), [""; 0]);
        assert_eq!(rig.ask(edit("elsewhere", pin(None))), None);
        assert_eq!(given(&rig.cycle(Pace::Wake).items), ["elsewhere"], "who passed it over looks again");
    }
}

#[test]
fn an_opened_task_is_pinned_to_no_robot_but_the_one_that_carries_its_item() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    let opened = TaskState { opened_robot_id: RobotId::parse("r1").ok(), ..rig.task("T1").clone() };
    rig.change(&opened);
    assert_eq!(rig.ask(edit("T1", pin(Some("r2")))), Some(Code::BoundElsewhere));
    assert_eq!(rig.ask(edit("T1", pin(Some("r1")))), None);
    assert_eq!(rig.ask(edit("T1", pin(None))), None);
}

#[test]
fn a_beginning_that_moves_ahead_takes_a_task_out_of_the_ready_ones_until_then_and_its_age_stays() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    rig.pass(MINUTE_MS);
    rig.cycle(Pace::Wake);
    let later = rig.now.utc.plus_ms(10 * MINUTE_MS);
    assert_eq!(rig.ask(edit("T1", not_before(Some(later)))), None);
    assert_eq!(rig.order(), [""; 0]);
    assert!(rig.view.ready.get(&id("T1")).is_none());
    assert_eq!(rig.why(&id("T1")).map(|why| (why.code, why.metadata[WAITS_FOR].clone())), {
        Some((Code::WaitingForTime, later.rfc3339()))
    });
    let mut rebuilt = rig.rebuilt();
    for rig in [&mut rig, &mut rebuilt] {
        rig.pass(10 * MINUTE_MS - 1);
        rig.cycle(Pace::Wake);
        assert_eq!(rig.order(), [""; 0]);
        rig.pass(1);
        rig.cycle(Pace::Wake);
        assert_eq!(rig.order(), ["T1"]);
        assert_eq!(rig.view.queue.rank(&id("T1")).map(|rank| rank.since), Some(BEGIN));
    }
}

#[test]
fn a_task_that_was_to_begin_later_and_may_begin_at_once_is_ready_from_then() {
    let mut rig = Rig::new();
    rig.submit("T1", |raw| raw.not_before = Some(BEGIN.plus_ms(60 * MINUTE_MS)));
    rig.pass(MINUTE_MS);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.ask(edit("T1", not_before(None))), None);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.order(), ["T1"]);
    let task = rig.task("T1");
    assert_eq!((task.ready_since, task.queued_since), (Some(rig.now.utc), rig.now.utc));
}

#[test]
fn a_deadline_that_changes_is_the_one_that_ends_the_task() {
    let mut rig = Rig::new();
    for task in ["T1", "T2"] {
        rig.submit(task, |raw| raw.deadline = Some(BEGIN.plus_ms(10 * MINUTE_MS)));
    }
    assert_eq!(rig.ask(edit("T1", deadline(Some(BEGIN.plus_ms(20 * MINUTE_MS))))), None);
    assert_eq!(rig.ask(edit("T2", deadline(None))), None);
    let mut rebuilt = rig.rebuilt();
    for rig in [&mut rig, &mut rebuilt] {
        let ended = |plan: &Plan| -> Vec<String> {
            let rows = plan.items.iter().flat_map(|item| &item.rows).filter(|row| row.kind == "task.expired");
            rows.map(|row| row.key.id.to_string()).collect()
        };
        rig.pass(15 * MINUTE_MS);
        assert_eq!(ended(&rig.cycle(Pace::Sweep)), [""; 0], "the old deadline passed");
        rig.pass(5 * MINUTE_MS);
        assert_eq!(ended(&rig.cycle(Pace::Sweep)), ["T1"]);
        rig.pass(24 * 60 * MINUTE_MS);
        assert_eq!(ended(&rig.cycle(Pace::Sweep)), [""; 0], "it has none");
    }
    let mut late = Rig::new();
    late.submit("T1", |raw| raw.not_before = Some(BEGIN.plus_ms(MINUTE_MS)));
    assert_eq!(late.ask(edit("T1", deadline(Some(BEGIN)))), Some(Code::NotAllowedNow));
}

#[test]
fn a_queued_task_that_a_person_holds_goes_to_no_robot_until_it_is_released() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.submit("later", |raw| raw.not_before = Some(BEGIN.plus_ms(MINUTE_MS)));
    assert_eq!((rig.hold("T1"), rig.hold("later")), (None, None));
    assert_eq!(rig.why(&id("later")).map(|why| why.code), Some(Code::HoldByPerson), "although its time has not come");
    rig.pass(2 * MINUTE_MS);
    let mut rebuilt = rig.rebuilt();
    for rig in [&mut rig, &mut rebuilt] {
        assert_eq!(given(&rig.cycle(Pace::Sweep).items), [""; 0]);
        let why = rig.why(&id("T1")).expect("a reason");
        assert_eq!((why.code, why.metadata["actor"].as_str()), (Code::HoldByPerson, "anna"));
        assert!(why.message.ends_with(": the aisle is wet"), "{}", why.message);
        assert_eq!(why.metadata[WAITS_FOR], "a person: midshift task release T1 --reason TEXT");
        assert_eq!(rig.task("T1").shown_reason().map(|shown| shown.message), Some(why.message));
        assert_eq!(rig.release("T1"), None);
        assert_eq!(given(&rig.cycle(Pace::Wake).items), ["T1"]);
        assert_eq!(rig.release("later"), None);
        rig.cycle(Pace::Wake);
        assert_eq!(rig.task("later").ready_since, Some(rig.now.utc), "it was held when its time came");
    }
}

#[test]
fn a_task_that_was_offered_and_is_held_stands_once_its_robot_has_taken_it() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Wake);
    assert_eq!(rig.hold("T1"), None);
    assert_eq!(rig.task("T1").phase, Phase::Assigned);
    rig.accepts("T1");
    assert_eq!(rig.task("T1").phase, Phase::Held);
}

#[test]
fn a_task_at_work_that_a_person_holds_stands_with_its_robot_and_its_timer_until_it_is_released() {
    let mut rig = at_work();
    assert_eq!(rig.hold("T1"), None);
    assert_eq!(rig.task("T1").reason.as_ref().map(|why| why.code), Some(Code::HoldByPerson));
    rig.cycle(Pace::Wake);
    let held = |rig: &Rig| rig.view.desired_work.get("r1").map(|work| work.row.held);
    assert_eq!((rig.task("T1").phase, held(&rig)), (Phase::Held, Some(true)));
    let why = rig.why(&id("T1")).expect("a reason");
    assert_eq!((why.code, why.metadata["actor"].as_str()), (Code::HoldByPerson, "anna"));
    rig.pass(30 * MINUTE_MS);
    rig.cycle(Pace::Wake);
    let timer = rig.start_to_close("T1");
    assert_eq!((timer.fires_at_service_ms, timer.remaining_ms), (None, 600_000));
    assert_eq!(rig.release("T1"), None);
    assert_eq!((rig.task("T1").phase, rig.task("T1").shown_reason()), (Phase::Running, None));
    assert!(rig.start_to_close("T1").fires_at_service_ms.is_some());
    rig.cycle(Pace::Wake);
    assert_eq!(held(&rig), Some(false));
}

#[test]
fn a_deadline_passes_although_a_person_holds_the_task() {
    let mut rig = at_work();
    rig.hold("T1");
    rig.pass(60 * MINUTE_MS);
    rig.cycle(Pace::Sweep);
    assert_eq!(
        (rig.task("T1").phase, rig.task("T1").then),
        (Phase::Stopping, Some(crate::task::AfterStopping::Expired))
    );
}

#[test]
fn a_resume_after_a_stop_leaves_what_a_person_holds_and_a_release_leaves_what_a_stop_holds() {
    let mut rig = at_work();
    rig.robot_token("resume:S1");
    assert_eq!(rig.task("T1").phase, Phase::Held);
    rig.hold("T1");
    rig.resume_all();
    assert!(rig.view.holds.is_empty(), "the robot waits for nobody");
    let task = rig.task("T1");
    assert_eq!((task.phase, task.holds.contains(OPERATOR_HOLD)), (Phase::Held, true));
    assert_eq!(task.shown_reason().map(|why| why.code), Some(Code::HoldByPerson));
    assert_eq!(rig.release("T1"), None);
    assert_eq!(rig.task("T1").phase, Phase::Running);

    rig.hold("T1");
    rig.robot_token("stop:S1");
    assert_eq!(rig.release("T1"), None);
    let task = rig.task("T1");
    assert_eq!((task.phase, task.holds.len()), (Phase::Held, 0));
    assert_eq!(task.shown_reason().map(|why| why.code), Some(Code::HoldByStop));
}

#[test]
fn a_second_hold_names_who_said_it_last_and_one_release_is_enough() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    rig.hold("T1");
    rig.pass(MINUTE_MS);
    rig.hold("T1");
    assert_eq!(rig.task("T1").operator_hold.as_ref().map(|hold| hold.since), Some(rig.now.utc));
    rig.release("T1");
    assert_eq!((rig.task("T1").operator_hold.as_ref(), rig.task("T1").holds.len()), (None, 0));
    assert_eq!(rig.release("T1"), None, "nothing happens to one that nobody holds");
}

#[test]
fn a_row_keeps_the_answers_to_the_newest_requests_alone() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    for n in 0..limits::ANSWERS_OF_TASK as u8 + 3 {
        rig.ask(edit("T1", priority(n % 10)));
    }
    let answers: Vec<&str> = rig.task("T1").answers.iter().map(|answer| answer.request.as_str()).collect();
    assert_eq!(
        (answers.len(), answers.first(), answers.last()),
        (limits::ANSWERS_OF_TASK, Some(&"ask-4"), Some(&"ask-11"))
    );
}

#[test]
fn a_task_that_nobody_changed_has_the_row_that_older_versions_write() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    let body = rig.task("T1").body();
    for key in ["edit", "priority_since", "operator_hold", "answers"] {
        assert!(!body.contains(&format!("\"{key}\"")), "{key}: {body}");
    }
}
