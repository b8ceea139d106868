//! Import of grid benchmarks: maps of squares (`type octile`), start cells and task lists.
//!
//! Invariant: a free cell is one waypoint `c<row * width + column>` joined to its free neighbours in four directions, 1 m
//! apart, at 1 m/s; bodies drive through each other (`collisions_modelled` is false), and nothing is reserved on a grid
//! but its chargers, which benchmarks do not have: a letter of ours.
//! Called by the command line for `--map` and `--tasks`, and by the bench.

use super::draft::{Draft, DraftArea, DraftLane, DraftWaypoint};
use super::map::{AreaDefaults, Kind, Site, Source, WaypointIx};
use crate::ids::WaypointId;
use crate::limits::{SITE_FILE_BYTES, SITE_WAYPOINTS_MAX, TASK_LIST_MAX};
use crate::reason::{Refusal, Violations};

/// Side of one cell, millimetres.
pub const CELL_MM: u32 = 1_000;
/// Speed on a grid, millimetres per second.
pub const SPEED_MM_S: u32 = 1_000;
/// Mistakes listed of one file; a file of another kind would list every line.
const VIOLATIONS_MAX: usize = 100;
/// Cells in one row of a task list.
const CELLS_PER_TASK_MAX: usize = 32;

/// Cells that a robot may be on.
const FREE: &[u8] = b".ESC";

/// The waypoint of a cell.
fn cell_name(cell: usize) -> String {
    format!("c{cell}")
}

struct Header {
    width: usize,
    height: usize,
    /// Lines before the first row.
    lines: usize,
}

fn header(text: &str) -> Result<Header, Refusal> {
    let (mut width, mut height, mut octile) = (0, 0, false);
    for (at, line) in text.lines().enumerate() {
        let field = || format!("line {}", at + 1);
        let mut words = line.split_whitespace();
        match (words.next(), words.next()) {
            (Some("type"), kind) => {
                if kind != Some("octile") {
                    return Err(Refusal::field(&field(), "only `type octile` is known"));
                }
                octile = true;
            }
            (Some(key @ ("width" | "height")), Some(number)) => {
                let number =
                    number.parse::<usize>().map_err(|_| Refusal::field(&field(), format!("{key} must be a number")))?;
                *(if key == "width" { &mut width } else { &mut height }) = number;
            }
            (Some("map"), None) => {
                let cells = width.checked_mul(height);
                if !octile || width == 0 || height == 0 || cells.is_none_or(|c| c > SITE_WAYPOINTS_MAX) {
                    let rule = format!(
                        "`type octile`, width and height of together 1..{SITE_WAYPOINTS_MAX} cells must stand before `map`"
                    );
                    return Err(Refusal::field(&field(), rule));
                }
                return Ok(Header { width, height, lines: at + 1 });
            }
            _ => return Err(Refusal::field(&field(), "must be type, height, width or map")),
        }
    }
    Err(Refusal::field("file", "there is no line `map`"))
}

