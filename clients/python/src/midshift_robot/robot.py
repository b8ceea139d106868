"""A robot that speaks link.v1 by itself: docs/robot-protocol.md as a program around a `Body`.

One thread reads each stream, everything else happens in `Robot.tick`: the body is asked, what came is heard, the next step
begins, the memory is written, and only then anything is said.
"""

import argparse
import math
import pathlib
import queue
import random
import signal
import sys
import time
import uuid

import grpc
from google.protobuf import json_format
from midshift.common.v1 import common_pb2
from midshift.link.v1 import link_pb2 as link
from midshift.link.v1 import link_pb2_grpc

from .body import Action, Body
from .events import EVENT, Events
from .identity import Identity
from .memory import Memory
from .stop_line import HALT, NONE, SLOW, StopLine
from .stream import Stream, now_ms, say

HEARTBEATS_REMEMBERED = 64
SILENCE_MS = 10_000
OBSERVED_SILENCE_MS = 60_000
HELLO_MS = 10_000
FENCED_MS = 60_000
STOP_SLOW_MM_S = 300
STOP_PORT = 7421
TICK_S = 0.02


def first_memory(at: list) -> dict:
    """What a robot knows that has never run."""
    return {
        "ring": str(uuid.uuid4()),
        "identity": None,  # {key_pem, certificate_pem, authority_pem, expires_unix_s}
        "session": None,  # {epoch, secret, store_id}
        "applied_work": 0,
        "applied_policy": 0,
        "produced": 0,
        "acked": 0,
        "samples": [],  # EVENT samples that were not acknowledged, as JSON
        "gaps": [],
        "holder": None,  # {subject, epoch, step, opened, intent, unknown, elapsed_ms, base_mm}
        "subjects": {},  # subject: {epoch, report}
        "unclosed": {},  # "subject/epoch": ReportedAttempt as JSON
        "inside": {},  # place: grant, 0 for none
        "used": [],  # grants that were used up or given back
        "at": at,  # waypoint, x_mm, y_mm
        "load": None,  # {task_id, item}
        "odometer_mm": 0,
    }


class Session(Stream):
    def __init__(self, channel: grpc.Channel, hello: link.Hello, inbox: queue.Queue) -> None:
        super().__init__(channel, link_pb2_grpc.LinkServiceStub(channel).Session, link.SessionRequest(hello=hello), inbox)
        self.heard_ms = now_ms()
        self.patience_ms = HELLO_MS
        self.epoch = 0
        self.hb = 0
        self.observed = False
        self.period_ms = 1000
        self.beat_at_ms = 0.0
        self.load_since = 0  # the heartbeat from which on each one lists the load at hand; 0: none


