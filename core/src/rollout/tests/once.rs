//! Commands that are only checked, and commands that are sent twice.

use super::*;
use crate::idempotency::CommandKey;
use crate::identity::Caller;
use crate::rollout::requests::{Ask, CheckOnly, CommandOutcome};

fn pin(n: usize) -> Command {
    Command::Pin { robot_id: robot_id(n), reason: "trial".into() }
}

fn asked(command: &Command, check_only: CheckOnly, request_id: Option<&str>) -> Ask {
    Ask {
        command: command.clone(),
        seen: None,
        check_only,
        request_id: request_id.map(Into::into),
        by: Caller::local(),
    }
}

impl Rig {
    fn once(&mut self, command: &Command, request_id: &str) -> Result<CommandOutcome, Refusal> {
        self.ota_turn();
        let mut taken = Ok(CommandOutcome::Now);
        let ask = asked(command, CheckOnly::No, Some(request_id));
        self.ota_plan(|rig, plan| taken = decide_request(&mut rig.ota, &rig.board, rig.now, &ask, plan));
        taken
    }

    fn is_pinned(&self, n: usize) -> bool {
        self.row::<RobotSoftware>(robot_id(n).as_str()).is_some_and(|s| s.pin.is_some())
    }

    /// What may be asked about software with a request_id, as things are in [`world`].
    fn all(&self) -> Vec<Command> {
        vec![
            pin(1),
            Command::Unpin { robot_id: robot_id(2) },
            Command::LiftQuarantine { robot_id: self.failed(), bundle: bundle_id(2) },
            Command::Do {
                rollout_id: rollout_id("next"),
                verb: Verb::Exclude(self.next_of(3)),
                reason: "because".into(),
            },
            Command::Revoke { bundle: bundle_id(3), reason: "leaks".into() },
            Command::AcceptKey { robot_id: robot_id(4), device_key: "ab".repeat(32) },
        ]
    }

    fn failed(&self) -> RobotId {
        self.ota.quarantines.values().next().expect("one went back").row.robot_id.clone()
    }

    fn next_of(&self, n: usize) -> RobotId {
        self.ota.robots_of(&rollout_id("next")).nth(n).expect("a robot").robot_id.clone()
    }
}

/// One robot is pinned, one went back from a bundle, and a roll-out of another one has begun.
fn world() -> Rig {
    let mut rig = Rig::new(8);
    rig.ask(&Command::Pin { robot_id: robot_id(2), reason: "a fair".into() }).expect("allowed");
    rig.fates(Fate::BadAtStart);
    rig.start(spec());
    rig.until(300, |r| r.phase() == Phase::Aborted);
    rig.put_row(bundle(3));
    rig.ticks(1);
    rig.start_as("next", RolloutSpec { bundle: bundle_id(3), ..spec() }, false);
    rig
}

#[test]
fn what_is_only_checked_writes_nothing_and_finds_what_would_be_refused() {
    let mut rig = world();
    for command in rig.all() {
        let mut plan = Plan::default();
        for id in [None, Some("a")] {
            let ask = asked(&command, CheckOnly::Yes, id);
            let taken = decide_request(&mut rig.ota, &rig.board, rig.now, &ask, &mut plan);
            assert_eq!(taken.expect("nothing is against it"), CommandOutcome::Now);
        }
        assert_eq!(plan.items, Vec::<Item>::new(), "{command:?}");
    }
    let nobody = Command::LiftQuarantine { robot_id: robot_id(1), bundle: bundle_id(9) };
    let ask = asked(&nobody, CheckOnly::Yes, None);
    let refused = decide_request(&mut rig.ota, &rig.board, rig.now, &ask, &mut Plan::default());
    assert_eq!(refused.expect_err("there is none").reason.code, Code::QuarantineNotFound);
}

#[test]
fn each_command_is_carried_out_once_for_its_request_id_and_another_one_is_refused_it() {
    let mut rig = world();
    for (ix, command) in rig.all().into_iter().enumerate() {
        let id = format!("request-{ix}");
        rig.once(&command, &id).expect("nothing is against it");
        let key: CommandKey<Command> = rig.row(&id).expect("it is written down");
        assert_eq!(key.command, command);
        let mut plan = Plan::default();
        for check_only in [CheckOnly::No, CheckOnly::Yes] {
            let ask = asked(&command, check_only, Some(&id));
            let taken = decide_request(&mut rig.ota, &rig.board, rig.now, &ask, &mut plan).expect("it was done");
            assert_eq!(taken, CommandOutcome::Before(Utc(key.at_unix_ms)), "{command:?} {check_only:?}");
        }
        assert_eq!(plan.items, Vec::<Item>::new(), "{command:?}");
        assert_eq!(rig.once(&pin(7), &id).expect_err("it is taken").reason.code, Code::RequestIdReused);
    }
    assert!(rig.is_pinned(1) && !rig.is_pinned(2) && !rig.is_pinned(7));
}

#[test]
fn a_request_that_comes_late_does_not_undo_what_was_asked_since() {
    let mut rig = Rig::new(3);
    rig.once(&pin(1), "a").expect("allowed");
    rig.ask(&Command::Unpin { robot_id: robot_id(1) }).expect("allowed");
    rig.once(&pin(1), "a").expect("it was done");
    assert!(!rig.is_pinned(1));
    // Without an id, or with a new one, it is another request.
    rig.once(&pin(1), "b").expect("allowed");
    assert!(rig.is_pinned(1));
}

#[test]
fn a_request_that_changed_nothing_is_remembered_too() {
    let mut rig = Rig::new(3);
    rig.ask(&pin(1)).expect("allowed");
    rig.once(&pin(1), "a").expect("it is so already");
    rig.ask(&Command::Unpin { robot_id: robot_id(1) }).expect("allowed");
    rig.once(&pin(1), "a").expect("it was done");
    assert!(!rig.is_pinned(1));
}

#[test]
fn what_a_request_does_and_its_id_are_one_item() {
    let mut rig = Rig::new(3);
    rig.ota_turn();
    let mut plan = Plan::default();
    let ask = asked(&pin(1), CheckOnly::No, Some("a"));
    decide_request(&mut rig.ota, &rig.board, rig.now, &ask, &mut plan).expect("allowed");
    let [item] = &plan.items[..] else { panic!("{} items", plan.items.len()) };
    assert_eq!((item.rows.len(), item.request_id.as_deref()), (2, Some("a")));
}

#[test]
fn a_request_id_is_kept_for_seven_days() {
    let mut rig = Rig::new(3);
    rig.once(&pin(1), "a").expect("allowed");
    let day = 24 * 3_600_000;
    rig.now.wall = rig.now.wall.plus_ms(7 * day);
    rig.once(&pin(2), "b").expect("allowed");
    assert!(rig.row::<CommandKey<Command>>("a").is_some());
    rig.now.wall = rig.now.wall.plus_ms(1);
    rig.once(&pin(2), "c").expect("it is so already");
    assert!(rig.row::<CommandKey<Command>>("a").is_none());
}
