/**
 * A client whose server is killed and started again under it. Whoever runs it kills the server at `submitted`, waits for `gave up`,
 * starts the server at `asking`, and cancels the task at `again`.
 *
 *     node dist/test/endure.js 127.0.0.1:7420
 */

import { once } from "node:events";
import { TaskState } from "../gen/midshift/task/v1/task_pb.js";
import { Client, MidshiftError, status } from "../src/index.js";

const midshift = new Client(process.argv[2]!);
const flat = { taskType: "transport", toWaypoint: "B03", timeoutSeconds: 600 };
const submit = (deadlineMs: number) => midshift.submit({ requestId: "endure-typescript", body: { case: "flat", value: flat } }, { deadlineMs });
try {
  const { taskId } = await submit(10_000);
  const waiting = midshift.wait(taskId, 120_000);
  console.log(`submitted ${taskId}`);
  await once(process.stdin, "data");
  process.stdin.pause();
  await submit(500).catch((failed: unknown) => {
    if (!(failed instanceof MidshiftError) || failed.code !== status.DEADLINE_EXCEEDED) throw failed;
    console.log(`gave up ${status[failed.code]}`);
  });
  console.log("asking");
  const again = await submit(60_000);
  console.log(`again ${again.taskId}`);
  const ended = await waiting;
  console.log(`ended ${TaskState[ended.state]}`);
} finally {
  midshift.close();
}
