"""What the helpers decide by themselves; what needs a server is in endure.py and the tour. Run: python -m unittest"""

import json
import unittest

import grpc
from google.protobuf import any_pb2, duration_pb2
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status
from midshift_client import Client, InvalidRequest, MidshiftError, Overloaded, Unavailable, Violation, error_of, service_config


class Failed(grpc.RpcError):
    """A call that ended so."""

    def __init__(self, code: grpc.StatusCode, message: str, *details) -> None:
        packed = []
        for detail in details:
            one = any_pb2.Any()
            one.Pack(detail)
            packed.append(one)
        status = status_pb2.Status(code=code.value[0], message=message, details=packed)
        self._code, self._message = code, message
        self._trailers = rpc_status.to_status(status).trailing_metadata if details else ()

    def code(self):
        return self._code

    def details(self):
        return self._message

    def trailing_metadata(self):
        return self._trailers


class Errors(unittest.TestCase):
    def test_every_violation_is_read(self):
        rule = error_details_pb2.BadRequest.FieldViolation
        bad = error_details_pb2.BadRequest(
            field_violations=[rule(field="flat.priority", description="must be 0..9"), rule(description="and 3 more")]
        )
        info = error_details_pb2.ErrorInfo(reason="INVALID_REQUEST", domain="midshift", metadata={"count": "2"})
        error = error_of(Failed(grpc.StatusCode.INVALID_ARGUMENT, "it breaks 2 rules", info, bad))
        self.assertIsInstance(error, InvalidRequest)
        self.assertEqual((error.reason, error.metadata), ("INVALID_REQUEST", {"count": "2"}))
        self.assertEqual(error.violations, [Violation("flat.priority", "must be 0..9"), Violation("", "and 3 more")])
        self.assertIn("flat.priority: must be 0..9; and 3 more", str(error))

    def test_a_limit_says_when_to_try_again(self):
        retry = error_details_pb2.RetryInfo(retry_delay=duration_pb2.Duration(seconds=1, nanos=500_000_000))
        request = error_details_pb2.RequestInfo(request_id="r-77")
        error = error_of(Failed(grpc.StatusCode.RESOURCE_EXHAUSTED, "too many", retry, request))
        self.assertIsInstance(error, Overloaded)
        self.assertEqual((error.retry_after_s, error.request_id), (1.5, "r-77"))

    def test_an_error_of_another_program_is_its_code_and_text(self):
        info = error_details_pb2.ErrorInfo(reason="ELSEWHERE", domain="example")
        error = error_of(Failed(grpc.StatusCode.UNAVAILABLE, "connection refused", info))
        self.assertIsInstance(error, Unavailable)
        self.assertEqual((error.reason, error.message), ("", "connection refused"))
        self.assertIs(type(error_of(Failed(grpc.StatusCode.UNKNOWN, "?"))), MidshiftError)


class Retries(unittest.TestCase):
    def test_only_what_may_be_sent_again_is(self):
        rules = json.loads(service_config())["methodConfig"]
        named = {name["method"] for rule in rules for name in rule["name"]}
        self.assertIn("SubmitTask", named)
        self.assertNotIn("SubmitTasks", named)
        self.assertEqual([rule["retryPolicy"]["retryableStatusCodes"] for rule in rules], [["UNAVAILABLE"]])


class SignIn(unittest.TestCase):
    def test_a_token_goes_to_nobody_in_plain_text(self):
        with self.assertRaisesRegex(ValueError, "whose root is not known"):
            Client("127.0.0.1:1", token="mst.a.b")


if __name__ == "__main__":
    unittest.main()
