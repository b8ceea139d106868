//! The gRPC face of fleet: decode, call, encode.

use crate::arguments::{check_reason, internal, place_and_request, request_id, robot_and_request};
use crate::{FleetService, encode};
use midshift_core::fleet::commands::Command;
use midshift_core::fleet::objects::{sees_incident, sees_place, sees_robot, sees_task};
use midshift_core::fleet::rows::Incident;
use midshift_core::fleet::{explain, projection::FleetProjection};
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::{AreaId, AttemptId, PlaceId, RobotId, Subject, TaskId};
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::{Key, Revision, Table};
use midshift_core::task::{TaskIntake, TaskState};
use midshift_core::time::Utc;
use midshift_core::unknown_rows;
use midshift_proto::access::caller;
use midshift_proto::convert::fleet::{encode_planner, encode_policy, parse_planner};
use midshift_proto::convert::plan::{encode_plan, encode_summary};
use midshift_proto::convert::task::revision_of;
use midshift_proto::convert::{At, parse_ms, timestamp};
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService as Face;
use midshift_proto::pages;
use std::ops::Bound;
use tonic::{Request, Response, Status};

/// Site time after which a drain is given up, unless the caller says another.
const DRAIN_WITHIN_MS: i64 = 30 * 60_000;
/// What a caller may say.
const DRAIN_MS: std::ops::RangeInclusive<i64> = 1_000..=24 * 3_600_000;
/// Site time after which the block of a place may end by itself.
const BLOCK_MS: std::ops::RangeInclusive<i64> = 1_000..=30 * 24 * 3_600_000;

fn not_found(code: Code, id: impl std::fmt::Display) -> Refusal {
    Refusal::new(Kind::NotFound, Reason::from(code).with("id", id))
}

fn answer<T>(result: Result<T, Refusal>) -> Result<Response<T>, Status> {
    result.map(Response::new).map_err(|refusal| midshift_proto::status(&refusal, None))
}

impl FleetService {
    /// Carries out a command about `robot_id`. What it is under then.
    async fn act_on_robot(
        &self,
        robot_id: RobotId,
        command: Command,
        by: &Caller,
        etag: &str,
        validate_only: bool,
        request_id: Option<String>,
    ) -> Result<Option<v1::RobotControl>, Refusal> {
        self.act(command, by, revision_of(etag), validate_only, request_id).await?;
        self.query_projection(move |view, board, _| Some(encode::control(view, board, &robot_id))).await
    }

