//! Robots of the rig: they obey their section `update` as agents do, or fail as their fate says.

use super::*;

impl Rig {
    /// A robot's event is stored.
    pub(super) fn say_event(&mut self, n: usize, event: RobotEvent) {
        let robot = &mut self.robots[n];
        robot.events += 1;
        let (id, epoch, seq) = (robot.id.clone(), robot.epoch, robot.events);
        let sample = Sample { seq, robot_unix_ms: self.now.wall.0, body: SampleBody::Event(event) };
        let entry = InboxEntry {
            robot_id: id.clone(),
            session_epoch: epoch,
            ring: "ring".into(),
            lane: Lane::Event,
            what: InboxItem::Sample(sample),
            stamp_in_future: false,
        };
        let body = serde_json::to_string(&entry).expect("plain fields");
        self.entry(Log::RobotInbox, None, id.as_str().into(), Some(body.into()), "robot.said");
        self.put_row(LaneMark { event: seq, ..LaneMark::fresh(id, "ring") });
    }

    /// A robot's update is in this state from now on.
    pub(super) fn report(&mut self, n: usize, state: UpdateState) {
        let Some(report) = self.robots[n].report.clone() else { panic!("it has no update") };
        self.report_update(n, UpdateReport { state, ..report });
    }

    pub(super) fn report_update(&mut self, n: usize, report: UpdateReport) {
        self.robots[n].report = Some(report.clone());
        self.say_event(n, RobotEvent::Update(UpdateEvent::Changed(report)));
    }

    pub(super) fn robots_act(&mut self) {
        for n in 0..self.robots.len() {
            if !self.robots[n].is_off {
                self.robot_acts(n);
            }
        }
    }

    /// Obeys the section `update` as an agent does.
    pub(super) fn robot_acts(&mut self, n: usize) {
        let robot = self.robots[n].clone();
        if let Some(report) = &robot.report
            && report.state == UpdateState::Trial
            && self.works
            && !robot.idles
        {
            self.ends_task(n, true);
        }
        let Some(desired) = self.row::<DesiredUpdate>(robot.id.as_str()) else { return };
        let words: Vec<&str> = desired.directive.split(' ').collect();
        let [generation, bundle, issued] = words[..] else { return };
        let (generation, bundle) = (generation.parse().expect("a number"), BundleId::parse(bundle).expect("an id"));
        let named = robot.report.as_ref().is_some_and(|r| r.directive_generation == generation);
        let over = robot.report.as_ref().is_some_and(|r| r.state == UpdateState::Committed);
        if robot.judged != desired.directive && desired.goal == Goal::Revert && (!named || over) {
            let why = match robot.fate {
                Fate::KeepsNothing => Some(Code::NothingKept),
                Fate::Stubborn => Some(Code::DirectiveRefused),
                _ => None,
            };
            if let Some(why) = why {
                return self.refuses(n, &desired, why);
            }
        }
        if !named {
            let issued = Utc(issued.parse().expect("a moment"));
            if robot.judged == desired.directive {
                return;
            }
            if self.now.wall.ms_since(issued) >= DIRECTIVE_LIVES_MS {
                return self.refuses(n, &desired, Code::DirectiveRefused);
            }
            if desired.goal == Goal::Revert && robot.version != "0.9.0" {
                self.report_update(n, fresh_report(UpdateState::Committed, &bundle, generation));
            }
            if matches!(desired.goal, Goal::Stage | Goal::Activate) {
                let (state, reason) = match robot.fate {
                    Fate::NoBytes => (UpdateState::Downloading, None),
                    Fate::Unfit => (UpdateState::Refused, None),
                    Fate::Refuses(code) => (UpdateState::Refused, Some(code.into())),
                    _ => (UpdateState::Staged, None),
                };
                let grant_id = robot.seen_grant;
                self.report_update(n, UpdateReport { reason, grant_id, ..fresh_report(state, &bundle, generation) });
            }
            return;
        }
        let Some(report) = robot.report.clone() else { return };
        let holder = self.row::<RobotAuthority>(robot.id.as_str()).map(|a| a.holder);
        let in_drain = desired.drain_id.clone().filter(|d| holder == Some(RobotHolder::Maintenance(d.clone())));
        let stands = in_drain.is_some() || robot.stop != HardwareStop::None;
        match (report.state, desired.goal) {
            (UpdateState::Staged | UpdateState::Downloading, Goal::Revert) => self.report(n, UpdateState::Refused),
            (UpdateState::Staged, Goal::Activate) => self.activates(n, &desired, in_drain, report),
            (UpdateState::Probation, Goal::Activate) => match robot.fate {
                Fate::Probation => {}
                Fate::BadAtStart => self.goes_back(n, Some(Code::SelfTestFailed)),
                _ => self.report(n, UpdateState::Trial),
            },
            (UpdateState::Trial, Goal::Commit) => {
                self.robots[n].kept.clone_from(&robot.version);
                self.report(n, UpdateState::Committed);
            }
            (UpdateState::Committed, Goal::Revert) if matches!(robot.fate, Fate::KeepsNothing | Fate::Stubborn) => {}
            (UpdateState::Probation | UpdateState::Trial | UpdateState::Committed, Goal::Revert) if stands => {
                self.goes_back(n, None);
            }
            _ => {}
        }
    }

