//! What the body does about stops: slow at once, standing at once, and nothing goes on by itself after.
//!
//! Invariant: nothing here starts the body. What stood goes on only through the rules of work: a fresh heartbeat that
//! was answered, and after a stop that a person has to resume, desired work's own permission. Asked in each step,
//! before anything else moves.

use super::governor;
use super::interface::Output;
use super::state::AgentCore;
use super::work::{Doing, Work};
use crate::body::BodyOrder;
use crate::stop::storage::Loaded;
use crate::stop::{Floor, StopNews, StopOrder, StopState};
use midshift_core::desired_state::DesiredWork;
use midshift_core::ids::{AreaId, StopId};
use midshift_core::robot::{Lane, StopLevel};
use midshift_core::robot_events::RobotEvent;
use midshift_core::stop::Reset;
use midshift_core::stop::ladder::Around;
use midshift_core::time::{LinkTime, Now, SiteDuration, SiteTime};
use midshift_proto::session::{Downlink, StopFacts};

/// A robot that drives while a part of the site is stopped looks this often where it is: 150 mm at its fastest.
const LOOK: SiteDuration = SiteDuration(100);

impl AgentCore {
    /// From now on it has a line to a stop service, and stands until it was told. Call before the first step.
    pub fn obeys_stops(&mut self, loaded: Loaded, now: LinkTime) {
        self.stop = Some(Box::new(StopState::begin(self.config.robot_id.clone(), loaded, now)));
    }

    /// Stops that it keeps and that are effective as far as it knows: what it says first on a line.
    pub fn known_stops(&self) -> impl Iterator<Item = &midshift_core::stop::Stop> {
        self.stop.iter().flat_map(|stop| stop.saved().latch.effective())
    }

    /// The level that it obeys; none without a line.
    pub(crate) fn stop_level(&self) -> StopLevel {
        self.stop.as_ref().map_or(StopLevel::None, |stop| stop.obeyed.level)
    }

    /// It stands by an operational stop or by the silence of the stop service.
    pub(crate) fn is_stopped(&self) -> bool {
        self.stop_level() >= StopLevel::Halt
    }

    pub(crate) fn stops_inside(&self) -> Vec<StopId> {
        self.stop.as_ref().map(|stop| stop.inside()).unwrap_or_default()
    }

    pub(crate) fn stops_awaiting(&self) -> Vec<StopId> {
        self.stop.as_ref().map(|stop| stop.awaiting()).unwrap_or_default()
    }

    pub(crate) fn apply_stop_news(&mut self, now: &Now, mut news: StopNews) {
        if let StopNews::Facts { resets, .. } = &mut news
            && self.config.bugs.reset_clears_all()
            && let Some(reset) = resets.first().cloned()
        {
            let known = self.known_stops().map(|stop| stop.stop_id.clone());
            resets.extend(known.map(|stop_id| Reset { stop_id, ..reset.clone() }));
        }
        if let Some(stop) = &mut self.stop {
            stop.take_news(now.link, news);
        }
    }

    /// What the link says of stops; one that has no stop line obeys none.
    pub(crate) fn apply_stops_of_link(&mut self, now: &Now, down: &Downlink) {
        if let Some(why) = &down.unreadable_stops {
            tracing::error!(robot_id = %self.config.robot_id, why, "stops on the link cannot be read: what is latched stays");
        }
        let Some(facts) = down.stops.clone() else { return };
        if self.config.bugs.reset_clears_all() {
            let StopFacts { stops, resets } = facts;
            self.apply_stop_news(now, StopNews::Facts { stops, resets, generation: 0 });
        } else if let Some(stop) = &mut self.stop {
            stop.merge_link_facts(facts);
        }
    }

    /// It stood, and nothing has let it go on since.
    pub(crate) fn has_stood(&self) -> bool {
        self.stop.as_ref().is_some_and(|stop| stop.has_stood)
    }

