// A tour: submit, watch, explain, a bad request, a roll-out.
//
//	tour 127.0.0.1:7420 [ROBOT BUNDLE]
//
// With a robot and a bundle (rbt-01 walk-1.5.0) it also brings that bundle to that robot and watches how.
package main

import (
	"context"
	"errors"
	"fmt"
	"os"
	"time"

	"google.golang.org/protobuf/proto"
	"google.golang.org/protobuf/types/known/durationpb"

	otav1 "midshift/clients/go/gen/midshift/ota/v1"
	taskv1 "midshift/clients/go/gen/midshift/task/v1"
	"midshift/clients/go/midshift"
)

func main() {
	if err := tour(os.Args[1:]); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}

func tour(args []string) error {
	if len(args) != 1 && len(args) != 3 {
		return errors.New("usage: tour SERVER [ROBOT BUNDLE]")
	}
	as, err := midshift.FromEnvironment()
	if err != nil {
		return err
	}
	client, err := midshift.New(args[0], as)
	if err != nil {
		return err
	}
	defer client.Close()
	// Whoever wrote a roll-out does not approve it. In midshift dev nobody is anybody.
	if token := os.Getenv("MIDSHIFT_APPROVER_TOKEN"); token != "" {
		as.Token = token
	}
	approver, err := midshift.New(args[0], as)
	if err != nil {
		return err
	}
	defer approver.Close()
	ctx, end := context.WithTimeout(context.Background(), 5*time.Minute)
	defer end()
	if err := badRequest(ctx, client); err != nil {
		return err
	}
	if err := transport(ctx, client); err != nil {
		return err
	}
	if len(args) == 3 {
		return rollout(ctx, client, approver, args[1], args[2])
	}
	return nil
}

func transport(ctx context.Context, client *midshift.Client) error {
	flat := &taskv1.FlatTask{
		TaskType: "transport", FromWaypoint: "A01", ToWaypoint: "B03", ItemSku: "SKU-88231", TimeoutSeconds: proto.Int32(600),
	}
	request := &taskv1.SubmitTaskRequest{Body: &taskv1.SubmitTaskRequest_Flat{Flat: flat}}
	soon, end := context.WithTimeout(ctx, 5*time.Second)
	defer end()
	task, err := client.Submit(soon, request)
	if err != nil {
		return err
	}
	fmt.Println("submitted", task.GetTaskId())
	why, err := client.Explain(ctx, task.GetTaskId())
	if err != nil {
		return err
	}
	verdict := why.GetVerdict().GetMessage()
	if verdict == "" {
		verdict = "nothing holds it"
	}
	fmt.Printf("explained %s: %s; %d candidates\n", why.GetTaskId(), verdict, len(why.GetCandidates()))
	for seen, err := range client.Watch(ctx, &taskv1.TaskFilter{TaskIds: []string{task.GetTaskId()}}) {
		if err != nil {
			return err
		}
		fmt.Println("watched", seen.GetState(), seen.GetRobotId())
		if seen.GetState() == taskv1.TaskState_TASK_STATE_SUCCEEDED {
			break
		}
	}
	ended, err := client.Wait(ctx, task.GetTaskId())
	if err != nil {
		return err
	}
	fmt.Println("ended", ended.GetState())
	return nil
}

func badRequest(ctx context.Context, client *midshift.Client) error {
	bad := &taskv1.FlatTask{TaskType: "Bad Type", Priority: proto.Int32(12), ToWaypoint: "nowhere"}
	_, err := client.Submit(ctx, &taskv1.SubmitTaskRequest{Body: &taskv1.SubmitTaskRequest_Flat{Flat: bad}})
	var refused *midshift.Error
	if !errors.As(err, &refused) || len(refused.Violations) == 0 {
		return fmt.Errorf("it was not refused as it should be: %w", err)
	}
	fmt.Println("refused", refused.Reason)
	for _, violation := range refused.Violations {
		fmt.Println("violation", violation)
	}
	return nil
}

func rollout(ctx context.Context, client, approver *midshift.Client, robotID, bundle string) error {
	id := "tour-go-" + robotID
	spec := &otav1.RolloutSpec{
		Bundle:        bundle,
		Selector:      &otav1.RolloutSelector{RobotIds: []string{robotID}},
		Waves:         []*otav1.RolloutWave{{Size: &otav1.RolloutWave_Rest{Rest: true}}},
		Probation:     durationpb.New(time.Second),
		Soak:          durationpb.New(0),
		ExposureTasks: proto.Uint64(0),
		AllowFullPush: true,
	}
	if _, err := client.Rollouts.CreateRollout(ctx, &otav1.CreateRolloutRequest{RolloutId: id, Spec: spec}); err != nil {
		return err
	}
	if _, err := client.Rollouts.SubmitRollout(ctx, &otav1.SubmitRolloutRequest{RolloutId: id}); err != nil {
		return err
	}
	if _, err := approver.Rollouts.ApproveRollout(ctx, &otav1.ApproveRolloutRequest{RolloutId: id}); err != nil {
		return err
	}
	if _, err := client.Rollouts.StartRollout(ctx, &otav1.StartRolloutRequest{RolloutId: id}); err != nil {
		return err
	}
	for seen, err := range client.WatchRollout(ctx, id) {
		if err != nil {
			return err
		}
		fmt.Printf("rollout %s wave %d\n", seen.GetRollout().GetPhase(), seen.GetRollout().GetWave())
		for _, robot := range seen.GetRobots() {
			fmt.Println("rollout robot", robot.GetRobotId(), robot.GetStep())
		}
	}
	return nil
}