class Robot:
    def __init__(self, body: Body, args: argparse.Namespace) -> None:
        self.body, self.args = body, args
        self.boot_id = str(uuid.uuid4())
        waypoint, x_mm, y_mm = args.at
        self.memory = Memory(args.data, first_memory([waypoint, int(x_mm), int(y_mm)]))
        self.events = Events(self.memory)
        self.identity = Identity(args, self.memory)
        self.stops = self.stop_line()
        # A robot with a stop line stands from its start until it was told and answered.
        # What a stop stood goes on by an echo that is newer than its end.
        self.stopped = self.stops is not None
        self.free_ms = now_ms()
        self.told_stop = None
        self.floor = (None, set())  # where it was when the areas around it were last known, and those
        self.inbox: queue.Queue = queue.Queue()
        self.session: Session | None = None
        self.dial_at_ms = 0.0
        self.pause_ms = 200.0
        self.patience_ms = SILENCE_MS
        self.fences = 0
        # Authority: when each of the last heartbeats of this session was sent, and the newest sending that was echoed.
        self.sent: dict[int, float] = {}
        self.lease_from_ms: float | None = None
        self.authority_ms = 30_000
        self.clock: link.ClockSample | None = None
        # Desired state, newest wins. None until the server has said it to this process.
        self.desired: link.DesiredWork | None = None
        self.order: link.Assignment | None = None
        self.rules: dict[str, link.AreaRules] = {}
        self.resume_needed = False
        self.ending: str | None = None
        self.refused: list[str] = []
        self.answered: set[str] = set()
        self.told = None
        self.progress = 0
        self.started = self.memory["holder"] is not None
        # The body: on the way along one lane, or busy with one action, or standing.
        self.heading: link.RoutePoint | None = None
        self.heading_mm_s = 0
        self.busy = False
        self.wait_until_ms: float | None = None  # of a step that is only a wait
        self.intent_is_fresh = False
        self.last_ms = now_ms()
        body.begin(*self.memory["at"][1:])
        if waypoint not in self.memory["inside"] and self.memory["at"][0] == waypoint:
            # It stands on a standing place that nobody granted: it says so.
            self.place(waypoint, 0, link.PLACE_NEWS_ENTERED)
            self.put("inside", waypoint, 0)

    # --- memory

    def put(self, table: str, key: str, value) -> None:
        self.memory[table] = {**self.memory[table], key: value}

    def drop(self, table: str, key: str) -> None:
        self.memory[table] = {k: v for k, v in self.memory[table].items() if k != key}

    def use_up(self, grant_id: int) -> None:
        if grant_id and grant_id not in self.memory["used"]:
            self.memory["used"] = [*self.memory["used"], grant_id]

    def place(self, place_id: str, grant_id: int, news: int) -> None:
        self.events.emit(place=link.PlaceReport(place_id=place_id, grant_id=grant_id, news=news))

    # --- authority

    def stale(self, authority: common_pb2.Authority) -> str | None:
        """Why this authority gives nothing now; none: it stands."""
        if self.session is None or authority.session_epoch != self.session.epoch:
            return "anchored to another session"
        sent_ms = self.sent.get(authority.hb)
        if sent_ms is None:
            return f"heartbeat {authority.hb} is not remembered"
        late_ms = now_ms() - sent_ms - authority.valid_ms
        return f"{late_ms:.0f} ms too late" if late_ms > 0 else None

    def may_go_on(self) -> bool:
        observed = self.session is not None and self.session.observed
        leased = self.lease_from_ms is not None and now_ms() <= self.lease_from_ms + self.authority_ms
        return leased and not observed

    def is_held(self) -> bool:
        return self.resume_needed or (self.desired is not None and self.desired.held)

    def suspends(self) -> bool:
        return self.order is not None and self.order.suspend and not self.memory["load"] and not self.busy

    # --- one turn

    def tick(self) -> None:
        now = now_ms()
        holder = self.memory["holder"]
        if holder and not self.is_held() and not self.stopped:
            holder["elapsed_ms"] += now - self.last_ms
        self.last_ms = now
        self.mind_stops()
        self.ask_body(now)
        while not self.inbox.empty():
            session, message = self.inbox.get()
            if session is self.session:
                self.hear(message)
        self.mind_hold()
        self.work()
        if self.session is None and now >= self.dial_at_ms:
            self.dial()
        elif self.session and now - self.session.heard_ms > self.session.patience_ms:
            self.lost("the server is silent")
        self.memory.save()
        self.send(now)

    # --- stops

    def stop_line(self) -> StopLine | None:
        server = self.args.stop_server
        if not server and self.identity.is_enrolled:
            server = f"{self.args.server.rsplit(':', 1)[0]}:{STOP_PORT}"
        if not server or self.args.no_stop:
            say("no stop line: fleet stop does not reach this robot by a way of its own")
            return None
        return StopLine(self.args.data.with_suffix(".stops.json"), server, self.identity, self.boot_id)

    def mind_stops(self) -> None:
        """Stands at once when it must, whatever it was told before; and says what it obeys with the next heartbeat."""
        if self.stops is None:
            return
        if self.desired and self.desired.resumed and self.session and not self.session.observed:
            # Said once, it stays true: a reset may come after it.
            self.stops.resumed(list(self.desired.resumed))
        before = self.stops.level
        self.stops.tick(self.body.position(), self.is_still(), self.is_alone())
        if self.stops.level >= HALT:
            if not self.stopped:
                self.stopped = True
                self.body.pause()
        elif before >= HALT:
            self.free_ms = now_ms()
        if self.heading and not self.stopped and self.speed(self.heading) != self.heading_mm_s:
            self.set_out(self.heading)
        told = (self.stops.level, self.stops.inside, self.stops.awaiting)
        if told != self.told_stop:
            self.told_stop = told
            say("obeys", common_pb2.StopLevel.Name(told[0]), *told[1], "awaits", *told[2])
            if self.session:
                self.session.beat_at_ms = now_ms()

    def is_alone(self) -> bool:
        """No people walk in the areas at both ends of the lane that it is on, as far as its route says where that is."""
        holder, here = self.memory["holder"], (self.memory["at"][0], self.heading and self.heading.waypoint)
        at = self.located(self.order, holder["step"]) if self.order and holder else None
        if at is not None:
            self.floor = (here, {self.order.route[at].area_id, *([self.heading.area_id] if self.heading else [])})
        elif self.floor[0] != here:
            self.floor = (here, set())
        areas = self.floor[1]
        return bool(areas) and all(area in self.rules and self.rules[area].without_people for area in areas)

    def is_still(self) -> bool:
        return self.stopped or (self.heading is None and not self.busy)

    def mind_hold(self) -> None:
        """A hold ends by a resume with fresh authority alone, and so does what a stop broke off that a person has to resume."""
        desired, awaits = self.desired, self.stops is not None and bool(self.stops.awaiting)
        if not self.memory["holder"]:
            self.resume_needed = False
        elif awaits or (desired is not None and desired.held):
            self.resume_needed = True
        elif self.resume_needed and desired is not None and desired.HasField("resume") and not self.stale(desired.resume):
            self.resume_needed = False
        if self.stopped and self.stops.level < HALT and not self.is_held():
            is_fresh = self.may_go_on() and self.lease_from_ms >= self.free_ms
            if is_fresh or self.is_idle():
                self.stopped = False
                self.body.resume()

    def is_idle(self) -> bool:
        return self.memory["holder"] is None and self.heading is None and not self.busy

    # --- the session

    def dial(self) -> None:
        old = self.memory["session"]
        hello = link.Hello(
            robot_id=self.args.robot_id,
            boot_id=self.boot_id,
            previous=old and link.PreviousSession(session_epoch=old["epoch"], secret=old["secret"]),
            inventory=link.Inventory(
                capabilities=self.body.capabilities,
                payload_g=self.body.payload_g,
                software=self.body.software,
                model=self.body.model,
                load_by_memory=True,
            ),
            reported=self.reported(),
            ring=self.memory["ring"],
            store_id=old["store_id"] if old else "",
            sent_unix_ms=int(time.time() * 1000),
            clock_rate_permille=1000,
            protocol_versions=[1],
        )
        self.events.position(hello)
        self.memory.save()
        self.session = Session(self.identity.channel(self.args.server), hello, self.inbox)

    def lost(self, why: str, at_least_ms: float = 0) -> None:
        say("session lost:", why)
        if self.session:
            self.session.close()
        self.session = None
        self.dial_at_ms = now_ms() + max(at_least_ms, self.pause_ms * random.uniform(0.5, 1))
        self.pause_ms = min(self.pause_ms * 2, 10_000)

    def hear(self, message: link.SessionResponse | None) -> None:
        if message is None:
            return self.lost(self.session.why)
        self.session.heard_ms = now_ms()
        kind = message.WhichOneof("message")
        if kind == "welcome":
            self.welcome(message.welcome)
        elif kind == "downlink":
            self.down(message.downlink)
        elif kind == "move_over":
            # This small robot closes and comes back: authority outlives that by far.
            self.lost("asked to move over")
        elif kind == "close":
            close = message.close
            self.fences += close.code == link.CLOSE_CODE_FENCED
            if self.fences > 1:
                sys.exit("fenced twice: another machine has this robot's id and proof")
            fenced_ms = FENCED_MS if close.code == link.CLOSE_CODE_FENCED else 0
            self.lost(f"closed: {close.reason.code}", max(close.retry_after_ms, fenced_ms))

    def welcome(self, welcome: link.Welcome) -> None:
        self.session.epoch, self.session.observed = welcome.session_epoch, welcome.observed
        # An observed session is silent until its end says that this robot may take charge: it is held, each in a row for longer.
        self.session.patience_ms = self.patience_ms if welcome.observed else SILENCE_MS
        self.patience_ms = min(2 * self.session.patience_ms, OBSERVED_SILENCE_MS) if welcome.observed else SILENCE_MS
        self.session.period_ms = welcome.heartbeat_period_ms
        self.session.beat_at_ms = now_ms()
        self.sent = {}  # what is anchored to an older session is stale; the lease is carried on
        self.authority_ms = min(welcome.authority_ms, 30_000)
        self.clock = None
        self.pause_ms = 200.0
        old = self.memory["session"]
        if old and old["store_id"] != welcome.store_id:
            self.memory["applied_work"] = self.memory["applied_policy"] = 0
            self.answered.clear()
        self.memory["session"] = {
            "epoch": welcome.session_epoch,
            "secret": welcome.session_secret,
            "store_id": welcome.store_id,
        }
        self.events.welcomed(welcome.acks)
        say("session", welcome.session_epoch, "observed" if welcome.observed else "in charge")

    def send(self, now: float) -> None:
        if self.session is None or not self.session.epoch:
            return
        uplink = link.Uplink()
        if batch := self.events.batch():
            uplink.batches.append(batch)
        if now >= self.session.beat_at_ms:
            self.session.beat_at_ms = now + self.session.period_ms
            self.session.hb += 1
            if self.memory["load"] and not self.session.load_since:
                self.session.load_since = self.session.hb
            uplink.heartbeat.reported.CopyFrom(self.reported())
            uplink.heartbeat.sent_unix_us = int(time.time() * 1e6)
            if self.clock:
                uplink.heartbeat.clock.CopyFrom(self.clock)
                self.clock = None
            self.sent[self.session.hb] = now_ms()
            self.sent = dict(list(self.sent.items())[-HEARTBEATS_REMEMBERED:])
        if uplink.batches or uplink.HasField("heartbeat"):
            if not self.session.send(link.SessionRequest(uplink=uplink)):
                self.lost("the way up is stuck")

    def reported(self) -> link.ReportedState:
        x_mm, y_mm = self.body.position()
        session = self.session if self.session and self.session.epoch else None
        state = link.ReportedState(
            hb=session.hb if session else 0,
            session_epoch=session.epoch if session else 0,
            # Grants are not kept: until the server has said them again, what is not listed here proves nothing.
            applied_work=self.memory["applied_work"] if self.desired or not session else 0,
            applied_policy=self.memory["applied_policy"],
            produced=[link.LaneMark(lane=EVENT, seq=self.memory["produced"])],
            mode=link.MODE_AUTOMATIC,
            vitals=link.Vitals(
                pose=common_pb2.Pose(x_mm=x_mm, y_mm=y_mm),
                waypoint=self.memory["at"][0],
                speed_mm_s=self.heading_mm_s if self.heading and not self.stopped else 0,
                battery_permille=1000,
                odometer_mm=self.memory["odometer_mm"],
            ),
            load=self.memory["load"] and link.Load(**self.memory["load"]),
            attempts=[json_format.ParseDict(a, link.ReportedAttempt()) for a in self.memory["unclosed"].values()],
            stop_level=self.stops.level if self.stops else NONE,
            hardware_stop=link.HARDWARE_STOP_NONE,
            stops=self.stops.inside if self.stops else [],
            awaiting_resume=self.stops.awaiting if self.stops else [],
        )
        if self.memory["holder"]:
            state.attempts.append(self.listed(self.work_state()))
        for place_id, grant_id in self.memory["inside"].items():
            state.places.add(place_id=place_id, grant_id=grant_id, inside=True)
        for grant in self.desired.grants if self.desired else []:
            if grant.grant_id not in self.memory["used"] and grant.grant_id not in self.memory["inside"].values():
                state.places.add(place_id=grant.place_id, grant_id=grant.grant_id)
        return state

    # --- desired state

    def down(self, down: link.Downlink) -> None:
        if down.HasField("echo"):
            sent_ms = self.sent.get(down.echo.hb)
            if sent_ms is not None and not self.session.observed:
                self.lease_from_ms = max(self.lease_from_ms or 0, sent_ms)
            self.clock = link.ClockSample()
            self.clock.CopyFrom(down.echo.clock)
            self.clock.t4_us = int(time.time() * 1e6)
        self.events.heard(down.acks)
        if self.stops and down.HasField("stops"):
            self.stops.beside(down.stops)
        if down.HasField("policy") and down.policy.generation >= self.memory["applied_policy"]:
            self.rules = {area.area_id: area for area in down.policy.areas}
            self.memory["applied_policy"] = down.policy.generation
        if down.HasField("work") and down.work.generation >= self.memory["applied_work"]:
            self.obey(down.work)

    def obey(self, desired: link.DesiredWork) -> None:
        old, self.desired = self.desired, desired
        self.memory["applied_work"] = desired.generation
        for closed in desired.closed:
            self.drop("unclosed", key_of(closed))
        listed = {grant.grant_id for grant in desired.grants}
        for gone in [g for g in (old.grants if old else []) if g.grant_id not in listed]:
            self.give_back(gone)
        for grant in desired.grants:
            used = grant.grant_id in self.memory["used"]
            on = self.memory["inside"].get(grant.place_id)
            if not used and (on == 0 or (on is None and not grant.HasField("entry"))):
                self.put("inside", grant.place_id, grant.grant_id)
        self.memory["used"] = [grant_id for grant_id in self.memory["used"] if grant_id in listed]
        if desired.HasField("load_word"):
            self.forget_load(desired.load_word)
        self.mind_hold()
        self.assigned(desired.assignment if desired.HasField("assignment") else None)

    def forget_load(self, word: link.LoadWord) -> None:
        """A person has looked: what that heartbeat listed, and what has not changed since, is not there."""
        if word.session_epoch == self.session.epoch and 0 < self.session.load_since <= word.hb:
            self.carries(None)

    def give_back(self, grant: link.GrantedPlace) -> None:
        """A grant that was not used and will not be."""
        if grant.grant_id not in self.memory["used"] and grant.grant_id not in self.memory["inside"].values():
            self.use_up(grant.grant_id)
            self.place(grant.place_id, grant.grant_id, link.PLACE_NEWS_NOT_ENTERED)

    def assigned(self, order: link.Assignment | None) -> None:
        holder = self.memory["holder"]
        if holder and order and key_of(order.attempt) == f"{holder['subject']}/{holder['epoch']}":
            self.order = order
            if order.stop:
                self.ending = "stop"
            return
        if holder:
            # What runs under an attempt that is not named any more is to be stopped and confirmed.
            self.ending = "stop"
        if order:
            self.consider(order)

    def consider(self, order: link.Assignment) -> None:
        """An offer: takes it, or says why not."""
        attempt, key = order.attempt, key_of(order.attempt)
        known = self.memory["subjects"].get(attempt.subject, {"epoch": 0, "report": None})
        if key in self.refused:
            return
        if known["report"] and (known["epoch"] == attempt.epoch or known["report"]["state"] == "WORK_STATE_SUCCEEDED"):
            # It ended here: the answer is told again from memory.
            if key not in self.memory["unclosed"] and key not in self.answered:
                self.answered.add(key)
                self.events.emit(attempt=json_format.ParseDict(known["report"], link.AttemptReport()))
                if known["epoch"] != attempt.epoch:
                    self.refuse(order, "ALREADY_FINISHED")
            return
        if known["epoch"] >= attempt.epoch:
            return self.refuse(order, "STALE_EPOCH")
        if order.stop:
            # The server takes back what was never taken: it must not be taken later.
            return self.put("subjects", attempt.subject, {"epoch": attempt.epoch, "report": known["report"]})
        if self.session.observed:
            return self.refuse(order, "ROBOT_OBSERVED")
        if why := self.stale(order.offer):
            return self.refuse(order, "STALE_AUTHORITY", why)
        if self.desired.maintenance:
            return self.refuse(order, "IN_MAINTENANCE")
        if self.stops and self.stops.level >= HALT:
            return self.refuse(order, "ROBOT_STOPPED")
        if self.memory["holder"]:
            return self.refuse(order, "ANOTHER_HOLDER")
        actions = [s.action.name for s in order.steps[order.from_step :] if s.WhichOneof("kind") == "action"]
        if unknown := [name for name in actions if name not in [*self.body.capabilities, "charge", "park"]]:
            return self.refuse(order, "UNSUPPORTED_ACTION", unknown[0])
        if order.route and self.located(order, order.from_step) is None:
            return self.refuse(order, "UNKNOWN_WAYPOINT", f"it is at {self.memory['at'][0]}")
        say("accepted", key)
        self.put("subjects", attempt.subject, {"epoch": attempt.epoch, "report": known["report"]})
        self.memory["holder"] = {
            "subject": attempt.subject,
            "epoch": attempt.epoch,
            "step": order.from_step,
            "opened": False,
            "intent": None,
            "unknown": False,
            "elapsed_ms": 0,
            "base_mm": self.memory["odometer_mm"],
        }
        self.order, self.ending, self.told, self.started = order, None, None, False
        self.resume_needed = self.desired.held

    def refuse(self, order: link.Assignment, code: str, why: str = "") -> None:
        attempt = order.attempt
        say("refused", key_of(attempt), code, why)
        known = self.memory["subjects"].get(attempt.subject, {"epoch": 0, "report": None})
        self.put("subjects", attempt.subject, {**known, "epoch": max(known["epoch"], attempt.epoch)})
        self.refused = [*self.refused, key_of(attempt)][-32:]
        reason = common_pb2.Reason(code=code, message=why)
        self.events.emit(attempt=link.AttemptReport(attempt=attempt, state=link.WORK_STATE_REFUSED, refusal=reason))

    # --- work

    def listed(self, state: int) -> link.ReportedAttempt:
        holder = self.memory["holder"]
        return link.ReportedAttempt(
            attempt=link.AttemptId(subject=holder["subject"], epoch=holder["epoch"]),
            state=state,
            step_index=holder["step"],
            progress=self.progress,
            route_index=(self.located(self.order, holder["step"]) or 0) if self.order else 0,
            opened=holder["opened"],
        )

    def report(self, state: int, **more) -> link.AttemptReport:
        holder = self.memory["holder"]
        return link.AttemptReport(
            attempt=link.AttemptId(subject=holder["subject"], epoch=holder["epoch"]),
            state=state,
            step_index=holder["step"],
            opened=holder["opened"],
            stats=common_pb2.WorkStats(
                duration_ms=int(holder["elapsed_ms"]), path_mm=self.memory["odometer_mm"] - holder["base_mm"]
            ),
            **more,
        )

    def work_state(self) -> int:
        if self.memory["holder"].get("unknown"):
            return link.WORK_STATE_STEP_UNKNOWN
        stands = self.is_still()
        if self.ending:
            return link.WORK_STATE_STOPPING
        if stands and (self.is_held() or self.stopped or (self.started and (self.order is None or not self.may_go_on()))):
            return link.WORK_STATE_PAUSED
        if not self.started:
            return link.WORK_STATE_ACCEPTED
        step = self.order.steps[self.memory["holder"]["step"]] if self.order and self.has_step() else None
        drives = step is not None and step.WhichOneof("kind") == "goto_waypoint"
        return link.WORK_STATE_NAVIGATING if drives else link.WORK_STATE_EXECUTING

    def has_step(self) -> bool:
        return self.memory["holder"]["step"] < len(self.order.steps)

    def work(self) -> None:
        """What is next, if nothing is under way. Nothing begins on what is not written down yet."""
        holder = self.memory["holder"]
        if holder is None:
            return
        if self.heading is None and not self.busy and self.order and not self.memory.dirty:
            self.next(holder)
        if self.memory["holder"]:
            state = (self.work_state(), holder["step"])
            if state != self.told:
                self.told = state
                self.events.emit(attempt=self.report(state[0]))

    def next(self, holder: dict) -> None:
        if not self.has_step():
            return self.finish(link.WORK_STATE_SUCCEEDED)
        if self.ending and not self.inside_passage():
            return self.finish(link.WORK_STATE_ABORTED)
        if holder["elapsed_ms"] > self.order.timeout_ms and not self.inside_passage():
            late = common_pb2.Fault(code=1003, fault_class=common_pb2.FAULT_CLASS_RECOVERABLE, message="it took too long")
            return self.finish(link.WORK_STATE_FAILED, fault=late)
        if self.suspends() and self.at_boundary():
            return self.finish(link.WORK_STATE_SUSPENDED)
        if self.stopped or holder.get("unknown"):
            return
        winds_down = bool(self.ending) or self.is_held() or self.suspends() or not self.may_go_on()
        step = self.order.steps[holder["step"]]
        if step.WhichOneof("kind") == "goto_waypoint":
            return self.drive(holder, winds_down)
        if winds_down:
            return
        self.started = True
        if step.WhichOneof("kind") == "wait_ms":
            self.busy, self.wait_until_ms = True, now_ms() + step.wait_ms
        elif step.action.name in ("charge", "park"):
            self.step_done()  # its battery is pretended to be full, and it stands as it is
        elif step.effect == link.WORK_EFFECT_AT_MOST_ONCE and holder["intent"] != holder["step"]:
            # Written down before the body begins: after a restart the journal of the body tells whether it was done.
            holder["intent"], self.intent_is_fresh = holder["step"], True
            self.memory.dirty = True
        else:
            self.act(holder, step)

    def act(self, holder: dict, step: link.WorkStep) -> None:
        """Begins an action; first the body is asked about one that may have been done before a restart."""
        action = self.action(holder)
        was_done: bool | None = False
        if step.effect != link.WORK_EFFECT_REPEATABLE and not self.intent_is_fresh:
            was_done = self.body.was_done(action)
        if was_done:
            self.did(action)
        elif was_done is None and step.effect == link.WORK_EFFECT_AT_MOST_ONCE:
            # Nobody knows: it stands until the server decides.
            holder["unknown"] = holder["opened"] = True
            self.memory.dirty = True
        else:
            self.busy = True
            self.body.act(action)

    def finish(self, state: int, **more) -> None:
        report, listed = self.report(state, **more), self.listed(state)
        say("finished", key_of(report.attempt), link.WorkState.Name(state))
        known = {"epoch": report.attempt.epoch, "report": json_format.MessageToDict(report)}
        self.put("subjects", report.attempt.subject, known)
        self.put("unclosed", key_of(report.attempt), json_format.MessageToDict(listed))
        for grant in self.desired.grants if self.desired else []:
            self.give_back(grant)
        self.answered.add(key_of(report.attempt))
        self.events.emit(attempt=report)
        self.memory["holder"] = None
        self.order, self.ending, self.resume_needed = None, None, False
        if self.session:
            self.session.beat_at_ms = now_ms()  # fleet gives the next work by where the robot stands now

    def step_done(self) -> None:
        holder = self.memory["holder"]
        step = self.order.steps[holder["step"]]
        holder["opened"] = holder["opened"] or step.effect == link.WORK_EFFECT_AT_MOST_ONCE
        resume = self.order.resume_step if self.order.from_step == holder["step"] else 0
        holder["step"], holder["intent"], self.intent_is_fresh = max(holder["step"] + 1, resume), None, False
        self.progress += 1
        self.memory.dirty = True

    # --- driving: one lane at a time

    def located(self, order: link.Assignment, step: int) -> int | None:
        """Index of the route point it stands on, on the leg of this step; none: it is not on it."""
        ends = [(i, p.ends_step) for i, p in enumerate(order.route) if p.HasField("ends_step")]
        first = max((i for i, end in ends if end < step), default=0)
        last = min((i for i, end in ends if end >= step), default=len(order.route) - 1)
        leg = range(min(first, last), last + 1)
        return next((i for i in leg if order.route[i].waypoint == self.memory["at"][0]), None)

    def drive(self, holder: dict, winds_down: bool) -> None:
        order, step = self.order, holder["step"]
        at = self.located(order, step)
        goal = next((i for i, p in enumerate(order.route) if i >= (at or 0) and p.HasField("ends_step") and p.ends_step == step), None)
        if goal == at if goal is not None else order.steps[step].goto_waypoint == self.memory["at"][0]:
            return self.step_done()
        if at is None or goal is None or not order.HasField("released_index") or order.released_index <= at:
            return
        if winds_down and not self.inside_passage():
            return
        point = order.route[at + 1]
        entered = []
        for place_id in needs(point):
            if place_id in self.memory["inside"]:
                continue
            grant = next((g for g in self.desired.grants if self.opens(g, place_id)), None)
            if grant is None:
                return  # not granted, or no longer: it stays where it is
            entered.append(grant)
        for grant in entered:
            self.put("inside", grant.place_id, grant.grant_id)
            self.place(grant.place_id, grant.grant_id, link.PLACE_NEWS_ENTERED)
        self.memory.save()
        self.set_out(point)
        self.started = True

    def set_out(self, point: link.RoutePoint) -> None:
        self.heading, self.heading_mm_s = point, self.speed(point)
        self.body.drive(point.x_mm, point.y_mm, self.heading_mm_s)

    def opens(self, grant: link.GrantedPlace, place_id: str) -> bool:
        fresh = grant.HasField("entry") and not self.stale(grant.entry)
        return grant.place_id == place_id and fresh and grant.grant_id not in self.memory["used"]

    def speed(self, point: link.RoutePoint) -> int:
        rules = self.rules.get(point.area_id)
        limits = [self.body.speed_mm_s, *(l.speed_limit_mm_s for l in (point, self.order, rules) if l and l.HasField("speed_limit_mm_s"))]
        if self.stops and self.stops.level == SLOW:
            limits.append(STOP_SLOW_MM_S)
        return max(1, min(limits))

    def arrive(self, point: link.RoutePoint) -> None:
        _, x_mm, y_mm = self.memory["at"]
        self.memory["odometer_mm"] += round(math.hypot(point.x_mm - x_mm, point.y_mm - y_mm))
        self.memory["at"] = [point.waypoint, point.x_mm, point.y_mm]
        self.progress += 1
        at = self.located(self.order, self.memory["holder"]["step"]) if self.order and self.memory["holder"] else None
        following = self.order.route[at + 1] if at is not None and at + 1 < len(self.order.route) else None
        kept = set(needs(following)) if following else set(point.passages if not point.standing else [])
        for place_id, grant_id in list(self.memory["inside"].items()):
            if place_id not in kept and place_id != point.standing:
                self.drop("inside", place_id)
                self.use_up(grant_id)
                self.place(place_id, grant_id, link.PLACE_NEWS_LEFT)

    def inside_passage(self) -> bool:
        """It stands where it may not stay: both the point it is on and the next one lie in a passage."""
        at = self.located(self.order, self.memory["holder"]["step"])
        if at is None or at + 1 >= len(self.order.route) or self.order.route[at].standing:
            return False
        return bool(set(self.order.route[at].passages) & set(self.order.route[at + 1].passages))

    def at_boundary(self) -> bool:
        at = self.located(self.order, self.memory["holder"]["step"])
        return at is None or bool(self.order.route[at].standing) or self.order.route[at].HasField("ends_step")

    # --- the body

    def ask_body(self, now: float) -> None:
        if self.stopped or not (self.heading or self.busy):
            return
        if self.wait_until_ms is not None:
            if now >= self.wait_until_ms:
                self.busy, self.wait_until_ms = False, None
                self.step_done()
        elif not self.body.is_done():
            self.progress += 1
        elif self.heading:
            point, self.heading = self.heading, None
            self.arrive(point)
        else:
            self.busy = False
            self.did(self.action(self.memory["holder"]))

    def action(self, holder: dict) -> Action:
        step = self.order.steps[holder["step"]]
        return Action(step.action.name, dict(step.action.params), holder["subject"], holder["step"])

    def did(self, action: Action) -> None:
        if action.name in ("pick", "place"):
            item = str(action.params.get("item") or "found")
            self.carries({"task_id": action.task_id, "item": item} if action.name == "pick" else None)
        self.step_done()

    def carries(self, load: dict | None) -> None:
        self.memory["load"] = load
        if self.session:
            self.session.load_since = 0
        self.events.emit(load=link.LoadReport(load=self.memory["load"] and link.Load(**self.memory["load"])))


