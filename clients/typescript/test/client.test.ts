/** What the helpers decide by themselves; what needs a server is in endure.ts and the tour. */

import { Metadata, type ServiceError, status } from "@grpc/grpc-js";
import { BadRequest, ErrorInfo, RequestInfo, RetryInfo } from "nice-grpc-error-details";
import { Status } from "nice-grpc-error-details/lib/proto/google/rpc/status.js";
import assert from "node:assert/strict";
import { test } from "node:test";
import { Client, errorOf, serviceConfig } from "../src/index.js";

function failed(code: status, details: string, ...said: [string, Uint8Array][]): ServiceError {
  const metadata = new Metadata();
  const packed = said.map(([name, value]) => ({ typeUrl: `type.googleapis.com/google.rpc.${name}`, value }));
  const bytes = Status.encode(Status.fromPartial({ code, message: details, details: packed })).finish();
  metadata.set("grpc-status-details-bin", Buffer.from(bytes));
  return Object.assign(new Error(details), { code, details, metadata });
}

test("every violation is read", () => {
  const violations = [
    { field: "flat.priority", description: "must be 0..9" },
    { field: "", description: "and 3 more" },
  ];
  const bad = BadRequest.encode(BadRequest.fromPartial({ fieldViolations: violations })).finish();
  const info = ErrorInfo.encode(ErrorInfo.fromPartial({ reason: "INVALID_REQUEST", domain: "midshift", metadata: { count: "2" } })).finish();
  const error = errorOf(failed(status.INVALID_ARGUMENT, "it breaks 2 rules", ["ErrorInfo", info], ["BadRequest", bad]));
  assert.equal(error.code, status.INVALID_ARGUMENT);
  assert.deepEqual([error.reason, error.facts], ["INVALID_REQUEST", { count: "2" }]);
  assert.deepEqual(error.violations, violations);
  assert.match(String(error), /flat\.priority: must be 0\.\.9; and 3 more$/);
});

test("a limit says when to try again", () => {
  const retry = RetryInfo.encode(RetryInfo.fromPartial({ retryDelay: { seconds: 1, nanos: 500_000_000 } })).finish();
  const request = RequestInfo.encode(RequestInfo.fromPartial({ requestId: "r-77" })).finish();
  const error = errorOf(failed(status.RESOURCE_EXHAUSTED, "too many", ["RetryInfo", retry], ["RequestInfo", request]));
  assert.deepEqual([error.retryAfterMs, error.requestId], [1500, "r-77"]);
});

test("an error of another program is its code and text", () => {
  const info = ErrorInfo.encode(ErrorInfo.fromPartial({ reason: "ELSEWHERE", domain: "example" })).finish();
  const error = errorOf(failed(status.UNAVAILABLE, "connection refused", ["ErrorInfo", info]));
  assert.deepEqual([error.reason, error.sentence], ["", "connection refused"]);
  assert.equal(errorOf(new Error("?")).code, status.UNKNOWN);
});

test("only what may be sent again is", () => {
  const rules: { name: { method: string }[]; retryPolicy: { retryableStatusCodes: string[] } }[] = JSON.parse(serviceConfig()).methodConfig;
  const named = rules.flatMap((rule) => rule.name.map(({ method }) => method));
  assert.ok(named.includes("SubmitTask") && !named.includes("SubmitTasks"));
  assert.deepEqual(rules.map((rule) => rule.retryPolicy.retryableStatusCodes), [["UNAVAILABLE"]]);
});

test("a token goes to nobody in plain text", () => {
  assert.throws(() => new Client("127.0.0.1:1", { token: "mst.a.b" }), /whose root is not known/);
});
