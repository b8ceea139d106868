//! The loop: take what is new, decide, sign, commit. A conflict means that somebody else decided too: the projection is
//! built again. Of several processes on one store one leads and does all that; the others keep their projection by rows
//! alone (`standby`).
//!
//! Invariant: the view has absorbed the whole feed before anything is decided on it; only a process that leads plans,
//! takes releases and signs, and one that could not say so for a while reads the rows again before it does.

use super::directives::Signer;
use super::releases;
use super::requests::{PendingCommand, Question, Request};
use crate::collect::NamedBundles;
use crate::service::OtaService;
use midshift_core::Boxed;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::RobotId;
use midshift_core::item::Item;
use midshift_core::leadership::{LeaderLease, LeaseAction, OtaLeader, OwnEntries};
use midshift_core::limits;
use midshift_core::projection;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rollout::bugs::Bugs;
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::requests::{CheckOnly, CommandOutcome};
use midshift_core::rollout::retention::needed_bundles;
use midshift_core::rollout::{Board, LOGS, Plan, Sign, absorb, cycle, decide_request, ended, obeyed, tell_damaged};
use midshift_core::rows::{Entry, Log, Seq, Table};
use midshift_core::site::Site;
use midshift_core::time::{Clock, Now};
use midshift_store::leadership::{self, GroupOutcome};
use midshift_store::{Applied, CommitError, Dirty, Error, LiveBoard, Store, follow};
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

/// Pause after the store failed, before everything is read again.
const STORE_RETRY: Duration = Duration::from_millis(200);
/// Requests taken into one cycle.
const REQUESTS_PER_CYCLE: usize = 64;

/// What the service is built from.
pub struct Parts {
    /// The memory that services share.
    pub store: Arc<dyn Store>,
    /// Newest heartbeats, written by telemetry.
    pub board: Arc<LiveBoard<NewestHeartbeat>>,
    /// The site.
    pub site: Arc<Site>,
    /// Where the time of the wall, the link and the site is read.
    pub clock: Arc<dyn Clock>,
    /// Releases and keys.
    pub ota: OtaService,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
}

/// The part that runs.
pub struct Planner {
    pub(super) parts: Parts,
    pub(super) requests: mpsc::Receiver<Request>,
    pub(super) changed: watch::Sender<Seq>,
}

pub(super) struct Loop {
    pub(super) parts: Parts,
    pub(super) view: RolloutProjection,
    pub(super) seq: Seq,
    pub(super) board: Board,
    dirty: Dirty<NewestHeartbeat>,
    /// Robots with a heartbeat that no plan has seen.
    heard: BTreeSet<RobotId>,
    started: Now,
    pub(super) changed: watch::Sender<Seq>,
    /// Serving time at which it is said next which bundles are needed, milliseconds.
    say_at_ms: u64,
    /// Questions that are answered once what they would see is committed.
    pub(super) questions: Vec<Question>,
    /// Whether this process leads.
    pub(super) lease: LeaderLease<OtaLeader>,
    /// What this process wrote and has not read again.
    own: OwnEntries,
    /// Commands that the next turn decides anew.
    again: Vec<Request>,
}

/// Commands, what is answered, and the items of a plan that must be committed before.
type Replies = Vec<(Box<PendingCommand>, CommandOutcome, Range<usize>)>;

impl Planner {
    /// Runs until `shutdown`. On a server without keys it only waits: nothing can be signed.
    ///
    /// # Errors
    /// Never by itself; the caller's services end alike.
    pub fn run(self, shutdown: CancellationToken) -> Boxed<'static, Result<(), Error>> {
        Box::pin(run(self, shutdown))
    }
}

