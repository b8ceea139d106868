//! What changes the latch: engaging, taking a lost stop from a robot, resetting.
//!
//! Invariant: a stop goes to all lines before anything waits for the disk; changes reach every line in the order of their generations. What is answered
//! was written and recorded, or says that it was not.

use crate::audit::{Action, MIDSHIFT, Note};
use crate::engaged::{EngagedByRequest, EngagedStops, Resetting};
use crate::frames;
use crate::inner::Inner;
use crate::outbox::Frame;
use crate::threads::lock;
use midshift_core::identity::{Actor, Caller, Permission};
use midshift_core::ids::{RequestId, RobotId, StopId};
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::robot::StopLevel;
use midshift_core::stop::latch::is_past;
use midshift_core::stop::{Reset, Scope, Stop};
use midshift_core::time::{LinkDuration, Now, Utc};
use std::collections::BTreeSet;

/// What somebody wants stopped.
pub struct Wanted {
    /// The robots that it is for.
    pub scope: Scope,
    /// The level that they are to obey.
    pub level: StopLevel,
    /// Why; may be empty.
    pub reason: String,
    /// Protects against a double call, with the hash of the request.
    pub request: Option<(RequestId, String)>,
    /// The actor that asks for it.
    pub actor: Actor,
}

/// A stop that is engaged.
pub struct Engaged {
    /// The stop as the latch has it.
    pub stop: Stop,
    /// What the disk must have had its turn with.
    pub version: u64,
}

/// This service ends, and whoever follows it is about to be there.
pub fn ends() -> Refusal {
    Refusal::new(Kind::Unavailable, Code::ShuttingDown).again_after(LinkDuration(0))
}

/// Asked with `fan` held: what it takes is kept.
///
/// # Errors
/// This service ends: nobody would keep what it took from now on.
pub fn is_open(inner: &Inner) -> Result<(), Refusal> {
    if inner.shutdown.is_cancelled() { Err(ends()) } else { Ok(()) }
}

/// Engages a stop and tells all lines.
///
/// # Errors
/// No such part of the site; no room; the request was another one, or its stop was reset; this service ends. Nothing is engaged then.
pub fn engage(inner: &Inner, wanted: Wanted) -> Result<Engaged, Refusal> {
    let region = inner.site_index.region(&wanted.scope)?;
    let now = inner.clock.now();
    let fan = lock(&inner.fan);
    is_open(inner)?;
    let mut engaged_stops = lock(&inner.engaged_stops);
    if let Some(engaged) = before(&engaged_stops, &wanted)? {
        return Ok(engaged);
    }
    engaged_stops.room(&wanted.scope, wanted.level)?;
    let (actor, token_id, reason) = (wanted.actor.to_string(), wanted.actor.token().cloned(), wanted.reason);
    let bare = Stop::new(engaged_stops.draw(now.wall), wanted.scope, wanted.level, now.wall);
    let mut stop = Stop { actor, reason, region, token_id, ..bare };
    inner.key.mark(&mut stop);
    let request_id = wanted.request.as_ref().map(|(id, _)| id.to_string());
    let request =
        wanted.request.map(|(id, hash)| (id, EngagedByRequest { stop_id: stop.stop_id.clone(), hash, at: now.wall }));
    let generation = engaged_stops.engage(stop.clone(), request);
    let version = engaged_stops.version();
    let note = note(Action::Engaged, &stop, now.wall);
    inner.disk.note(request_id.iter().fold(note, |note, id| note.with("request_id", id)));
    drop(engaged_stops);
    let told = generation.map_or(0, |generation| tell_lines(inner, &stop, generation, &now));
    drop(fan);
    inner.disk.wake();
    inner.touch();
    metrics::counter!("midshift_stop_engaged_total").increment(1);
    tracing::warn!(stop_id = %stop.stop_id, level = ?stop.level, told, "stop engaged");
    Ok(Engaged { stop, version })
}

/// What the same request engaged before.
fn before(engaged_stops: &EngagedStops, wanted: &Wanted) -> Result<Option<Engaged>, Refusal> {
    let Some((request_id, hash)) = &wanted.request else { return Ok(None) };
    let Some(engaged) = engaged_stops.engaged_by(request_id) else { return Ok(None) };
    if engaged.hash != *hash {
        let text = "this request_id engaged another stop; nothing more was stopped";
        let reason = Reason::new(Code::RequestIdReused, text).with("stop_id", &engaged.stop_id);
        return Err(Refusal::new(Kind::AlreadyExists, reason));
    }
    match engaged_stops.latch().stop(&engaged.stop_id).filter(|stop| engaged_stops.latch().is_effective(&stop.stop_id))
    {
        Some(stop) => Ok(Some(Engaged { stop: stop.clone(), version: engaged_stops.version() })),
        None => Err(was_reset(&engaged.stop_id)),
    }
}

