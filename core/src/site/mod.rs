//! One site as robots drive it: waypoints, lanes, places and areas, with indices for machines and names for people.
//!
//! Invariant: a [`Site`] exists only if every name in it is known and every rule of its making holds; it never
//! changes afterwards. A changed map is another `Site`. Called by fleet (routes, grants), the simulator (motion) and the
//! operator's `map` commands.

mod area_lookup;
mod draft;
pub mod file;
pub mod grid;
pub mod lif;
pub mod lint;
mod map;
pub mod route;
pub mod show;
pub mod task_list;
pub mod text;

pub use map::{
    Area, AreaDefaults, AreaIx, Inside, Kind, Lane, LaneIx, Place, PlaceExtent, PlaceIx, PlaceKind, PlaceRule, Site,
    Source, Waypoint, WaypointIx,
};

use crate::reason::Refusal;

/// The demo site as text: a small factory that `midshift dev` runs when no other site is named.
pub const DEMO: &str = include_str!("../../../sites/demo.site.toml");
/// A small site of two stations and one corridor, for tests.
pub const CORRIDOR: &str = include_str!("../../../sites/corridor.site.toml");

/// Reads the text of a site that was stored, whichever form the file had that it came from.
///
/// # Errors
/// It has none of these forms.
pub fn read_stored(site_id: &str, body: &str) -> Result<Site, Refusal> {
    let as_site = text::parse(body);
    let as_lif = || lif::parse(site_id, body).map(|import| import.site).ok();
    let as_grid = || grid::parse_map(site_id, body).ok();
    as_site.or_else(|refusal| as_lif().or_else(as_grid).ok_or(refusal))
}
