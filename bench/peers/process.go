package main

import (
	"fmt"
	"os"
	"path/filepath"
	"strconv"
	"strings"
)

// ticksPerSecond is what Linux counts CPU in on every machine that this runs on (USER_HZ).
const ticksPerSecond = 100

// stat are the fields of /proc/PID/stat behind the program's name, from the third on.
func stat(pid int) ([]string, error) {
	text, err := os.ReadFile(filepath.Join("/proc", strconv.Itoa(pid), "stat"))
	if err != nil {
		return nil, err
	}
	_, fields, found := strings.Cut(string(text), ") ")
	if !found {
		return nil, fmt.Errorf("/proc/%d/stat has no name", pid)
	}
	return strings.Fields(fields), nil
}

func ticks(fields []string, numbers ...int) float64 {
	sum := 0.0
	for _, number := range numbers {
		value, _ := strconv.ParseFloat(fields[number-3], 64)
		sum += value
	}
	return sum
}

// cpuSeconds is what a process has spent, with its children, those that have ended too.
func cpuSeconds(pid int) (float64, error) {
	fields, err := stat(pid)
	if err != nil {
		return 0, err
	}
	spent := ticks(fields, 14, 15, 16, 17)
	others, err := filepath.Glob("/proc/[0-9]*")
	if err != nil {
		return 0, err
	}
	for _, other := range others {
		child, _ := strconv.Atoi(filepath.Base(other))
		// One that ends meanwhile is among those that have ended the next time.
		if fields, err := stat(child); err == nil && fields[1] == strconv.Itoa(pid) {
			spent += ticks(fields, 14, 15)
		}
	}
	return spent / ticksPerSecond, nil
}