    async fn cordon(&self, r: v1::CordonRobotRequest, by: &Caller) -> Result<v1::CordonRobotResponse, Refusal> {
        let bad = Violations::default();
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, Some(&r.reason), bad)?;
        let command = Command::Cordon { robot_id: robot_id.clone(), reason: r.reason };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::CordonRobotResponse { control })
    }

    async fn uncordon(&self, r: v1::UncordonRobotRequest, by: &Caller) -> Result<v1::UncordonRobotResponse, Refusal> {
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, None, Violations::default())?;
        let command = Command::Uncordon { robot_id: robot_id.clone() };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::UncordonRobotResponse { control })
    }

    async fn retire(&self, r: v1::RetireRobotRequest, by: &Caller) -> Result<v1::RetireRobotResponse, Refusal> {
        let bad = Violations::default();
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, Some(&r.reason), bad)?;
        let command = Command::Retire { robot_id: robot_id.clone(), reason: r.reason };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::RetireRobotResponse { control })
    }

    async fn disown(&self, r: v1::DisownAttemptRequest, by: &Caller) -> Result<v1::DisownAttemptResponse, Refusal> {
        let mut bad = Violations::default();
        let subject = bad.accept("subject", Subject::parse(&r.subject));
        if r.epoch == 0 {
            bad.add("epoch", "is required, from 1");
        }
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, Some(&r.reason), bad)?;
        let attempt = AttemptId { subject: subject.ok_or_else(internal)?, epoch: r.epoch };
        let command = Command::Disown { robot_id: robot_id.clone(), attempt, reason: r.reason };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::DisownAttemptResponse { control })
    }

    async fn settle_load(
        &self,
        r: v1::SettleRobotLoadRequest,
        by: &Caller,
    ) -> Result<v1::SettleRobotLoadResponse, Refusal> {
        let bad = Violations::default();
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, Some(&r.reason), bad)?;
        let command = Command::SettleLoad { robot_id: robot_id.clone(), reason: r.reason };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::SettleRobotLoadResponse { control })
    }

    async fn label(&self, r: v1::LabelRobotRequest, by: &Caller) -> Result<v1::LabelRobotResponse, Refusal> {
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, None, Violations::default())?;
        let removed = r.removed.into_iter().collect();
        let command = Command::Label { robot_id: robot_id.clone(), labels: r.labels, removed };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::LabelRobotResponse { control })
    }

    async fn drain(&self, r: v1::DrainRobotRequest, by: &Caller) -> Result<v1::DrainRobotResponse, Refusal> {
        let mut bad = Violations::default();
        let within_ms = parse_ms(r.within.as_ref(), At::top("within"), &mut bad).unwrap_or(DRAIN_WITHIN_MS);
        if !DRAIN_MS.contains(&within_ms) {
            bad.add("within", "must be 1 s to 24 h");
        }
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, Some(&r.reason), bad)?;
        let within_ms = within_ms.unsigned_abs();
        let command = Command::Drain { robot_id: robot_id.clone(), reason: r.reason, within_ms };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::DrainRobotResponse { control })
    }

    async fn undrain(&self, r: v1::UndrainRobotRequest, by: &Caller) -> Result<v1::UndrainRobotResponse, Refusal> {
        let (robot_id, request_id) = robot_and_request(&r.robot_id, &r.request_id, None, Violations::default())?;
        let command = Command::Undrain { robot_id: robot_id.clone() };
        let control = self.act_on_robot(robot_id, command, by, &r.etag, r.validate_only, request_id).await?;
        Ok(v1::UndrainRobotResponse { control })
    }

    async fn control(
        &self,
        r: v1::GetRobotControlRequest,
        by: &Caller,
    ) -> Result<v1::GetRobotControlResponse, Refusal> {
        let robot_id = RobotId::parse(&r.robot_id).map_err(|e| Refusal::field("robot_id", e.to_string()))?;
        let by = by.clone();
        let found = self
            .query_projection(move |view, board, _| {
                let is_there = view.sessions.contains_key(robot_id.as_str());
                let is_seen = is_there && sees_robot(view, board, &by, &robot_id);
                is_seen.then(|| encode::control(view, board, &robot_id))
            })
            .await?;
        let control = found.ok_or_else(|| not_found(Code::RobotNotFound, &r.robot_id))?;
        Ok(v1::GetRobotControlResponse { control: Some(control) })
    }

    async fn controls(
        &self,
        r: v1::ListRobotControlsRequest,
        by: &Caller,
    ) -> Result<v1::ListRobotControlsResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let by = by.clone();
        self.query_projection(move |view: &FleetProjection, board, now| {
            let robots = view.sessions.values().map(|session| &session.row.robot_id);
            let robots = robots.filter(|robot_id| sees_robot(view, board, &by, robot_id));
            let (robots, next_page_token) = pages::page(robots.map(|id| (id.to_string(), id)), &r.page_token, size);
            let controls = robots.into_iter().map(|robot_id| encode::control(view, board, robot_id)).collect();
            v1::ListRobotControlsResponse { controls, next_page_token, list_time: Some(timestamp(now.utc)) }
        })
        .await
    }

    async fn policy(&self, area_id: AreaId, by: &Caller) -> Result<v1::AreaPolicy, Refusal> {
        let id = area_id.clone();
        if !by.is_permitted_in(Permission::Read, [&area_id]) {
            return Err(not_found(Code::AreaNotFound, area_id));
        }
        let found = self
            .query_projection(move |view, _, _| {
                view.site.find_area(&id)?;
                let revision = view.policies.get(id.as_str()).map(|p| p.revision);
                Some(encode_policy(&view.policy(&id), revision))
            })
            .await?;
        found.ok_or_else(|| not_found(Code::AreaNotFound, area_id))
    }

    async fn put_policy(&self, r: v1::PutAreaPolicyRequest, by: &Caller) -> Result<v1::PutAreaPolicyResponse, Refusal> {
        let mut bad = Violations::default();
        let request_id = request_id(&r.request_id, &mut bad);
        let wire = r.policy.unwrap_or_default();
        let seen = revision_of(&wire.etag);
        let policy: Option<midshift_core::policy::AreaPolicy> =
            midshift_proto::Parse::parse_at(wire, At::top("policy"), &mut bad);
        bad.finish()?;
        let policy = policy.ok_or_else(|| Refusal::field("policy", "is required"))?;
        let area_id = policy.area_id.clone();
        self.act(Command::PutPolicy(policy), by, seen, r.validate_only, request_id).await?;
        let robots = self.query_projection(|view, _, _| view.sessions.len() as u32).await?;
        Ok(v1::PutAreaPolicyResponse { policy: Some(self.policy(area_id, by).await?), robots })
    }

    async fn planner(&self, by: &Caller) -> Result<v1::PlannerPolicy, Refusal> {
        by.authorize(Permission::Read, [])?;
        self.query_projection(|view, _, _| {
            let revision = view.planner_policies.get(view.site.site_id().as_str()).map(|p| p.revision);
            encode_planner(&view.planner(), revision)
        })
        .await
    }

    async fn change_planner(&self, r: v1::PutPlannerRequest, by: &Caller) -> Result<v1::PutPlannerResponse, Refusal> {
        let mut bad = Violations::default();
        let request_id = request_id(&r.request_id, &mut bad);
        let wire = r.policy.unwrap_or_else(|| {
            bad.add("policy", "is required");
            v1::PlannerPolicy::default()
        });
        let seen = revision_of(&wire.etag);
        let policy = parse_planner(wire, self.site.site_id(), At::top("policy"), &mut bad);
        bad.finish()?;
        self.act(Command::PutPlanner(policy.ok_or_else(internal)?), by, seen, r.validate_only, request_id).await?;
        Ok(v1::PutPlannerResponse { policy: Some(self.planner(by).await?) })
    }

    async fn plans(&self, by: &Caller) -> Result<v1::ListPlansResponse, Refusal> {
        by.authorize(Permission::Read, [])?;
        let plans = self.query_projection(|view, _, _| view.plans.iter().cloned().collect::<Vec<_>>()).await?;
        Ok(v1::ListPlansResponse { plans: plans.iter().map(|plan| encode_summary(plan)).collect() })
    }

    async fn plan(&self, r: v1::GetPlanRequest, by: &Caller) -> Result<v1::GetPlanResponse, Refusal> {
        by.authorize(Permission::Read, [])?;
        let found = self.query_projection(move |view, _, _| view.plans.get(r.number).cloned()).await?;
        let asked = || r.number.map_or_else(|| "the newest".to_owned(), |number| number.to_string());
        let plan = found.ok_or_else(|| not_found(Code::PlanNotFound, asked()))?;
        Ok(v1::GetPlanResponse { plan: Some(encode_plan(&plan)) })
    }

    async fn places(&self, r: v1::ListPlacesRequest, by: &Caller) -> Result<v1::ListPlacesResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let by = by.clone();
        let (places, next_page_token) = self
            .query_projection(move |view: &FleetProjection, _, _| {
                let in_use = |p: &midshift_core::fleet::rows::Place| {
                    !p.holders.is_empty()
                        || p.quarantine.is_some()
                        || view.place_blocks.contains_key(p.place_id.as_str())
                        || view.waits.values().any(|w| w.places.contains(&p.place_id))
                };
                let rows = view.places.iter().filter(|(_, p)| !r.in_use || in_use(&p.row));
                let rows = rows.filter(|(_, p)| sees_place(view, &by, &p.row.place_id));
                pages::page(rows.map(|(id, p)| (id, encode::place(view, &p.row, p.revision))), &r.page_token, size)
            })
            .await?;
        Ok(v1::ListPlacesResponse { places, next_page_token })
    }

    async fn clear(&self, r: v1::ClearPlaceRequest, by: &Caller) -> Result<v1::ClearPlaceResponse, Refusal> {
        let mut bad = Violations::default();
        let seen: Option<Revision> = revision_of(&r.etag);
        if seen.is_none() {
            bad.add("etag", "is required: a person clears what the person saw");
        }
        let (place_id, request_id) = place_and_request(&r.place_id, &r.request_id, &r.reason, bad)?;
        let command = Command::ClearPlace { place_id: place_id.clone(), reason: r.reason };
        self.act(command, by, seen, r.validate_only, request_id).await?;
        Ok(v1::ClearPlaceResponse { place: self.place(place_id).await? })
    }

    async fn block(&self, r: v1::BlockPlaceRequest, by: &Caller) -> Result<v1::BlockPlaceResponse, Refusal> {
        let mut bad = Violations::default();
        let lasts_ms = parse_ms(r.lasts.as_ref(), At::top("lasts"), &mut bad);
        if lasts_ms.is_some_and(|ms| !BLOCK_MS.contains(&ms)) {
            bad.add("lasts", "must be 1 s to 30 days");
        }
        let (place_id, request_id) = place_and_request(&r.place_id, &r.request_id, &r.reason, bad)?;
        let lasts_ms = lasts_ms.map(i64::unsigned_abs);
        let command = Command::BlockPlace { place_id: place_id.clone(), reason: r.reason, lasts_ms };
        self.act(command, by, None, r.validate_only, request_id).await?;
        Ok(v1::BlockPlaceResponse { place: self.place(place_id).await? })
    }

    async fn unblock(&self, r: v1::UnblockPlaceRequest, by: &Caller) -> Result<v1::UnblockPlaceResponse, Refusal> {
        let bad = Violations::default();
        let (place_id, request_id) = place_and_request(&r.place_id, &r.request_id, &r.reason, bad)?;
        let command = Command::UnblockPlace { place_id: place_id.clone(), reason: r.reason };
        self.act(command, by, None, r.validate_only, request_id).await?;
        Ok(v1::UnblockPlaceResponse { place: self.place(place_id).await? })
    }

    async fn place(&self, place_id: PlaceId) -> Result<Option<v1::Place>, Refusal> {
        self.query_projection(move |view, _, _| {
            view.places.get(place_id.as_str()).map(|p| encode::place(view, &p.row, p.revision))
        })
        .await
    }

    async fn why_task(&self, r: v1::ExplainTaskRequest, by: &Caller) -> Result<v1::ExplainTaskResponse, Refusal> {
        let task_id = TaskId::parse(&r.task_id).map_err(|e| Refusal::field("task_id", e.to_string()))?;
        let (asked, reader) = (task_id.clone(), by.clone());
        let (found, now) = self
            .query_projection(move |view, board, now| {
                let found = explain::task(view, board, now, &asked).filter(|_| sees_task(view, &reader, &asked));
                let found = found.map(|mut found| {
                    let sees = |robot_id: &RobotId| sees_robot(view, board, &reader, robot_id);
                    found.candidates.retain(|c| sees(&c.robot_id));
                    found.choice = found.choice.filter(|choice| choice.is_given || sees(&choice.robot_id));
                    if let Some(choice) = &mut found.choice {
                        choice.next.retain(|next| sees(&next.robot_id));
                        for next in &mut choice.next {
                            next.took = next.took.take().filter(|task_id| sees_task(view, &reader, task_id));
                        }
                    }
                    encode::task_explanation(&asked, &found, now.utc)
                });
                (found, now.utc)
            })
            .await?;
        let explanation = match found {
            Some(found) => found,
            None => self.why_stored(&task_id, by, now).await?,
        };
        Ok(v1::ExplainTaskResponse { explanation: Some(explanation) })
    }

    /// What the store says of a task that is not in the projection: it has ended, or was accepted a moment ago.
    async fn why_stored(&self, task_id: &TaskId, by: &Caller, now: Utc) -> Result<v1::TaskExplanation, Refusal> {
        let missing = || not_found(Code::TaskNotFound, task_id);
        let keys = [Table::TaskState, Table::TaskIntake].map(|table| Key::new(table, task_id.as_str()));
        let unread = |_| Refusal::new(Kind::Unavailable, Code::StoreUnavailable);
        let rows = self.store.get(keys.to_vec()).await.map_err(unread)?;
        let of = |table| rows.iter().find(|row| row.key.table == table).ok_or_else(missing);
        let intake = of(Table::TaskIntake)?.decode::<TaskIntake>().ok();
        let areas = intake.map(|intake| self.site.areas_of_task(&intake.spec));
        if !by.is_permitted_everywhere(Permission::Read)
            && !areas.is_some_and(|a| by.is_permitted_in(Permission::Read, &a))
        {
            return Err(missing());
        }
        let row = of(Table::TaskState)?;
        let task: TaskState = match row.decode() {
            Ok(task) => task,
            Err(error) if error.is_unknown() => {
                let found = explain::unknown(unknown_rows::reason(row, &error));
                return Ok(encode::task_explanation(task_id, &found, now));
            }
            Err(_) => return Err(internal()),
        };
        Ok(encode::task_explanation(task_id, &explain::stored(&task), now))
    }

    async fn why_robot(&self, r: v1::ExplainRobotRequest, by: &Caller) -> Result<v1::ExplainRobotResponse, Refusal> {
        let robot_id = RobotId::parse(&r.robot_id).map_err(|e| Refusal::field("robot_id", e.to_string()))?;
        let by = by.clone();
        let found = self
            .query_projection(move |view, board, now| {
                let found = explain::robot(view, board, now, &robot_id);
                let mut found = found.filter(|_| sees_robot(view, board, &by, &robot_id))?;
                found.candidates.retain(|c| sees_task(view, &by, &c.task_id));
                Some(encode::robot_explanation(view, board, now, &robot_id, &found))
            })
            .await?;
        let explanation = found.ok_or_else(|| not_found(Code::RobotNotFound, &r.robot_id))?;
        Ok(v1::ExplainRobotResponse { explanation: Some(explanation) })
    }

    async fn incidents(&self, r: v1::ListIncidentsRequest, by: &Caller) -> Result<v1::ListIncidentsResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        let robot_id = if r.robot_id.is_empty() { None } else { bad.accept("robot_id", RobotId::parse(&r.robot_id)) };
        bad.finish()?;
        let by = by.clone();
        let (incidents, next_page_token) = self
            .query_projection(move |view: &FleetProjection, board, _| {
                let wanted = |i: &Incident| {
                    (r.include_closed || i.closed.is_none()) && (robot_id.is_none() || i.robot_id == robot_id)
                };
                let prefix = &r.incident_id_prefix;
                let rows = view.incidents.range::<str, _>((Bound::Included(prefix.as_str()), Bound::Unbounded));
                let rows = rows.take_while(|(id, _)| id.starts_with(prefix));
                let rows = rows.filter(|(_, i)| wanted(&i.row));
                let rows = rows.filter(|(_, i)| sees_incident(view, board, &by, &i.row));
                pages::page(rows.map(|(id, i)| (id, encode::incident(&i.row, i.revision))), &r.page_token, size)
            })
            .await?;
        Ok(v1::ListIncidentsResponse { incidents, next_page_token })
    }

    async fn incident(&self, incident_id: String, by: &Caller) -> Result<v1::Incident, Refusal> {
        let (id, by) = (incident_id.clone(), by.clone());
        let found = self
            .query_projection(move |view, board, _| {
                let found = view.incidents.get(id.as_str()).filter(|i| sees_incident(view, board, &by, &i.row));
                found.map(|i| encode::incident(&i.row, i.revision))
            })
            .await?;
        found.ok_or_else(|| not_found(Code::IncidentNotFound, incident_id))
    }

    async fn close_one(&self, r: v1::CloseIncidentRequest, by: &Caller) -> Result<v1::CloseIncidentResponse, Refusal> {
        let mut bad = Violations::default();
        let request_id = request_id(&r.request_id, &mut bad);
        check_reason(&r.reason, &mut bad);
        bad.finish()?;
        let command = Command::CloseIncident { incident_id: r.incident_id.clone(), reason: r.reason };
        self.act(command, by, revision_of(&r.etag), r.validate_only, request_id).await?;
        Ok(v1::CloseIncidentResponse { incident: Some(self.incident(r.incident_id, by).await?) })
    }

    async fn counters(&self, r: v1::ListCountersRequest, by: &Caller) -> Result<v1::ListCountersResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let by = by.clone();
        let (counters, next_page_token) = self
            .query_projection(move |view, board, _| {
                let wanted = |c: &midshift_core::fleet::rows::RobotCounter| {
                    (r.robot_ids.is_empty() || r.robot_ids.iter().any(|id| id == c.robot_id.as_str()))
                        && (r.software.is_empty() || r.software == c.software)
                };
                let rows = view.counters.iter().filter(|(_, c)| wanted(&c.row));
                let rows = rows.filter(|(_, c)| sees_robot(view, board, &by, &c.row.robot_id));
                pages::page(rows.map(|(id, c)| (id, encode::counter(&c.row))), &r.page_token, size)
            })
            .await?;
        Ok(v1::ListCountersResponse { counters, next_page_token })
    }
}

