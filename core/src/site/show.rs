//! A site as text for a person: a sketch of the floor and tables of places and areas, with robots where somebody knows where they are.
//! Called by `map show`.

use super::{Kind, Site};
use std::collections::BTreeMap;
use std::fmt::Write;

/// Size of the sketch, characters; a character is about twice as high as wide.
const SKETCH: (usize, usize) = (96, 36);
/// Waypoints up to which the sketch has names; larger sites show marks only.
const NAMED_MAX: usize = 100;
/// Robots up to which the sketch has names; of more it shows marks only.
const ROBOTS_NAMED_MAX: usize = 30;

/// A robot on the floor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlacedRobot {
    /// Its name.
    pub robot_id: String,
    /// Position on the map, millimetres.
    pub x_mm: i64,
    /// Position on the map, millimetres.
    pub y_mm: i64,
    /// What it does, in a few words.
    pub does: String,
}

/// What is on the floor at one moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Occupants {
    /// Robots, by name.
    pub robots: Vec<PlacedRobot>,
    /// Who has a place or may enter it, and what closes it, by the place. Absent: nobody.
    pub held: BTreeMap<String, String>,
}

/// The whole description, ending in a line break. `occupants`: none where nobody was asked for robots.
pub fn show(site: &Site, occupants: Option<&Occupants>) -> String {
    let mut out = String::new();
    describe(site, occupants, &mut out).unwrap_or_default();
    out
}

fn describe(site: &Site, occupants: Option<&Occupants>, out: &mut String) -> std::fmt::Result {
    writeln!(out, "{} ({}), map {} version {}", site.name(), site.site_id(), site.map_id(), site.map_version())?;
    let count = |kind| site.of_kind(kind).count();
    writeln!(
        out,
        "{} waypoints: {} stations, {} chargers, {} parking places, {} hold points; {} lanes; {} passages",
        site.waypoints().len(),
        count(Kind::Station),
        count(Kind::Charger),
        count(Kind::Park),
        count(Kind::Hold),
        site.lanes().len(),
        site.places().iter().filter(|p| p.inside().is_some()).count(),
    )?;
    if !site.collisions_modelled() {
        writeln!(out, "collisions: not modelled")?;
    }
    let robots = occupants.map_or(&[][..], |occupants| &occupants.robots);
    writeln!(out, "\n{}", sketch(site, robots))?;
    if occupants.is_some() {
        writeln!(out, "{:<16} {:>8} {:>8}  DOES", "ROBOT", "X mm", "Y mm")?;
        for robot in robots {
            writeln!(out, "{:<16} {:>8} {:>8}  {}", robot.robot_id, robot.x_mm, robot.y_mm, robot.does)?;
        }
        writeln!(out)?;
    }
    writeln!(out, "{:<16} {:>6} {:>12} {:>14}  PEOPLE", "AREA", "SEATS", "SPEED mm/s", "DISTANCE mm")?;
    for (at, area) in site.areas().iter().enumerate() {
        let shown = |value: Option<u32>| value.map_or_else(|| "-".to_owned(), |v| v.to_string());
        let speed = shown(area.defaults.speed_limit_mm_s);
        let distance = shown(area.defaults.avoidance_distance_mm);
        let seats = site.area_capacity(super::AreaIx(at as u32));
        let people = if area.people { "yes" } else { "no" };
        writeln!(out, "{:<16} {seats:>6} {speed:>12} {distance:>14}  {people}", area.area_id.as_str())?;
    }
    writeln!(out, "\n{:<16} {:<9} {:<10} {:>8}  AT", "PLACE", "KIND", "RULE", "CAPACITY")?;
    for place in site.places() {
        let name = |w| site.name_of(w).as_str();
        let at = match (place.waypoint(), place.inside()) {
            (Some(w), _) => site.waypoint(w).kind.as_str().to_owned(),
            (None, Some(inside)) => {
                let lanes = inside.lanes.iter().map(|l| site.lane(*l));
                lanes.map(|l| format!("{}>{}", name(l.from), name(l.to))).collect::<Vec<_>>().join(" ")
            }
            (None, None) => String::new(),
        };
        let (place_id, kind, rule) = (place.place_id.as_str(), place.kind_str(), place.rule_str());
        let held = occupants.and_then(|occupants| occupants.held.get(place_id));
        let held = held.map_or_else(String::new, |held| format!("  held: {held}"));
        writeln!(out, "{place_id:<16} {kind:<9} {rule:<10} {:>8}  {at}{held}", place.capacity)?;
    }
    Ok(())
}

