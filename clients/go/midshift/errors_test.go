package midshift

import (
	"context"
	"encoding/json"
	"slices"
	"strings"
	"testing"
	"time"

	"google.golang.org/genproto/googleapis/rpc/errdetails"
	"google.golang.org/grpc/codes"
	"google.golang.org/grpc/status"
	"google.golang.org/protobuf/protoadapt"
	"google.golang.org/protobuf/types/known/durationpb"
)

func failed(t *testing.T, code codes.Code, message string, details ...protoadapt.MessageV1) *Error {
	t.Helper()
	said, err := status.New(code, message).WithDetails(details...)
	if err != nil {
		t.Fatal(err)
	}
	return ErrorOf(said.Err()).(*Error)
}

func TestEveryViolationIsRead(t *testing.T) {
	bad := &errdetails.BadRequest{FieldViolations: []*errdetails.BadRequest_FieldViolation{
		{Field: "flat.priority", Description: "must be 0..9"}, {Description: "and 3 more"},
	}}
	info := &errdetails.ErrorInfo{Reason: "INVALID_REQUEST", Domain: Domain, Metadata: map[string]string{"count": "2"}}
	got := failed(t, codes.InvalidArgument, "it breaks 2 rules", info, bad)
	if got.Reason != "INVALID_REQUEST" || got.Metadata["count"] != "2" {
		t.Errorf("reason %q, facts %v", got.Reason, got.Metadata)
	}
	if want := []Violation{{"flat.priority", "must be 0..9"}, {"", "and 3 more"}}; !slices.Equal(got.Violations, want) {
		t.Errorf("violations %v", got.Violations)
	}
	if !strings.HasSuffix(got.Error(), "flat.priority: must be 0..9; and 3 more") {
		t.Error(got)
	}
}

func TestALimitSaysWhenToTryAgain(t *testing.T) {
	retry := &errdetails.RetryInfo{RetryDelay: durationpb.New(1500 * time.Millisecond)}
	got := failed(t, codes.ResourceExhausted, "too many", retry, &errdetails.RequestInfo{RequestId: "r-77"})
	if got.RetryAfter != 1500*time.Millisecond || got.RequestID != "r-77" {
		t.Errorf("%+v", got)
	}
}

func TestAnErrorOfAnotherProgramIsItsCodeAndText(t *testing.T) {
	got := failed(t, codes.Unavailable, "connection refused", &errdetails.ErrorInfo{Reason: "ELSEWHERE", Domain: "example"})
	if got.Reason != "" || got.Message != "connection refused" || CodeOf(got) != codes.Unavailable {
		t.Errorf("%+v", got)
	}
	if code := CodeOf(ErrorOf(context.DeadlineExceeded)); code != codes.DeadlineExceeded {
		t.Error(code)
	}
	if ErrorOf(nil) != nil {
		t.Error("no error became one")
	}
}

func TestOnlyWhatMayBeSentAgainIs(t *testing.T) {
	var config struct {
		MethodConfig []struct {
			Name        []struct{ Method string }
			RetryPolicy struct{ RetryableStatusCodes []string }
		}
	}
	if err := json.Unmarshal([]byte(ServiceConfig), &config); err != nil {
		t.Fatal(err)
	}
	named := map[string]bool{}
	for _, rule := range config.MethodConfig {
		if !slices.Equal(rule.RetryPolicy.RetryableStatusCodes, []string{"UNAVAILABLE"}) {
			t.Error(rule.RetryPolicy)
		}
		for _, name := range rule.Name {
			named[name.Method] = true
		}
	}
	if !named["SubmitTask"] || named["SubmitTasks"] {
		t.Error(named)
	}
}
