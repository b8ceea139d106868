//! Pairs rows with columns at least cost: shortest augmenting paths over a sparse graph, in integers.
//!
//! Source: the successive shortest path method with potentials (Jonker and Volgenant 1987), here with rows that may stay
//! alone. Called by `rolling`. Invariant: the same input gives the same pairs.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Columns that a row may be paired with, each with what that costs.
pub type Choices = Vec<(usize, i64)>;

/// For each row its column, so that the sum of costs is least; none: it stays alone, which costs nothing. A pair is
/// made only where it lowers the sum. Costs are within ±2^60 / rows; columns are below `columns`.
pub fn pair_up(rows: &[Choices], columns: usize) -> Vec<Option<usize>> {
    let mut pairs = Pairs {
        row_prices: vec![0; rows.len()],
        column_prices: vec![0; columns],
        row_of: vec![None; columns],
        column_of: vec![None; rows.len()],
    };
    let mut search = Search::new(columns);
    for row in 0..rows.len() {
        search.run(rows, &mut pairs, row);
    }
    pairs.column_of
}

struct Pairs {
    row_prices: Vec<i64>,
    column_prices: Vec<i64>,
    row_of: Vec<Option<usize>>,
    column_of: Vec<Option<usize>>,
}

/// One search for the cheapest way to give one more row a column, or to leave one alone.
struct Search {
    /// Cost of the way to each column so far, and the row before it.
    reached: Vec<Option<(i64, usize)>>,
    is_settled: Vec<bool>,
    touched: Vec<usize>,
    heap: BinaryHeap<Reverse<(i64, usize)>>,
}

/// Where a way ends.
enum End {
    /// At a column that nobody has.
    Column(usize),
    /// At a row that is left alone.
    Row(usize),
}

impl Search {
    fn new(columns: usize) -> Self {
        Self {
            reached: vec![None; columns],
            is_settled: vec![false; columns],
            touched: Vec::new(),
            heap: BinaryHeap::new(),
        }
    }

    fn run(&mut self, rows: &[Choices], pairs: &mut Pairs, root: usize) {
        let (end, cost, settled) = self.find_end(rows, pairs, root);
        pairs.row_prices[root] += cost;
        for column in settled {
            let (at, _) = self.reached[column].expect("it was reached");
            pairs.column_prices[column] -= cost - at;
            let row = pairs.row_of[column].expect("a settled column has a row");
            pairs.row_prices[row] += cost - at;
        }
        // Along the way each row takes the column that it was reached over.
        let (mut row, mut given) = match end {
            End::Column(column) => (self.reached[column].expect("it was reached").1, Some(column)),
            End::Row(row) => (row, None),
        };
        loop {
            let had = std::mem::replace(&mut pairs.column_of[row], given);
            given.into_iter().for_each(|column| pairs.row_of[column] = Some(row));
            if row == root {
                break;
            }
            let column = had.expect("a row on the way had a column");
            (row, given) = (self.reached[column].expect("it was reached").1, Some(column));
        }
        self.forget();
    }

    fn find_end(&mut self, rows: &[Choices], pairs: &Pairs, root: usize) -> (End, i64, Vec<usize>) {
        let (mut row, mut at, mut settled) = (root, 0, Vec::new());
        let mut alone = (i64::MAX, root);
        loop {
            alone = alone.min((at - pairs.row_prices[row], row));
            for (column, cost) in &rows[row] {
                if self.is_settled[*column] {
                    continue;
                }
                let cost = at + cost - pairs.row_prices[row] - pairs.column_prices[*column];
                if self.reached[*column].is_none_or(|(known, _)| cost < known) {
                    self.touched.push(*column);
                    self.reached[*column] = Some((cost, row));
                    self.heap.push(Reverse((cost, *column)));
                }
            }
            while self.heap.peek().is_some_and(|Reverse((_, column))| self.is_settled[*column]) {
                self.heap.pop();
            }
            let next = self.heap.pop().filter(|Reverse((cost, _))| *cost < alone.0);
            let Some(Reverse((cost, column))) = next else {
                return (End::Row(alone.1), alone.0, settled);
            };
            let Some(owner) = pairs.row_of[column] else { return (End::Column(column), cost, settled) };
            self.is_settled[column] = true;
            settled.push(column);
            (row, at) = (owner, cost);
        }
    }

    fn forget(&mut self) {
        for column in self.touched.drain(..) {
            self.reached[column] = None;
            self.is_settled[column] = false;
        }
        self.heap.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sum(rows: &[Choices], pairs: &[Option<usize>]) -> i64 {
        let cost = |(row, column): (&Choices, &Option<usize>)| {
            column
                .map_or(0, |column| rows[row_index(rows, row)].iter().find(|(c, _)| *c == column).expect("a choice").1)
        };
        rows.iter().zip(pairs).map(cost).sum()
    }

    fn row_index(rows: &[Choices], row: &Choices) -> usize {
        rows.iter().position(|r| std::ptr::eq(r, row)).expect("it is one of them")
    }

    /// The least sum by trying everything: of each row each column that is still free.
    fn least(rows: &[Choices], taken: u32) -> i64 {
        let Some((first, rest)) = rows.split_first() else { return 0 };
        let with =
            first.iter().filter(|(c, _)| taken >> c & 1 == 0).map(|(c, cost)| cost + least(rest, taken | 1 << c));
        with.chain([least(rest, taken)]).min().expect("to stay alone is a choice")
    }

    fn choices(columns: usize, costs: std::ops::Range<i64>) -> impl Strategy<Value = Choices> {
        let cost = prop::option::of(costs);
        prop::collection::vec(cost, columns)
            .prop_map(|costs| costs.into_iter().enumerate().filter_map(|(c, cost)| Some((c, cost?))).collect())
    }

    proptest! {
        #[test]
        fn the_sum_is_the_least_that_there_is_on_random_and_on_tied_costs(
            rows in prop::collection::vec(prop_oneof![choices(6, -50..20), choices(6, -2..1)], 0..6)
        ) {
            let pairs = pair_up(&rows, 6);
            let taken: Vec<usize> = pairs.iter().flatten().copied().collect();
            let mut once = taken.clone();
            once.sort_unstable();
            once.dedup();
            prop_assert_eq!(once.len(), taken.len(), "no column is given twice");
            prop_assert_eq!(sum(&rows, &pairs), least(&rows, 0));
        }
    }

    #[test]
    fn as_many_are_paired_as_can_be_where_each_pair_is_worth_more_than_any_detour() {
        // Both want the first; only the second row can take the other.
        let rows = vec![vec![(0, -1_000)], vec![(0, -1_010), (1, -900)]];
        assert_eq!(pair_up(&rows, 2), [Some(0), Some(1)]);
        assert_eq!(pair_up(&[vec![], vec![(0, 5)], vec![(0, 0)]], 1), [None, None, None], "nothing to be gained");
    }

    #[test]
    fn a_thousand_rows_among_fifteen_hundred_columns_are_paired() {
        let mut seed = 7_u64;
        let mut draw = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            seed >> 33
        };
        let rows: Vec<Choices> = (0..1_000)
            .map(|_| (0..32).map(|_| ((draw() % 1_500) as usize, -(1 << 40) + (draw() % 100_000) as i64)).collect())
            .collect();
        let paired = pair_up(&rows, 1_500).iter().flatten().count();
        assert_eq!(paired, 1_000);
    }
}
