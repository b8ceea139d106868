//! Puts chargers on a grid map, which has none of its own.
//!
//! Invariant: a charger stands on a free cell that no task needs and that lies beside no station; whatever else is free
//! stays in one piece without it.

use anyhow::{Context, ensure};
use std::collections::BTreeSet;

/// A row and a column.
type Cell = (usize, usize);

/// Free floor by rows, as the letters of a map.
struct Cells {
    rows: Vec<Vec<u8>>,
}

impl Cells {
    fn letter(&self, (row, column): Cell) -> u8 {
        self.rows.get(row).and_then(|cells| cells.get(column)).copied().unwrap_or(b'@')
    }

    fn neighbours(&self, (row, column): Cell) -> impl Iterator<Item = Cell> {
        let beside =
            [(row.wrapping_sub(1), column), (row + 1, column), (row, column.wrapping_sub(1)), (row, column + 1)];
        beside.into_iter()
    }

    fn all(&self) -> impl Iterator<Item = Cell> {
        let columns = |(row, cells): (usize, &Vec<u8>)| (0..cells.len()).map(move |column| (row, column));
        self.rows.iter().enumerate().flat_map(columns)
    }

    /// Cells that routes lead over.
    fn is_way(&self, cell: Cell) -> bool {
        b".ES".contains(&self.letter(cell))
    }

    /// Cells that are reached from the first cell that routes lead over.
    fn reached(&self) -> usize {
        let mut reached: BTreeSet<Cell> = self.all().find(|cell| self.is_way(*cell)).into_iter().collect();
        let mut ahead: Vec<Cell> = reached.iter().copied().collect();
        while let Some(at) = ahead.pop() {
            let next = self.neighbours(at).filter(|cell| self.is_way(*cell));
            ahead.extend(next.filter(|cell| reached.insert(*cell)));
        }
        reached.len()
    }

    /// Whether a charger may stand here: on the way to nothing, and in nobody's.
    fn has_room(&self, cell: Cell, needed: &BTreeSet<Cell>) -> bool {
        let is_quiet = |beside: Cell| !b"ESC".contains(&self.letter(beside));
        self.letter(cell) == b'.'
            && !needed.contains(&cell)
            && self.neighbours(cell).all(is_quiet)
            && self.neighbours(cell).any(|beside| self.is_way(beside))
    }
}

/// The text of a map with so many chargers, each as far from the others as can be. `needed` are cells of tasks by their
/// number in the map.
///
/// # Errors
/// The map has no room for so many.
pub fn place_chargers(text: &str, count: usize, needed: &BTreeSet<usize>) -> anyhow::Result<String> {
    let begins = text.lines().position(|line| line.trim() == "map").context("there is no line `map`")? + 1;
    let lines: Vec<&str> = text.lines().collect();
    let mut cells = Cells { rows: lines[begins..].iter().map(|line| line.trim_end().as_bytes().to_vec()).collect() };
    let width = cells.rows.first().map_or(0, Vec::len).max(1);
    let needed: BTreeSet<Cell> = needed.iter().map(|cell| (cell / width, cell % width)).collect();
    let mut left: Vec<Cell> = cells.all().filter(|cell| cells.has_room(*cell, &needed)).collect();
    let (mut chosen, whole): (Vec<Cell>, usize) = (Vec::new(), cells.reached());
    while chosen.len() < count {
        let apart = |cell: &Cell| {
            let far = chosen.iter().map(|at: &Cell| at.0.abs_diff(cell.0) + at.1.abs_diff(cell.1));
            (far.min().unwrap_or(0), std::cmp::Reverse(*cell))
        };
        let best = left.iter().enumerate().max_by_key(|(_, cell)| apart(cell)).map(|(at, _)| at);
        let best = best.with_context(|| format!("the map has room for {} chargers, not for {count}", chosen.len()))?;
        let cell = left.swap_remove(best);
        if !cells.has_room(cell, &needed) {
            continue;
        }
        cells.rows[cell.0][cell.1] = b'C';
        if cells.reached() + chosen.len() + 1 == whole {
            chosen.push(cell);
        } else {
            cells.rows[cell.0][cell.1] = b'.';
        }
    }
    ensure!(chosen.len() == count, "chargers were lost");
    let rows = cells.rows.into_iter().map(|row| String::from_utf8_lossy(&row).into_owned());
    let all: Vec<String> = lines[..begins].iter().map(|line| (*line).to_owned()).chain(rows).collect();
    Ok(all.join("\n") + "\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::site::grid;
    use midshift_core::site::route::Router;
    use std::sync::Arc;

    const HALL: &str = "type octile\nheight 5\nwidth 9\nmap\nE.......E\n.@@@.@@@.\n....@....\n.@@@.@@@.\nE.......E\n";

    #[test]
    fn chargers_are_spread_and_cut_nothing_apart() {
        let text = place_chargers(HALL, 3, &BTreeSet::from([18])).expect("there is room");
        let site = Arc::new(grid::parse_map("hall", &text).expect("a map"));
        let chargers: Vec<_> = site.chargers().collect();
        assert_eq!(chargers.len(), 3, "{text}");
        let router = Router::new(site.clone());
        let stations: Vec<_> = site.stations().collect();
        for goal in stations.iter().chain(&chargers) {
            assert!(stations.iter().all(|from| router.distance_mm(*from, *goal).is_some()), "{text}");
        }
        assert!(!text.contains("\nC...@"), "a cell of a task is kept free: {text}");
        let told = place_chargers(HALL, 40, &BTreeSet::new()).expect_err("no room").to_string();
        assert!(told.starts_with("the map has room for ") && told.ends_with(", not for 40"), "{told}");
    }
}
