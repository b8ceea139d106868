/**
 * A client whose server is killed and started again under it. Whoever runs it kills the server at `submitted`, waits for `gave up`,
 * starts the server at `asking`, and at `again` cancels the task and aborts the roll-out.
 *
 *     node dist/test/endure.js 127.0.0.1:7420 ROLLOUT
 */

import { once } from "node:events";
import { RolloutPhase } from "../gen/midshift/ota/v1/rollout_pb.js";
import { TaskState } from "../gen/midshift/task/v1/task_pb.js";
import { Client, fromEnvironment, MidshiftError, status } from "../src/index.js";

const [server, rolloutId] = process.argv.slice(2) as [string, string];
const midshift = new Client(server, fromEnvironment());
const flat = { taskType: "transport", toWaypoint: "B03", timeoutSeconds: 600 };
const submit = (deadlineMs: number) => midshift.submit({ requestId: "endure-typescript", body: { case: "flat", value: flat } }, { deadlineMs });
async function lastPhase(): Promise<RolloutPhase | undefined> {
  let phase: RolloutPhase | undefined;
  for await (const { rollout } of midshift.watchRollout(rolloutId, 120_000)) phase = rollout?.phase;
  return phase;
}

try {
  const { taskId } = await submit(10_000);
  const waiting = midshift.wait(taskId, 120_000);
  const following = lastPhase();
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
  console.log(`rollout ${RolloutPhase[(await following)!]}`);
  console.log(`ended ${TaskState[ended.state]}`);
} finally {
  midshift.close();
}
