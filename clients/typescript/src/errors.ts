/** What a call that failed says: gRPC's code, midshift's reason, and every broken rule. */

import { Metadata, type ServiceError, status } from "@grpc/grpc-js";
import { BadRequest, ErrorInfo, RequestInfo, RetryInfo } from "nice-grpc-error-details";
import { Status } from "nice-grpc-error-details/lib/proto/google/rpc/status.js";

/** `ErrorInfo.domain` of every error that midshift itself makes. */
export const DOMAIN = "midshift";

const DETAILS = "grpc-status-details-bin";

/** One broken rule of a request. */
export interface Violation {
  /** Path into the request, e.g. `flat.timeout_seconds`; empty: the request as a whole. */
  readonly field: string;
  /** The rule, as a person reads it. */
  readonly description: string;
}

/** A call that failed. What the server did not say is empty. */
export class MidshiftError extends Error {
  override readonly name = "MidshiftError";
  /** midshift's reason, UPPER_SNAKE; empty: the error is not midshift's own, e.g. a connection that could not be made. */
  reason = "";
  /** Facts behind the reason. */
  facts: Record<string, string> = {};
  /** Every broken rule. */
  violations: Violation[] = [];
  /** Milliseconds to wait before the next try; undefined: not said. */
  retryAfterMs: number | undefined;
  /** To find it in the server's log. */
  requestId = "";

  /** `code` is gRPC's own, `sentence` what the server said. */
  constructor(
    readonly code: status,
    readonly sentence: string,
    cause?: unknown,
  ) {
    super(`${status[code]}: ${sentence}`, { cause });
  }

  /** All of it in one line. */
  override toString(): string {
    const rules = this.violations.map((v) => (v.field ? `${v.field}: ${v.description}` : v.description));
    return [`${status[this.code]} ${this.reason}`.trimEnd() + `: ${this.sentence}`, ...rules].join("; ");
  }
}

/** What a failed call says. Details that cannot be read are as if they were not there. */
export function errorOf(failed: unknown): MidshiftError {
  if (failed instanceof MidshiftError) return failed;
  if (!isServiceError(failed)) return new MidshiftError(status.UNKNOWN, String(failed), failed);
  const error = new MidshiftError(failed.code, failed.details, failed);
  const [bytes] = failed.metadata.get(DETAILS);
  if (!(bytes instanceof Uint8Array)) return error;
  try {
    for (const { typeUrl, value } of Status.decode(bytes).details) read(error, typeUrl, value);
  } catch {
    // Cut short on the way, or not ours: code and sentence are enough.
  }
  return error;
}

function read(error: MidshiftError, typeUrl: string, value: Uint8Array): void {
  switch (typeUrl.slice(typeUrl.lastIndexOf("/") + 1)) {
    case "google.rpc.ErrorInfo": {
      const info = ErrorInfo.decode(value);
      if (info.domain === DOMAIN) [error.reason, error.facts] = [info.reason, info.metadata];
      break;
    }
    case "google.rpc.BadRequest":
      error.violations = BadRequest.decode(value).fieldViolations.map(({ field, description }) => ({ field, description }));
      break;
    case "google.rpc.RetryInfo": {
      const delay = RetryInfo.decode(value).retryDelay;
      if (delay) error.retryAfterMs = Number(delay.seconds) * 1000 + delay.nanos / 1e6;
      break;
    }
    case "google.rpc.RequestInfo":
      error.requestId = RequestInfo.decode(value).requestId;
  }
}

function isServiceError(failed: unknown): failed is ServiceError {
  return failed instanceof Error && "code" in failed && "details" in failed && "metadata" in failed && failed.metadata instanceof Metadata;
}