/// Nobody obeys it any more.
pub fn was_reset(stop_id: &StopId) -> Refusal {
    Refusal::new(Kind::Precondition, Reason::from(Code::StopWasReset).with("stop_id", stop_id))
}

/// Takes stops of the service's own making, which it has lost, from a robot. The others come back, and those of which it brings the name alone: they are only shown.
pub fn adopt(inner: &Inner, robot_id: &RobotId, stops: Vec<Stop>, more: Vec<StopId>) -> BTreeSet<StopId> {
    let now = inner.clock.now();
    let mut foreign: BTreeSet<StopId> = more.into_iter().collect();
    let mut is_lost = Vec::new();
    let forgotten = {
        let engaged_stops = lock(&inner.engaged_stops);
        foreign.retain(|stop_id| engaged_stops.latch().stop(stop_id).is_none());
        for stop in stops {
            let latch = engaged_stops.latch();
            if latch.stop(&stop.stop_id).is_none() && latch.reset_of(&stop.stop_id).is_none() {
                is_lost.push(stop);
            }
        }
        engaged_stops.latch().forgotten()
    };
    // Outside of the lock: a signature takes its time.
    // What is not newer than what was forgotten may have been reset: it stops the robot that brings it, and nobody else.
    let is_young = |stop: &Stop| stop.engaged_unix_ms > forgotten && !is_past(stop.engaged_unix_ms, now.wall);
    let (own, others): (Vec<Stop>, Vec<Stop>) =
        is_lost.into_iter().partition(|stop| is_young(stop) && inner.key.knows(stop));
    foreign.extend(others.into_iter().map(|stop| stop.stop_id));
    foreign.extend(take_back(inner, own, ("robot_id", robot_id.as_str())));
    foreign
}

/// Takes stops that the store has as engaged and this service has lost. They were copied from here, so that they need no mark; whoever writes them writes who is known too.
pub fn take_copied(inner: &Inner, stops: Vec<Stop>) {
    for stop_id in take_back(inner, stops, ("from", "store")) {
        tracing::error!(%stop_id, "there is no room for a stop that the store has as engaged");
    }
}

/// Engages again what is not known here, neither it nor its reset, and tells all lines. Those for which there is no room, or no time left, come back.
fn take_back(inner: &Inner, stops: Vec<Stop>, from: (&str, &str)) -> Vec<StopId> {
    let now = inner.clock.now();
    let _fan = lock(&inner.fan);
    if is_open(inner).is_err() {
        return stops.into_iter().map(|stop| stop.stop_id).collect();
    }
    let (mut left, mut adopted) = (Vec::new(), 0);
    for stop in stops {
        let mut engaged_stops = lock(&inner.engaged_stops);
        if engaged_stops.latch().reset_of(&stop.stop_id).is_some() || engaged_stops.is_resetting(&stop.stop_id) {
            continue;
        }
        let is_known = engaged_stops.latch().stop(&stop.stop_id).is_some();
        if !is_known && engaged_stops.room(&stop.scope, stop.level).is_err() {
            left.push(stop.stop_id);
            continue;
        }
        let Some(generation) = engaged_stops.engage(stop.clone(), None) else { continue };
        let engaged = note(Action::Adopted, &stop, now.wall).with("engaged_by", &stop.actor);
        inner.disk.note(Note { actor: MIDSHIFT.to_owned(), ..engaged.with(from.0, from.1) });
        drop(engaged_stops);
        tell_lines(inner, &stop, generation, &now);
        adopted += 1;
        metrics::counter!("midshift_stop_adopted_total").increment(1);
        tracing::warn!(stop_id = %stop.stop_id, from = from.1, "a lost stop was taken back");
    }
    if adopted > 0 {
        inner.disk.wake();
        inner.touch();
    }
    left
}

