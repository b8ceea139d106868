"""A thin client of midshift: one channel, a deadline for each call, retries, typed errors, and waiting that outlives a server.

    with Client("127.0.0.1:7420") as midshift:
        task = midshift.submit(flat=FlatTask(...))
        print(midshift.wait(task.task_id, timeout_s=600).state)

Messages and stubs are in `midshift.<noun>.v1`, as protoc makes them.
"""

from .client import Client, service_config
from .errors import (
    AlreadyExists,
    Conflict,
    CursorExpired,
    DeadlineExceeded,
    InvalidRequest,
    MidshiftError,
    NotFound,
    Overloaded,
    PreconditionFailed,
    Unavailable,
    Violation,
    error_of,
)

__all__ = [
    "AlreadyExists",
    "Client",
    "Conflict",
    "CursorExpired",
    "DeadlineExceeded",
    "InvalidRequest",
    "MidshiftError",
    "NotFound",
    "Overloaded",
    "PreconditionFailed",
    "Unavailable",
    "Violation",
    "error_of",
    "service_config",
]