/// Names (or marks) at their positions, north up, robots with an `@` before all else; what would cover another is moved aside or left out.
fn sketch(site: &Site, robots: &[PlacedRobot]) -> String {
    let xs = || site.waypoints().iter().map(|w| w.x_mm);
    let ys = || site.waypoints().iter().map(|w| w.y_mm);
    let (Some(west), Some(east), Some(south), Some(north)) = (xs().min(), xs().max(), ys().min(), ys().max()) else {
        return String::new();
    };
    let (columns, rows) = SKETCH;
    let scale = |value: i64, least: i64, most: i64, cells: usize| {
        (((value - least) as i128 * (cells as i128 - 1)) / i128::from((most - least).max(1))) as usize
    };
    let mut floor = vec![vec![' '; columns + 12]; rows];
    let mut draw = |x_mm: i64, y_mm: i64, text: &str| {
        let row = rows - 1 - scale(y_mm.clamp(south, north), south, north, rows);
        let column = scale(x_mm.clamp(west, east), west, east, columns);
        let free = |line: &[char]| line.iter().skip(column).take(text.len() + 1).all(|c| *c == ' ');
        let tries = [row, row.saturating_sub(1), (row + 1).min(rows - 1)];
        let at = tries.into_iter().find(|r| free(&floor[*r])).unwrap_or(row);
        let cells = floor[at].iter_mut().skip(column);
        cells.zip(text.chars()).filter(|(cell, _)| **cell == ' ').for_each(|(cell, c)| *cell = c);
    };
    for robot in robots {
        let name = if robots.len() <= ROBOTS_NAMED_MAX { robot.robot_id.as_str() } else { "" };
        draw(robot.x_mm, robot.y_mm, &format!("@{name}"));
    }
    for w in site.waypoints() {
        let mark = match w.kind {
            Kind::Junction => "+",
            Kind::Station => "s",
            Kind::Charger => "c",
            Kind::Park => "p",
            Kind::Hold => "h",
        };
        let named = site.waypoints().len() <= NAMED_MAX && w.kind != Kind::Junction;
        let text = if named { w.waypoint_id.as_str() } else { mark };
        draw(w.x_mm, w.y_mm, text);
    }
    let lines = floor.into_iter().map(|line| line.into_iter().collect::<String>().trim_end().to_owned());
    lines.collect::<Vec<_>>().join("\n") + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::site::{DEMO, grid, text};

    #[test]
    fn the_demo_is_shown_with_every_name_that_a_person_may_use() {
        let site = text::parse(DEMO).expect("reads");
        let shown = show(&site, None);
        for place in site.places() {
            assert!(shown.contains(place.place_id.as_str()), "{} is not in:\n{shown}", place.place_id);
        }
        let sketch = sketch(&site, &[]);
        for at in site.stations() {
            assert!(sketch.contains(site.name_of(at).as_str()), "{} is not in:\n{sketch}", site.name_of(at));
        }
    }

    #[test]
    fn a_grid_says_that_collisions_are_not_modelled() {
        let site = grid::parse_map("g", "type octile\nheight 1\nwidth 2\nmap\n.S\n").expect("reads");
        assert!(show(&site, None).contains("collisions: not modelled"));
    }

    #[test]
    fn robots_are_drawn_where_they_are_and_places_say_who_has_them() {
        let site = text::parse(DEMO).expect("reads");
        let robot = |nth: i64| {
            let (robot_id, does) = (format!("rbt-{nth:02}"), "works on T1".to_owned());
            PlacedRobot { robot_id, x_mm: 1_000 * nth, y_mm: 99_999_999, does }
        };
        let held = BTreeMap::from([("door".to_owned(), "rbt-01 inside".to_owned())]);
        let few = show(&site, Some(&Occupants { robots: vec![robot(1), robot(20)], held }));
        let first = few.lines().find(|line| line.contains("@rbt-01")).expect("it is drawn");
        assert!(first.find("@rbt-01") < first.find("@rbt-20"), "west is left, and off the map is at its edge:\n{few}");
        assert!(few.lines().any(|line| line.starts_with("rbt-20") && line.ends_with("works on T1")), "{few}");
        assert!(few.lines().any(|line| line.starts_with("door") && line.ends_with("held: rbt-01 inside")), "{few}");
        let many = Occupants { robots: (0..31).map(robot).collect(), held: BTreeMap::new() };
        let many = sketch(&site, &many.robots);
        assert!(many.contains('@') && !many.contains("@rbt"), "{many}");
    }
}
