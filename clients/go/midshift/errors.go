package midshift

import (
	"errors"
	"fmt"
	"strings"
	"time"

	"google.golang.org/genproto/googleapis/rpc/errdetails"
	"google.golang.org/grpc/codes"
	"google.golang.org/grpc/status"
)

// Domain is ErrorInfo.domain of every error that midshift itself makes.
const Domain = "midshift"

// Violation is one broken rule of a request.
type Violation struct {
	// Field is the path into the request, e.g. flat.timeout_seconds; empty: the request as a whole.
	Field string
	// Description is the rule, as a person reads it.
	Description string
}

func (v Violation) String() string {
	if v.Field == "" {
		return v.Description
	}
	return v.Field + ": " + v.Description
}

// Error is a call that failed. What the server did not say is empty.
type Error struct {
	// Code is gRPC's own.
	Code codes.Code
	// Reason is midshift's, UPPER_SNAKE; empty: the error is not midshift's own, e.g. a connection that could not be made.
	Reason string
	// Message is the sentence.
	Message string
	// Metadata are the facts behind the reason.
	Metadata map[string]string
	// Violations are all broken rules.
	Violations []Violation
	// RetryAfter is how long to wait before the next try; 0: not said.
	RetryAfter time.Duration
	// RequestID finds it in the server's log.
	RequestID string
	cause     error
}

func (e *Error) Error() string {
	said := []string{strings.TrimSpace(fmt.Sprintf("%s %s", e.Code, e.Reason)) + ": " + e.Message}
	for _, violation := range e.Violations {
		said = append(said, violation.String())
	}
	return strings.Join(said, "; ")
}

// Unwrap gives gRPC's own error.
func (e *Error) Unwrap() error { return e.cause }

// CodeOf is gRPC's code of err; OK for nil, Unknown for what is no error of a call.
func CodeOf(err error) codes.Code {
	var failed *Error
	if errors.As(err, &failed) {
		return failed.Code
	}
	return status.Code(err)
}

// ErrorOf reads what a failed call says; nil for nil.
func ErrorOf(err error) error {
	var known *Error
	if err == nil || errors.As(err, &known) {
		return err
	}
	said, ok := status.FromError(err)
	if !ok {
		said = status.FromContextError(err)
	}
	failed := &Error{Code: said.Code(), Message: said.Message(), cause: err}
	for _, detail := range said.Details() {
		switch detail := detail.(type) {
		case *errdetails.ErrorInfo:
			if detail.GetDomain() == Domain {
				failed.Reason, failed.Metadata = detail.GetReason(), detail.GetMetadata()
			}
		case *errdetails.BadRequest:
			for _, v := range detail.GetFieldViolations() {
				failed.Violations = append(failed.Violations, Violation{v.GetField(), v.GetDescription()})
			}
		case *errdetails.RetryInfo:
			failed.RetryAfter = detail.GetRetryDelay().AsDuration()
		case *errdetails.RequestInfo:
			failed.RequestID = detail.GetRequestId()
		}
	}
	return failed
}
