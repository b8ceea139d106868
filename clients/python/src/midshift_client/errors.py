"""What a call that failed says: gRPC's code, midshift's reason, and every broken rule.

A caller catches `MidshiftError`, or the kind of it that it can do something about.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import grpc
from google.rpc import error_details_pb2
from grpc_status import rpc_status

#: `ErrorInfo.domain` of every error that midshift itself makes.
DOMAIN = "midshift"


@dataclass(frozen=True)
class Violation:
    """One broken rule of a request."""

    #: Path into the request, e.g. `flat.timeout_seconds`; empty: the request as a whole.
    field: str
    #: The rule, as a person reads it.
    description: str

    def __str__(self) -> str:
        return f"{self.field}: {self.description}" if self.field else self.description


@dataclass
class MidshiftError(Exception):
    """A call that failed. What the server did not say is empty."""

    #: gRPC's own code.
    code: grpc.StatusCode
    #: The sentence.
    message: str
    #: midshift's reason, UPPER_SNAKE; empty: the error is not midshift's own, e.g. a connection that could not be made.
    reason: str = ""
    #: Facts behind the reason.
    metadata: dict[str, str] = field(default_factory=dict)
    #: Every broken rule.
    violations: list[Violation] = field(default_factory=list)
    #: Seconds to wait before the next try; none: not said.
    retry_after_s: float | None = None
    #: To find it in the server's log.
    request_id: str = ""

    def __str__(self) -> str:
        shown = f"{self.code.name} {self.reason}".rstrip() + f": {self.message}"
        return "; ".join([shown, *map(str, self.violations)])


class InvalidRequest(MidshiftError):
    """The request breaks rules; `violations` has all of them. Sending it again does not help."""


class NotFound(MidshiftError):
    """There is nothing of this id."""


class AlreadyExists(MidshiftError):
    """The request_id or the id was used for something else."""


class PreconditionFailed(MidshiftError):
    """Not in the state that it is in; `reason` says which rule stands against it."""


class CursorExpired(MidshiftError):
    """The cursor is older than what the server keeps: begin again without one."""


class Conflict(MidshiftError):
    """It changed since the caller saw it: look again."""


class Overloaded(MidshiftError):
    """A limit was reached; `retry_after_s` says when to try again."""


class Unavailable(MidshiftError):
    """The server could not be reached, or cannot answer now. Whether it did what was asked is not known."""


class DeadlineExceeded(MidshiftError):
    """No answer in time. Whether the server did what was asked is not known."""


_KINDS: dict[grpc.StatusCode, type[MidshiftError]] = {
    grpc.StatusCode.INVALID_ARGUMENT: InvalidRequest,
    grpc.StatusCode.NOT_FOUND: NotFound,
    grpc.StatusCode.ALREADY_EXISTS: AlreadyExists,
    grpc.StatusCode.FAILED_PRECONDITION: PreconditionFailed,
    grpc.StatusCode.OUT_OF_RANGE: CursorExpired,
    grpc.StatusCode.ABORTED: Conflict,
    grpc.StatusCode.RESOURCE_EXHAUSTED: Overloaded,
    grpc.StatusCode.UNAVAILABLE: Unavailable,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineExceeded,
}


def error_of(failed: grpc.RpcError) -> MidshiftError:
    """What a failed call says. Never fails itself: details that cannot be read are as if they were not there."""
    code = failed.code()
    error = _KINDS.get(code, MidshiftError)(code=code, message=failed.details() or "")
    try:
        status = rpc_status.from_call(failed)
    except ValueError:
        status = None
    for detail in status.details if status else []:
        _read(error, detail)
    return error


def _read(error: MidshiftError, detail) -> None:
    info = error_details_pb2.ErrorInfo()
    bad = error_details_pb2.BadRequest()
    retry = error_details_pb2.RetryInfo()
    request = error_details_pb2.RequestInfo()
    if detail.Is(info.DESCRIPTOR) and detail.Unpack(info) and info.domain == DOMAIN:
        error.reason, error.metadata = info.reason, dict(info.metadata)
    elif detail.Is(bad.DESCRIPTOR) and detail.Unpack(bad):
        error.violations = [Violation(v.field, v.description) for v in bad.field_violations]
    elif detail.Is(retry.DESCRIPTOR) and detail.Unpack(retry):
        error.retry_after_s = retry.retry_delay.ToTimedelta().total_seconds()
    elif detail.Is(request.DESCRIPTOR) and detail.Unpack(request):
        error.request_id = request.request_id