/// Reads a map. `.`, `E`, `S` and `C` are free, `@` and `T` blocked; `E` and `S` become stations (all free cells, if
/// there is none), and `C` a charger, which no route leads over. Errors: each bad line, up to 100.
pub fn parse_map(name: &str, text: &str) -> Result<Site, Refusal> {
    if text.len() > SITE_FILE_BYTES {
        return Err(Refusal::field("file", format!("must be at most {SITE_FILE_BYTES} bytes")));
    }
    let Header { width, height, lines } = header(text)?;
    let mut v = Violations::default();
    let rows: Vec<&[u8]> =
        text.lines().skip(lines).map(str::trim_end).take_while(|r| !r.is_empty()).map(str::as_bytes).collect();
    if rows.len() != height {
        v.add("height", format!("says {height}, but there are {} rows", rows.len()));
    }
    for (at, row) in rows.iter().enumerate() {
        let field = format!("line {}", lines + at + 1);
        if row.len() != width {
            v.add(field, format!("has {} cells, width says {width}", row.len()));
        } else if let Some(column) = row.iter().position(|c| !FREE.contains(c) && !b"@T".contains(c)) {
            v.add(field, format!("column {}: a cell must be one of . E S C @ T", column + 1));
        }
        if v.0.len() >= VIOLATIONS_MAX {
            break;
        }
    }
    if !v.0.is_empty() {
        return Err(Refusal::invalid(v.0));
    }
    let marked = rows.iter().any(|row| row.iter().any(|c| b"ES".contains(c)));
    let free = |row: usize, column: usize| rows.get(row).and_then(|r| r.get(column)).is_some_and(|c| FREE.contains(c));
    let (mut waypoints, mut lanes) = (Vec::new(), Vec::new());
    for (row, cells) in rows.iter().enumerate() {
        for column in (0..width).filter(|column| free(row, *column)) {
            let kind = match cells[column] {
                b'C' => Kind::Charger,
                b'.' if marked => Kind::Junction,
                _ => Kind::Station,
            };
            waypoints.push(DraftWaypoint {
                field: String::new(),
                id: cell_name(row * width + column),
                x_mm: column as i64 * i64::from(CELL_MM),
                y_mm: (height - 1 - row) as i64 * i64::from(CELL_MM),
                area: None,
                kind,
                capacity: None,
                reserved: kind == Kind::Charger,
            });
            for (other_row, other_column) in [(row, column + 1), (row + 1, column)] {
                if free(other_row, other_column) {
                    let ends = [cell_name(row * width + column), cell_name(other_row * width + other_column)];
                    lanes.extend([(0, 1), (1, 0)].map(|(from, to)| grid_lane(&ends[from], &ends[to])));
                }
            }
        }
    }
    let defaults = AreaDefaults { speed_limit_mm_s: Some(SPEED_MM_S), ..AreaDefaults::default() };
    let draft = Draft {
        site_id: site_id_of(name),
        name: name.chars().filter(|c| !c.is_control()).take(64).collect(),
        map_id: site_id_of(name),
        map_version: "1".to_owned(),
        source: Source::Grid,
        collisions_modelled: false,
        areas: vec![DraftArea { field: "area".to_owned(), id: "grid".to_owned(), people: false, defaults }],
        waypoints,
        lanes,
        passages: Vec::new(),
        robots: Vec::new(),
    };
    draft.build(v)
}

fn grid_lane(from: &str, to: &str) -> DraftLane {
    let (from, to) = (from.to_owned(), to.to_owned());
    DraftLane { field: String::new(), from, to, length_mm: Some(CELL_MM), speed_limit_mm_s: None, wide: false }
}

/// A site id from a file name: lower case, anything else a hyphen.
pub(super) fn site_id_of(name: &str) -> String {
    let lower = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' };
    let id: String = name.chars().map(lower).take(64).collect();
    let id = id.trim_matches('-');
    if id.is_empty() { "grid".to_owned() } else { id.to_owned() }
}

/// What one task of a grid list asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GridWork {
    /// Drive to each cell in this order.
    Visit,
    /// Two cells: pick up at the first, put down at the second.
    Transport,
}

/// One task of a grid list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GridTask {
    /// Line of the file that it begins on, from 1.
    pub line: usize,
    /// What to do there.
    pub work: GridWork,
    /// Where, in order; two for a transport, else at least two.
    pub cells: Vec<WaypointId>,
}

/// The lines of a list that are not comments and not empty, with their numbers, after the count in the first of them.
fn counted<'a>(text: &'a str, v: &mut Violations) -> Vec<(usize, &'a str)> {
    if text.len() > SITE_FILE_BYTES {
        v.add("file", format!("must be at most {SITE_FILE_BYTES} bytes"));
        return Vec::new();
    }
    let numbered = text.lines().enumerate().map(|(at, line)| (at + 1, line.trim()));
    let mut lines = numbered.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let Some((at, first)) = lines.next() else {
        v.add("file", "there is no count line");
        return Vec::new();
    };
    let rows: Vec<_> = lines.take(TASK_LIST_MAX + 1).collect();
    match first.parse::<usize>() {
        Ok(_) if rows.len() > TASK_LIST_MAX => v.add("file", format!("must have at most {TASK_LIST_MAX} rows")),
        Ok(count) if count == rows.len() => {}
        Ok(count) => v.add(format!("line {at}"), format!("says {count} rows, but there are {}", rows.len())),
        Err(_) => v.add(format!("line {at}"), "the first line must be the number of rows"),
    }
    rows
}