    /// It says once that it does not take the directive.
    fn refuses(&mut self, n: usize, desired: &DesiredUpdate, why: Code) {
        self.robots[n].judged.clone_from(&desired.directive);
        let (generation, reason) = (desired.generation, why.into());
        self.say_event(n, RobotEvent::Update(UpdateEvent::DirectiveRefused { generation, reason }));
    }

    pub(super) fn activates(
        &mut self,
        n: usize,
        desired: &DesiredUpdate,
        in_drain: Option<DrainId>,
        report: UpdateReport,
    ) {
        let Some(drain_id) = in_drain.filter(|_| self.robots[n].fate != Fate::NeverReady) else { return };
        let robot = &self.robots[n];
        match desired.grant.clone().filter(|g| g.grant_id > robot.seen_grant) {
            Some(grant) => {
                let age_ms = robot.hb.saturating_sub(grant.authority.hb) * 1_000;
                let alive = grant.authority.session_epoch == robot.epoch && age_ms <= grant.authority.valid_ms;
                self.robots[n].seen_grant = grant.grant_id;
                if !alive || self.robots[n].fate == Fate::Dawdles {
                    return;
                }
                assert_eq!(grant.drain_id, drain_id, "a permission outside its drain");
                if self.robots[n].fate == Fate::Silent {
                    self.robots[n].is_off = true;
                    return;
                }
                self.robots[n].version =
                    format!("{}.0.0", u32::from_str_radix(&report.bundle.as_str()[56..], 16).expect("a number"));
                self.attach(n, |_| {});
                let switched = UpdateReport {
                    state: UpdateState::Probation,
                    drain_id: Some(drain_id),
                    grant_id: grant.grant_id,
                    tries: 1,
                    ..report
                };
                self.report_update(n, switched);
            }
            // It asks again every few seconds.
            None if !robot.hb.is_multiple_of(3) => {}
            None => {
                let set = crate::ids::SetId::parse(&"a".repeat(64)).expect("an id");
                self.say_event(n, RobotEvent::Update(UpdateEvent::Ready { drain_id, set }));
            }
        }
    }

    /// What was kept runs again.
    pub(super) fn goes_back(&mut self, n: usize, why: Option<Code>) {
        let robot = &mut self.robots[n];
        robot.version = if robot.version == robot.kept { "0.9.0".into() } else { robot.kept.clone() };
        robot.kept.clone_from(&robot.version);
        let report = robot.report.clone().expect("an update");
        self.attach(n, |_| {});
        let reason = why.map(Reason::from);
        self.report_update(n, UpdateReport { state: UpdateState::RolledBack, reason, ..report });
    }

    /// A task of the robot ends.
    pub(super) fn ends_task(&mut self, n: usize, well: bool) {
        let id = format!("{}@{}", self.robots[n].id, self.robots[n].version);
        let mut row = self.row::<RobotCounter>(&id).unwrap_or_else(|| RobotCounter {
            robot_id: self.robots[n].id.clone(),
            software: self.robots[n].version.clone(),
            succeeded: 0,
            failures: BTreeMap::new(),
            stats: WorkStats::default(),
            errands: WorkStats::default(),
            attached_ms: 0,
            counted: Default::default(),
            energy_sums: Default::default(),
        });
        if well {
            row.succeeded += 1;
        } else {
            *row.failures.entry(7).or_default() += 1;
        }
        let energy_mwh = if self.robots[n].version == "0.9.0" { 10 } else { self.trial_energy_mwh };
        row.stats += WorkStats { path_mm: 50_000, duration_ms: 20_000, energy_mwh, ..WorkStats::default() };
        self.put_row(row);
    }
}
