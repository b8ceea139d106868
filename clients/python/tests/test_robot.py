"""What a robot decides alone: whom it obeys, and what it begins from memory."""

import pathlib
import tempfile
import unittest
from unittest import mock

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from midshift.link.v1 import link_pb2 as link
from midshift.stop.v1 import stop_link_service_pb2 as wire
from midshift.stop.v1 import stop_pb2
from midshift_robot import Action, Body, flags
from midshift_robot import stop_line as stops
from midshift_robot.robot import Robot


class Still(Body):
    """A body that writes down what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def drive(self, x_mm: int, y_mm: int, speed_mm_s: int) -> None:
        self.told.append(f"drive at {speed_mm_s}")

    def act(self, action: Action) -> None:
        self.told.append(action.name)

    def is_done(self) -> bool:
        return False

    def pause(self) -> None:
        self.told.append("pause")

    def resume(self) -> None:
        self.told.append("resume")

    def position(self) -> tuple[int, int]:
        return 0, 0


class Clock:
    """The monotonic clock of the module under test."""

    def __init__(self, test: unittest.TestCase) -> None:
        self.ms = 1_000_000.0
        for module in ("stop_line", "robot"):
            patched = mock.patch(f"midshift_robot.{module}.now_ms", lambda: self.ms)
            patched.start()
            test.addCleanup(patched.stop)


def stop(name: str, level: int, *boxes: stop_pb2.Box) -> stop_pb2.Stop:
    return stop_pb2.Stop(stop_id=name, scope=stop_pb2.Scope(fleet=stop_pb2.Fleet()), level=level, engaged_unix_ms=5, boxes=boxes)


class Stopped(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.data = pathlib.Path(folder.name) / "robot.json"
        self.clock = Clock(self)
        self.body = Still()
        self.robot = self.begun()
        self.line = self.robot.stops

    def begun(self) -> Robot:
        told = ["--robot-id", "r1", "--data", str(self.data), "--at", "park", "0", "0", "--stop-server", "127.0.0.1:1"]
        return Robot(self.body, flags().parse_args(told))

    def answered(self, times: int = 3) -> None:
        """So many check-ins, a second apart, with their answers."""
        for _ in range(times):
            self.clock.ms += 1_000
            self.line.silence.answered(self.clock.ms)

    def free(self) -> None:
        self.line.is_told = True
        self.answered()
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.NONE)

    def test_it_stands_until_it_was_told_and_answered_three_times(self):
        self.line.obey((0, 0))
        self.assertEqual((self.line.level, self.robot.stopped), (stops.HALT, True))
        self.answered()
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.HALT, "answered, and not told")
        self.line.is_told = True
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.NONE)

    def test_a_stop_ends_by_its_reset_and_a_resume_in_either_order_and_outlives_a_restart(self):
        self.free()
        self.line._hear(wire.AttendResponse(facts=stop_pb2.StopFacts(stops=[stop("STOP-1", stops.HALT)]), facts_generation=7))
        self.line.obey((0, 0))
        self.assertEqual((self.line.level, self.line.inside, self.line.awaiting), (stops.HALT, ["STOP-1"], ["STOP-1"]))
        self.line.memory.save()
        self.robot = self.begun()
        self.line = self.robot.stops
        self.line.is_told = True
        self.answered()
        self.line.resumed(["STOP-1"])
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.HALT, "a resume that overtakes the reset waits for it")
        reset = stop_pb2.Reset(stop_id="STOP-1", at_unix_ms=6)
        self.line._hear(wire.AttendResponse(facts=stop_pb2.StopFacts(resets=[reset]), facts_generation=8))
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.HALT, "a reset moves nobody")
        self.line.resumed(["STOP-1"])
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.NONE)

    def test_a_stop_of_a_part_is_for_robots_in_it_or_near_it(self):
        self.free()
        self.line._add([stop("STOP-1", stops.SLOW, stop_pb2.Box(x0_mm=5_000, y0_mm=-1_000, x1_mm=9_000, y1_mm=1_000))], [])
        for x_mm, level in [(2_999, stops.NONE), (3_000, stops.SLOW), (11_000, stops.SLOW), (11_001, stops.NONE)]:
            self.line.obey((x_mm, 0))
            self.assertEqual(self.line.level, level, x_mm)

    def test_a_reset_beside_the_line_counts_if_the_stop_service_has_marked_it(self):
        self.free()
        key = Ed25519PrivateKey.generate()
        self.line._hear(wire.AttendResponse(synced=wire.Synced(generation=1, key=key.public_key().public_bytes_raw())))
        self.line._add([stop("STOP-1", stops.SLOW)], [])
        reset = stop_pb2.Reset(stop_id="STOP-1", at_unix_ms=6, actor="a", reason="b")
        older = stop_pb2.Reset(stop_id="STOP-1", at_unix_ms=4, actor="a", reason="b")
        older.proof = key.sign(b"midshift reset 1\0" + older.SerializeToString())
        for wrong in (reset, older):
            self.line.beside(mock.Mock(stops=[], resets=[wrong]))
            self.assertEqual(self.line.memory["resets"], {})
        reset.proof = key.sign(b"midshift reset 1\0" + reset.SerializeToString())
        self.line.beside(mock.Mock(stops=[], resets=[reset]))
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.NONE)

    def test_a_silence_slows_then_stands_and_a_person_ends_it(self):
        self.free()
        for passed_ms, level in [(2_999, stops.NONE), (1, stops.SLOW), (3_000, stops.POSTURE)]:
            self.clock.ms += passed_ms
            self.line.obey((0, 0))
            self.assertEqual(self.line.level, level)
        self.answered()
        self.line.obey((0, 0))
        (name,) = self.line.awaiting
        self.assertEqual((name.startswith("SILENCE-r1-"), self.line.level), (True, stops.HALT))
        self.line.resumed([name])
        self.line.obey((0, 0))
        self.assertEqual(self.line.level, stops.NONE)

    def test_where_no_people_walk_it_bears_a_silence_for_longer_and_goes_on_by_itself(self):
        self.free()
        for passed_ms, level in [(9_999, stops.NONE), (1, stops.SLOW), (20_000, stops.POSTURE)]:
            self.clock.ms += passed_ms
            self.line.obey((0, 0), is_alone=True)
            self.assertEqual(self.line.level, level)
        self.answered()
        self.line.obey((0, 0), is_alone=True)
        self.assertEqual((self.line.level, self.line.awaiting), (stops.NONE, []))

    def test_what_a_stop_broke_off_goes_on_after_a_fresh_echo_and_the_resume_alone(self):
        robot = self.robot
        self.free()
        robot.stopped, robot.told_stop = False, None
        robot.memory["holder"] = {"subject": "T1", "epoch": 1, "step": 0, "opened": False, "intent": None, "elapsed_ms": 0, "base_mm": 0}
        robot.session = mock.Mock(observed=False, epoch=3)
        robot.desired = link.DesiredWork(generation=1)
        robot.sent = {1: self.clock.ms}
        robot.lease_from_ms = self.clock.ms
        robot.set_out(link.RoutePoint(waypoint="b", x_mm=9_000))
        self.line._add([stop("STOP-1", stops.HALT)], [])
        with mock.patch.object(self.line, "tick", lambda position, *_: self.line.obey(position)):
            self.turn()
            self.assertEqual((self.body.told, robot.resume_needed), (["drive at 1000", "pause"], True))
            self.line._add([], [stop_pb2.Reset(stop_id="STOP-1", at_unix_ms=6)])
            self.clock.ms += 1
            self.turn()
            robot.desired = link.DesiredWork(generation=2, resumed=["STOP-1"])
            self.turn()
            self.assertEqual((self.line.level, robot.stopped), (stops.NONE, True), "resumed, and the hold has not ended")
            robot.desired.resume.session_epoch, robot.desired.resume.hb, robot.desired.resume.valid_ms = 3, 1, 10_000
            self.clock.ms += 1
            self.turn()
            self.assertEqual((robot.resume_needed, self.body.told[-1]), (False, "pause"), "nothing was echoed since")
            robot.lease_from_ms = self.clock.ms
            self.turn()
            self.assertEqual((self.body.told[-1], robot.stopped), ("resume", False))

    def turn(self) -> None:
        self.robot.mind_stops()
        self.robot.mind_hold()

    def test_nobody_guesses_whether_a_step_was_done(self):
        step = link.WorkStep(action=link.WorkAction(name="pick"), effect=link.WORK_EFFECT_AT_MOST_ONCE)
        self.robot.order = link.Assignment(steps=[step])
        holder = {"subject": "T1", "epoch": 1, "step": 0, "opened": False, "intent": 0, "elapsed_ms": 0, "base_mm": 0}
        self.robot.memory["holder"] = holder
        self.robot.act(holder, step)
        self.assertEqual((self.robot.work_state(), holder["opened"]), (link.WORK_STATE_STEP_UNKNOWN, True))
        self.assertEqual(self.body.told, [])


if __name__ == "__main__":
    unittest.main()
