// One batch of many small items over one call; prints how many were admitted.
//
//	batch 127.0.0.1:7420 PREFIX COUNT
package main

import (
	"context"
	"errors"
	"fmt"
	"io"
	"os"
	"strconv"
	"time"

	"google.golang.org/protobuf/proto"

	taskv1 "midshift/clients/go/gen/midshift/task/v1"
	"midshift/clients/go/midshift"
)

func main() {
	if err := batch(os.Args[1], os.Args[2], os.Args[3]); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}

func batch(server, prefix, number string) error {
	count, err := strconv.Atoi(number)
	if err != nil {
		return err
	}
	as, err := midshift.FromEnvironment()
	if err != nil {
		return err
	}
	client, err := midshift.New(server, as)
	if err != nil {
		return err
	}
	defer client.Close()
	ctx, end := context.WithTimeout(context.Background(), time.Minute)
	defer end()
	stream, err := client.Tasks.SubmitTasks(ctx)
	if err != nil {
		return err
	}
	flat := &taskv1.FlatTask{TaskType: "transport", ToWaypoint: "B03", TimeoutSeconds: proto.Int32(600)}
	for i := range count {
		item := &taskv1.SubmitTaskRequest{RequestId: fmt.Sprintf("%s-%d", prefix, i), Body: &taskv1.SubmitTaskRequest_Flat{Flat: flat}}
		// A stream that broke says why when its answer is asked for.
		if err := stream.Send(&taskv1.SubmitTasksRequest{Item: item}); errors.Is(err, io.EOF) {
			break
		} else if err != nil {
			return err
		}
	}
	answer, err := stream.CloseAndRecv()
	if err != nil {
		return err
	}
	admitted := 0
	for _, result := range answer.GetResults() {
		if result.GetTaskId() != "" {
			admitted++
		}
	}
	fmt.Println("admitted", admitted)
	return nil
}
