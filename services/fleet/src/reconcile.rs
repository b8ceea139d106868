//! The loop: take what is new, decide, commit (`commit`), publish. A conflict means that somebody else decided too: the projection is built again.
//! Each turn is a slice of some milliseconds; between two, people are answered. A turn takes a few requests *and* a sweep that is due: neither
//! keeps the other waiting.
//! Of several processes on one store one leads and does all that; the others keep their projection by rows alone (`standby`).
//!
//! Invariant: the view has absorbed the feed up to a head of it before anything is planned on it, never a part of a commit; only a process that leads plans, and one that could not
//! say so for a while reads the rows again before it does.

use crate::figures::Figures;
use crate::requests::{Look, MapOutdated, Parts, PendingCommand, Request};
use midshift_core::fleet::projection::{self, FleetProjection};
use midshift_core::fleet::{
    Board, LOGS, Pace, Plan, Slice, absorb, commands, cycle, ensure_site_rows, explain, maps, objects,
};
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::idempotency;
use midshift_core::identity::Actor;
use midshift_core::leadership::{FleetLeader, LeaderLease, LeaseAction, OwnEntries};
use midshift_core::limits;
use midshift_core::projection::entries_of;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{Key, Log, Seq, Table};
use midshift_core::time::Now;
use midshift_store::{Dirty, Error, FeedPage, Store, leadership};
use std::ops::Range;
use std::sync::OnceLock;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// Pause after the store failed, before everything is read again.
const STORE_RETRY: Duration = Duration::from_millis(200);
/// Entries that are absorbed before it is asked again whether the slice is spent.
const ENTRIES_AT_ONCE: usize = 16;
/// Timers are no finer than this, so a shorter turn needs no rest.
const TIMER_GRAIN: Duration = Duration::from_millis(1);

pub(crate) struct Loop {
    pub(crate) parts: Parts,
    pub(crate) view: FleetProjection,
    pub(crate) seq: Seq,
    pub(crate) board: Board,
    dirty: Dirty<NewestHeartbeat>,
    started: Now,
    /// Until then what others write gathers: thinking takes half of the time at most.
    rested: Instant,
    /// Up to where others' heartbeats are on the board that was taken last.
    heard_up_to: u64,
    /// Questions that are answered once what they would see is committed.
    pub(crate) looks: Vec<Look>,
    /// Whether this process leads.
    pub(crate) lease: LeaderLease<FleetLeader>,
    /// What this process wrote and has not read again.
    pub(crate) own: OwnEntries,
    /// When the next sweep is due.
    sweep_due: Instant,
    /// Head of the feed up to which this process reads before it plans; none: it has read it.
    pub(crate) behind: Option<Seq>,
    /// Others have written what no plan has seen.
    pub(crate) news: bool,
    /// A stage of the last turn was cut.
    more: bool,
    /// Decisions of a stage, so that a turn takes no longer than it may.
    share: usize,
    /// Commands that the next turn decides anew.
    pub(crate) again: Vec<Request>,
    /// Text of the map that was stored when this process began.
    at_start: OnceLock<Option<String>>,
    /// What is published of the shift.
    pub(crate) figures: Figures,
    /// Why this process must not plan on its map; then it ends.
    outdated: Option<MapOutdated>,
}

/// Commands, and the items of a plan that must be committed before each is answered.
pub(crate) type Replies = Vec<(Box<PendingCommand>, Range<usize>)>;

