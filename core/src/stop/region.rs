//! Where a stop of a part of the site is: boxes on its map, a little larger than the floor they stand for.
//!
//! Invariant: it errs to the side of stopping. A box holds all of each lane that touches the part, a margin is added for where a robot really is
//! and how far it still rolls, boxes that are too many become fewer and larger, and who does not know its pose lies inside.

use crate::ids::{AreaId, PlaceId};
use crate::limits;
use crate::robot::Pose;
use crate::site::{AreaIx, PlaceExtent, Site, WaypointIx};
use serde::{Deserialize, Serialize};

/// A box, millimetres in the site's frame, corners included.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Bounds {
    /// Western edge, millimetres.
    pub x0_mm: i32,
    /// Southern edge, millimetres.
    pub y0_mm: i32,
    /// Eastern edge, millimetres.
    pub x1_mm: i32,
    /// Northern edge, millimetres.
    pub y1_mm: i32,
}

impl Bounds {
    fn between(a: (i64, i64), b: (i64, i64)) -> Self {
        let mm = |v: i64| i32::try_from(v).unwrap_or(if v < 0 { i32::MIN } else { i32::MAX });
        Self { x0_mm: mm(a.0.min(b.0)), y0_mm: mm(a.1.min(b.1)), x1_mm: mm(a.0.max(b.0)), y1_mm: mm(a.1.max(b.1)) }
    }
    fn with(self, other: Self) -> Self {
        Self {
            x0_mm: self.x0_mm.min(other.x0_mm),
            y0_mm: self.y0_mm.min(other.y0_mm),
            x1_mm: self.x1_mm.max(other.x1_mm),
            y1_mm: self.y1_mm.max(other.y1_mm),
        }
    }
    fn is_near(&self, pose: &Pose, margin_mm: i32) -> bool {
        let near =
            |v: i32, from: i32, to: i32| (from.saturating_sub(margin_mm)..=to.saturating_add(margin_mm)).contains(&v);
        near(pose.x_mm, self.x0_mm, self.x1_mm) && near(pose.y_mm, self.y0_mm, self.y1_mm)
    }
}

/// A part of the floor, as boxes that cover at least all of it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Region {
    /// At most [`limits::REGION_BOXES_MAX`], ascending. None at all: nowhere is told, so everywhere.
    boxes: Vec<Bounds>,
}

impl Region {
    /// One area of a site: its waypoints, and the lanes from and to them. None if the site has no such area.
    pub fn of_area(site: &Site, area_id: &AreaId) -> Option<Self> {
        let area: AreaIx = site.find_area(area_id)?;
        let is_in = |at: WaypointIx| site.waypoint(at).area == area;
        let lanes = site.lanes().iter().filter(|lane| is_in(lane.from) || is_in(lane.to));
        let points = (0..site.waypoints().len() as u32).map(WaypointIx).filter(|at| is_in(*at));
        Some(Self::new(
            lanes.map(|lane| between(site, lane.from, lane.to)).chain(points.map(|at| between(site, at, at))),
        ))
    }

    /// One passage or standing place of a site. None if the site has no such place.
    pub fn of_zone(site: &Site, place_id: &PlaceId) -> Option<Self> {
        Some(match &site.place(site.find_place(place_id)?).extent {
            PlaceExtent::Standing(at) => Self::new([between(site, *at, *at)]),
            PlaceExtent::Passage(inside) => {
                let lanes = inside.lanes.iter().map(|lane| site.lane(*lane));
                Self::new(lanes.map(|lane| between(site, lane.from, lane.to)))
            }
        })
    }

    /// One box.
    pub fn of_box(x0_mm: i32, y0_mm: i32, x1_mm: i32, y1_mm: i32) -> Self {
        Self::new([Bounds::between((x0_mm.into(), y0_mm.into()), (x1_mm.into(), y1_mm.into()))])
    }

