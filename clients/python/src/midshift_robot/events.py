"""Lane EVENT: facts that are numbered, kept until the server has acknowledged them, and said again from wherever it asks."""

import time

from google.protobuf import json_format
from midshift.common.v1 import common_pb2
from midshift.link.v1 import link_pb2 as link

from .memory import Memory

EVENT = link.LANE_EVENT
SAMPLES_PER_MESSAGE = 256


class Events:
    """The numbers of the lane, in the memory of the robot; `cursor` is the last one that was sent in the session at hand."""

    def __init__(self, memory: Memory) -> None:
        self.memory = memory
        self.cursor = 0

    def emit(self, **event) -> None:
        seq = self.memory["produced"] + 1
        sample = link.Sample(seq=seq, robot_unix_ms=int(time.time() * 1000), event=link.RobotEvent(**event))
        self.memory["produced"] = seq
        self.memory["samples"] = [*self.memory["samples"], json_format.MessageToDict(sample)]

    def position(self, hello: link.Hello) -> None:
        """Where the lane is, for a Hello."""
        kept = [int(s["seq"]) for s in self.memory["samples"]] + [gap["from"] for gap in self.memory["gaps"]]
        if self.memory["produced"]:
            next_seq = self.memory["produced"] + 1
            hello.lanes.add(lane=EVENT, first_seq=min(kept, default=next_seq), next_seq=next_seq)

    def welcomed(self, acks) -> None:
        """A session begins: all that is kept is sent again, from what the server has."""
        for ack in acks:
            if ack.lane == EVENT and ack.seq > self.memory["produced"]:
                # The server knows numbers that this memory does not: it was put back. Numbers go on behind them.
                moved = [{**s, "seq": str(ack.seq + 1 + i)} for i, s in enumerate(self.memory["samples"])]
                self.memory["samples"], self.memory["gaps"] = moved, []
                self.memory["acked"], self.memory["produced"] = ack.seq, ack.seq + len(moved)
            self._acked(ack)
        self.cursor = self.memory["acked"]
        for ack in acks:
            self._expected(ack)

    def heard(self, acks) -> None:
        for ack in acks:
            self._acked(ack)
            self._expected(ack)

    def _acked(self, ack: link.LaneAck) -> None:
        if ack.lane == EVENT and ack.seq > self.memory["acked"]:
            self.memory["acked"] = min(ack.seq, self.memory["produced"])
            self.memory["samples"] = [s for s in self.memory["samples"] if int(s["seq"]) > ack.seq]
            self.memory["gaps"] = [gap for gap in self.memory["gaps"] if gap["to"] > ack.seq]

    def _expected(self, ack: link.LaneAck) -> None:
        """The server saw a hole: again from there, or the word that it will never come."""
        if ack.lane != EVENT or not ack.HasField("expect"):
            return
        first = min((int(s["seq"]) for s in self.memory["samples"]), default=self.memory["produced"] + 1)
        if ack.expect < first:
            self.memory["gaps"] = [{"from": ack.expect, "to": first - 1}]
        self.cursor = ack.expect - 1

    def batch(self) -> link.LaneBatch | None:
        """What is to be sent now; none: nothing is."""
        batch = link.LaneBatch(lane=EVENT)
        for gap in self.memory["gaps"]:
            if gap["to"] > self.cursor:
                reason = common_pb2.Reason(code="FREED_AFTER_ACK")
                batch.gaps.append(link.Gap(from_seq=gap["from"], to_seq=gap["to"], reason=reason))
                self.cursor = gap["to"]
        for kept in self.memory["samples"]:
            if int(kept["seq"]) > self.cursor and len(batch.samples) < SAMPLES_PER_MESSAGE - 1:
                batch.samples.append(json_format.ParseDict(kept, link.Sample()))
                self.cursor = int(kept["seq"])
        return batch if batch.samples or batch.gaps else None
