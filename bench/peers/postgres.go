package main

import (
	"cmp"
	"context"
	"errors"
	"fmt"
	"os"
	"os/exec"
	"os/user"
	"path/filepath"
	"slices"
	"strconv"
	"sync"
	"sync/atomic"
	"time"

	"github.com/jackc/pgx/v5"
	"github.com/jackc/pgx/v5/pgxpool"
)

const (
	schema = `CREATE TABLE job (id bigserial PRIMARY KEY, body bytea NOT NULL, state smallint NOT NULL DEFAULT 0);
		CREATE INDEX job_open ON job (id) WHERE state = 0`
	submitJob = `INSERT INTO job (body) VALUES ($1) RETURNING id`
	tellOfJob = `WITH new AS (INSERT INTO job (body) VALUES ($1) RETURNING id) SELECT pg_notify('job', id::text) FROM new`
	claimJob  = `UPDATE job SET state = 1 WHERE id = (SELECT id FROM job WHERE state = 0 ORDER BY id LIMIT 1
		FOR UPDATE SKIP LOCKED) RETURNING id`
	endJob = `UPDATE job SET state = 2 WHERE id = $1`
	// About what a stored transport takes.
	bodyBytes = 300
)

// Database is a PostgreSQL server of this run alone, with fsync on.
type Database struct {
	command *exec.Cmd
	pool    *pgxpool.Pool
}

// startDatabase makes a server in a folder of its own, by the newest programs of the machine.
func startDatabase(ctx context.Context, folder string) (*Database, error) {
	programs, err := filepath.Glob("/usr/lib/postgresql/*/bin")
	if err != nil || len(programs) == 0 {
		return nil, fmt.Errorf("no server programs of PostgreSQL: install the package postgresql")
	}
	version := func(path string) float64 {
		number, _ := strconv.ParseFloat(filepath.Base(filepath.Dir(path)), 64)
		return number
	}
	slices.SortFunc(programs, func(a, b string) int { return cmp.Compare(version(a), version(b)) })
	bin, data := programs[len(programs)-1], filepath.Join(folder, "data")
	as := func(program string, args ...string) *exec.Cmd {
		program = filepath.Join(bin, program)
		if os.Getuid() != 0 {
			return exec.Command(program, args...)
		}
		return exec.Command("runuser", append([]string{"-u", "postgres", "--", program}, args...)...)
	}
	if err := giveTo("postgres", folder); err != nil {
		return nil, err
	}
	if out, err := as("initdb", "--auth=trust", "-U", "postgres", "-D", data).CombinedOutput(); err != nil {
		return nil, fmt.Errorf("initdb: %w: %s", err, out)
	}
	started := as("pg_ctl", "-D", data, "-w", "-l", filepath.Join(folder, "log"), "-o",
		"-c listen_addresses='' -c max_connections=200 -k "+folder, "start")
	// Whatever becomes of the run, and of the start.
	database := &Database{command: as("pg_ctl", "-D", data, "-m", "immediate", "stop")}
	if out, err := started.CombinedOutput(); err != nil {
		return database, fmt.Errorf("pg_ctl start: %w: %s", err, out)
	}
	config, err := pgxpool.ParseConfig(fmt.Sprintf("host=%s user=postgres dbname=postgres", folder))
	if err != nil {
		return database, err
	}
	config.MaxConns = 128
	if database.pool, err = pgxpool.NewWithConfig(ctx, config); err != nil {
		return database, err
	}
	_, err = database.pool.Exec(ctx, schema)
	return database, err
}

func giveTo(name, folder string) error {
	if os.Getuid() != 0 {
		return nil
	}
	owner, err := user.Lookup(name)
	if err != nil {
		return err
	}
	uid, _ := strconv.Atoi(owner.Uid)
	gid, _ := strconv.Atoi(owner.Gid)
	return os.Chown(folder, uid, gid)
}

// End ends the server; its folder is its maker's.
func (d *Database) End() {
	if d.pool != nil {
		d.pool.Close()
	}
	_ = d.command.Run()
}

// pid is that of the server's first process.
func (d *Database) pid(ctx context.Context) (int, error) {
	var data string
	if err := d.pool.QueryRow(ctx, "SHOW data_directory").Scan(&data); err != nil {
		return 0, err
	}
	text, err := os.ReadFile(filepath.Join(data, "postmaster.pid"))
	if err != nil {
		return 0, err
	}
	var pid int
	_, err = fmt.Sscan(string(text), &pid)
	return pid, err
}

// measureQueue is one round of a queue in a table.
func measureQueue(ctx context.Context, args Args, figures *Figures) error {
	folder, err := os.MkdirTemp(args.Dir, "peers")
	if err != nil {
		return err
	}
	defer os.RemoveAll(folder)
	database, err := startDatabase(ctx, folder)
	if database != nil {
		defer database.End()
	}
	if err != nil {
		return err
	}
	pid, err := database.pid(ctx)
	if err != nil {
		return err
	}
	cpu := func() (float64, error) { return cpuSeconds(pid) }
	submit := func() error {
		var id int64
		return database.pool.QueryRow(ctx, submitJob, make([]byte, bodyBytes)).Scan(&id)
	}
	alone, err := measureCalls(1, args.Calls/10, cpu, submit)
	if err != nil {
		return err
	}
	many, err := measureCalls(args.InFlight, args.Calls, cpu, submit)
	if err != nil {
		return err
	}
	const queue = "PostgreSQL queue: "
	figures.Add(queue+"durable submit, one at a time, p50", "ms", alone.p50)
	figures.Add(queue+"durable submit, one at a time, p99", "ms", alone.p99)
	many.tell(figures, fmt.Sprintf("%sdurable submit, %d in flight", queue, args.InFlight))
	if _, err := database.pool.Exec(ctx, "TRUNCATE job"); err != nil {
		return err
	}
	claims, spent, err := work(ctx, database, args, cpu)
	if err != nil {
		return err
	}
	figures.Add(queue+"submit to its claim by an idle worker, p50", "ms", percentile(claims, 0.5))
	figures.Add(queue+"submit to its claim by an idle worker, p99", "ms", percentile(claims, 0.99))
	name := fmt.Sprintf("%ssubmit, claim and end of a task at %d/s, CPU of the database each", queue, args.Rate)
	figures.Add(name, "ms", spent*1e3/float64(len(claims)))
	return nil
}

