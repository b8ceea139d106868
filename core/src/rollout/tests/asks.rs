//! What tests look at in the rig, and what people ask in it.

use super::*;

impl Rig {
    // --- what there is

    pub(super) fn row<R: Record>(&self, id: &str) -> Option<R> {
        self.rows.get(&Key::new(R::TABLE, id)).map(|row| row.decode().expect("a row"))
    }

    pub(super) fn rollout(&self, id: &str) -> Rollout {
        self.row(id).expect("a roll-out")
    }

    pub(super) fn robot_in(&self, id: &str, n: usize) -> RolloutRobot {
        self.row(&RolloutRobot::id_of(&rollout_id(id), &robot_id(n))).expect("a robot of it")
    }

    pub(super) fn step(&self, n: usize) -> Step {
        self.robot_in("ro", n).step
    }

    pub(super) fn phase(&self) -> Phase {
        self.rollout("ro").phase
    }

    pub(super) fn count(&self, step: Step) -> usize {
        self.ota.robots.values().filter(|r| r.row.step == step).count()
    }

    /// Robots of roll-out `ro` in order of wave and rank.
    pub(super) fn order(&self) -> Vec<usize> {
        let mut all: Vec<RolloutRobot> = self.ota.robots_of(&rollout_id("ro")).cloned().collect();
        all.sort_by_key(|r| (r.wave, r.rank));
        all.iter().map(|r| r.robot_id.as_str()[1..].parse().expect("a number")).collect()
    }

    pub(super) fn fates(&mut self, fate: Fate) {
        self.robots.iter_mut().for_each(|r| r.fate = fate);
    }

    pub(super) fn rules(&mut self, change: impl FnOnce(&mut crate::policy::SoftwareRules)) {
        let mut row = self.row("hall").unwrap_or_else(|| AreaPolicy::default_of(hall()));
        change(&mut row.software);
        self.put_row(row);
    }

    /// A session's inventory is changed, and the robot attaches anew with it.
    pub(super) fn label(&mut self, n: usize, key: &str, value: &str) {
        self.attach(n, |i| drop(i.labels.insert(key.into(), value.into())));
    }

    pub(super) fn control(&mut self, n: usize, change: impl FnOnce(&mut RobotControl)) {
        let mut row = self.row::<RobotControl>(robot_id(n).as_str()).expect("a row");
        change(&mut row);
        self.put_row(row);
    }

    /// A robot shows another device key than the one that is known: this one.
    pub(super) fn shows_another_key(&mut self, n: usize) -> String {
        let key = "ab".repeat(32);
        let session = self.row::<Session>(robot_id(n).as_str()).expect("it attached");
        self.put_row(Session { other_device_key: Some(key.clone()), ..session });
        key
    }

    pub(super) fn retire(&mut self, n: usize) {
        let act = fleet::rows::Cordon { reason: String::new(), actor: "ana".into(), since: self.now.utc };
        self.control(n, |c| c.retired = Some(act));
    }

    // --- people

    pub(super) fn ask(&mut self, command: &Command) -> Result<bool, Refusal> {
        self.ota_turn();
        let done = check_command(&self.ota, &self.board, command, None)?;
        if !done {
            self.ota_plan(|rig, plan| carry_out(&mut rig.ota, &rig.board, rig.now, command, &"ana".into(), plan));
        }
        Ok(done)
    }

    pub(super) fn verb(&mut self, id: &str, verb: Verb) -> Result<bool, Refusal> {
        self.ask(&Command::Do { rollout_id: rollout_id(id), verb, reason: "because".into() })
    }

    pub(super) fn must(&mut self, id: &str, verb: Verb) {
        assert!(!self.verb(id, verb).expect("it is allowed"), "it was done before");
    }

    pub(super) fn create(&mut self, id: &str, spec: RolloutSpec) {
        self.ask(&Command::Create { rollout_id: rollout_id(id), spec: Arc::new(spec) }).expect("it is allowed");
    }

    /// Creates, submits, approves and starts one.
    pub(super) fn start_as(&mut self, id: &str, spec: RolloutSpec, supersede: bool) {
        self.create(id, spec);
        for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede }] {
            self.must(id, verb);
        }
    }

    pub(super) fn start(&mut self, spec: RolloutSpec) {
        self.start_as("ro", spec, false);
    }

    /// All release rows that were ever written, by why.
    pub(super) fn releases(&self) -> Vec<ReleasedBy> {
        let table = crate::drain_request::DrainRelease::TABLE;
        let bodies = self.feed.iter().filter(|e| e.table == Some(table)).filter_map(|e| e.body.as_ref());
        bodies.map(|b| serde_json::from_str::<crate::drain_request::DrainRelease>(b).expect("a row").why).collect()
    }

    /// Codes of the incidents that were asked for.
    pub(super) fn incidents(&self) -> Vec<Code> {
        let told =
            self.feed.iter().filter(|e| &*e.kind == crate::drain_request::INCIDENT).filter_map(|e| e.body.as_ref());
        told.map(|b| serde_json::from_str::<Reason>(b).expect("a reason").code).collect()
    }
}
