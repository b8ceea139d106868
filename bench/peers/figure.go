package main

import (
	"fmt"
	"io"
	"math"
	"slices"
)

// Figure is one record of midshift-bench's JSON, as far as it is told here: over several rounds, each in turn with all others.
type Figure struct {
	Name   string  `json:"name"`
	Unit   string  `json:"unit"`
	Median float64 `json:"median"`
	Min    float64 `json:"min"`
	Max    float64 `json:"max"`
	Runs   int     `json:"runs"`
}

// Figures gathers what each round says, in the order of the first.
type Figures struct {
	order  []Figure
	values map[string][]float64
}

// Add takes one value of a figure.
func (f *Figures) Add(name, unit string, value float64) {
	if f.values == nil {
		f.values = map[string][]float64{}
	}
	key := name + "\x00" + unit
	if _, known := f.values[key]; !known {
		f.order = append(f.order, Figure{Name: name, Unit: unit})
	}
	f.values[key] = append(f.values[key], value)
}

// All are the figures with their spread.
func (f *Figures) All() []Figure {
	all := slices.Clone(f.order)
	for i := range all {
		values := f.values[all[i].Name+"\x00"+all[i].Unit]
		all[i].Median, all[i].Runs = percentile(values, 0.5), len(values)
		all[i].Min, all[i].Max = slices.Min(values), slices.Max(values)
	}
	return all
}

func printTable(out io.Writer, figures []Figure) {
	fmt.Fprintf(out, "%-84s %12s %12s %12s %-9s %4s\n", "figure", "median", "min", "max", "unit", "runs")
	for _, f := range figures {
		fmt.Fprintf(out, "%-84s %12.3f %12.3f %12.3f %-9s %4d\n", f.Name, f.Median, f.Min, f.Max, f.Unit, f.Runs)
	}
}

// percentile is the value below which this share of the numbers lies; 0 of none.
func percentile(values []float64, share float64) float64 {
	if len(values) == 0 {
		return 0
	}
	sorted := slices.Sorted(slices.Values(values))
	return sorted[int(math.Round(float64(len(sorted)-1)*share))]
}