/// Runs until `shutdown`.
pub async fn run(
    parts: Parts,
    mut requests: mpsc::Receiver<Request>,
    shutdown: CancellationToken,
) -> Result<(), MapOutdated> {
    let mut wake = parts.store.wake();
    let started = parts.clock.now();
    let dirty = parts.board.watch();
    let view = FleetProjection::new(parts.site.clone(), started, started);
    // A store of one process is its process' alone; and a simulation's, whose runs must be the same again.
    let me = match parts.store.is_shared() {
        true => format!("{:032x}", rand::random::<u128>()),
        false => format!("alone-{}", parts.clock.now().wall.0),
    };
    let lease = LeaderLease::new(me, midshift_core::fleet::contenders(parts.store.is_shared(), parts.bugs));
    metrics::gauge!("midshift_fleet_leads").set(0);
    let mut this = Loop {
        parts,
        view,
        seq: Seq(0),
        board: Board::new(),
        dirty,
        started,
        rested: Instant::now(),
        heard_up_to: 0,
        looks: Vec::new(),
        lease,
        own: OwnEntries::default(),
        sweep_due: Instant::now(),
        behind: None,
        news: false,
        more: false,
        share: limits::DECISIONS_PER_STAGE,
        again: Vec::new(),
        at_start: OnceLock::new(),
        figures: Figures::default(),
        outdated: None,
    };
    this.rebuild_until_read(&shutdown).await;
    let mut batch = Vec::new();
    while this.outdated.is_none() {
        // Questions that wait for their turn leave others less room.
        let room = limits::REQUESTS_PER_TURN.saturating_sub(this.looks.len());
        tokio::select! {
            biased;
            () = shutdown.cancelled() => break,
            n = requests.recv_many(&mut batch, room), if room > 0 => if n == 0 { break },
            () = tokio::time::sleep_until(this.sweep_due) => {}
            () = tokio::task::yield_now(), if this.is_not_done() => {}
            changed = news(&mut wake, this.rested) => if changed.is_err() { break },
        }
        while batch.len() < room
            && let Ok(request) = requests.try_recv()
        {
            batch.push(request);
        }
        let pace = if Instant::now() >= this.sweep_due { Pace::Sweep } else { Pace::Wake };
        if this.turn(pace, std::mem::take(&mut batch)).await.is_err() {
            tokio::time::sleep(STORE_RETRY).await;
            this.rebuild_until_read(&shutdown).await;
            // What was read is committed, so whoever asked needs not wait until the store takes something again.
            this.answer(this.parts.clock.now());
        }
    }
    this.release_lease().await;
    this.outdated.map_or(Ok(()), Err)
}

/// Something was written, and it is time to look.
async fn news(wake: &mut watch::Receiver<Seq>, rested: Instant) -> Result<(), watch::error::RecvError> {
    tokio::time::sleep_until(rested).await;
    wake.changed().await
}

/// Entries of the feed that come next. A cursor that never read anything begins at the oldest entry that is kept.
async fn page_after(store: &dyn Store, cursor: &mut Seq) -> Result<FeedPage, Error> {
    match store.feed(*cursor, LOGS, limits::ENTRIES_PER_TURN).await {
        Err(Error::CursorExpired { asked, oldest }) if asked < oldest && *cursor == Seq(0) => {
            *cursor = oldest;
            store.feed(oldest, LOGS, limits::ENTRIES_PER_TURN).await
        }
        page => page,
    }
}

fn leads_no_more(figures: &mut Figures) {
    metrics::gauge!("midshift_fleet_leads").set(0);
    figures.leave();
    tracing::info!("this process does not lead fleet any more");
}

