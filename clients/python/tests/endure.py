"""A client whose server is killed and started again under it. Whoever runs it kills the server at `submitted`, waits for `gave up`,
starts the server at `asking`, and at `again` cancels the task and aborts the roll-out.

    python endure.py 127.0.0.1:7420 ROLLOUT
"""

import sys
import threading

from midshift.ota.v1 import rollout_pb2
from midshift.task.v1 import task_pb2
from midshift_client import Client, DeadlineExceeded


def main() -> None:
    sys.stdout.reconfigure(line_buffering=True)
    flat = task_pb2.FlatTask(task_type="transport", to_waypoint="B03", timeout_seconds=600)
    with Client.from_environment(sys.argv[1]) as midshift:
        task = midshift.submit(flat=flat, request_id="endure-python")
        ended = []
        waiting = threading.Thread(target=lambda: ended.append(midshift.wait(task.task_id, timeout_s=120)), daemon=True)
        waiting.start()
        phases = []
        follow = lambda: phases.extend(seen.rollout.phase for seen in midshift.watch_rollout(sys.argv[2], timeout_s=120))
        following = threading.Thread(target=follow, daemon=True)
        following.start()
        print(f"submitted {task.task_id}")
        sys.stdin.readline()
        try:
            midshift.submit(flat=flat, request_id="endure-python", deadline_s=0.5)
        except DeadlineExceeded as error:
            print(f"gave up {error.code.name}")
        print("asking")
        again = midshift.submit(flat=flat, request_id="endure-python", deadline_s=60)
        print(f"again {again.task_id}")
        waiting.join()
        following.join()
        print(f"rollout {rollout_pb2.RolloutPhase.Name(phases[-1])}")
        print(f"ended {task_pb2.TaskState.Name(ended[0].state)}")


main()
