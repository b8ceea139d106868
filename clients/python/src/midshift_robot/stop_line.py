"""The line to the stop service: the chapter "Fleet stop" of docs/robot-protocol.md as a program.

An operational stop request, not a safety function: a robot's own emergency stop works without any of this. It has a
connection and a file of its own. Unless it knows better, people may be around this robot, and it minds a silence sooner.
"""

import base64
import pathlib
import queue
import random
import time
from collections import OrderedDict

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from midshift.common.v1 import common_pb2
from midshift.stop.v1 import stop_link_service_pb2 as wire
from midshift.stop.v1 import stop_link_service_pb2_grpc, stop_pb2

from .identity import Identity
from .memory import Memory
from .stream import Stream, now_ms, say

NONE, SLOW = common_pb2.STOP_LEVEL_NONE, common_pb2.STOP_LEVEL_SLOW
HALT, POSTURE = common_pb2.STOP_LEVEL_HALT, common_pb2.STOP_LEVEL_CONTROLLED_STOP_POSTURE
HEARD, STAGE_SLOW, STAND = wire.SILENCE_STAGE_HEARD, wire.SILENCE_STAGE_SLOW, wire.SILENCE_STAGE_STAND
CHECK_IN_MS = 1_000
MISSED_MS = 3_000
BEHIND_MS = 2_000
SLOW_AFTER_MS, STAND_AFTER_MS = 3_000, 6_000
ALONE_SLOW_AFTER_MS, ALONE_STAND_AFTER_MS = 10_000, 30_000
CHECK_INS_GOOD = 3
NEAR_MM = 2_000
LISTED_MAX = 256
UNANSWERED_MAX = 64
ATTEND_BYTES = 256 * 1024
RESETS_MAX = 1_000
RETRY_MS, RETRY_SOON_MS, RETRY_MAX_MS, SOON_FOR_MS = 200, 1_000, 5_000, 10_000
REVOKED_MS = 60_000


def text_of(message) -> str:
    return base64.b64encode(message.SerializeToString()).decode()


class Silence:
    """How long nobody has answered. An answer counts as of the moment at which its check-in was *sent*; three in a row end a silence."""

    def __init__(self) -> None:
        self.fed_ms = self.risen_ms = now_ms()
        self.stage = STAND
        self.good = 0

    def answered(self, sent_ms: float) -> None:
        if sent_ms >= self.fed_ms:
            self.fed_ms = sent_ms
            self.good += sent_ms >= self.risen_ms

    def look(self, is_alone: bool) -> int:
        silent_ms = now_ms() - self.fed_ms
        slow_ms, stand_ms = (ALONE_SLOW_AFTER_MS, ALONE_STAND_AFTER_MS) if is_alone else (SLOW_AFTER_MS, STAND_AFTER_MS)
        due = STAND if silent_ms >= stand_ms else STAGE_SLOW if silent_ms >= slow_ms else HEARD
        if due > self.stage:
            self.stage, self.risen_ms, self.good = due, now_ms(), 0
        elif due > HEARD:
            self.good = 0
        elif self.good >= CHECK_INS_GOOD:
            self.stage = HEARD
        return self.stage


