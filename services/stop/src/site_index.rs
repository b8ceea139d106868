//! Where parts of the site are, found once at the start: an engage must not wait for it.

use midshift_core::ids::{AreaId, PlaceId};
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::site::Site;
use midshift_core::stop::{Region, Scope};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;

/// Names that a refusal lists; of more it says how many.
const NAMES_MAX: usize = 24;

/// The regions of all parts.
#[derive(Default)]
pub struct SiteIndex(Option<Parts>);

struct Parts {
    areas: BTreeMap<AreaId, Option<Region>>,
    zones: BTreeMap<PlaceId, Option<Region>>,
    /// The areas that a zone leads through.
    around: BTreeMap<PlaceId, BTreeSet<AreaId>>,
}

impl SiteIndex {
    /// Of a site. None: there is no site file, and every part means everywhere.
    pub fn of_site(site: Option<&Site>) -> Self {
        // A part without a place on the map is everywhere.
        let placed = |region: Option<Region>| region.filter(|region| !region.boxes().is_empty());
        Self(site.map(|site| {
            let areas = site.areas().iter().map(|a| (a.area_id.clone(), placed(Region::of_area(site, &a.area_id))));
            let zones = site.places().iter().map(|p| (p.place_id.clone(), placed(Region::of_zone(site, &p.place_id))));
            let around = site.places().iter().map(|p| (p.place_id.clone(), site.areas_of_place(&p.place_id)));
            Parts { areas: areas.collect(), zones: zones.collect(), around: around.collect() }
        }))
    }

    /// The areas in which a stop is; none: it is the site's. Where a robot stands is not asked: it goes on standing when it is somewhere else.
    pub fn areas(&self, scope: &Scope) -> BTreeSet<AreaId> {
        match scope {
            Scope::Robot(_) | Scope::Fleet => BTreeSet::new(),
            Scope::Area(id) => BTreeSet::from([id.clone()]),
            Scope::Zone(id) => self.0.as_ref().and_then(|parts| parts.around.get(id)).cloned().unwrap_or_default(),
        }
    }

    /// Where a stop is.
    ///
    /// # Errors
    /// A part that the site does not have.
    pub fn region(&self, scope: &Scope) -> Result<Option<Region>, Refusal> {
        let Some(parts) = &self.0 else { return Ok(None) };
        match scope {
            Scope::Robot(_) | Scope::Fleet => Ok(None),
            Scope::Area(id) => parts.areas.get(id).cloned().ok_or_else(|| {
                let reason = Reason::new(Code::AreaNotFound, none("area", id, parts.areas.keys()));
                Refusal::new(Kind::NotFound, reason.with("area_id", id))
            }),
            Scope::Zone(id) => parts.zones.get(id).cloned().ok_or_else(|| {
                let reason = Reason::new(Code::PlaceNotFound, none("zone", id, parts.zones.keys()));
                Refusal::new(Kind::NotFound, reason.with("place_id", id))
            }),
        }
    }
}

fn none<'a, T: Display + 'a>(what: &str, id: &T, there: impl ExactSizeIterator<Item = &'a T>) -> String {
    let all = there.len();
    let names: Vec<String> = there.take(NAMES_MAX).map(|name| name.to_string()).collect();
    let more = if all > names.len() { format!(" and {} more", all - names.len()) } else { String::new() };
    format!("the site has no {what} {id}; it has {}{more}. Nothing was stopped", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::site::{DEMO, text};

    #[test]
    fn an_unknown_part_is_refused_with_what_there_is_and_without_a_site_a_part_is_everywhere() {
        let site = text::parse(DEMO).unwrap();
        let site_index = SiteIndex::of_site(Some(&site));
        let door = Scope::Zone(PlaceId::parse("door").unwrap());
        assert!(site_index.region(&door).unwrap().is_some());
        let nowhere = Scope::Area(AreaId::parse("nowhere").unwrap());
        let refusal = site_index.region(&nowhere).unwrap_err();
        assert_eq!(refusal.kind(), Kind::NotFound);
        assert!(refusal.reason.text().contains(site.areas()[0].area_id.as_str()), "{refusal}");
        assert_eq!(SiteIndex::of_site(None).region(&nowhere).unwrap(), None);
    }
}