    /// These boxes; if they are too many, fewer that hold them all.
    pub fn new(boxes: impl IntoIterator<Item = Bounds>) -> Self {
        let mut boxes: Vec<Bounds> = boxes.into_iter().collect();
        boxes.sort_unstable();
        boxes.dedup();
        while boxes.len() > limits::REGION_BOXES_MAX {
            // Neighbours in this order lie in one column.
            boxes = boxes.chunks(2).map(|pair| pair.iter().copied().reduce(Bounds::with).unwrap_or(pair[0])).collect();
            boxes.sort_unstable();
        }
        let all = boxes.clone();
        boxes.retain(|b| !all.iter().any(|other| other != b && other.with(*b) == *other));
        Self { boxes }
    }

    /// The boxes.
    pub fn boxes(&self) -> &[Bounds] {
        &self.boxes
    }

    /// Whether a robot at this pose lies inside, or too near to be sure.
    pub fn includes(&self, pose: Option<&Pose>) -> bool {
        let Some(pose) = pose else { return true };
        self.is_near(pose, limits::STOP_MARGIN_MM)
    }

    /// Whether a pose lies inside or at most `margin_mm` beside it.
    pub fn is_near(&self, pose: &Pose, margin_mm: i32) -> bool {
        self.boxes.is_empty() || self.boxes.iter().any(|b| b.is_near(pose, margin_mm))
    }
}

fn between(site: &Site, a: WaypointIx, b: WaypointIx) -> Bounds {
    let at = |w: WaypointIx| (site.waypoint(w).x_mm, site.waypoint(w).y_mm);
    Bounds::between(at(a), at(b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::WaypointId;
    use crate::site::{self, text};
    use proptest::prelude::*;

    fn demo() -> Site {
        text::parse(site::DEMO).expect("reads")
    }

    fn at(site: &Site, name: &str) -> Pose {
        let waypoint = site.waypoint(site.find(&WaypointId::parse(name).expect("a name")).expect(name));
        Pose { x_mm: waypoint.x_mm as i32, y_mm: waypoint.y_mm as i32, theta_mrad: 0 }
    }

    #[test]
    fn every_waypoint_of_an_area_lies_inside_and_a_far_one_does_not() {
        let site = demo();
        for area in site.areas() {
            let region = Region::of_area(&site, &area.area_id).expect("its area");
            for (i, waypoint) in site.waypoints().iter().enumerate() {
                let is_in = site.area_of(WaypointIx(i as u32)).area_id == area.area_id;
                let pose = at(&site, waypoint.waypoint_id.as_str());
                assert!(!is_in || region.includes(Some(&pose)), "{} in {}", waypoint.waypoint_id, area.area_id);
            }
        }
        let room = site.area_of(site.find(&WaypointId::parse("door-2").expect("a name")).expect("behind the door"));
        let region = Region::of_area(&site, &room.area_id).expect("its area");
        assert!(!region.includes(Some(&at(&site, "C01"))), "{region:?}");
    }

    #[test]
    fn a_zone_has_its_lanes_inside_and_who_does_not_know_where_it_is_lies_inside() {
        let site = demo();
        let door = Region::of_zone(&site, &PlaceId::parse("door").expect("a name")).expect("a zone");
        assert!(door.includes(Some(&at(&site, "door-1"))));
        assert!(!door.includes(Some(&at(&site, "A01"))));
        assert!(door.includes(None));
        assert_eq!(Region::of_zone(&site, &PlaceId::parse("nowhere").expect("a name")), None);
    }

    proptest! {
        #[test]
        fn fewer_boxes_still_hold_everything(corners in proptest::collection::vec((-90_000..90_000_i32, -90_000..90_000_i32), 1..2_000)) {
            let boxes = corners.iter().map(|(x, y)| Bounds { x0_mm: *x, y0_mm: *y, x1_mm: x + 10, y1_mm: y + 10 });
            let region = Region::new(boxes);
            prop_assert!(region.boxes().len() <= limits::REGION_BOXES_MAX);
            for (x, y) in corners {
                let pose = Pose { x_mm: x, y_mm: y, theta_mrad: 0 };
                prop_assert!(region.includes(Some(&pose)));
            }
        }
    }
}