/// Runs until `shutdown`.
async fn run(planner: Planner, shutdown: CancellationToken) -> Result<(), Error> {
    let Planner { parts, mut requests, changed } = planner;
    if parts.ota.opened().is_err() {
        shutdown.cancelled().await;
        return Ok(());
    }
    let started = parts.clock.now();
    let dirty = parts.board.watch();
    let view = RolloutProjection::new(parts.site.clone(), started, started);
    let board = Board::new();
    // A store of one process is its process' alone; and a simulation's, whose runs must be the same again.
    let me = match parts.store.is_shared() {
        true => format!("{:032x}", rand::random::<u128>()),
        false => format!("alone-{}", parts.clock.now().wall.0),
    };
    let lease = LeaderLease::new(me, midshift_core::rollout::contenders(parts.store.is_shared(), parts.bugs));
    metrics::gauge!("midshift_ota_leads").set(0);
    let mut this = Loop {
        parts,
        view,
        seq: Seq(0),
        board,
        dirty,
        heard: BTreeSet::new(),
        started,
        changed,
        say_at_ms: 0,
        questions: Vec::new(),
        lease,
        own: OwnEntries::default(),
        again: Vec::new(),
    };
    this.rebuild_until_read(&shutdown).await;
    let mut sweep = tokio::time::interval(Duration::from_millis(limits::SWEEP.as_ms()));
    sweep.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut batch = Vec::new();
    let mut more = false;
    loop {
        tokio::select! {
            biased;
            () = shutdown.cancelled() => break,
            n = requests.recv_many(&mut batch, REQUESTS_PER_CYCLE) => if n == 0 { break },
            _ = sweep.tick(), if !more => {}
            () = tokio::task::yield_now(), if more || !this.again.is_empty() => {}
        }
        let again = std::mem::take(&mut this.again);
        match this.turn(again.into_iter().chain(batch.drain(..)).collect()).await {
            Ok(unfinished) => more = unfinished,
            Err(()) => {
                tokio::time::sleep(STORE_RETRY).await;
                this.rebuild_until_read(&shutdown).await;
                // What was read is committed, so whoever asked needs not wait until the store takes something again.
                this.answer(this.parts.clock.now());
            }
        }
    }
    this.release_lease().await;
    Ok(())
}

/// From where the log can be read on: `after`, or its oldest entry if what stands between went while no process of
/// roll-outs was there. Rows say what became of it, and robots say again how they are.
async fn reachable(store: &dyn Store, after: Seq) -> Result<Seq, Error> {
    match store.feed(after, LOGS, 1).await {
        Err(Error::CursorExpired { asked, oldest }) if asked < oldest => {
            tracing::info!(asked = asked.0, oldest = oldest.0, "roll-outs begin at the oldest entry of the log");
            Ok(oldest)
        }
        page => page.map(|_| after),
    }
}

