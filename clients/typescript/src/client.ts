/** The connection, the calls that people make most, and the two watches that outlive a restart of the server. */

import { type MessageInitShape } from "@bufbuild/protobuf";
import { Client as Connection, type ChannelCredentials, credentials, Metadata, status } from "@grpc/grpc-js";
import { randomUUID } from "node:crypto";
import { readFileSync } from "node:fs";
import { setTimeout as sleep } from "node:timers/promises";
import { type TaskExplanation } from "../gen/midshift/fleet/v1/fleet_pb.js";
import { FleetService } from "../gen/midshift/fleet/v1/fleet_service_pb.js";
import { RolloutPhase } from "../gen/midshift/ota/v1/rollout_pb.js";
import { RolloutService, type WatchRolloutResponse } from "../gen/midshift/ota/v1/rollout_service_pb.js";
import { type Task, TaskState } from "../gen/midshift/task/v1/task_pb.js";
import { type SubmitTaskRequestSchema, type TaskFilterSchema, TaskService } from "../gen/midshift/task/v1/task_service_pb.js";
import { TelemetryService } from "../gen/midshift/telemetry/v1/telemetry_service_pb.js";
import { errorOf, MidshiftError } from "./errors.js";
import { type CallOptions, type Stubs, stubs } from "./stubs.js";

/** Shortest and longest pause before a watch is opened again, milliseconds. */
const PAUSE_MS = [100, 5_000] as const;

/** A task does not leave these. */
export const TASK_ENDED: ReadonlySet<TaskState> = new Set([TaskState.SUCCEEDED, TaskState.FAILED, TaskState.CANCELED, TaskState.EXPIRED]);
/** A roll-out does not leave these. */
export const ROLLOUT_ENDED: ReadonlySet<RolloutPhase> = new Set([RolloutPhase.COMPLETED, RolloutPhase.ABORTED, RolloutPhase.SUPERSEDED]);

/** Which calls are tried again after UNAVAILABLE, and how often: the rules that all clients share, as JSON. */
export function serviceConfig(): string {
  return readFileSync(new URL("../gen/service_config.json", import.meta.url), "utf8");
}

/** Growing pauses with jitter, begun anew whenever something was heard. */
class Pause {
  private nextMs: number = PAUSE_MS[0];

  heard(): void {
    this.nextMs = PAUSE_MS[0];
  }

  async rest(untilMs: number): Promise<void> {
    const jittered = this.nextMs * (0.5 + Math.random() / 2);
    await sleep(Math.max(0, Math.min(jittered, untilMs - performance.now())));
    this.nextMs = Math.min(this.nextMs * 2, PAUSE_MS[1]);
  }
}

/** Whom a client believes and who it is. */
export interface SignIn {
  /** The site's root, PEM. Without it the client speaks plain text, as `midshift dev` does, and takes no token. */
  authorityPem?: Buffer | undefined;
  /** One that `midshift token create` printed. Without it: nobody. */
  token?: string | undefined;
}

/** Signed in as the command line is: by the file that MIDSHIFT_CA names, and MIDSHIFT_TOKEN. Neither is set: plain text. */
export function fromEnvironment(): SignIn {
  const { MIDSHIFT_CA: authority, MIDSHIFT_TOKEN: token } = process.env;
  return { authorityPem: authority ? readFileSync(authority) : undefined, token: token || undefined };
}

function channelCredentials({ authorityPem, token }: SignIn): ChannelCredentials {
  if (!authorityPem) {
    if (token) throw new Error("a token goes to no server whose root is not known: give authorityPem too");
    return credentials.createInsecure();
  }
  const tls = credentials.createSsl(authorityPem);
  if (!token) return tls;
  const bearer = new Metadata();
  bearer.set("authorization", `Bearer ${token}`);
  return credentials.combineChannelCredentials(
    tls,
    credentials.createFromMetadataGenerator((_, done) => done(null, bearer)),
  );
}

/** One server. Close it when it is not needed any more. */
export class Client {
  private readonly connection: Connection;
  /** Stubs, with deadline and typed errors, also for everything that has no method here. */
  readonly tasks: Stubs<typeof TaskService>;
  readonly fleet: Stubs<typeof FleetService>;
  readonly telemetry: Stubs<typeof TelemetryService>;
  readonly rollouts: Stubs<typeof RolloutService>;