#[tonic::async_trait]
impl Face for FleetService {
    async fn cordon_robot(
        &self,
        r: Request<v1::CordonRobotRequest>,
    ) -> Result<Response<v1::CordonRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.cordon(r.into_inner(), &by).await)
    }
    async fn uncordon_robot(
        &self,
        r: Request<v1::UncordonRobotRequest>,
    ) -> Result<Response<v1::UncordonRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.uncordon(r.into_inner(), &by).await)
    }
    async fn retire_robot(
        &self,
        r: Request<v1::RetireRobotRequest>,
    ) -> Result<Response<v1::RetireRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.retire(r.into_inner(), &by).await)
    }
    async fn disown_attempt(
        &self,
        r: Request<v1::DisownAttemptRequest>,
    ) -> Result<Response<v1::DisownAttemptResponse>, Status> {
        let by = caller(&r);
        answer(self.disown(r.into_inner(), &by).await)
    }
    async fn drain_robot(&self, r: Request<v1::DrainRobotRequest>) -> Result<Response<v1::DrainRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.drain(r.into_inner(), &by).await)
    }
    async fn undrain_robot(
        &self,
        r: Request<v1::UndrainRobotRequest>,
    ) -> Result<Response<v1::UndrainRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.undrain(r.into_inner(), &by).await)
    }
    async fn get_robot_control(
        &self,
        r: Request<v1::GetRobotControlRequest>,
    ) -> Result<Response<v1::GetRobotControlResponse>, Status> {
        let by = caller(&r);
        answer(self.control(r.into_inner(), &by).await)
    }
    async fn list_robot_controls(
        &self,
        r: Request<v1::ListRobotControlsRequest>,
    ) -> Result<Response<v1::ListRobotControlsResponse>, Status> {
        let by = caller(&r);
        answer(self.controls(r.into_inner(), &by).await)
    }
    async fn settle_robot_load(
        &self,
        r: Request<v1::SettleRobotLoadRequest>,
    ) -> Result<Response<v1::SettleRobotLoadResponse>, Status> {
        let by = caller(&r);
        answer(self.settle_load(r.into_inner(), &by).await)
    }
    async fn label_robot(&self, r: Request<v1::LabelRobotRequest>) -> Result<Response<v1::LabelRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.label(r.into_inner(), &by).await)
    }
    async fn get_area_policy(
        &self,
        r: Request<v1::GetAreaPolicyRequest>,
    ) -> Result<Response<v1::GetAreaPolicyResponse>, Status> {
        let by = caller(&r);
        let area_id = AreaId::parse(&r.into_inner().area_id).map_err(|e| Refusal::field("area_id", e.to_string()));
        let policy = match area_id {
            Ok(area_id) => self.policy(area_id, &by).await,
            Err(refusal) => Err(refusal),
        };
        answer(policy.map(|policy| v1::GetAreaPolicyResponse { policy: Some(policy) }))
    }
    async fn put_area_policy(
        &self,
        r: Request<v1::PutAreaPolicyRequest>,
    ) -> Result<Response<v1::PutAreaPolicyResponse>, Status> {
        let by = caller(&r);
        answer(self.put_policy(r.into_inner(), &by).await)
    }
    async fn get_planner(&self, r: Request<v1::GetPlannerRequest>) -> Result<Response<v1::GetPlannerResponse>, Status> {
        let policy = self.planner(&caller(&r)).await;
        answer(policy.map(|policy| v1::GetPlannerResponse { policy: Some(policy) }))
    }
    async fn put_planner(&self, r: Request<v1::PutPlannerRequest>) -> Result<Response<v1::PutPlannerResponse>, Status> {
        let by = caller(&r);
        answer(self.change_planner(r.into_inner(), &by).await)
    }
    async fn list_plans(&self, r: Request<v1::ListPlansRequest>) -> Result<Response<v1::ListPlansResponse>, Status> {
        let by = caller(&r);
        answer(self.plans(&by).await)
    }
    async fn get_plan(&self, r: Request<v1::GetPlanRequest>) -> Result<Response<v1::GetPlanResponse>, Status> {
        let by = caller(&r);
        answer(self.plan(r.into_inner(), &by).await)
    }
    async fn list_places(&self, r: Request<v1::ListPlacesRequest>) -> Result<Response<v1::ListPlacesResponse>, Status> {
        let by = caller(&r);
        answer(self.places(r.into_inner(), &by).await)
    }
    async fn clear_place(&self, r: Request<v1::ClearPlaceRequest>) -> Result<Response<v1::ClearPlaceResponse>, Status> {
        let by = caller(&r);
        answer(self.clear(r.into_inner(), &by).await)
    }
    async fn block_place(&self, r: Request<v1::BlockPlaceRequest>) -> Result<Response<v1::BlockPlaceResponse>, Status> {
        let by = caller(&r);
        answer(self.block(r.into_inner(), &by).await)
    }
    async fn unblock_place(
        &self,
        r: Request<v1::UnblockPlaceRequest>,
    ) -> Result<Response<v1::UnblockPlaceResponse>, Status> {
        let by = caller(&r);
        answer(self.unblock(r.into_inner(), &by).await)
    }
    async fn explain_task(
        &self,
        r: Request<v1::ExplainTaskRequest>,
    ) -> Result<Response<v1::ExplainTaskResponse>, Status> {
        let by = caller(&r);
        answer(self.why_task(r.into_inner(), &by).await)
    }
    async fn explain_robot(
        &self,
        r: Request<v1::ExplainRobotRequest>,
    ) -> Result<Response<v1::ExplainRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.why_robot(r.into_inner(), &by).await)
    }
    async fn list_incidents(
        &self,
        r: Request<v1::ListIncidentsRequest>,
    ) -> Result<Response<v1::ListIncidentsResponse>, Status> {
        let by = caller(&r);
        answer(self.incidents(r.into_inner(), &by).await)
    }
    async fn get_incident(
        &self,
        r: Request<v1::GetIncidentRequest>,
    ) -> Result<Response<v1::GetIncidentResponse>, Status> {
        let by = caller(&r);
        let incident = self.incident(r.into_inner().incident_id, &by).await;
        answer(incident.map(|incident| v1::GetIncidentResponse { incident: Some(incident) }))
    }
    async fn close_incident(
        &self,
        r: Request<v1::CloseIncidentRequest>,
    ) -> Result<Response<v1::CloseIncidentResponse>, Status> {
        let by = caller(&r);
        answer(self.close_one(r.into_inner(), &by).await)
    }
    async fn list_counters(
        &self,
        r: Request<v1::ListCountersRequest>,
    ) -> Result<Response<v1::ListCountersResponse>, Status> {
        let by = caller(&r);
        answer(self.counters(r.into_inner(), &by).await)
    }
}
