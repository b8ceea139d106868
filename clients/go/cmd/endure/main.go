// A client whose server is killed and started again under it. Whoever runs it kills the server at `submitted`, waits for `gave up`,
// starts the server at `asking`, and at `again` cancels the task and aborts the roll-out.
//
//	endure 127.0.0.1:7420 ROLLOUT
package main

import (
	"bufio"
	"context"
	"fmt"
	"os"
	"time"

	"google.golang.org/grpc/codes"
	"google.golang.org/protobuf/proto"

	otav1 "midshift/clients/go/gen/midshift/ota/v1"
	taskv1 "midshift/clients/go/gen/midshift/task/v1"
	"midshift/clients/go/midshift"
)

func main() {
	if err := endure(os.Args[1], os.Args[2]); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}

func endure(server, rolloutID string) error {
	as, err := midshift.FromEnvironment()
	if err != nil {
		return err
	}
	client, err := midshift.New(server, as)
	if err != nil {
		return err
	}
	defer client.Close()
	ctx, end := context.WithTimeout(context.Background(), 2*time.Minute)
	defer end()
	submit := func(ctx context.Context, within time.Duration) (*taskv1.Task, error) {
		ctx, end := context.WithTimeout(ctx, within)
		defer end()
		flat := &taskv1.FlatTask{TaskType: "transport", ToWaypoint: "B03", TimeoutSeconds: proto.Int32(600)}
		return client.Submit(ctx, &taskv1.SubmitTaskRequest{RequestId: "endure-go", Body: &taskv1.SubmitTaskRequest_Flat{Flat: flat}})
	}
	task, err := submit(ctx, midshift.Deadline)
	if err != nil {
		return err
	}
	type outcome struct {
		task *taskv1.Task
		err  error
	}
	ended := make(chan outcome, 1)
	go func() {
		task, err := client.Wait(ctx, task.GetTaskId())
		ended <- outcome{task, err}
	}()
	type phase struct {
		phase otav1.RolloutPhase
		err   error
	}
	followed := make(chan phase, 1)
	go func() {
		var last phase
		for seen, err := range client.WatchRollout(ctx, rolloutID) {
			last = phase{seen.GetRollout().GetPhase(), err}
		}
		followed <- last
	}()
	fmt.Println("submitted", task.GetTaskId())
	if _, err := bufio.NewReader(os.Stdin).ReadString('\n'); err != nil {
		return err
	}
	if _, err := submit(ctx, 500*time.Millisecond); midshift.CodeOf(err) == codes.DeadlineExceeded {
		fmt.Println("gave up", midshift.CodeOf(err))
	}
	fmt.Println("asking")
	again, err := submit(ctx, time.Minute)
	if err != nil {
		return err
	}
	fmt.Println("again", again.GetTaskId())
	last := <-ended
	if last.err != nil {
		return last.err
	}
	reached := <-followed
	if reached.err != nil {
		return reached.err
	}
	fmt.Println("rollout", reached.phase)
	fmt.Println("ended", last.task.GetState())
	return nil
}
