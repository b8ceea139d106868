"""A tour: submit, watch, explain, a bad request, a roll-out.

    python tour.py 127.0.0.1:7420 [ROBOT BUNDLE]

With a robot and a bundle (`rbt-01 walk-1.5.0`) it also brings that bundle to that robot and watches how.
"""

import os
import pathlib
import sys

from google.protobuf import duration_pb2
from midshift.ota.v1 import rollout_pb2, rollout_service_pb2
from midshift.task.v1 import task_pb2, task_service_pb2
from midshift_client import Client, InvalidRequest


def transport(midshift: Client) -> None:
    flat = task_pb2.FlatTask(
        task_type="transport",
        from_waypoint="A01",
        to_waypoint="B03",
        item_sku="SKU-88231",
        timeout_seconds=600,
    )
    task = midshift.submit(flat=flat, deadline_s=5)
    print(f"submitted {task.task_id}")

    why = midshift.explain(task.task_id)
    verdict = why.verdict.message or why.verdict.code or "nothing holds it"
    print(f"explained {why.task_id}: {verdict}; {len(why.candidates)} candidates")

    for seen in midshift.watch(task_service_pb2.TaskFilter(task_ids=[task.task_id]), timeout_s=120):
        print(f"watched {task_pb2.TaskState.Name(seen.state)} {seen.robot_id}".rstrip())
        if seen.state == task_pb2.TASK_STATE_SUCCEEDED:
            break
    ended = midshift.wait(task.task_id, timeout_s=30)
    print(f"ended {task_pb2.TaskState.Name(ended.state)}")


def bad_request(midshift: Client) -> None:
    bad = task_pb2.FlatTask(task_type="Bad Type", priority=12, to_waypoint="nowhere")
    try:
        midshift.submit(flat=bad)
    except InvalidRequest as refused:
        print(f"refused {refused.reason}")
        for violation in refused.violations:
            print(f"violation {violation}")


def approver(server: str) -> Client:
    """Whoever wrote a roll-out does not approve it: somebody else, whose token is in MIDSHIFT_APPROVER_TOKEN. In `midshift dev` nobody is anybody."""
    token = os.environ.get("MIDSHIFT_APPROVER_TOKEN")
    if not token:
        return Client.from_environment(server)
    return Client(server, authority_pem=pathlib.Path(os.environ["MIDSHIFT_CA"]).read_bytes(), token=token)


def rollout(midshift: Client, robot_id: str, bundle: str) -> None:
    rollout_id = f"tour-python-{robot_id}"
    spec = rollout_pb2.RolloutSpec(
        bundle=bundle,
        selector=rollout_pb2.RolloutSelector(robot_ids=[robot_id]),
        waves=[rollout_pb2.RolloutWave(rest=True)],
        probation=duration_pb2.Duration(seconds=1),
        soak=duration_pb2.Duration(),
        exposure_tasks=0,
        allow_full_push=True,
    )
    calls = midshift.rollouts
    midshift.call(calls.CreateRollout, rollout_service_pb2.CreateRolloutRequest(rollout_id=rollout_id, spec=spec))
    midshift.call(calls.SubmitRollout, rollout_service_pb2.SubmitRolloutRequest(rollout_id=rollout_id))
    with approver(sys.argv[1]) as other:
        other.call(other.rollouts.ApproveRollout, rollout_service_pb2.ApproveRolloutRequest(rollout_id=rollout_id))
    midshift.call(calls.StartRollout, rollout_service_pb2.StartRolloutRequest(rollout_id=rollout_id))
    for seen in midshift.watch_rollout(rollout_id, timeout_s=180):
        print(f"rollout {rollout_pb2.RolloutPhase.Name(seen.rollout.phase)} wave {seen.rollout.wave}")
        for robot in seen.robots:
            print(f"rollout robot {robot.robot_id} {rollout_pb2.RolloutStep.Name(robot.step)}")


def main() -> None:
    sys.stdout.reconfigure(line_buffering=True)
    with Client.from_environment(sys.argv[1]) as midshift:
        bad_request(midshift)
        transport(midshift)
        if len(sys.argv) > 3:
            rollout(midshift, sys.argv[2], sys.argv[3])


main()