    /// It may go on, and what stood it is over.
    pub(crate) fn goes_on(&mut self) {
        if let Some(stop) = &mut self.stop {
            stop.has_stood = false;
        }
    }

    /// What people resumed, as the newest desired work says. Said once, it stays true: a reset may come after it.
    fn resume_stops(&mut self) {
        let is_observed = self.is_observed();
        let says = |desired: &&DesiredWork| !desired.resumed.is_empty() && !is_observed;
        let Some(desired) = self.desired.as_ref().filter(says) else { return };
        if let Some(stop) = &mut self.stop
            && !stop.saved().awaiting.is_empty()
        {
            stop.resumed(&desired.resumed.iter().cloned().collect());
        }
    }

    /// When it must look again, link and site clock.
    pub(crate) fn stop_wakes(&self) -> (Option<LinkTime>, Option<SiteTime>) {
        self.stop.as_ref().map_or((None, None), |stop| (stop.next_at(), stop.look_at))
    }

    /// Looks what it has to obey, and brings the body to it.
    pub(crate) fn obey(&mut self, now: &Now) {
        if self.stop.is_none() {
            return;
        }
        let state = self.body.state(now.site);
        // A body that has not found itself yet knows no pose, and lies inside of everything.
        let pose = state.waypoint.is_some().then_some(state.pose);
        let around = self.around(now);
        self.resume_stops();
        let Some(stop) = &mut self.stop else { return };
        let before = stop.obeyed.level;
        stop.look_around(now, pose.as_ref(), around);
        let (level, bodily) = (stop.obeyed.level, std::mem::replace(&mut stop.bodily, stop.obeyed.level));
        let is_awaiting = !stop.saved().awaiting.is_empty();
        stop.has_stood |= level >= StopLevel::Halt;
        if level != bodily {
            self.body.obeys(now.site, level);
            self.beat_at_once(now);
        }
        if level >= StopLevel::Halt {
            self.resume_needed |= is_awaiting && self.work.is_some();
            self.stand(now, level, level > bodily);
        } else if before >= StopLevel::Halt {
            self.released(now);
        }
        if level == StopLevel::Slow {
            self.slow_down(now);
        }
        self.look_again(now);
        self.tell_stop(now);
    }

    /// It stands where it is. A halt keeps the order under way; a posture drops it, and the step is looked at before it
    /// is begun again.
    fn stand(&mut self, now: &Now, level: StopLevel, is_higher: bool) {
        let doing = self.work.as_ref().map_or(Doing::Nothing, |w| w.doing);
        if level == StopLevel::ControlledStopPosture && is_higher {
            self.body.stop(now.site, level);
            self.drop_order(doing);
            return;
        }
        match doing {
            Doing::Driving | Doing::Acting => {
                if let Some(work) = self.work.as_mut().filter(|w| !w.paused) {
                    work.paused = true;
                    self.body.pause(now.site);
                }
            }
            Doing::Parking if !self.body.standstill(now.site) => {
                self.body.stop(now.site, StopLevel::Halt);
                self.drop_order(doing);
            }
            Doing::Nothing if is_higher && !self.body.standstill(now.site) => self.body.stop(now.site, StopLevel::Halt),
            Doing::Nothing | Doing::Charging | Doing::Parking => {}
        }
    }

    fn drop_order(&mut self, doing: Doing) {
        let Some(work) = self.work.as_mut().filter(|_| !matches!(doing, Doing::Nothing | Doing::Charging)) else {
            return;
        };
        work.doing = Doing::Nothing;
        (work.paused, work.located, work.recheck, work.intent_fresh) = (false, false, true, false);
        work.path.clear();
        self.judge_intent();
    }

    /// Nothing that was said before lets it go on.
    fn released(&mut self, now: &Now) {
        self.echo_after = Some(now.link);
        if let Some((is_held, resume)) = self.desired.as_ref().map(|d| (d.held, d.resume)) {
            self.mind_hold(now, is_held, resume);
        }
    }