impl Loop {
    async fn rebuild_until_read(&mut self, shutdown: &CancellationToken) {
        while let Err(error) = self.rebuild().await {
            tracing::warn!(%error, "roll-outs cannot read the store, trying again");
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(STORE_RETRY) => {}
            }
        }
    }

    /// Reads who leads, and takes over if nobody does.
    async fn claim_if_free(&mut self) -> Result<(), Error> {
        let led = self.lease.leads();
        let began =
            leadership::claim_if_free(&mut self.lease, self.parts.store.as_ref(), self.parts.clock.as_ref()).await;
        if led && !self.lease.leads() {
            self.lead_no_more();
        }
        if began? {
            self.begin_to_lead();
        }
        Ok(())
    }

    /// As after a start: everybody counts as heard now, and nothing is remembered.
    fn begin_to_lead(&mut self) {
        self.started = self.parts.clock.now();
        self.view = RolloutProjection::new(self.parts.site.clone(), self.started, self.started);
        self.heard = self.board.keys().cloned().collect();
        // Said anew once robots could say what they run.
        self.say_at_ms = 0;
        self.parts.ota.lead(true);
        if let Ok(opened) = self.parts.ota.opened() {
            opened.repository.forget_told();
        }
        metrics::gauge!("midshift_ota_leads").set(1);
        metrics::counter!("midshift_ota_takeovers_total").increment(1);
        tracing::info!("this process leads roll-outs");
    }

    fn lead_no_more(&self) {
        self.parts.ota.lead(false);
        metrics::gauge!("midshift_ota_leads").set(0);
        tracing::info!("this process does not lead roll-outs any more");
    }

    /// Lets another process lead at once, if this one does.
    async fn release_lease(&mut self) {
        let Some(is_said) = leadership::release_lease(&mut self.lease, self.parts.store.as_ref()).await else { return };
        if !is_said {
            tracing::warn!(
                "another process will lead roll-outs only after a while: this one could not say that it ends"
            );
        }
        self.lead_no_more();
    }

    /// Builds the projection from nothing.
    pub(super) async fn rebuild(&mut self) -> Result<(), Error> {
        self.claim_if_free().await?;
        self.own.clear();
        let Self { lease, parts, .. } = self;
        let parts_read = ended::alive();
        let reading = parts.store.read(&parts_read, ended::named);
        let snapshot = leadership::renew_while(lease, parts.store.as_ref(), parts.clock.as_ref(), reading).await?;
        let now = self.parts.clock.now();
        let served = self.view.served_ms(&now);
        let mut next = RolloutProjection::new(self.parts.site.clone(), self.started, now);
        next.bugs = self.parts.bugs;
        next.carry_over(&mut self.view);
        self.view = next;
        self.view.load(&snapshot.rows, snapshot.seq)?;
        // The row is as old as the last commit; this process has served on since.
        self.view.served.site_ms = self.view.served.site_ms.max(served);
        self.seq = self.view.marks.get("ota").map_or(Seq(0), |m| m.row.seq).min(snapshot.seq);
        if !self.lease.leads() {
            self.seq = snapshot.seq;
            self.view.arrived.clear();
        } else {
            self.seq = reachable(self.parts.store.as_ref(), self.seq).await?;
            if self.say_at_ms == 0 {
                // Not before robots could say what they run.
                self.say_at_ms = self.view.served_ms(&now) + limits::COLLECT_EVERY_MS;
            }
        }
        metrics::counter!("midshift_ota_rebuilds_total").increment(1);
        // Questions that are still open are answered from this projection.
        let wanted = self.wanted(&[]);
        self.read_wanted(wanted).await
    }

    /// One turn; true: there is more to do at once. An error: the projection can no longer be trusted.
    async fn turn(&mut self, requests: Vec<Request>) -> Result<bool, ()> {
        self.take_heartbeats();
        let unreadable = |error| tracing::warn!(%error, "roll-outs cannot read the store");
        // What the clock says comes first: a process that was away decides nothing before it has read who leads.
        if self.lease.next_action(self.parts.clock.now().link) == LeaseAction::StepDown {
            self.rebuild().await.map_err(unreadable)?;
        }
        if !self.lease.leads() {
            self.follow_rows().await.map_err(unreadable)?;
            self.view.let_go();
            if self.lease.next_action(self.parts.clock.now().link) == LeaseAction::TakeOver {
                self.rebuild().await.map_err(unreadable)?;
            }
        }
        if self.lease.leads() { self.lead(requests).await } else { self.assist(requests).await.map(|()| false) }
    }

    /// Takes what robots said since.
    fn take_heartbeats(&mut self) {
        for (robot_id, live) in self.dirty.take_changed() {
            match live {
                Some(live) => {
                    self.heard.insert(robot_id.clone());
                    self.board.insert(robot_id, live);
                }
                None => {
                    self.board.remove(&robot_id);
                    self.view.contacts.remove(&robot_id);
                }
            }
        }
    }

    /// Absorbs the feed to its head; gives back the newest entry of another process of this service.
    async fn take_feed(&mut self, now: Now, plan: &mut Plan) -> Result<Option<Seq>, Error> {
        let mut foreign = None;
        let mut seen = Ok(());
        let clock = self.parts.clock.clone();
        let Self { view, lease, own, .. } = self;
        let take = |entries: &[Entry]| {
            for entry in entries.iter().filter(|e| e.log == Log::Ota) {
                if !own.is_own(entry.seq.0) && entry.table != Some(Table::OtaLeader) {
                    foreign = Some(entry.seq);
                }
            }
            if seen.is_ok() {
                seen = lease.follow(entries, clock.now().link);
            }
            absorb(view, now, entries, plan);
        };
        follow(self.parts.store.as_ref(), &mut self.seq, LOGS, take).await?;
        seen?;
        Ok(foreign)
    }

    /// One turn of the process that plans.
    async fn lead(&mut self, requests: Vec<Request>) -> Result<bool, ()> {
        let undoubted = self.parts.clock.undoubted();
        let now = undoubted.unwrap_or_else(|_| self.parts.clock.now());
        let mut plan = Plan::default();
        let unreadable = |error| tracing::warn!(%error, "roll-outs cannot read the feed");
        let foreign = self.take_feed(now, &mut plan).await.map_err(unreadable)?;
        if plan.items.is_empty() {
            self.view.let_go();
        }
        let wanted = self.wanted(&requests);
        self.read_wanted(wanted).await.map_err(unreadable)?;
        let renewal = match self.lease.next_action(now.link) {
            LeaseAction::StepDown => {
                // What was planned a moment ago is dropped, and with it the projection that holds it.
                self.rebuild().await.map_err(unreadable)?;
                return self.assist(requests).await.map(|()| false);
            }
            LeaseAction::Renew => Some(self.lease.claim()),
            LeaseAction::Lead | LeaseAction::StandBy | LeaseAction::TakeOver => None,
        };
        let ota = self.parts.ota.clone();
        let Ok(opened) = ota.opened() else { return Ok(false) };
        // Rows that another process committed from what it published are not undone.
        opened.repository.documents().look_if_possible().await;
        releases::take_release(&mut self.view, now, opened.repository.newest().as_deref(), &mut plan);
        let damaged = opened.downloads.damaged();
        for digest in &damaged {
            tell_damaged(&mut self.view, now, &digest.to_string(), &mut plan);
        }
        let replies = self.take_requests(requests, now, &mut plan);
        // The service looks for one each second.
        let key = match undoubted {
            Ok(_) => opened.repository.directive_key().map_err(|keyless| keyless.reason().code),
            // Orders would have the time of this turn, though the wall may be right again.
            Err(_) => Err(Code::ClockDoubted),
        };
        let heard = std::mem::take(&mut self.heard);
        let more = {
            let signer = key.as_deref().map(Signer);
            let sign = match &signer {
                Ok(signer) => Ok(signer as &dyn Sign),
                Err(code) => Err(**code),
            };
            cycle(&mut self.view, now, &self.board, &heard, sign, &mut plan)
        };
        for text in &plan.unreadable {
            tracing::error!(text, "roll-outs passed over something they cannot read");
        }
        self.renew_and_commit(renewal, now, plan, replies).await?;
        opened.downloads.mark_damaged_reported(&damaged);
        self.answer(now);
        if let Some(seq) = foreign {
            self.changed.send_replace(seq);
        }
        let served_ms = self.view.served_ms(&now);
        if served_ms >= self.say_at_ms {
            self.say_at_ms = served_ms + limits::COLLECT_EVERY_MS;
            self.view.forget_contacts(&self.board);
            // From rows that are committed, as answers are.
            opened.named.send_replace(Some(NamedBundles { bundles: needed_bundles(&self.view, &now), served_ms }));
        }
        Ok(more)
    }

    /// Answers every question from the projection, which holds only what is committed at this moment.
    pub(super) fn answer(&mut self, now: Now) {
        for question in std::mem::take(&mut self.questions) {
            (question.answer)(&self.view, &self.board, &now);
        }
    }

    fn take_requests(&mut self, requests: Vec<Request>, now: Now, plan: &mut Plan) -> Replies {
        let mut replies = Vec::new();
        for request in requests {
            match request {
                Request::Question(question) => self.questions.push(question),
                Request::Do(asked) => {
                    let before = plan.items.len();
                    let taken = decide_request(&mut self.view, &self.board, now, &asked.ask, plan);
                    let after = plan.items.len();
                    match taken {
                        Ok(taken) if asked.ask.check_only == CheckOnly::No => {
                            // What was asked before is in the store, or in an item before this one.
                            replies.push((asked, taken, if after > before { before..after } else { 0..after }));
                        }
                        taken => drop(asked.reply.send(taken)),
                    }
                }
            }
        }
        replies
    }

    /// Answers a command of which these items were committed, or decides it anew.
    fn settle(
        &mut self,
        mut asked: Box<PendingCommand>,
        taken: CommandOutcome,
        results: Option<&[Result<Applied, CommitError>]>,
    ) {
        asked.lost += 1;
        let answer = match results.map(leadership::group_outcome) {
            Some(GroupOutcome::Done) => Ok(taken),
            Some(GroupOutcome::Moved) if asked.lost < limits::COMMAND_TRIES => {
                self.again.push(Request::Do(asked));
                return;
            }
            Some(GroupOutcome::Moved) => Err(Refusal::new(Kind::Unavailable, Code::MovedMeanwhile)),
            Some(GroupOutcome::Unknown) | None => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
        };
        drop(asked.reply.send(answer));
    }

    /// Commits the plan, and before it that this process still leads, if it is time to say so.
    async fn renew_and_commit(
        &mut self,
        renewal: Option<Item>,
        now: Now,
        plan: Plan,
        replies: Replies,
    ) -> Result<(), ()> {
        let renews = renewal.is_some();
        let items: Vec<Item> = renewal.into_iter().chain(plan.items).collect();
        let about: Vec<(Option<Seq>, u64)> = items.iter().map(|i| (obeyed(i), projection::entries_of(i))).collect();
        let results = if items.is_empty() { Vec::new() } else { self.parts.store.commit(items).await };
        if renews && results.first().is_some_and(Result::is_ok) {
            self.lease.claimed(now.link);
        }
        let mut trusted = Ok(());
        let mut newest = None;
        for (place, (result, (entry, entries))) in results.iter().zip(about).enumerate() {
            match result {
                Ok(applied) => {
                    self.own.wrote(applied.seq.0, entries);
                    if !renews || place > 0 {
                        newest = Some(applied.seq);
                    }
                }
                Err(error) => {
                    if let (true, Some(seq)) = (error.is_final(), entry) {
                        tracing::error!(seq = seq.0, "an entry of the log cannot be obeyed and is passed over");
                        self.view.unusable.insert(seq);
                    }
                    let conflict = matches!(error, CommitError::Conflict { .. });
                    let counted =
                        metrics::counter!("midshift_ota_items_lost_total", "conflict" => conflict.to_string());
                    counted.increment(1);
                    tracing::warn!(%error, "an item of a roll-out was not applied; planning again");
                    trusted = Err(());
                }
            }
        }
        let of_plan = results.get(usize::from(renews)..).unwrap_or_default();
        for (asked, taken, items) in replies {
            self.settle(asked, taken, of_plan.get(items));
        }
        if let Some(seq) = newest {
            self.changed.send_replace(seq);
        }
        trusted
    }
}
