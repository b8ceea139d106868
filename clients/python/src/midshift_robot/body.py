"""What a machine must offer so that `run` can drive it: one thing at a time, begun by a call and asked for until it is done."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Action:
    """One action of a task."""

    name: str
    """One of the body's capabilities."""
    params: dict
    """What whoever gave the task said; `item` of transports: what to take or to put down."""
    task_id: str
    step: int
    """Index of its step in the task."""


class Body:
    """A machine. Each call returns at once; everything happens on one thread. What it does not say of itself here is not asked of it."""

    capabilities = ["pick", "place"]
    model = "robot"
    software = "1.0.0"
    payload_g = 0
    speed_mm_s = 1_000
    """The fastest that it may drive, whatever anybody asks for."""

    def begin(self, x_mm: int, y_mm: int) -> None:
        """It was ended there, or stands there at its first start. A body that sees by itself where it is ignores this."""

    def drive(self, x_mm: int, y_mm: int, speed_mm_s: int) -> None:
        """Begins a way straight to this point, or goes on with it at another speed."""
        raise NotImplementedError

    def act(self, action: Action) -> None:
        """Begins an action."""
        raise NotImplementedError

    def is_done(self) -> bool:
        """Whether it has come to the end of what was begun last. Asked again and again, and not while it is paused."""
        raise NotImplementedError

    def pause(self) -> None:
        """Stands at once, and keeps what was begun. Called too when the program ends."""
        raise NotImplementedError

    def resume(self) -> None:
        """Goes on with it."""
        raise NotImplementedError

    def position(self) -> tuple[int, int]:
        """Where it is, millimetres east and north."""
        raise NotImplementedError

    def was_done(self, action: Action) -> bool | None:
        """After a restart: whether this action, which may have been under way, was done. None: it cannot tell, and a person is asked."""
        return None
