package main

import (
	"bufio"
	"fmt"
	"io"
	"os"
	"os/exec"
	"strings"
	"sync"
	"time"

	"github.com/nats-io/nats-server/v2/server"
	"github.com/nats-io/nats.go"
)

const (
	stream = "STATUS"
	// About what a report of a robot takes.
	reportBytes = 170
)

// playServer is a NATS server with JetStream that syncs each message, until stdin ends. It says its address on stdout.
func playServer(folder string) error {
	options := &server.Options{Host: "127.0.0.1", Port: -1, JetStream: true, StoreDir: folder, SyncAlways: true, NoSigs: true}
	running, err := server.NewServer(options)
	if err != nil {
		return err
	}
	running.Start()
	if !running.ReadyForConnections(10 * time.Second) {
		return fmt.Errorf("the server does not listen")
	}
	fmt.Println(running.ClientURL())
	_, _ = io.Copy(io.Discard, os.Stdin)
	running.Shutdown()
	return nil
}

// measureStream is one round of a stream that syncs each message before it acknowledges it.
func measureStream(args Args, figures *Figures) error {
	folder, err := os.MkdirTemp(args.Dir, "peers")
	if err != nil {
		return err
	}
	defer os.RemoveAll(folder)
	this, err := os.Executable()
	if err != nil {
		return err
	}
	child := exec.Command(this, "nats-server", folder)
	child.Stderr = os.Stderr
	end, err := child.StdinPipe()
	if err != nil {
		return err
	}
	said, err := child.StdoutPipe()
	if err != nil {
		return err
	}
	if err := child.Start(); err != nil {
		return err
	}
	defer func() {
		_ = end.Close()
		_ = child.Wait()
	}()
	line, err := bufio.NewReader(said).ReadString('\n')
	if err != nil {
		return err
	}
	url := strings.TrimSpace(line)
	cpu := func() (float64, error) { return cpuSeconds(child.Process.Pid) }
	first, messages, err := connect(url)
	if err != nil {
		return err
	}
	defer first.Close()
	if _, err := messages.AddStream(&nats.StreamConfig{Name: stream, Subjects: []string{"status.*"}}); err != nil {
		return err
	}
	publish := func() error {
		_, err := messages.Publish("status.one", make([]byte, reportBytes))
		return err
	}
	many, err := measureCalls(args.InFlight, args.Calls, cpu, publish)
	if err != nil {
		return err
	}
	many.tell(figures, fmt.Sprintf("NATS JetStream, sync always: a message, %d in flight", args.InFlight))
	steady, err := measureRobots(url, args, cpu)
	if err != nil {
		return err
	}
	steady.tell(figures, fmt.Sprintf("NATS JetStream, sync always: a message of %d robots at 1/s", args.Robots))
	return nil
}

func connect(url string) (*nats.Conn, nats.JetStreamContext, error) {
	connection, err := nats.Connect(url)
	if err != nil {
		return nil, nil, err
	}
	messages, err := connection.JetStream(nats.MaxWait(time.Minute))
	return connection, messages, err
}

// measureRobots lets each robot publish once a second on a connection of its own.
func measureRobots(url string, args Args, cpu func() (float64, error)) (Load, error) {
	var connections []*nats.Conn
	defer func() {
		for _, connection := range connections {
			connection.Close()
		}
	}()
	took, failed := make([][]float64, args.Robots), make([]error, args.Robots)
	begin := make(chan struct{})
	var group sync.WaitGroup
	for robot := range args.Robots {
		connection, messages, err := connect(url)
		if err != nil {
			close(begin)
			return Load{}, err
		}
		connections = append(connections, connection)
		group.Go(func() {
			<-begin
			time.Sleep(time.Second * time.Duration(robot) / time.Duration(args.Robots))
			due := time.NewTicker(time.Second)
			defer due.Stop()
			for range args.Seconds {
				at := time.Now()
				_, failed[robot] = messages.Publish(fmt.Sprintf("status.%d", robot), make([]byte, reportBytes))
				if failed[robot] != nil {
					return
				}
				took[robot] = append(took[robot], time.Since(at).Seconds()*1e3)
				<-due.C
			}
		})
	}
	before, err := cpu()
	begun := time.Now()
	close(begin)
	group.Wait()
	seconds := time.Since(begun).Seconds()
	after, errAfter := cpu()
	for _, err := range append(failed, err, errAfter) {
		if err != nil {
			return Load{}, err
		}
	}
	var all []float64
	for _, robot := range took {
		all = append(all, robot...)
	}
	count := float64(len(all))
	return Load{(after - before) * 1e6 / count, count / seconds, percentile(all, 0.5), percentile(all, 0.99)}, nil
}
