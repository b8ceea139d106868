//! Places that people blocked for a while: nobody is let in, and ways lead around them.
//!
//! Read by `routing`, grants, errands and the explanations; blocks that are over end once a sweep. Invariant: a block takes nothing back.
//! Who was let in before still drives through, and holds the place until it reports that it is outside.

use super::engaged_stops;
use crate::fleet::decision::plan::Plan;
use crate::fleet::decision::report::WAITS_FOR;
use crate::fleet::projection::rows::PlaceBlock;
use crate::fleet::projection::state::FleetProjection;
use crate::reason::{Code, Reason};
use crate::site::PlaceIx;
use crate::time::Now;
use std::collections::BTreeSet;

/// Places that nobody is let into now: those that are blocked, and those inside of a fleet stop.
pub fn barred(view: &FleetProjection) -> BTreeSet<PlaceIx> {
    let blocked = view.place_blocks.values().filter_map(|block| view.site.find_place(&block.row.place_id));
    let aside = view.unknown_rows.blocked_places().filter_map(|place_id| view.site.find_place(&place_id));
    blocked.chain(aside).chain(engaged_stops::closed(view)).collect()
}

/// The only block that there is of a place of the map. None: there is none, or nobody can say which of several bars a way.
pub fn find_only_block(view: &FleetProjection) -> Option<&PlaceBlock> {
    let mut blocks = view.place_blocks.values().map(|block| &block.row);
    let mut of_map = blocks.by_ref().filter(|block| view.site.find_place(&block.place_id).is_some());
    of_map.next().filter(|_| of_map.next().is_none())
}

/// The block of a place that there is.
pub fn find_block(view: &FleetProjection, place: PlaceIx) -> Option<&PlaceBlock> {
    view.place_blocks.get(view.site.place(place).place_id.as_str()).map(|block| &block.row)
}

/// `reason` as that of a block: in its words, with its facts.
pub fn word_block(mut reason: Reason, block: &PlaceBlock) -> Reason {
    let PlaceBlock { place_id, since, .. } = block;
    let end = block.until.map_or_else(|| "until a person ends that".to_owned(), |at| format!("until {}", at.rfc3339()));
    let command = format!("midshift zone unblock {place_id} --reason TEXT");
    reason.code = Code::PlaceBlocked;
    reason.message =
        format!("Place {place_id} is blocked since {} {end}: {}. Sooner: `{command}`.", since.rfc3339(), block.reason);
    let reason = reason.with("place_id", place_id).with("command", command);
    reason.with(WAITS_FOR, format!("the end of the block of place {place_id}"))
}

/// Ends the blocks whose time is over, and those of places that the map has lost.
pub(in crate::fleet) fn end_blocks(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let is_over = |block: &PlaceBlock| {
        block.until.is_some_and(|until| until <= now.utc) || view.site.find_place(&block.place_id).is_none()
    };
    let over = view.place_blocks.iter().filter(|(_, block)| is_over(&block.row)).map(|(id, _)| id.clone());
    for id in over.collect::<Vec<_>>() {
        if plan.is_cut() {
            return;
        }
        plan.decide(view, now, "fleet", |tx| tx.delete::<PlaceBlock>(&id, "place.block_over"));
    }
}