impl Loop {
    async fn rebuild_until_read(&mut self, shutdown: &CancellationToken) {
        while let Err(error) = self.rebuild().await {
            tracing::warn!(%error, "fleet cannot read the store, trying again");
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(STORE_RETRY) => {}
            }
        }
    }

    /// The last turn has left something for the next one, which comes at once.
    fn is_not_done(&self) -> bool {
        self.more || self.behind.is_some() || !self.again.is_empty() || !self.looks.is_empty()
    }

    /// Reads who leads, and takes over if nobody does.
    async fn claim_if_free(&mut self) -> Result<(), Error> {
        let led = self.lease.leads();
        let began =
            leadership::claim_if_free(&mut self.lease, self.parts.store.as_ref(), self.parts.clock.as_ref()).await;
        if led && !self.lease.leads() {
            leads_no_more(&mut self.figures);
        }
        if began? {
            self.begin_to_lead();
        }
        Ok(())
    }

    /// As after a start: every lease counts as renewed now, no timer fires soon, and nothing is remembered.
    fn begin_to_lead(&mut self) {
        self.started = self.parts.clock.now();
        let router = self.view.router.clone();
        self.view =
            FleetProjection { router, ..FleetProjection::new(self.parts.site.clone(), self.started, self.started) };
        metrics::gauge!("midshift_fleet_leads").set(1);
        metrics::counter!("midshift_fleet_takeovers_total").increment(1);
        tracing::info!("this process leads fleet");
    }

    /// Lets another process lead at once, if this one does.
    async fn release_lease(&mut self) {
        let Some(is_said) = leadership::release_lease(&mut self.lease, self.parts.store.as_ref()).await else { return };
        if !is_said {
            tracing::warn!("another process will lead fleet only after a while: this one could not say that it ends");
        }
        leads_no_more(&mut self.figures);
    }

    /// Builds the projection from nothing and takes what was not consumed yet. A process that leads makes sure that it may plan on its map.
    pub(crate) async fn rebuild(&mut self) -> Result<(), Error> {
        self.claim_if_free().await?;
        self.own.clear();
        let Self { lease, parts, .. } = self;
        let alive = projection::alive();
        let reading = parts.store.read(&alive, projection::named);
        let snapshot = leadership::renew_while(lease, parts.store.as_ref(), parts.clock.as_ref(), reading).await?;
        let now = self.parts.clock.now();
        let served = self.view.serving(&now);
        let mut next = FleetProjection::new(self.parts.site.clone(), self.started, now);
        next.bugs = self.parts.bugs;
        next.carry_over(&mut self.view);
        next.unknown_rows.carry_requests(&mut self.view.unknown_rows);
        self.view = next;
        self.view.load(&snapshot.rows, snapshot.seq)?;
        // The row is as old as the last commit; this process has served on since.
        self.view.served.site_ms = self.view.served.site_ms.max(served.site_ms);
        self.view.served.link_ms = self.view.served.link_ms.max(served.link_ms);
        self.seq = self.view.marks.get("fleet").map_or(Seq(0), |m| m.row.seq).min(snapshot.seq);
        (self.behind, self.news, self.more) = (None, true, false);
        metrics::counter!("midshift_fleet_rebuilds_total").increment(1);
        let stored = self.view.sites.get(self.parts.site.site_id().as_str()).map(|s| &s.row.text);
        let at_start = self.at_start.get_or_init(|| stored.cloned());
        let Parts { site_text, map, .. } = &self.parts;
        if self.lease.leads() {
            self.outdated = maps::outdated(&self.view, site_text, at_start.as_deref(), map).map(MapOutdated);
        }
        if !self.lease.leads() || self.outdated.is_some() {
            self.seq = snapshot.seq;
            self.view.rest();
            return Ok(());
        }
        let mut plan = Plan::default();
        ensure_site_rows(&mut self.view, self.parts.clock.now(), &self.parts.site_text, &self.parts.map, &mut plan);
        let entries: Vec<u64> = plan.items.iter().map(entries_of).collect();
        for (result, entries) in self.parts.store.commit(plan.items).await.into_iter().zip(entries) {
            let applied = result.map_err(|error| Error::Unavailable(std::sync::Arc::new(error)))?;
            self.own.wrote(applied.seq.0, entries);
        }
        Ok(())
    }

    /// One turn. An error: the projection can no longer be trusted.
    async fn turn(&mut self, pace: Pace, requests: Vec<Request>) -> Result<(), ()> {
        let again = std::mem::take(&mut self.again);
        let requests = again.into_iter().chain(requests).collect();
        self.read_board();
        let unreadable = |error| tracing::warn!(%error, "fleet cannot read the store");
        // What the clock says comes first: a process that was away decides nothing before it has read who leads.
        if self.lease.next_action(self.parts.clock.now().link) == LeaseAction::StepDown {
            self.rebuild().await.map_err(unreadable)?;
        }
        if !self.lease.leads() {
            self.sweep_due = Instant::now() + Duration::from_millis(limits::SWEEP.as_ms());
            (self.behind, self.more) = (None, false);
            let begun = Instant::now();
            self.follow_rows().await.map_err(unreadable)?;
            self.rest_after(begun.elapsed());
            if self.lease.next_action(self.parts.clock.now().link) == LeaseAction::TakeOver {
                self.rebuild().await.map_err(unreadable)?;
            }
        }
        if self.outdated.is_some() {
            // Whoever asked hears that this process ends.
            return Ok(());
        }
        if self.lease.leads() { self.lead(pace, requests).await } else { self.assist(requests).await }
    }

    fn rest_after(&mut self, took: Duration) {
        if took >= TIMER_GRAIN {
            self.rested = Instant::now() + took;
        }
    }

    /// Takes what robots said since.
    fn read_board(&mut self) {
        // Before the board is taken: what is read into it meanwhile may be known, or not.
        self.heard_up_to = self.parts.board.read_up_to();
        for (robot_id, live) in self.dirty.take_changed() {
            match live {
                Some(live) => self.board.insert(robot_id, live),
                None => self.board.remove(&robot_id),
            };
        }
    }

    /// One turn of the process that plans.
    async fn lead(&mut self, pace: Pace, requests: Vec<Request>) -> Result<(), ()> {
        let begun = Instant::now();
        let now = self.parts.clock.now();
        // People come first: what is planned beside a command is the least that goes on.
        let has_command = requests.iter().any(|request| matches!(request, Request::Do(_)));
        let share = if has_command { limits::DECISIONS_PER_STAGE_MIN } else { self.share };
        let mut plan = Plan::for_slice(Slice::for_decisions(share));
        self.take_feed(now, &mut plan).await.map_err(|error| tracing::warn!(%error, "fleet cannot read the feed"))?;
        let unread = |error| tracing::warn!(%error, "fleet cannot read what is over");
        self.load_wanted_rows(used_ids(&requests)).await.map_err(unread)?;
        let renewal = match self.lease.next_action(now.link) {
            LeaseAction::StepDown => {
                // What was planned a moment ago is dropped, and with it the projection that holds it.
                self.rebuild().await.map_err(|error| tracing::warn!(%error, "fleet cannot read the store"))?;
                return self.assist(requests).await;
            }
            LeaseAction::Renew => Some(self.lease.claim()),
            LeaseAction::Lead | LeaseAction::StandBy | LeaseAction::TakeOver => None,
        };
        let replies = self.take_requests(requests, now, &mut plan);
        let is_due = self.news || self.more || !replies.is_empty() || pace == Pace::Sweep;
        if is_due && self.behind.is_none() {
            plan.slice.renew();
            cycle(&mut self.view, now, &self.board, pace, &mut plan);
            (self.news, self.more) = (false, plan.report.more);
            if pace == Pace::Sweep {
                self.sweep_due = Instant::now() + Duration::from_millis(limits::SWEEP.as_ms());
            }
        }
        let took = begun.elapsed();
        self.rest_after(took);
        metrics::histogram!("midshift_fleet_cycle_seconds").record(took.as_secs_f64());
        publish(&plan, pace);
        if pace == Pace::Sweep {
            self.figures.publish(&self.view, &self.board, &now);
        }
        self.figures.ended = std::mem::take(&mut plan.report.ended);
        if let Some(generation) = self.view.behind.take() {
            // Restored from a copy: its numbers go on above everything a robot may have seen of it.
            match self.parts.store.raise_head(Seq(generation)).await {
                Ok(head) => tracing::warn!(
                    generation,
                    head = head.0,
                    "the store is older than a robot; its numbers go on higher"
                ),
                Err(error) => tracing::error!(%error, generation, "the store's numbers could not be raised"),
            }
        }
        for silent in plan.items.iter_mut().filter_map(|item| item.silent.as_mut()) {
            silent.position = self.heard_up_to;
        }
        let is_cut = self.more;
        let is_doubted = self.parts.bugs.fenced_reports_rebuild() && plan.report.tally.fenced > 0;
        self.renew_and_commit(renewal, now, plan, replies).await?;
        if is_doubted {
            return Err(());
        }
        if !has_command {
            self.fit(begun.elapsed(), is_cut);
        }
        self.answer(now);
        Ok(())
    }

    /// Gives the next turn less to do if this one took too long, and more if it was cut early.
    fn fit(&mut self, took: Duration, is_cut: bool) {
        metrics::histogram!("midshift_fleet_turn_seconds").record(took.as_secs_f64());
        let most = Duration::from_millis(limits::TURN.as_ms());
        let share = match (took > most, is_cut && took < most / 2) {
            (true, _) => self.share / 2,
            (false, true) => self.share + self.share / 4,
            (false, false) => self.share,
        };
        self.share = share.clamp(limits::DECISIONS_PER_STAGE_MIN, limits::DECISIONS_PER_STAGE);
    }

    /// Answers as many questions as a turn has time for from the projection, which holds only what is committed at this moment. What it finds of
    /// robots on the way serves all of them.
    pub(crate) fn answer(&mut self, now: Now) {
        self.view.screened.take();
        let some = self.looks.len().min(explain::per_turn(self.view.sessions.len()));
        for look in self.looks.drain(..some) {
            look(&self.view, &self.board, &now);
        }
    }

    /// Absorbs a slice of the feed, on the way to the head that it had when this way began: a head is never inside of a commit. Who leads is no
    /// news for a plan.
    async fn take_feed(&mut self, now: Now, plan: &mut Plan) -> Result<(), Error> {
        let page = page_after(self.parts.store.as_ref(), &mut self.seq).await?;
        let goal = self.behind.unwrap_or(page.head);
        let clock = self.parts.clock.clone();
        let mut next = page.next.min(goal);
        let entries = page.entries.partition_point(|entry| entry.seq <= goal);
        for some in page.entries[..entries].chunks(ENTRIES_AT_ONCE) {
            for entry in some {
                let is_lease = matches!(entry.table, Some(Table::FleetLeader | Table::OtaLeader));
                let is_own = entry.log == Log::Fleet && self.own.is_own(entry.seq.0);
                self.news |= !is_lease && !is_own;
            }
            self.lease.follow(some, clock.now().link)?;
            absorb(&mut self.view, now, &self.board, some, plan);
            if let Some(last) = some.last().filter(|_| plan.slice.is_spent()) {
                next = last.seq.min(next);
                break;
            }
        }
        self.seq = next;
        self.behind = (next < goal).then_some(goal);
        Ok(())
    }

    /// Reads by id what the projection wants to know of what is over, and these rows too.
    pub(crate) async fn load_wanted_rows(&mut self, mut keys: Vec<Key>) -> Result<(), Error> {
        keys.extend(self.view.wanted());
        if keys.is_empty() {
            return Ok(());
        }
        let rows = self.parts.store.get(keys.clone()).await?;
        Ok(self.view.apply_rows(&keys, &rows)?)
    }

    fn take_requests(&mut self, requests: Vec<Request>, now: Now, plan: &mut Plan) -> Replies {
        let mut replies = Vec::new();
        for request in requests {
            match request {
                Request::Look(look) => self.looks.push(look),
                Request::Do(asked) => {
                    let PendingCommand { command, seen, validate_only, by, request_id, .. } = &*asked;
                    let permitted = objects::permit(&self.view, &self.board, by, command);
                    let repeat = permitted.and_then(|()| match request_id {
                        Some(id) => idempotency::is_repeat(&self.view.command_keys, id, command, *seen),
                        None => Ok(false),
                    });
                    let actor = Actor::from(by);
                    let is_repeat = matches!(repeat, Ok(true));
                    let check = || commands::check(&self.view, &self.board, &now, command, *seen);
                    let checked = repeat.and_then(|known| if known { Ok(()) } else { check() });
                    if let (Err(refusal), false) = (&checked, *validate_only) {
                        let request_id = request_id.as_deref();
                        plan.items.extend(commands::refusal(&self.view, command, by, request_id, refusal));
                    }
                    if checked.is_err() || *validate_only {
                        drop(asked.reply.send(checked));
                        continue;
                    }
                    // What was asked before is in the store, or in an item before this one.
                    let before = plan.items.len();
                    if is_repeat {
                        replies.push((asked, 0..before));
                        continue;
                    }
                    let mut tx =
                        midshift_core::fleet::Tx::new(&mut self.view, now, &actor).on_request(request_id.as_deref());
                    commands::apply(&mut tx, &self.board, command, actor.name());
                    if let Some(id) = request_id {
                        idempotency::remember(&mut tx, id, command, *seen);
                    }
                    let unknown = tx.unknown_row();
                    if plan.keep_decision(tx) {
                        let after = plan.items.len();
                        // What changes nothing rests on what came before it.
                        replies.push((asked, if after > before { before..after } else { 0..after }));
                    } else {
                        let aside = || Refusal::new(Kind::Exhausted, Code::DecisionPutAside);
                        let refusal = unknown.map_or_else(aside, |why| Refusal::new(Kind::Precondition, why));
                        drop(asked.reply.send(Err(refusal)));
                    }
                }
            }
        }
        replies
    }
}

