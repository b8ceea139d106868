/**
 * A thin client of midshift: one connection, a deadline for each call, retries, typed errors, and waiting that outlives a server.
 * Messages are in `gen/midshift/<noun>/v1`, as protoc-gen-es makes them.
 */

export { Client, fromEnvironment, ROLLOUT_ENDED, serviceConfig, type SignIn, TASK_ENDED } from "./client.js";
export { DOMAIN, errorOf, MidshiftError, type Violation } from "./errors.js";
export { type CallOptions, DEADLINE_MS, type Stubs, stubs } from "./stubs.js";
export { status } from "@grpc/grpc-js";
