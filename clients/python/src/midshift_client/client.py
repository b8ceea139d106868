"""The channel, the calls that people make most, and the two watches that outlive a restart of the server."""

from __future__ import annotations

import importlib.resources
import os
import pathlib
import random
import time
import uuid
from collections.abc import Iterator
from typing import Any

import grpc
from midshift.fleet.v1 import fleet_pb2, fleet_service_pb2, fleet_service_pb2_grpc
from midshift.ota.v1 import rollout_pb2, rollout_service_pb2, rollout_service_pb2_grpc
from midshift.task.v1 import task_pb2, task_service_pb2, task_service_pb2_grpc
from midshift.telemetry.v1 import telemetry_service_pb2_grpc

from .errors import CursorExpired, DeadlineExceeded, NotFound, PreconditionFailed, Unavailable, error_of

#: Seconds that a call may take unless the caller says otherwise.
DEADLINE_S = 10.0
#: Shortest and longest pause before a watch is opened again, seconds.
PAUSE_S = (0.1, 5.0)

#: A task does not leave these.
TASK_ENDED = frozenset(
    {task_pb2.TASK_STATE_SUCCEEDED, task_pb2.TASK_STATE_FAILED, task_pb2.TASK_STATE_CANCELED, task_pb2.TASK_STATE_EXPIRED}
)
#: A roll-out does not leave these.
ROLLOUT_ENDED = frozenset(
    {
        rollout_pb2.ROLLOUT_PHASE_COMPLETED,
        rollout_pb2.ROLLOUT_PHASE_ABORTED,
        rollout_pb2.ROLLOUT_PHASE_SUPERSEDED,
    }
)


def service_config() -> str:
    """Which calls are tried again after UNAVAILABLE, and how often: the rules that all clients share, as JSON."""
    return importlib.resources.files(__package__).joinpath("service_config.json").read_text(encoding="utf-8")


def _credentials(authority_pem: bytes, token: str | None) -> grpc.ChannelCredentials:
    tls = grpc.ssl_channel_credentials(authority_pem)
    return grpc.composite_channel_credentials(tls, grpc.access_token_call_credentials(token)) if token else tls


def _channel(server: str, authority_pem: bytes | None, token: str | None) -> grpc.Channel:
    options = [
        ("grpc.service_config", service_config()),
        ("grpc.enable_retries", 1),
        # A server that is gone without a word is noticed within 40 s, also while nothing but a watch is open.
        ("grpc.keepalive_time_ms", 30_000),
        ("grpc.keepalive_timeout_ms", 10_000),
        ("grpc.http2.max_pings_without_data", 0),
        ("grpc.initial_reconnect_backoff_ms", 200),
        ("grpc.min_reconnect_backoff_ms", 200),
        ("grpc.max_reconnect_backoff_ms", 5_000),
    ]
    if authority_pem is not None:
        return grpc.secure_channel(server, _credentials(authority_pem, token), options)
    if token:
        raise ValueError("a token goes to no server whose root is not known: give authority_pem too")
    return grpc.insecure_channel(server, options)


class _Pause:
    """Growing pauses with jitter, begun anew whenever something was heard."""

    def __init__(self) -> None:
        self._next_s = PAUSE_S[0]

    def heard(self) -> None:
        self._next_s = PAUSE_S[0]

    def rest(self, until: float) -> None:
        """Waits, but not beyond `until` of the monotonic clock."""
        time.sleep(max(0.0, min(self._next_s * random.uniform(0.5, 1.0), until - time.monotonic())))
        self._next_s = min(self._next_s * 2, PAUSE_S[1])


