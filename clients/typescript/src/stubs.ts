/** Stubs of a service of the .proto files on a gRPC connection: a promise for each call, an async iterable for each watch. */

import {
  create,
  type DescMessage,
  type DescMethod,
  type DescMethodServerStreaming,
  type DescMethodUnary,
  type DescService,
  fromBinary,
  type MessageInitShape,
  type MessageShape,
  toBinary,
} from "@bufbuild/protobuf";
import { type Client, Metadata } from "@grpc/grpc-js";
import { errorOf } from "./errors.js";

/** Milliseconds that a call may take unless the caller says otherwise. */
export const DEADLINE_MS = 10_000;

/** What may be said of one call. */
export interface CallOptions {
  /** Milliseconds that it may take, tries and waiting for a connection included. Without it 10 s; a watch has none. */
  deadlineMs?: number | undefined;
  /** Ends a watch. */
  signal?: AbortSignal | undefined;
}

type Stub<M> =
  M extends DescMethodUnary<infer I, infer O>
    ? (request: MessageInitShape<I>, options?: CallOptions) => Promise<MessageShape<O>>
    : M extends DescMethodServerStreaming<infer I, infer O>
      ? (request: MessageInitShape<I>, options?: CallOptions) => AsyncIterable<MessageShape<O>>
      : never;

/** All calls of a service; those with a stream upwards are left to gRPC itself. */
export type Stubs<S extends DescService> = { [N in keyof S["method"]]: Stub<S["method"][N]> };

/** The stubs of `service` on `connection`. */
export function stubs<S extends DescService>(service: S, connection: Client): Stubs<S> {
  const made: Record<string, unknown> = {};
  for (const method of service.methods) {
    if (method.methodKind === "unary") {
      made[method.localName] = (request: MessageInitShape<DescMessage>, options?: CallOptions) =>
        unary(connection, method, request, options);
    } else if (method.methodKind === "server_streaming") {
      made[method.localName] = (request: MessageInitShape<DescMessage>, options?: CallOptions) =>
        watch(connection, method, request, options);
    }
  }
  return made as Stubs<S>;
}

function wire(method: DescMethod) {
  return {
    path: `/${method.parent.typeName}/${method.name}`,
    up: (message: MessageShape<DescMessage>) => Buffer.from(toBinary(method.input, message)),
    down: (bytes: Buffer) => fromBinary(method.output, bytes),
  };
}

/** A connection that is not there yet is waited for: the deadline bounds it. */
const patient = () => new Metadata({ waitForReady: true });

const until = (ms: number | undefined) => (ms === undefined ? {} : { deadline: Date.now() + ms });

function unary(connection: Client, method: DescMethod, request: MessageInitShape<DescMessage>, options?: CallOptions) {
  const { path, up, down } = wire(method);
  return new Promise<MessageShape<DescMessage>>((resolve, reject) => {
    connection.makeUnaryRequest(
      path,
      up,
      down,
      create(method.input, request),
      patient(),
      until(options?.deadlineMs ?? DEADLINE_MS),
      (failed, answer) => (failed || !answer ? reject(errorOf(failed)) : resolve(answer)),
    );
  });
}

async function* watch(connection: Client, method: DescMethod, request: MessageInitShape<DescMessage>, options?: CallOptions) {
  const { path, up, down } = wire(method);
  const call = connection.makeServerStreamRequest(path, up, down, create(method.input, request), patient(), until(options?.deadlineMs));
  const end = () => call.cancel();
  options?.signal?.addEventListener("abort", end);
  try {
    for await (const message of call) yield message as MessageShape<DescMessage>;
  } catch (failed) {
    throw errorOf(failed);
  } finally {
    options?.signal?.removeEventListener("abort", end);
    end();
  }
}
