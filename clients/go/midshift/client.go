// Package midshift is a thin client of midshift: one channel, a deadline for each call, retries, typed errors, and waiting that outlives
// a server. Messages and stubs are in gen/midshift/<noun>/v1, as protoc-gen-go makes them.
package midshift

import (
	"context"
	"crypto/rand"
	"crypto/tls"
	"crypto/x509"
	_ "embed"
	"errors"
	"os"
	"time"

	"google.golang.org/grpc"
	"google.golang.org/grpc/backoff"
	"google.golang.org/grpc/credentials"
	"google.golang.org/grpc/credentials/insecure"
	"google.golang.org/grpc/keepalive"

	fleetv1 "midshift/clients/go/gen/midshift/fleet/v1"
	otav1 "midshift/clients/go/gen/midshift/ota/v1"
	taskv1 "midshift/clients/go/gen/midshift/task/v1"
	telemetryv1 "midshift/clients/go/gen/midshift/telemetry/v1"
)

// Deadline is what a call may take if its context has no deadline of its own.
const Deadline = 10 * time.Second

// ServiceConfig says which calls are tried again after UNAVAILABLE, and how often: the rules that all clients share, as JSON.
//
//go:embed service_config.json
var ServiceConfig string

// Client is one server. Safe for use by several goroutines.
type Client struct {
	connection *grpc.ClientConn
	// Stubs for everything that has no method here. Their unary calls get deadline and typed errors too.
	Tasks     taskv1.TaskServiceClient
	Fleet     fleetv1.FleetServiceClient
	Telemetry telemetryv1.TelemetryServiceClient
	Rollouts  otav1.RolloutServiceClient
}

// SignIn says whom a client believes and who it is.
type SignIn struct {
	// The site's root, PEM. Without it the client speaks plain text, as midshift dev does, and takes no token.
	AuthorityPEM []byte
	// One that midshift token create printed. Empty: nobody.
	Token string
}

// FromEnvironment is signed in as the command line is: by the file that MIDSHIFT_CA names, and MIDSHIFT_TOKEN. Neither is set: plain text.
func FromEnvironment() (SignIn, error) {
	as := SignIn{Token: os.Getenv("MIDSHIFT_TOKEN")}
	path := os.Getenv("MIDSHIFT_CA")
	if path == "" {
		return as, nil
	}
	pem, err := os.ReadFile(path)
	as.AuthorityPEM = pem
	return as, err
}

func (as SignIn) options() ([]grpc.DialOption, error) {
	if as.AuthorityPEM == nil {
		if as.Token != "" {
			return nil, errors.New("a token goes to no server whose root is not known: give AuthorityPEM too")
		}
		return []grpc.DialOption{grpc.WithTransportCredentials(insecure.NewCredentials())}, nil
	}
	roots := x509.NewCertPool()
	if !roots.AppendCertsFromPEM(as.AuthorityPEM) {
		return nil, errors.New("no certificate in AuthorityPEM")
	}
	over := credentials.NewTLS(&tls.Config{RootCAs: roots, MinVersion: tls.VersionTLS13})
	options := []grpc.DialOption{grpc.WithTransportCredentials(over)}
	if as.Token != "" {
		options = append(options, grpc.WithPerRPCCredentials(bearer(as.Token)))
	}
	return options, nil
}

// bearer is a token, which goes over TLS only.
type bearer string

func (b bearer) GetRequestMetadata(context.Context, ...string) (map[string]string, error) {
	return map[string]string{"authorization": "Bearer " + string(b)}, nil
}

func (bearer) RequireTransportSecurity() bool { return true }

// New makes a client of server, host:port. It connects when it is used; Close it.
func New(server string, as SignIn) (*Client, error) {
	signedIn, err := as.options()
	if err != nil {
		return nil, err
	}
	connection, err := grpc.NewClient("passthrough:///"+server, append(signedIn,
		grpc.WithDefaultServiceConfig(ServiceConfig),
		// A server that is gone without a word is noticed within 40 s, also while nothing but a watch is open.
		grpc.WithKeepaliveParams(keepalive.ClientParameters{Time: 30 * time.Second, Timeout: 10 * time.Second}),
		grpc.WithConnectParams(grpc.ConnectParams{
			Backoff:           backoff.Config{BaseDelay: 200 * time.Millisecond, Multiplier: 1.6, Jitter: 0.2, MaxDelay: 5 * time.Second},
			MinConnectTimeout: 5 * time.Second,
		}),
		grpc.WithUnaryInterceptor(unary),
	)...)
	if err != nil {
		return nil, err
	}
	return &Client{
		connection: connection,
		Tasks:      taskv1.NewTaskServiceClient(connection),
		Fleet:      fleetv1.NewFleetServiceClient(connection),
		Telemetry:  telemetryv1.NewTelemetryServiceClient(connection),
		Rollouts:   otav1.NewRolloutServiceClient(connection),
	}, nil
}

// Close ends the channel and every watch on it.
func (c *Client) Close() error { return c.connection.Close() }

// unary gives each call a deadline and typed errors.
func unary(ctx context.Context, method string, request, reply any, cc *grpc.ClientConn, next grpc.UnaryInvoker, options ...grpc.CallOption) error {
	if _, has := ctx.Deadline(); !has {
		var end context.CancelFunc
		ctx, end = context.WithTimeout(ctx, Deadline)
		defer end()
	}
	return ErrorOf(next(ctx, method, request, reply, cc, options...))
}

// Submit admits one task, durable when it returns. It may be tried again under way: a request_id is drawn if none is given. Keep your
// own, and after Unavailable or DeadlineExceeded submit again with it: the task is not made twice.
func (c *Client) Submit(ctx context.Context, request *taskv1.SubmitTaskRequest) (*taskv1.Task, error) {
	if request.GetRequestId() == "" {
		request.RequestId = rand.Text()
	}
	answer, err := c.Tasks.SubmitTask(ctx, request)
	return answer.GetTask(), err
}

// Explain says why a task is where it is.
func (c *Client) Explain(ctx context.Context, taskID string) (*fleetv1.TaskExplanation, error) {
	answer, err := c.Fleet.ExplainTask(ctx, &fleetv1.ExplainTaskRequest{TaskId: taskID})
	return answer.GetExplanation(), err
}