  /** `server` is host:port. Connects when it is used. */
  constructor(server: string, signIn: SignIn = {}) {
    this.connection = new Connection(server, channelCredentials(signIn), {
      "grpc.service_config": serviceConfig(),
      "grpc.enable_retries": 1,
      // A server that is gone without a word is noticed within 40 s, also while nothing but a watch is open.
      "grpc.keepalive_time_ms": 30_000,
      "grpc.keepalive_timeout_ms": 10_000,
      "grpc.initial_reconnect_backoff_ms": 200,
      "grpc.max_reconnect_backoff_ms": 5_000,
    });
    this.tasks = stubs(TaskService, this.connection);
    this.fleet = stubs(FleetService, this.connection);
    this.telemetry = stubs(TelemetryService, this.connection);
    this.rollouts = stubs(RolloutService, this.connection);
  }

  /** Ends the connection and every watch on it. */
  close(): void {
    this.connection.close();
  }

  /**
   * Admits one task, durable when this resolves. It may be tried again under way: a request id is drawn if none is given. Keep your own,
   * and after UNAVAILABLE or DEADLINE_EXCEEDED submit again with it: the task is not made twice.
   */
  async submit(request: MessageInitShape<typeof SubmitTaskRequestSchema>, options?: CallOptions): Promise<Task> {
    const answer = await this.tasks.submitTask({ ...request, requestId: request.requestId || randomUUID() }, options);
    return answer.task!;
  }

  /** Why a task is where it is. */
  async explain(taskId: string, options?: CallOptions): Promise<TaskExplanation> {
    return (await this.fleet.explainTask({ taskId }, options)).explanation!;
  }

  /**
   * The tasks that match as they are, and then each change in commit order, without loss, across restarts of the server. If the server
   * cannot go on from where it was (the data is another's, or too much happened), it begins again with the tasks as they are. Ends with
   * a MidshiftError of DEADLINE_EXCEEDED.
   */
  async *watch(filter: MessageInitShape<typeof TaskFilterSchema>, timeoutMs: number): AsyncGenerator<Task> {
    for await (const task of this.changes(filter, timeoutMs)) if (task) yield task;
  }

  /** Waits until a task has ended, whatever its end. A MidshiftError of NOT_FOUND if there is none, of DEADLINE_EXCEEDED in time. */
  async wait(taskId: string, timeoutMs: number): Promise<Task> {
    let known = false;
    for await (let task of this.changes({ taskIds: [taskId] }, timeoutMs)) {
      if (!task && !known) task = (await this.tasks.getTask({ taskId })).task;
      known = true;
      if (task && TASK_ENDED.has(task.state)) return task;
    }
    throw new MidshiftError(status.NOT_FOUND, `${taskId} is not watched any more`);
  }

  /** As `watch`; undefined is a bookmark: everything up to here was said. */
  private async *changes(filter: MessageInitShape<typeof TaskFilterSchema>, timeoutMs: number): AsyncGenerator<Task | undefined> {
    const untilMs = performance.now() + timeoutMs;
    const pause = new Pause();
    for (let cursor = ""; ; ) {
      try {
        for await (const message of this.tasks.watchTasks({ filter, cursor }, { deadlineMs: left(untilMs) })) {
          pause.heard();
          // While existing tasks are sent there is no cursor yet: a break begins again.
          cursor = message.cursor;
          const { item } = message;
          yield item.case === "existing" ? item.value : item.case === "change" ? item.value.task : undefined;
        }
      } catch (failed) {
        const error = errorOf(failed);
        const lostPlace = error.code === status.OUT_OF_RANGE || error.code === status.FAILED_PRECONDITION;
        if (lostPlace && cursor) cursor = "";
        else if (error.code !== status.UNAVAILABLE) throw error;
      }
      await pause.rest(untilMs);
    }
  }

  /** A roll-out with the robots that changed, now and with each change, to its end, across restarts of the server. */
  async *watchRollout(rolloutId: string, timeoutMs: number): AsyncGenerator<WatchRolloutResponse> {
    const untilMs = performance.now() + timeoutMs;
    const pause = new Pause();
    for (;;) {
      try {
        for await (const message of this.rollouts.watchRollout({ rolloutId }, { deadlineMs: left(untilMs) })) {
          pause.heard();
          yield message;
          if (message.rollout && ROLLOUT_ENDED.has(message.rollout.phase)) return;
        }
      } catch (failed) {
        const error = errorOf(failed);
        if (error.code !== status.UNAVAILABLE) throw error;
      }
      await pause.rest(untilMs);
    }
  }
}

function left(untilMs: number): number {
  const leftMs = untilMs - performance.now();
  if (leftMs <= 0) throw new MidshiftError(status.DEADLINE_EXCEEDED, "the time for this wait is over");
  return leftMs;
}