class StopLine:
    """What this robot obeys: `level`, of the stops `inside`, until nothing is `awaiting`."""

    def __init__(self, path: pathlib.Path, server: str, identity: Identity, boot_id: str) -> None:
        self.server, self.identity, self.boot_id = server, identity, boot_id
        # Stops and resets by their names, as the service encoded them. `key` is that of its marks.
        self.memory = Memory(path, {"stops": {}, "resets": {}, "awaiting": [], "key": ""})
        self.inbox: queue.Queue = queue.Queue()
        self.line: Stream | None = None
        self.dial_at_ms, self.failures, self.without_ms, self.told_why = 0.0, 0, now_ms(), ""
        self.silence, self.silence_name = Silence(), None
        self.is_told = self.was_heard = False
        self.level, self.inside = HALT, []
        self.stage = STAND
        self._forget_line()

    def _forget_line(self) -> None:
        self.nonce = random.getrandbits(63)
        self.unanswered: OrderedDict[int, float] = OrderedDict()
        self.heard_ms, self.next_ms = now_ms(), 0.0
        self.generation, self.behind_ms, self.said = 0, None, None

    @property
    def awaiting(self) -> list[str]:
        """What a person has to resume before this robot moves. Stops before silences: a list that is cut loses no stop."""
        return sorted(self.memory["awaiting"], key=lambda name: name.startswith("SILENCE-"))[:LISTED_MAX]

    # --- what it knows

    def _effective(self) -> list[stop_pb2.Stop]:
        known = ((name, text) for name, text in self.memory["stops"].items() if name not in self.memory["resets"])
        return [stop_pb2.Stop.FromString(base64.b64decode(text)) for _, text in known]

    def _add(self, stops, resets) -> None:
        known = {**{stop.stop_id: text_of(stop) for stop in stops}, **self.memory["stops"]}
        over = {**{reset.stop_id: text_of(reset) for reset in resets}, **self.memory["resets"]}
        for name in list(over)[RESETS_MAX:]:
            over.pop(name)
            known.pop(name, None)
        if (known, over) != (self.memory["stops"], self.memory["resets"]):
            self.memory["stops"], self.memory["resets"] = known, over

    def beside(self, facts) -> None:
        """What the session says of stops. A stop counts; a reset that the stop service has marked, and that is not older than its stop."""
        self._add(facts.stops, [reset for reset in facts.resets if self._is_marked(reset) and not self._is_older(reset)])

    def _is_marked(self, reset: stop_pb2.Reset) -> bool:
        bare = stop_pb2.Reset()
        bare.CopyFrom(reset)
        bare.ClearField("proof")
        try:
            key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(self.memory["key"]))
            key.verify(reset.proof, b"midshift reset 1\0" + bare.SerializeToString(deterministic=True))
        except (InvalidSignature, ValueError):
            return False
        return True

    def _is_older(self, reset: stop_pb2.Reset) -> bool:
        known = self.memory["stops"].get(reset.stop_id)
        return known is not None and reset.at_unix_ms < stop_pb2.Stop.FromString(base64.b64decode(known)).engaged_unix_ms

    def resumed(self, names) -> None:
        """People resumed these. One whose stop is effective here waits for its reset."""
        effective = {stop.stop_id for stop in self._effective()}
        left = [name for name in self.memory["awaiting"] if name not in names or name in effective]
        if left != self.memory["awaiting"]:
            self.memory["awaiting"] = left

    def _includes(self, stop: stop_pb2.Stop, position: tuple[int, int]) -> bool:
        if stop.scope.WhichOneof("scope") == "robot_id" and stop.scope.robot_id != self.identity.robot_id:
            return False
        x_mm, y_mm = position
        within = (
            b.x0_mm - NEAR_MM <= x_mm <= b.x1_mm + NEAR_MM and b.y0_mm - NEAR_MM <= y_mm <= b.y1_mm + NEAR_MM for b in stop.boxes
        )
        return not stop.boxes or any(within)

    # --- what it obeys

    def obey(self, position: tuple[int, int], is_alone: bool = False) -> None:
        """Looks what comes of all that is known. Once a stop stood this robot, only that stop's reset and a resume of it let it move."""
        over = sorted((stop for stop in self._effective() if self._includes(stop, position)), key=lambda stop: -stop.level)
        self.inside = [stop.stop_id for stop in over][:LISTED_MAX]
        self.stage = self.silence.look(is_alone)
        self.was_heard = self.was_heard or self.stage < STAND
        stood = [stop.stop_id for stop in over if stop.level >= HALT] + self._silent(is_alone)
        if new := [name for name in stood if name not in self.memory["awaiting"]]:
            self.memory["awaiting"] = [*self.memory["awaiting"], *new]
        silence = {HEARD: NONE, STAGE_SLOW: SLOW}.get(self.stage, POSTURE if self.is_told and self.was_heard else HALT)
        held = HALT if self.memory["awaiting"] or not self.is_told else NONE
        self.level = max([silence, held, *(stop.level for stop in over)])

    def _silent(self, is_alone: bool) -> list[str]:
        """A silence that stood it among people is a person's to end, by the name that it is given here. At the start nobody was heard yet."""
        if self.stage != STAND:
            self.silence_name = None
        elif self.silence_name is None and self.is_told and self.was_heard and not is_alone:
            if not any(name.startswith("SILENCE-") for name in self.memory["awaiting"]):
                self.silence_name = f"SILENCE-{self.identity.robot_id}-{int(time.time() * 1000)}"
                return [self.silence_name]
        return []

    # --- the line

    def tick(self, position: tuple[int, int], is_still: bool, is_alone: bool) -> None:
        """Hears, obeys, keeps and says: again and again, whatever else goes on. `is_alone`: no people walk where it is."""
        while not self.inbox.empty():
            line, message = self.inbox.get()
            if line is self.line:
                self._hear(message)
        self.obey(position, is_alone)
        # It is obeyed before it is written, and said to be durable only then.
        self.memory.save()
        now = now_ms()
        if self.line is None and now >= self.dial_at_ms:
            self._dial()
        elif self.line and (why := self._is_broken(now)):
            self._lost(why)
        elif self.line:
            self._check_in(now, is_still, is_alone)

    def _dial(self) -> None:
        self._forget_line()
        whole, more, room = [], [], ATTEND_BYTES
        for stop in sorted(self._effective(), key=lambda stop: -stop.level):
            room -= stop.ByteSize()
            (whole if room >= 0 and len(whole) < LISTED_MAX else more).append(stop)
        attend = wire.Attend(
            robot_id=self.identity.robot_id,
            boot_id=self.boot_id,
            stops=whole,
            more_stop_ids=[stop.stop_id for stop in more[:LISTED_MAX]],
        )
        channel = self.identity.channel(self.server)
        method = stop_link_service_pb2_grpc.StopLinkServiceStub(channel).Attend
        self.line = Stream(channel, method, wire.AttendRequest(attend=attend), self.inbox)

    def _lost(self, why: str, pause_ms: float | None = None) -> None:
        if why != self.told_why:
            say("stop line lost:", why)
            self.told_why = why
        if self.line:
            self.line.close()
        self.line = None
        if self.failures == 0:
            self.without_ms = now_ms()
        longest_ms = RETRY_SOON_MS if now_ms() - self.without_ms < SOON_FOR_MS else RETRY_MAX_MS
        self.failures += 1
        drawn_ms = random.uniform(RETRY_MS, min(longest_ms, RETRY_MS << min(self.failures, 8)))
        self.dial_at_ms = now_ms() + (drawn_ms if pause_ms is None else pause_ms)

    def _hear(self, message: wire.AttendResponse | None) -> None:
        kind = message and message.WhichOneof("message")
        if message is None:
            # The key of this machine lets nobody in any more, which only a person changes.
            is_revoked = any(b"KEY_DENIED" in value for key, value in self.line.call.trailing_metadata() or () if key.endswith("-bin"))
            self._lost(self.line.why, REVOKED_MS if is_revoked else None)
        elif kind == "facts":
            self._add(message.facts.stops, message.facts.resets)
            self._knows(message.facts_generation)
        elif kind == "synced":
            if message.synced.key and message.synced.key.hex() != self.memory["key"]:
                self.memory["key"] = message.synced.key.hex()
            self.is_told, self.failures, self.told_why = True, 0, ""
            self._knows(message.synced.generation)
        elif kind == "check_in_answer":
            self._answered(message.check_in_answer)
        elif kind == "move_over":
            self._lost("asked to move over", random.uniform(1, 500))

    def _knows(self, generation: int) -> None:
        self.generation, self.behind_ms = max(self.generation, generation), None

    def _answered(self, answer: wire.CheckInAnswer) -> None:
        if answer.nonce not in self.unanswered:
            return
        self.heard_ms = now_ms()
        sent_ms = self.unanswered.pop(answer.nonce)
        while self.unanswered and next(iter(self.unanswered.values())) <= sent_ms:
            self.unanswered.popitem(last=False)  # answers come in order
        if answer.generation > self.generation:
            self.behind_ms = self.behind_ms or now_ms()  # it knows of what it has not told
        else:
            self.silence.answered(sent_ms)

    def _is_broken(self, now: float) -> str | None:
        oldest = next(iter(self.unanswered.values()), self.heard_ms)
        if now - max(oldest, self.heard_ms) >= MISSED_MS:
            return "no answer"
        return "a stop was not told" if self.behind_ms and now - self.behind_ms >= BEHIND_MS else None

    def _check_in(self, now: float, is_still: bool, is_alone: bool) -> None:
        words = wire.CheckIn(
            generation=self.generation,
            durable=not self.memory.dirty,
            obeys=self.level,
            standstill=is_still,
            inside=self.inside,
            awaiting_resume=self.awaiting,
            silence=self.stage,
            without_people=is_alone,
        )
        # A robot that works stands and drives all the time, among people and not: that alone is no news.
        said = wire.CheckIn()
        said.CopyFrom(words)
        said.standstill, said.without_people = is_still and self.level >= HALT, False
        if now < self.next_ms and said == self.said:
            return
        self.nonce += 1
        words.nonce = self.nonce
        self.unanswered[self.nonce] = now
        while len(self.unanswered) > UNANSWERED_MAX:
            self.unanswered.popitem(last=False)
        self.next_ms, self.said = now + CHECK_IN_MS, said
        if not self.line.send(wire.AttendRequest(check_in=words)):
            self._lost("the way up is stuck")
