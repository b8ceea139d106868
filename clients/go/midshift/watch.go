package midshift

import (
	"context"
	"errors"
	"io"
	"iter"
	"math/rand/v2"
	"time"

	"google.golang.org/grpc"
	"google.golang.org/grpc/codes"

	otav1 "midshift/clients/go/gen/midshift/ota/v1"
	taskv1 "midshift/clients/go/gen/midshift/task/v1"
)

// Shortest and longest pause before a watch is opened again.
const (
	pauseMin = 100 * time.Millisecond
	pauseMax = 5 * time.Second
)

// HasEnded says whether a task will not leave its state.
func HasEnded(state taskv1.TaskState) bool {
	switch state {
	case taskv1.TaskState_TASK_STATE_SUCCEEDED, taskv1.TaskState_TASK_STATE_FAILED,
		taskv1.TaskState_TASK_STATE_CANCELED, taskv1.TaskState_TASK_STATE_EXPIRED:
		return true
	}
	return false
}

// RolloutHasEnded says whether a roll-out will not leave its phase.
func RolloutHasEnded(phase otav1.RolloutPhase) bool {
	switch phase {
	case otav1.RolloutPhase_ROLLOUT_PHASE_COMPLETED, otav1.RolloutPhase_ROLLOUT_PHASE_ABORTED,
		otav1.RolloutPhase_ROLLOUT_PHASE_SUPERSEDED:
		return true
	}
	return false
}

// pause grows with each rest, with jitter, and begins anew whenever something was heard.
type pause struct{ next time.Duration }

func (p *pause) heard() { p.next = pauseMin }

func (p *pause) rest(ctx context.Context) error {
	timer := time.NewTimer(p.next/2 + rand.N(p.next/2+1))
	defer timer.Stop()
	p.next = min(p.next*2, pauseMax)
	select {
	case <-timer.C:
		return nil
	case <-ctx.Done():
		return ErrorOf(ctx.Err())
	}
}

// Watch gives the tasks that match as they are, and then each change in commit order, without loss, across restarts of the server. If
// the server cannot go on from where it was (the data is another's, or too much happened), it begins again with the tasks as they are.
// It ends with ctx, whose error is the last thing it gives.
func (c *Client) Watch(ctx context.Context, filter *taskv1.TaskFilter) iter.Seq2[*taskv1.Task, error] {
	return func(yield func(*taskv1.Task, error) bool) {
		for task, err := range c.watch(ctx, filter) {
			if (task != nil || err != nil) && !yield(task, err) {
				return
			}
		}
	}
}

// Wait waits until a task has ended, whatever its end, or until ctx ends. NotFound if there is no such task.
func (c *Client) Wait(ctx context.Context, taskID string) (*taskv1.Task, error) {
	known := false
	for task, err := range c.watch(ctx, &taskv1.TaskFilter{TaskIds: []string{taskID}}) {
		if err != nil {
			return nil, err
		}
		if task == nil && !known {
			answer, err := c.Tasks.GetTask(ctx, &taskv1.GetTaskRequest{TaskId: taskID})
			if err != nil {
				return nil, err
			}
			task = answer.GetTask()
		}
		known = true
		if task != nil && HasEnded(task.GetState()) {
			return task, nil
		}
	}
	return nil, ErrorOf(context.Canceled)
}

// watch is Watch; nil and nil are a bookmark: everything up to here was said.
func (c *Client) watch(ctx context.Context, filter *taskv1.TaskFilter) iter.Seq2[*taskv1.Task, error] {
	return func(yield func(*taskv1.Task, error) bool) {
		cursor, rest := "", pause{pauseMin}
		for {
			stream, err := c.Tasks.WatchTasks(ctx, &taskv1.WatchTasksRequest{Filter: filter, Cursor: cursor}, grpc.WaitForReady(true))
			for err == nil {
				var message *taskv1.WatchTasksResponse
				if message, err = stream.Recv(); err != nil {
					break
				}
				rest.heard()
				// While existing tasks are sent there is no cursor yet: a break begins again.
				cursor = message.GetCursor()
				task := message.GetExisting()
				if task == nil {
					task = message.GetChange().GetTask()
				}
				if !yield(task, nil) {
					return
				}
			}
			code := CodeOf(err)
			switch {
			case errors.Is(err, io.EOF), code == codes.Unavailable:
			case cursor != "" && (code == codes.OutOfRange || code == codes.FailedPrecondition):
				cursor = ""
			default:
				yield(nil, ErrorOf(err))
				return
			}
			if err := rest.rest(ctx); err != nil {
				yield(nil, err)
				return
			}
		}
	}
}

// WatchRollout gives a roll-out with the robots that changed, now and with each change, to its end, across restarts of the server.
func (c *Client) WatchRollout(ctx context.Context, rolloutID string) iter.Seq2[*otav1.WatchRolloutResponse, error] {
	return func(yield func(*otav1.WatchRolloutResponse, error) bool) {
		rest := pause{pauseMin}
		for {
			stream, err := c.Rollouts.WatchRollout(ctx, &otav1.WatchRolloutRequest{RolloutId: rolloutID}, grpc.WaitForReady(true))
			for err == nil {
				var message *otav1.WatchRolloutResponse
				if message, err = stream.Recv(); err != nil {
					break
				}
				rest.heard()
				if !yield(message, nil) || RolloutHasEnded(message.GetRollout().GetPhase()) {
					return
				}
			}
			if !errors.Is(err, io.EOF) && CodeOf(err) != codes.Unavailable {
				yield(nil, ErrorOf(err))
				return
			}
			if err := rest.rest(ctx); err != nil {
				yield(nil, err)
				return
			}
		}
	}
}