    /// The drive under way goes on slowly, whatever has to be written first.
    fn slow_down(&mut self, now: &Now) {
        let most = governor::slowed_mm_s(&self.limits);
        // One that stands gets its path anew before it goes on.
        let drives = |w: &&mut Work| w.doing == Doing::Driving && !w.paused;
        let Some(work) = self.work.as_mut().filter(drives) else { return };
        if work.path.iter().all(|p| p.speed_mm_s <= most) {
            return;
        }
        work.path.iter_mut().for_each(|p| p.speed_mm_s = p.speed_mm_s.min(most));
        let path = BodyOrder::Drive(work.path.clone());
        if let Err(fault) = self.body.start(now.site, path) {
            self.step_failed(now, fault);
        }
    }

    fn look_again(&mut self, now: &Now) {
        let drives = self.is_driving() && !self.body.standstill(now.site);
        let Some(stop) = &mut self.stop else { return };
        let watches = drives && stop.has_parts() && stop.obeyed.level < StopLevel::Halt;
        stop.look_at = watches.then_some(now.site + LOOK);
    }

    /// Says what it obeys as a sample and with the next heartbeat, if that changed.
    fn tell_stop(&mut self, now: &Now) {
        let Some(stop) = &mut self.stop else { return };
        let new = (stop.obeyed.level, stop.inside(), stop.awaiting());
        stop.was_free |= new.0 < StopLevel::Halt;
        let is_start = !stop.was_free && new.1.is_empty() && new.2.is_empty();
        if new == stop.said || is_start {
            return;
        }
        stop.said.clone_from(&new);
        let (level, stops, awaiting_resume) = new;
        tracing::info!(robot_id = %self.config.robot_id, ?level, ?stops, ?awaiting_resume, "obeys stops");
        self.emit(Lane::Critical, RobotEvent::FleetStop { level, stops, awaiting_resume });
        self.beat_at_once(now);
    }

    /// What goes to the stop service and to its file, before everything else.
    pub(crate) fn say_stop(&mut self, now: &Now, out: &mut Vec<Output>) {
        let is_still = self.body.standstill(now.site);
        let orders = self.stop.iter_mut().flat_map(|stop| stop.due_orders(now.link, is_still));
        out.extend(orders.map(|order| match order {
            StopOrder::Save(number, saved) => Output::SaveStops(number, saved),
            StopOrder::Redial(why) => Output::RedialStop(why),
            StopOrder::CheckIn(nonce, check_in) => Output::CheckIn(nonce, check_in),
        }));
    }

    /// Whether people may be around: it knows better only where it knows the area at each end of the lane that it is
    /// on.
    fn around(&mut self, now: &Now) -> Around {
        let at = self.body.state(now.site).waypoint;
        if let Some(areas) = self.areas_here() {
            let floor = Floor { at, heading: self.heading.clone(), areas };
            if let Some(stop) = self.stop.as_mut().filter(|stop| stop.floor != floor) {
                stop.floor = floor;
            }
        } else if let Some(stop) = &mut self.stop
            && (stop.floor.at != at || stop.floor.heading != self.heading)
        {
            stop.floor = Floor::default();
        }
        let policy = &self.memory.ledger.policy;
        let is_without = |area: &AreaId| governor::policy_of(policy, area).is_some_and(|p| p.without_people);
        match self.stop.as_ref().map(|stop| &stop.floor.areas) {
            Some(areas) if !areas.is_empty() && areas.iter().all(is_without) => Around::Robots,
            _ => Around::People,
        }
    }

    /// Areas that it stands or drives in, as its route says. None: its route does not say.
    fn areas_here(&self) -> Option<Vec<AreaId>> {
        let work = self.work.as_ref().filter(|w| w.located)?;
        let route = &work.order.as_ref()?.route;
        let reached = work.reached?;
        let last = reached + usize::from(self.heading.is_some());
        let areas = route.get(reached..=last)?.iter().map(|p| p.area_id.clone());
        Some(areas.collect())
    }
}
