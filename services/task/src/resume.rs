//! ResumeHeld: what waits for a person goes on.
//!
//! Invariant: a resume lets go what its stop holds no more, and nothing later: one that comes before the reset is refused, never kept for then. A reset is here a moment
//! after the stop service has answered it, so it is waited for a little.

use crate::TaskService;
use crate::commands::{PendingCommand, hash, internal, reason_text, request_id};
use crate::rows::{unavailable, unknown_robot};
use midshift_core::fleet::rows::HoldToken;
use midshift_core::fleet::stops::Hold;
use midshift_core::identity::Caller;
use midshift_core::ids::{AreaId, RobotId, StopId, TaskId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::Record;
use midshift_core::stop::record::StopRecord;
use midshift_core::task::Ask;
use midshift_proto::task::v1;
use midshift_store::{Cursor, Query, load};
use std::collections::BTreeSet;
use std::time::Duration;

/// Tokens of all robots are read so often at most.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Robots that a stop holds, as fleet has written it down.
#[derive(Default)]
struct Held {
    /// They wait for a person.
    waiting: BTreeSet<RobotId>,
    /// It is engaged over them, as far as fleet knows.
    stopped: BTreeSet<RobotId>,
}

/// Whom a resume of a stop that is named concerns.
struct Named {
    stop_id: StopId,
    /// Empty: everybody.
    robot_ids: Vec<RobotId>,
}

impl Named {
    /// None: it names no fleet stop, or tasks or an area whose robots only fleet knows.
    fn from_ask(ask: &Ask) -> Option<Self> {
        let Ask::ResumeHeld { stop_id: Some(stop_id), area_id: None, task_ids, robot_ids } = ask else { return None };
        let stop_id = StopId::parse(stop_id).ok()?;
        task_ids.is_empty().then(|| Self { stop_id, robot_ids: robot_ids.clone() })
    }
    /// A fleet stop that is named beside an area or tasks.
    fn beside(ask: &Ask) -> Option<Self> {
        let Ask::ResumeHeld { stop_id: Some(stop_id), area_id, task_ids, .. } = ask else { return None };
        let stop_id = StopId::parse(stop_id).ok().filter(|_| area_id.is_some() || !task_ids.is_empty())?;
        Some(Self { stop_id, robot_ids: Vec::new() })
    }
    fn not_found(&self) -> Refusal {
        Refusal::new(Kind::NotFound, Reason::from(Code::StopNotFound).with("stop_id", &self.stop_id))
    }
}

/// What a request names, if it names anything.
fn read(r: &v1::ResumeHeldRequest, is_area: impl Fn(&AreaId) -> bool, bad: &mut Violations) -> Ask {
    let area_id = if r.area_id.is_empty() { None } else { bad.accept("area_id", AreaId::parse(&r.area_id)) };
    if area_id.as_ref().is_some_and(|area| !is_area(area)) {
        bad.add("area_id", "the site has no such area");
    }
    let most = limits::PAGE_MAX;
    if r.task_ids.len() > most || r.robot_ids.len() > most {
        bad.add("task_ids", "at most 1000 task_ids and 1000 robot_ids");
    }
    let tasks = r.task_ids.iter().enumerate();
    let task_ids = tasks.filter_map(|(i, id)| bad.accept(&format!("task_ids[{i}]"), TaskId::parse(id))).collect();
    let robots = r.robot_ids.iter().enumerate();
    let robot_ids = robots.filter_map(|(i, id)| bad.accept(&format!("robot_ids[{i}]"), RobotId::parse(id))).collect();
    let stop_id = Some(r.stop_id.clone()).filter(|id| !id.is_empty());
    if stop_id.is_none() && r.area_id.is_empty() && r.task_ids.is_empty() && r.robot_ids.is_empty() {
        bad.add("stop_id", "name a stop_id, an area_id, task_ids or robot_ids: nothing is resumed by accident");
    }
    Ask::ResumeHeld { stop_id, area_id, task_ids, robot_ids }
}

impl TaskService {
    /// Takes `resume:` tokens away.
    pub async fn resume(&self, r: v1::ResumeHeldRequest, by: &Caller) -> Result<v1::ResumeHeldResponse, Refusal> {
        let mut bad = Violations::default();
        reason_text(&r.reason, &mut bad);
        let request_id = request_id(&r.request_id, &mut bad);
        let ask = read(&r, |area| self.inner.parts.site.find_area(area).is_some(), &mut bad);
        bad.finish()?;
        match self.authorize_resume(&ask, by).await {
            Err(refusal) if !r.validate_only => return Err(self.denied(ask, r.reason, request_id, by, refusal).await),
            looked => looked?,
        }
        let same = v1::ResumeHeldRequest { request_id: String::new(), validate_only: false, ..r.clone() };
        let hash = hash("resume", &same);
        let earlier = self.asked_before(request_id.as_ref(), &hash).await?;
        if earlier.is_none() {
            self.robots_must_be_known(&ask).await?;
            if let Some(named) = Named::beside(&ask) {
                self.must_be_known(&named).await?;
            }
        }
        let named = Named::from_ask(&ask).filter(|_| earlier.is_none());
        let asked = PendingCommand { ask, reason: r.reason, request_id, hash, actor: by.into(), robot_id: None };
        let held = match &named {
            None => None,
            Some(named) => match self.until_over(named).await {
                Err(refusal) if refusal.kind() == Kind::Precondition && !r.validate_only => {
                    return Err(self.noted(&asked, Err(refusal)).await.err().unwrap_or_else(internal));
                }
                held => Some(held?),
            },
        };
        let pending = if r.validate_only { false } else { self.submit_command(earlier, asked).await? };
        let robots = held.as_ref().map(|held| held.waiting.len() as u32);
        let stopped = held.map(|held| held.stopped).unwrap_or_default();
        let still_stopped = stopped.iter().take(limits::PAGE_MAX).map(ToString::to_string).collect();
        Ok(v1::ResumeHeldResponse { pending, robots, still_stopped })
    }

    /// Nobody means a robot that is not enrolled and has never connected.
    async fn robots_must_be_known(&self, ask: &Ask) -> Result<(), Refusal> {
        let Ask::ResumeHeld { robot_ids, .. } = ask else { return Ok(()) };
        let Some(robot_id) = unknown_robot(self.store(), robot_ids).await? else { return Ok(()) };
        Err(Refusal::new(Kind::NotFound, Reason::from(Code::RobotNotFound).with("robot_id", robot_id)))
    }

    /// Nobody means a stop that neither the copy of the stops nor any robot knows.
    async fn must_be_known(&self, named: &Named) -> Result<(), Refusal> {
        let record = load::<StopRecord>(self.store(), named.stop_id.as_str()).await.map_err(unavailable)?;
        let held = self.held(named).await?;
        let is_known = record.is_some() || !held.waiting.is_empty() || !held.stopped.is_empty();
        if is_known { Ok(()) } else { Err(named.not_found()) }
    }

    /// Waits a little until a stop is over everywhere, and says whom it holds.
    ///
    /// # Errors
    /// It is engaged; nobody knows of it.
    async fn until_over(&self, named: &Named) -> Result<Held, Refusal> {
        let mut wake = self.store().wake();
        let deadline = tokio::time::Instant::now() + Duration::from_millis(limits::RESUME_WAIT.as_ms());
        loop {
            wake.mark_unchanged();
            let record = load::<StopRecord>(self.store(), named.stop_id.as_str()).await.map_err(unavailable)?;
            let record = record.map(|(record, _)| record);
            let held = self.held(named).await?;
            let is_engaged = record.as_ref().is_some_and(StopRecord::is_effective);
            let is_known = record.is_some() || !held.waiting.is_empty() || !held.stopped.is_empty();
            if is_known && !is_engaged && held.stopped.is_empty() {
                return Ok(held);
            }
            let woken = tokio::time::timeout_at(deadline, wake.changed()).await;
            if matches!(woken, Ok(Ok(()))) {
                // A busy store is not read again for each of its commits.
                tokio::time::sleep(LOOK_EVERY).await;
                continue;
            }
            return match (is_known, is_engaged) {
                (false, _) => Err(named.not_found()),
                (true, true) => {
                    let reason = Reason::from(Code::StopEngaged).with("stop_id", &named.stop_id);
                    Err(Refusal::new(Kind::Precondition, reason))
                }
                (true, false) => Ok(held),
            };
        }
    }

    /// Whom a stop holds now.
    async fn held(&self, named: &Named) -> Result<Held, Refusal> {
        let (mut held, mut after) = (Held::default(), None);
        loop {
            let query = Query { after, ..Query::all(HoldToken::TABLE) };
            let rows = self.store().list(query).await.map_err(unavailable)?;
            let Some(last) = rows.last() else { return Ok(held) };
            after = Some(Cursor::of_row(last));
            for row in &rows {
                let HoldToken { robot_id, token, .. } = row.decode().map_err(unavailable)?;
                let is_named = named.robot_ids.is_empty() || named.robot_ids.contains(&robot_id);
                match Hold::read(&token).filter(|(stop_id, _)| is_named && *stop_id == named.stop_id) {
                    Some((_, Hold::Resume)) => drop(held.waiting.insert(robot_id)),
                    Some((_, Hold::Stop)) => drop(held.stopped.insert(robot_id)),
                    None => {}
                }
            }
        }
    }
}