/// Notes a reset. It counts after the disk's turn, see [`settle`].
///
/// # Errors
/// Whoever asks may not reset where the stop is. One that is not known may be anywhere. Or this service ends.
pub fn reset(inner: &Inner, stop_id: StopId, reason: String, by: &Caller) -> Result<Resetting, Refusal> {
    let now = inner.clock.now();
    let fan = lock(&inner.fan);
    is_open(inner)?;
    let mut engaged_stops = lock(&inner.engaged_stops);
    let areas =
        engaged_stops.latch().stop(&stop_id).map(|stop| inner.site_index.areas(&stop.scope)).unwrap_or_default();
    if let Err(refusal) = by.authorize(Permission::Reset, &areas) {
        let note = Note::by_actor(now.wall, Action::Denied, &by.into());
        let note = note.with("code", refusal.reason.code).with("asked", "stop.reset").with("stop_id", stop_id);
        inner.disk.denied(note, 0);
        return Err(refusal);
    }
    let by = Actor::from(by);
    let (actor, token_id) = (by.to_string(), by.token().cloned());
    let mut reset = Reset { actor, reason, token_id, ..Reset::new(stop_id, now.wall) };
    inner.key.mark_reset(&mut reset);
    let resetting = engaged_stops.reset(reset);
    if resetting.is_new {
        let Reset { stop_id, reason, .. } = &resetting.reset;
        let note = Note::by_actor(now.wall, Action::Reset, &by);
        inner
            .disk
            .note(note.with("stop_id", stop_id).with("reason", reason).with("was_engaged", resetting.was_engaged));
    }
    drop((engaged_stops, fan));
    inner.disk.wake();
    Ok(resetting)
}

/// The disk had its turn with all up to `version`, or is not waited for any longer: resets among them count now, and all lines hear so.
pub fn settle(inner: &Inner, version: u64) {
    let now = inner.clock.now();
    let fan = lock(&inner.fan);
    let settled = lock(&inner.engaged_stops).settle(version, now.wall);
    if settled.is_empty() {
        return;
    }
    for (reset, generation) in settled {
        for bytes in frames::encode_changes([], [&reset], generation) {
            let resets = [reset.stop_id.clone()].into();
            inner.robots.tell_lines(&Frame { generation, bytes, resets }, now.link);
        }
        metrics::counter!("midshift_stop_reset_total").increment(1);
        tracing::warn!(stop_id = %reset.stop_id, "stop reset");
    }
    drop(fan);
    inner.touch();
}

fn tell_lines(inner: &Inner, stop: &Stop, generation: u64, now: &Now) -> usize {
    let told = frames::encode_changes([stop], [], generation).into_iter();
    told.map(|bytes| inner.robots.tell_lines(&Frame { generation, bytes, resets: [].into() }, now.link)).sum()
}

fn note(action: Action, stop: &Stop, at: Utc) -> Note {
    let Stop { stop_id, scope, level, reason, .. } = stop;
    let note = Note::by_actor(at, action, &Actor::new(&stop.actor, stop.token_id.clone()));
    note.with("stop_id", stop_id).with("scope", scope).with("level", format!("{level:?}")).with("reason", reason)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Parts, StopService};
    use midshift_core::time::ScaledClock;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
    use tokio_util::sync::CancellationToken;

    #[test]
    fn a_stop_that_may_have_been_reset_and_forgotten_is_not_taken_back_from_a_robot() {
        let (folder, us) = (tempfile::tempdir().unwrap(), Arc::<AtomicU64>::default());
        let mono = us.clone();
        let clock = Arc::new(ScaledClock::new(move || mono.load(Relaxed), Utc(1_780_000_000_000), 1000));
        let parts = Parts { folder: folder.path().join("stop"), site: None, clock };
        let inner = StopService::open(parts, CancellationToken::new()).unwrap().inner;
        let stop_and_reset = || {
            us.fetch_add(1_000_000, Relaxed);
            let (scope, level) = (Scope::Fleet, StopLevel::Halt);
            let wanted = Wanted { scope, level, reason: String::new(), request: None, actor: "anna".into() };
            let stop = engage(&inner, wanted).unwrap().stop;
            let resetting = reset(&inner, stop.stop_id.clone(), "over".to_owned(), &Caller::local());
            lock(&inner.engaged_stops).settle(resetting.unwrap().version, inner.clock.now().wall);
            stop
        };
        let (old, newer) = (stop_and_reset(), stop_and_reset());
        lock(&inner.engaged_stops).shorten(inner.clock.now().wall);
        assert!(lock(&inner.engaged_stops).latch().stop(&old.stop_id).is_none(), "it is forgotten with its reset");
        let lost_id = StopId::parse("STOP-LATER").unwrap();
        let mut lost = Stop::new(lost_id.clone(), Scope::Fleet, StopLevel::Halt, newer.engaged_unix_ms);
        inner.key.mark(&mut lost);
        let robot_id = RobotId::parse("r1").unwrap();
        let foreign = adopt(&inner, &robot_id, vec![old.clone(), lost], Vec::new());
        assert_eq!(foreign, [old.stop_id.clone()].into(), "it is shown, and stops nobody else");
        let engaged_stops = lock(&inner.engaged_stops);
        assert!(!engaged_stops.latch().is_effective(&old.stop_id) && engaged_stops.latch().is_effective(&lost_id));
    }
}