fn cell(site: &Site, line: usize, word: &str, v: &mut Violations) -> Option<WaypointIx> {
    let number = word.trim().parse::<usize>().ok();
    let found = number.and_then(|n| WaypointId::parse(&cell_name(n)).ok()).and_then(|name| site.find(&name));
    if found.is_none() {
        v.add(format!("line {line}"), format!("{word:?} is not a free cell of map {}", site.map_id()));
    }
    found
}

/// Reads start cells: a count, then one cell a line. Errors: each bad line, up to 100.
pub fn parse_starts(site: &Site, text: &str) -> Result<Vec<WaypointIx>, Refusal> {
    let mut v = Violations::default();
    let mut starts = Vec::new();
    for (line, row) in counted(text, &mut v) {
        starts.extend(cell(site, line, row, &mut v));
        if v.0.len() >= VIOLATIONS_MAX {
            break;
        }
    }
    v.finish()?;
    Ok(starts)
}

/// Reads a task list: a count, then rows of cells parted by commas. A row of several cells visits them; rows of a single
/// cell are taken in pairs, pickup and drop. Errors: each bad line, up to 100.
pub fn parse_tasks(site: &Site, text: &str) -> Result<Vec<GridTask>, Refusal> {
    let mut v = Violations::default();
    let mut tasks = Vec::new();
    let mut pickup: Option<(usize, WaypointId)> = None;
    for (line, row) in counted(text, &mut v) {
        if v.0.len() >= VIOLATIONS_MAX {
            break;
        }
        let words: Vec<_> = row.split(',').filter(|w| !w.trim().is_empty()).collect();
        if words.is_empty() || words.len() > CELLS_PER_TASK_MAX {
            v.add(format!("line {line}"), format!("must have 1..{CELLS_PER_TASK_MAX} cells"));
            continue;
        }
        let found: Vec<_> =
            words.iter().filter_map(|w| cell(site, line, w, &mut v)).map(|w| site.name_of(w).clone()).collect();
        if found.len() != words.len() {
            continue;
        }
        if found.len() > 1 {
            tasks.push(GridTask { line, work: GridWork::Visit, cells: found });
        } else if let Some((first_line, first)) = pickup.take() {
            let cells = std::iter::once(first).chain(found).collect();
            tasks.push(GridTask { line: first_line, work: GridWork::Transport, cells });
        } else {
            pickup = found.into_iter().next().map(|name| (line, name));
        }
    }
    if let Some((line, name)) = pickup.filter(|_| v.0.is_empty()) {
        v.add(format!("line {line}"), format!("pickup at {name} has no row with its drop"));
    }
    v.finish()?;
    Ok(tasks)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::site::lint;
    use crate::site::route::Router;
    use std::sync::Arc;

    const SMALL: &str = "type octile\nheight 3\nwidth 4\nmap\nE..@\n.@.S\n...T\n";

    fn small() -> Site {
        parse_map("Small Map.map", SMALL).expect("reads")
    }

    fn fields(refusal: &Refusal) -> Vec<&str> {
        refusal.violations.iter().map(|v| v.field.as_str()).collect()
    }

    #[test]
    fn free_cells_are_joined_in_four_directions_and_nothing_is_reserved() {
        let site = Arc::new(small());
        assert_eq!((site.site_id().as_str(), site.waypoints().len(), site.lanes().len()), ("small-map-map", 9, 18));
        assert!(site.places().is_empty() && !site.collisions_modelled());
        let stations: Vec<_> = site.stations().map(|w| site.name_of(w).as_str()).collect();
        assert_eq!(stations, ["c0", "c7"]);
        let at = |name: &str| site.find(&WaypointId::parse(name).expect("a name")).expect(name);
        assert_eq!((site.waypoint(at("c0")).x_mm, site.waypoint(at("c0")).y_mm), (0, 2000));
        assert_eq!(site.find(&WaypointId::parse("c3").expect("a name")), None, "blocked");
        assert_eq!(Router::new(site.clone()).distance_mm(at("c0"), at("c7")), Some(4000));
        assert!(!lint::refuses(&lint::lint(&site, Some(50))));
    }

    #[test]
    fn a_charger_is_reserved_and_no_route_leads_over_it() {
        let site = Arc::new(parse_map("m", "type octile\nheight 2\nwidth 4\nmap\nE.CS\n....\n").expect("reads"));
        let at = |name: &str| site.find(&WaypointId::parse(name).expect("a name")).expect(name);
        assert_eq!(site.chargers().collect::<Vec<_>>(), [at("c2")]);
        assert_eq!((site.places().len(), site.stations().count()), (1, 2));
        let router = Router::new(site.clone());
        assert_eq!(
            (router.distance_mm(at("c0"), at("c2")), router.distance_mm(at("c0"), at("c3"))),
            (Some(2000), Some(5000))
        );
    }

    #[test]
    fn rows_of_one_cell_are_paired_and_longer_rows_are_visits() {
        let tasks = parse_tasks(&small(), "# a comment\n5\n0\n7\n8, 2 ,0\n\n10\n# another\n0\n").expect("reads");
        let shown: Vec<_> = tasks.iter().map(|t| (t.line, t.work, format!("{:?}", t.cells))).collect();
        let want = [
            (3, GridWork::Transport, "[c0, c7]"),
            (5, GridWork::Visit, "[c8, c2, c0]"),
            (7, GridWork::Transport, "[c10, c0]"),
        ];
        assert_eq!(shown, want.map(|(line, work, cells)| (line, work, cells.to_owned())));
    }

    #[test]
    fn bad_lists_name_each_line() {
        let refusal = parse_tasks(&small(), "4\n0\n3\nx,0\n99\n").expect_err("three bad rows");
        assert_eq!(fields(&refusal), ["line 3", "line 4", "line 5"]);
        let refusal = parse_tasks(&small(), "3\n0\n7\n2\n").expect_err("half a pair");
        assert_eq!(fields(&refusal), ["line 4"]);
        assert_eq!(fields(&parse_tasks(&small(), "2\n0\n").expect_err("too few")), ["line 1"]);
        assert_eq!(fields(&parse_starts(&small(), "").expect_err("empty")), ["file"]);
        assert_eq!(parse_starts(&small(), "2\n0\n7\n").map(|s| s.len()), Ok(2));
    }

    #[test]
    fn bad_maps_name_each_line() {
        for (from, to, field) in [
            ("octile", "hex", "line 1"),
            ("height 3", "height 4", "height"),
            ("width 4", "width x", "line 3"),
            ("width 4", "width 900000000", "line 4"),
            (".@.S", ".@.SS", "line 6"),
            (".@.S", ".@?S", "line 6"),
            ("map\n", "", "line 4"),
        ] {
            assert_eq!(fields(&parse_map("m", &SMALL.replace(from, to)).expect_err(to)), [field], "{to}");
        }
        assert_eq!(fields(&parse_map("m", "type octile\n").expect_err("no map")), ["file"]);
    }

    #[test]
    fn a_hall_with_its_task_list_and_start_cells_reads_from_files() {
        let site = parse_map("hall.map", include_str!("../../tests/data/hall.map")).expect("the map reads");
        assert_eq!((site.waypoints().len(), site.stations().count()), (87, 20));
        let tasks = parse_tasks(&site, include_str!("../../tests/data/hall.tasks")).expect("the list reads");
        let visits = tasks.iter().filter(|t| t.work == GridWork::Visit).count();
        assert_eq!((tasks.len(), visits), (17, 1));
        let starts = parse_starts(&site, include_str!("../../tests/data/hall.agents")).expect("the cells read");
        assert_eq!(starts.len(), 8);
        let findings = lint::lint(&site, Some(8));
        assert!(findings.iter().all(|f| f.rule != lint::Rule::NotConnected), "{findings:?}");
        let router = Router::new(Arc::new(site));
        for task in &tasks {
            let at = |name| router.site().find(name).expect("a cell of the map");
            let ways = task.cells.windows(2).map(|two| router.distance_mm(at(&two[0]), at(&two[1])));
            assert!(ways.into_iter().all(|way| way.is_some()), "{task:?}");
        }
    }
}