/// Rows that say whether a command with a request_id was carried out before.
fn used_ids(requests: &[Request]) -> Vec<Key> {
    let ids = requests.iter().filter_map(|request| match request {
        Request::Do(asked) => asked.request_id.as_ref(),
        Request::Look(_) => None,
    });
    ids.map(|id| Key::new(Table::CommandKey, id)).collect()
}

/// Counts of a turn as metrics; nothing of it goes through the store.
fn publish(plan: &Plan, pace: Pace) {
    let report = &plan.report;
    metrics::counter!("midshift_fleet_offers_total").increment(report.offers);
    metrics::counter!("midshift_fleet_errands_total").increment(report.errands);
    metrics::counter!("midshift_fleet_fenced_reports_total").increment(report.tally.fenced);
    metrics::counter!("midshift_fleet_stale_authority_total").increment(report.tally.stale_authority);
    metrics::counter!("midshift_fleet_repairs_total").increment(report.tally.repaired);
    metrics::counter!("midshift_fleet_unexplained_total").increment(report.unexplained.len() as u64);
    for what in &report.unexplained {
        tracing::error!(what, "nobody can say why this does not move on");
    }
    for text in &report.unreadable {
        tracing::error!(text, "fleet passed over something it cannot read");
    }
    if pace == Pace::Sweep {
        metrics::gauge!("midshift_fleet_robots_waiting_for_place").set(report.tally.waiting_for_place as f64);
    }
}
