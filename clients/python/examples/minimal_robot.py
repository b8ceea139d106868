"""A robot whose body is pretended and whose obedience is not: `midshift_robot` with a point for a body.

    python minimal_robot.py --server 127.0.0.1:7420 --robot-id rbt-py --data robot.json --journal effects.txt --at park-a 0 3000

Against a server with TLS it also needs the site's root and, once, the secret that `midshift robot enroll rbt-py` prints:

    MIDSHIFT_ENROLL=mse.ID.SECRET.DIGEST python minimal_robot.py ... --ca midshift-data/identity/ca.pem
"""

import math
import os
import pathlib
import time

from midshift_robot import Action, Body, flags, run


class Point(Body):
    model = "minimal"
    payload_g = 20_000

    def __init__(self, journal: pathlib.Path, speed_mm_s: int, act_s: float) -> None:
        self.journal, self.speed_mm_s, self.act_s = journal, speed_mm_s, act_s
        self.paused_s: float | None = None
        self.action: Action | None = None

    def begin(self, x_mm: int, y_mm: int) -> None:
        self.here = self.goal = (x_mm, y_mm)
        self.since_s = self.until_s = time.monotonic()

    def drive(self, x_mm: int, y_mm: int, speed_mm_s: int) -> None:
        self.here, self.goal, self.action = self.position(), (x_mm, y_mm), None
        self._lasts(math.dist(self.here, self.goal) / speed_mm_s)

    def act(self, action: Action) -> None:
        self.here, self.action = self.goal, action
        self._lasts(self.act_s)

    def _lasts(self, duration_s: float) -> None:
        self.since_s, self.paused_s = time.monotonic(), None
        self.until_s = self.since_s + duration_s

    def is_done(self) -> bool:
        if time.monotonic() < self.until_s:
            return False
        if self.action:
            # What an action did is written down before anybody hears of it.
            with open(self.journal, "a") as journal:
                journal.write(f"{self._line(self.action)}{self.action.params.get('item') or 'found'}\n")
                journal.flush()
                os.fsync(journal.fileno())
        self.here, self.action = self.goal, None
        return True

    def pause(self) -> None:
        self.paused_s = self.paused_s or time.monotonic()

    def resume(self) -> None:
        if self.paused_s:
            stood_s = time.monotonic() - self.paused_s
            self.since_s, self.until_s, self.paused_s = self.since_s + stood_s, self.until_s + stood_s, None

    def position(self) -> tuple[int, int]:
        passed_s, whole_s = (self.paused_s or time.monotonic()) - self.since_s, self.until_s - self.since_s
        share = min(1.0, passed_s / whole_s) if whole_s > 0 else 1.0
        return tuple(round(a + share * (b - a)) for a, b in zip(self.here, self.goal))

    def was_done(self, action: Action) -> bool:
        written = self.journal.read_text().splitlines() if self.journal.exists() else []
        return any(line.startswith(self._line(action)) for line in written)

    @staticmethod
    def _line(action: Action) -> str:
        return f"{action.name} {action.task_id} {action.step} "


if __name__ == "__main__":
    parser = flags(__doc__)
    parser.add_argument("--journal", required=True, type=pathlib.Path)
    parser.add_argument("--speed-mm-s", type=int, default=1500)
    parser.add_argument("--act-ms", type=int, default=500, help="what one action takes")
    told = parser.parse_args()
    run(Point(told.journal, told.speed_mm_s, told.act_ms / 1000), told)
