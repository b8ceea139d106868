"""One batch of many small items over one call; prints how many were admitted.

    python batch.py 127.0.0.1:7420 PREFIX COUNT
"""

import sys

from midshift.task.v1 import task_pb2, task_service_pb2
from midshift_client import Client


def main() -> None:
    server, prefix, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    flat = task_pb2.FlatTask(task_type="transport", to_waypoint="B03", timeout_seconds=600)
    items = (task_service_pb2.SubmitTaskRequest(request_id=f"{prefix}-{i}", flat=flat) for i in range(count))
    messages = (task_service_pb2.SubmitTasksRequest(item=item) for item in items)
    with Client.from_environment(server) as midshift:
        answer = midshift.call(midshift.tasks.SubmitTasks, messages, deadline_s=60)
    print(f"admitted {sum(bool(result.task_id) for result in answer.results)}")


main()