def key_of(attempt: link.AttemptId) -> str:
    return f"{attempt.subject}/{attempt.epoch}"


def needs(point: link.RoutePoint) -> list[str]:
    """All places to be held on the way to this point."""
    return [*point.passages, *([point.standing] if point.standing else [])]


def flags(description: str | None = None) -> argparse.ArgumentParser:
    """What every robot is told on its command line. The secret that enrols it comes by the variable MIDSHIFT_ENROLL."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="127.0.0.1:7420", help="host:port")
    parser.add_argument("--robot-id", required=True)
    parser.add_argument("--ca", type=pathlib.Path, help="the site's root, PEM; without it everything is plain text")
    parser.add_argument("--data", required=True, type=pathlib.Path, help="a file for what must survive a restart")
    parser.add_argument("--at", required=True, nargs=3, metavar=("WAYPOINT", "X_MM", "Y_MM"), help="where it stands at its first start")
    parser.add_argument("--stop-server", help="the stop service, host:port; that on port 7421 of the server if the robot is enrolled")
    parser.add_argument("--no-stop", action="store_true", help="no line to a stop service")
    return parser


def run(body: Body, args: argparse.Namespace | None = None) -> None:
    """Drives `body` until the program is told to end; by `args` of `flags`, or by the command line."""
    robot = Robot(body, args or flags().parse_args())
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        while True:
            robot.tick()
            time.sleep(TICK_S)
    except KeyboardInterrupt:
        say("told to end")
    finally:
        body.pause()