class Client:
    """One server. Safe to share between threads; close it, or use it in a `with`."""

    def __init__(self, server: str, *, authority_pem: bytes | None = None, token: str | None = None) -> None:
        """`server` is host:port, `authority_pem` the site's root, `token` one that `midshift token create` printed.

        Without a root it speaks plain text, as `midshift dev` does, and takes no token. Connects when it is used.
        """
        self._channel = _channel(server, authority_pem, token)
        #: Stubs for everything that has no method here: `call` gives them deadline and typed errors.
        self.tasks = task_service_pb2_grpc.TaskServiceStub(self._channel)
        self.fleet = fleet_service_pb2_grpc.FleetServiceStub(self._channel)
        self.telemetry = telemetry_service_pb2_grpc.TelemetryServiceStub(self._channel)
        self.rollouts = rollout_service_pb2_grpc.RolloutServiceStub(self._channel)

    @classmethod
    def from_environment(cls, server: str) -> Client:
        """Signed in as the command line is: by the file that MIDSHIFT_CA names, and MIDSHIFT_TOKEN. Neither is set: plain text."""
        authority, token = os.environ.get("MIDSHIFT_CA"), os.environ.get("MIDSHIFT_TOKEN")
        return cls(server, authority_pem=pathlib.Path(authority).read_bytes() if authority else None, token=token)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the channel and every watch on it."""
        self._channel.close()

    def call(self, method: Any, request: Any, deadline_s: float = DEADLINE_S) -> Any:
        """One call of a stub. Raises a `MidshiftError`."""
        try:
            return method(request, timeout=deadline_s)
        except grpc.RpcError as failed:
            raise error_of(failed) from failed

    def submit(
        self,
        *,
        flat: task_pb2.FlatTask | None = None,
        spec: task_pb2.TaskSpec | None = None,
        task_id: str = "",
        request_id: str = "",
        deadline_s: float = DEADLINE_S,
    ) -> task_pb2.Task:
        """Admits one task, durable when this returns. May be tried again under way: a request_id is drawn if none is given.

        Keep your own request_id, and after `Unavailable` or `DeadlineExceeded` submit again with it: the task is not made twice.
        """
        request = task_service_pb2.SubmitTaskRequest(
            request_id=request_id or str(uuid.uuid4()), task_id=task_id, flat=flat, spec=spec
        )
        return self.call(self.tasks.SubmitTask, request, deadline_s).task

    def get(self, task_id: str, deadline_s: float = DEADLINE_S) -> task_pb2.Task:
        """One task. Raises `NotFound`."""
        return self.call(self.tasks.GetTask, task_service_pb2.GetTaskRequest(task_id=task_id), deadline_s).task

    def explain(self, task_id: str, deadline_s: float = DEADLINE_S) -> fleet_pb2.TaskExplanation:
        """Why a task is where it is."""
        request = fleet_service_pb2.ExplainTaskRequest(task_id=task_id)
        return self.call(self.fleet.ExplainTask, request, deadline_s).explanation

    def watch(self, filter: task_service_pb2.TaskFilter, timeout_s: float) -> Iterator[task_pb2.Task]:
        """The tasks that match as they are, and then each change in commit order, without loss, across restarts of the server.

        If the server cannot go on from where it was (the data is another's, or too much happened), it begins again with the tasks
        as they are. Ends with `DeadlineExceeded`.
        """
        for message in self._watch(filter, timeout_s):
            if message is not None:
                yield message

    def wait(self, task_id: str, timeout_s: float) -> task_pb2.Task:
        """Waits until a task has ended, whatever its end. Raises `NotFound`, or `DeadlineExceeded` after `timeout_s`."""
        known = False
        for task in self._watch(task_service_pb2.TaskFilter(task_ids=[task_id]), timeout_s):
            if task is None and not known:
                task = self.get(task_id)
            known = True
            if task is not None and task.state in TASK_ENDED:
                return task
        raise NotFound(grpc.StatusCode.NOT_FOUND, f"{task_id} is not watched any more")

    def _watch(self, filter: task_service_pb2.TaskFilter, timeout_s: float) -> Iterator[task_pb2.Task | None]:
        """As `watch`; none is a bookmark: everything up to here was said."""
        until, pause, cursor = time.monotonic() + timeout_s, _Pause(), ""
        while True:
            request = task_service_pb2.WatchTasksRequest(filter=filter, cursor=cursor)
            try:
                for message in self.tasks.WatchTasks(request, timeout=_left(until), wait_for_ready=True):
                    pause.heard()
                    # While existing tasks are sent there is no cursor yet: a break begins again.
                    cursor = message.cursor
                    kind = message.WhichOneof("item")
                    yield message.existing if kind == "existing" else message.change.task if kind == "change" else None
            except grpc.RpcError as failed:
                error = error_of(failed)
                if isinstance(error, (CursorExpired, PreconditionFailed)) and cursor:
                    cursor = ""
                elif not isinstance(error, Unavailable):
                    raise error from failed
            pause.rest(until)

    def watch_rollout(self, rollout_id: str, timeout_s: float) -> Iterator[rollout_service_pb2.WatchRolloutResponse]:
        """A roll-out with the robots that changed, now and with each change, to its end, across restarts of the server."""
        until, pause = time.monotonic() + timeout_s, _Pause()
        request = rollout_service_pb2.WatchRolloutRequest(rollout_id=rollout_id)
        while True:
            try:
                for message in self.rollouts.WatchRollout(request, timeout=_left(until), wait_for_ready=True):
                    pause.heard()
                    yield message
                    if message.rollout.phase in ROLLOUT_ENDED:
                        return
            except grpc.RpcError as failed:
                error = error_of(failed)
                if not isinstance(error, Unavailable):
                    raise error from failed
            pause.rest(until)


def _left(until: float) -> float:
    left = until - time.monotonic()
    if left <= 0:
        raise DeadlineExceeded(grpc.StatusCode.DEADLINE_EXCEEDED, "the time for this wait is over")
    return left
