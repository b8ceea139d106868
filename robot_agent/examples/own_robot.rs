//! A robot of one's own: a point that drives, picks and places. Beside `cargo run --release -- dev --robots 6` start it
//! by `cargo run --release -p midshift-agent --example own_robot -- --robot-id own-1 --data own-1 --stop-server
//! 127.0.0.1:7421`
use midshift_agent::body::{Body, BodyLimits, BodyNews, BodyOrder, BodyState, Fault, Inventory, Load, Pose};
use midshift_agent::body::{SiteDuration, SiteTime, StepKind, StopLevel, TaskId, WaypointId};

#[rustfmt::skip] struct Point { file: std::path::PathBuf, seen: (WaypointId, Pose, Option<Load>), is_there: bool,
    order: Option<BodyOrder>, job: Option<Load>, left_ms: u64, now: SiteTime, paused: bool }

#[rustfmt::skip] impl Body for Point {
    fn capabilities(&self) -> Inventory {
        Inventory { capabilities: vec!["pick".into(), "place".into()], model: "point".into(), ..Inventory::default() }
    }
    fn limits(&self) -> BodyLimits { BodyLimits { speed_mm_s: 1_500, floor_speed_mm_s: 50, battery_critical_permille: 100 } }
    fn work_for(&mut self, task_id: Option<&TaskId>, _: u32) { self.job = Some(Load { task_id: task_id.cloned(), item: "a box".into() }); }
    fn start(&mut self, now: SiteTime, order: BodyOrder) -> Result<(), Fault> {
        self.left_ms = if let BodyOrder::Act(StepKind::Wait { duration_ms }) = order { duration_ms } else { 2_000 };
        (self.order, self.now, self.paused) = (Some(order), now, false);
        Ok(())
    }
    fn pause(&mut self, _now: SiteTime) { self.paused = true; }
    fn resume(&mut self, now: SiteTime) { (self.now, self.paused) = (now, false); }
    fn stop(&mut self, _now: SiteTime, level: StopLevel) { self.order.take_if(|_| level >= StopLevel::Halt); }
    fn poll(&mut self, now: SiteTime) -> Vec<BodyNews> {
        let past = SiteDuration(if self.paused { 0 } else { now.since(self.now).as_ms() });
        (self.now, self.left_ms) = (now, self.left_ms.saturating_sub(past.as_ms()));
        let mut news = vec![match &mut self.order {
            Some(BodyOrder::Drive(path)) => {
                self.is_there = path[0].approach(&mut self.seen.1, past);
                if !self.is_there { return vec![] }
                self.seen.0 = path.remove(0).waypoint;
                BodyNews::Reached(self.seen.0.clone())
            }
            Some(BodyOrder::Act(step)) if self.left_ms == 0 => {
                if let StepKind::Action { name, .. } = step { self.seen.2 = self.job.clone().filter(|_| name == "pick") }
                BodyNews::Load(self.seen.2.clone())
            }
            _ => return vec![],
        }];
        if self.order.take_if(|order| !matches!(order, BodyOrder::Drive(path) if !path.is_empty())).is_some() { news.push(BodyNews::Done) }
        midshift_durable::replace(&self.file, &serde_json::to_vec(&self.seen).unwrap_or_default()).expect("a disk");
        news
    }
    fn next_change(&self, now: SiteTime) -> Option<SiteTime> { (self.order.is_some() && !self.paused).then(|| now + SiteDuration(50)) }
    fn state(&self, _now: SiteTime) -> BodyState {
        BodyState { pose: self.seen.1, waypoint: Some(self.seen.0.clone()), battery_permille: 1_000, ..BodyState::default() }
    }
    fn load(&self) -> Option<Load> { self.seen.2.clone() }
    fn stands_on(&self) -> Vec<WaypointId> { if self.is_there { vec![self.seen.0.clone()] } else { vec![] } }
}

#[tokio::main]
async fn main() -> std::process::ExitCode {
    tracing_subscriber::fmt().with_writer(std::io::stderr).init();
    let config = <midshift_agent::Config as clap::Parser>::parse();
    let file = config.data.join("seen.json"); // A machine sees by itself where it is and what it carries; a point has a file.
    let seen = std::fs::read(&file).unwrap_or(br#"["hold-a", [13500, 5800, 0], null]"#.to_vec());
    let (seen, now) = (serde_json::from_slice(&seen).expect("what it saw last"), SiteTime(0));
    let point = Point { file, seen, is_there: true, order: None, job: None, left_ms: 0, now, paused: false };
    midshift_agent::run(config, Box::new(point)).await
}
