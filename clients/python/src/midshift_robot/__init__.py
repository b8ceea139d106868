"""A robot of one's own in Python, without its software being changed from here: docs/make-a-robot.md.

    class Cart(Body):
        ...

    run(Cart())

It speaks link.v1, stop.v1 and the enrolment of identity.v1 by itself, as docs/robot-protocol.md says.
"""

from .body import Action, Body
from .robot import flags, run

__all__ = ["Action", "Body", "flags", "run"]