// work submits tasks at a rate to workers that are told of each, and says the milliseconds until each was claimed and the CPU of all.
func work(ctx context.Context, database *Database, args Args, cpu func() (float64, error)) ([]float64, float64, error) {
	ctx, cancel := context.WithCancel(ctx)
	defer cancel()
	tasks := args.Rate * args.Seconds
	begun, claimed := make([]time.Time, tasks+1), make([]float64, 0, tasks)
	var lock sync.Mutex
	var failed error
	all := make(chan struct{})
	heard, err := listen(ctx, database)
	if err != nil {
		return nil, 0, err
	}
	var workers sync.WaitGroup
	for range args.Workers {
		workers.Go(func() {
			err := serve(ctx, database, heard, func(id int64) {
				lock.Lock()
				defer lock.Unlock()
				claimed = append(claimed, time.Since(begun[id]).Seconds()*1e3)
				if len(claimed) == tasks {
					close(all)
				}
			})
			if err != nil && ctx.Err() == nil {
				lock.Lock()
				failed = err
				lock.Unlock()
				cancel()
			}
		})
	}
	if _, err := database.pool.Exec(ctx, "ALTER SEQUENCE job_id_seq RESTART"); err != nil {
		return nil, 0, err
	}
	before, err := cpu()
	if err != nil {
		return nil, 0, err
	}
	due := time.NewTicker(time.Second / time.Duration(args.Rate))
	defer due.Stop()
	for id := 1; id <= tasks; id++ {
		<-due.C
		lock.Lock()
		begun[id] = time.Now()
		lock.Unlock()
		if _, err := database.pool.Exec(ctx, tellOfJob, make([]byte, bodyBytes)); err != nil {
			return nil, 0, err
		}
	}
	select {
	case <-all:
	case <-time.After(time.Minute):
		lock.Lock()
		failed = fmt.Errorf("%d of %d tasks were claimed", len(claimed), tasks)
		lock.Unlock()
	case <-ctx.Done():
	}
	after, err := cpu()
	cancel()
	workers.Wait()
	if failed != nil {
		err = failed
	}
	return claimed, after - before, err
}

// listen says each time that a task was submitted, on one connection for all workers: told one by one, all would ask for each task.
func listen(ctx context.Context, database *Database) (<-chan struct{}, error) {
	connection, err := database.pool.Acquire(ctx)
	if err != nil {
		return nil, err
	}
	if _, err := connection.Exec(ctx, "LISTEN job"); err != nil {
		connection.Release()
		return nil, err
	}
	heard := make(chan struct{})
	go func() {
		defer close(heard)
		defer connection.Release()
		for {
			if _, err := connection.Conn().WaitForNotification(ctx); err != nil {
				return
			}
			select {
			case heard <- struct{}{}:
			case <-ctx.Done():
				return
			}
		}
	}()
	return heard, nil
}

// serve claims the oldest task each time that one was submitted, and ends it.
func serve(ctx context.Context, database *Database, heard <-chan struct{}, claimed func(int64)) error {
	for range heard {
		var id int64
		err := database.pool.QueryRow(ctx, claimJob).Scan(&id)
		if errors.Is(err, pgx.ErrNoRows) {
			continue
		}
		if err != nil {
			return err
		}
		claimed(id)
		if _, err := database.pool.Exec(ctx, endJob, id); err != nil {
			return err
		}
	}
	return ctx.Err()
}

// Load is what many calls of one thing came to.
type Load struct {
	cpuMicros, perSecond, p50, p99 float64
}

func (l Load) tell(figures *Figures, name string) {
	figures.Add(name+", CPU of the server each", "us", l.cpuMicros)
	figures.Add(name+", rate", "1/s", l.perSecond)
	figures.Add(name+", p50", "ms", l.p50)
	figures.Add(name+", p99", "ms", l.p99)
}

// measureCalls makes so many calls, some at once, and counts the CPU of who is called.
func measureCalls(inFlight, calls int, cpu func() (float64, error), call func() error) (Load, error) {
	var next atomic.Int64
	var group sync.WaitGroup
	took, failed := make([][]float64, inFlight), make([]error, inFlight)
	before, err := cpu()
	if err != nil {
		return Load{}, err
	}
	begun := time.Now()
	for caller := range inFlight {
		group.Go(func() {
			for next.Add(1) <= int64(calls) {
				at := time.Now()
				if failed[caller] = call(); failed[caller] != nil {
					return
				}
				took[caller] = append(took[caller], time.Since(at).Seconds()*1e3)
			}
		})
	}
	group.Wait()
	seconds := time.Since(begun).Seconds()
	after, err := cpu()
	if err != nil {
		return Load{}, err
	}
	for _, err := range failed {
		if err != nil {
			return Load{}, err
		}
	}
	all := slices.Concat(took...)
	count := float64(len(all))
	return Load{(after - before) * 1e6 / count, count / seconds, percentile(all, 0.5), percentile(all, 0.99)}, nil
}
