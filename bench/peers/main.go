// Peers measures what others do for the same work on the same machine: a queue in a table of PostgreSQL, and a stream of NATS
// that syncs each message. In each round midshift's own bench is asked in turn with them. There are no thresholds.
package main

import (
	"context"
	"encoding/json"
	"flag"
	"fmt"
	"os"
	"os/exec"
	"os/signal"
	"path/filepath"
	"strings"
	"syscall"
)

// Args say what is measured.
type Args struct {
	Rounds, Calls, InFlight, Rate, Workers, Robots, Seconds int
	Dir, JSON, Bench, Names                                 string
}

func main() {
	if len(os.Args) == 3 && os.Args[1] == "nats-server" {
		fail(playServer(os.Args[2]))
		return
	}
	var args Args
	flag.IntVar(&args.Rounds, "rounds", 5, "rounds of each")
	flag.IntVar(&args.Calls, "calls", 20_000, "calls of one load")
	flag.IntVar(&args.InFlight, "in-flight", 50, "calls under way at once")
	flag.IntVar(&args.Rate, "rate", 32, "tasks a second, from submit to end")
	flag.IntVar(&args.Workers, "workers", 20, "workers of the queue")
	flag.IntVar(&args.Robots, "robots", 1_000, "robots that publish once a second")
	flag.IntVar(&args.Seconds, "seconds", 20, "seconds of a load that has a rate")
	flag.StringVar(&args.Dir, "dir", "", "where databases are made and taken away again; it should be a real disk")
	flag.StringVar(&args.JSON, "json", "", "also write the figures as a JSON array")
	flag.StringVar(&args.Bench, "bench", "", "midshift-bench, asked in turn with the others; without it they are alone")
	flag.StringVar(&args.Names, "names", "submit,offer,task", "what midshift-bench is asked for")
	flag.Parse()
	ctx, stop := signal.NotifyContext(context.Background(), os.Interrupt, syscall.SIGTERM)
	defer stop()
	fail(run(ctx, args))
}

func run(ctx context.Context, args Args) error {
	if flag.NArg() > 0 || min(args.Rounds, args.Calls/10, args.InFlight, args.Rate, args.Workers, args.Robots, args.Seconds) < 1 {
		return fmt.Errorf("each number must be at least 1, --calls at least 10, and nothing stands beside the flags")
	}
	var figures Figures
	for round := 1; round <= args.Rounds && ctx.Err() == nil; round++ {
		fmt.Fprintf(os.Stderr, "round %d of %d\n", round, args.Rounds)
		if err := measureQueue(ctx, args, &figures); err != nil {
			return err
		}
		if err := measureStream(args, &figures); err != nil {
			return err
		}
		if args.Bench == "" {
			continue
		}
		for _, name := range strings.Split(args.Names, ",") {
			if err := askBench(ctx, args, name, &figures); err != nil {
				return err
			}
		}
	}
	if ctx.Err() != nil {
		return fmt.Errorf("interrupted")
	}
	all := figures.All()
	printTable(os.Stdout, all)
	if args.JSON == "" {
		return nil
	}
	text, err := json.MarshalIndent(all, "", "  ")
	if err != nil {
		return err
	}
	return os.WriteFile(args.JSON, text, 0o644)
}

// askBench takes one round of midshift's own figures.
func askBench(ctx context.Context, args Args, name string, figures *Figures) error {
	folder, err := os.MkdirTemp(args.Dir, "peers")
	if err != nil {
		return err
	}
	defer os.RemoveAll(folder)
	path := filepath.Join(folder, "figures.json")
	bench := exec.CommandContext(ctx, args.Bench, name, "--rounds", "1", "--json", path)
	bench.Stderr = os.Stderr
	if args.Dir != "" {
		bench.Args = append(bench.Args, "--dir", args.Dir)
	}
	if err := bench.Run(); err != nil {
		return fmt.Errorf("%s %s: %w", args.Bench, name, err)
	}
	text, err := os.ReadFile(path)
	if err != nil {
		return err
	}
	var told []Figure
	if err := json.Unmarshal(text, &told); err != nil {
		return err
	}
	for _, figure := range told {
		figures.Add("midshift: "+figure.Name, figure.Unit, figure.Median)
	}
	return nil
}

func fail(err error) {
	if err != nil {
		fmt.Fprintln(os.Stderr, "error:", err)
		os.Exit(1)
	}
}
