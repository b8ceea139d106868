/**
 * A tour: submit, watch, explain, a bad request, a roll-out.
 *
 *     node dist/examples/tour.js 127.0.0.1:7420 [ROBOT BUNDLE]
 *
 * With a robot and a bundle (`rbt-01 walk-1.5.0`) it also brings that bundle to that robot and watches how.
 */

import { RolloutPhase, RolloutStep } from "../gen/midshift/ota/v1/rollout_pb.js";
import { TaskState } from "../gen/midshift/task/v1/task_pb.js";
import { Client, fromEnvironment, MidshiftError, status } from "../src/index.js";

async function transport(midshift: Client): Promise<void> {
  const flat = { taskType: "transport", fromWaypoint: "A01", toWaypoint: "B03", itemSku: "SKU-88231", timeoutSeconds: 600 };
  const { taskId } = await midshift.submit({ body: { case: "flat", value: flat } }, { deadlineMs: 5_000 });
  console.log(`submitted ${taskId}`);

  const why = await midshift.explain(taskId);
  const verdict = why.verdict?.message || why.verdict?.code || "nothing holds it";
  console.log(`explained ${why.taskId}: ${verdict}; ${why.candidates.length} candidates`);

  for await (const seen of midshift.watch({ taskIds: [taskId] }, 120_000)) {
    console.log(`watched ${TaskState[seen.state]} ${seen.robotId}`.trimEnd());
    if (seen.state === TaskState.SUCCEEDED) break;
  }
  const ended = await midshift.wait(taskId, 30_000);
  console.log(`ended ${TaskState[ended.state]}`);
}

async function badRequest(midshift: Client): Promise<void> {
  try {
    const bad = { taskType: "Bad Type", priority: 12, toWaypoint: "nowhere" };
    await midshift.submit({ body: { case: "flat", value: bad } });
  } catch (refused) {
    if (!(refused instanceof MidshiftError) || refused.code !== status.INVALID_ARGUMENT) throw refused;
    console.log(`refused ${refused.reason}`);
    for (const { field, description } of refused.violations) console.log(`violation ${field}: ${description}`);
  }
}

async function rollout(midshift: Client, robotId: string, bundle: string): Promise<void> {
  const rolloutId = `tour-typescript-${robotId}`;
  const spec = {
    bundle,
    selector: { robotIds: [robotId] },
    waves: [{ size: { case: "rest" as const, value: true } }],
    probation: { seconds: 1n },
    soak: {},
    exposureTasks: 0n,
    allowFullPush: true,
  };
  await midshift.rollouts.createRollout({ rolloutId, spec });
  await midshift.rollouts.submitRollout({ rolloutId });
  await approver.rollouts.approveRollout({ rolloutId });
  await midshift.rollouts.startRollout({ rolloutId });
  for await (const { rollout, robots } of midshift.watchRollout(rolloutId, 180_000)) {
    console.log(`rollout ${RolloutPhase[rollout!.phase]} wave ${rollout!.wave}`);
    for (const robot of robots) console.log(`rollout robot ${robot.robotId} ${RolloutStep[robot.step]}`);
  }
}

const [server, robotId, bundle] = process.argv.slice(2);
if (!server) throw new Error("usage: tour SERVER [ROBOT BUNDLE]");
const midshift = new Client(server, fromEnvironment());
// Whoever wrote a roll-out does not approve it. In `midshift dev` nobody is anybody.
const approver = new Client(server, { ...fromEnvironment(), token: process.env["MIDSHIFT_APPROVER_TOKEN"] || fromEnvironment().token });
try {
  await badRequest(midshift);
  await transport(midshift);
  if (robotId && bundle) await rollout(midshift, robotId, bundle);
} finally {
  midshift.close();
  approver.close();
}
