//! `midshift zone …`: passages and standing places.

use super::area::milliseconds;
use super::client::{Call, Change, Exit, unary};
use super::duration::duration;
use super::out::{Format, Out};
use super::pages::{self, Listed, PAGE_SIZE};
use clap::Subcommand;
use midshift_proto::convert::time_of;
use midshift_proto::fleet::v1;
use prost_types::Timestamp;
use std::time::Duration;

/// Verbs of places.
#[derive(Subcommand)]
pub enum Verb {
    /// List places.
    Ls {
        #[command(flatten)]
        call: Call,
        /// Only places that are held, waited for, quarantined or blocked.
        #[arg(long)]
        in_use: bool,
    },
    /// A person has looked: nobody and nothing is inside.
    Clear {
        #[command(flatten)]
        call: Call,
        /// The place that is empty.
        place_id: String,
        /// What you saw.
        #[arg(long)]
        reason: String,
        /// The etag you saw, from `zone ls -o json`.
        #[arg(long)]
        if_match: String,
        #[command(flatten)]
        change: Change,
    },
    /// Let nobody into a place; robots that were let in before still drive through.
    Block {
        #[command(flatten)]
        call: Call,
        /// The place into which nobody is let.
        place_id: String,
        /// Why nobody is let in.
        #[arg(long)]
        reason: String,
        /// Site time until that ends by itself; without it a person ends it.
        #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
        lasts: Option<Duration>,
        #[command(flatten)]
        change: Change,
    },
    /// Let robots into a place again.
    Unblock {
        #[command(flatten)]
        call: Call,
        /// The place that is open again.
        place_id: String,
        /// Why it may be entered again.
        #[arg(long)]
        reason: String,
        #[command(flatten)]
        change: Change,
    },
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Ls { call, in_use } => Ok(out.list(&list(&call, in_use).await?)?),
        Verb::Clear { call, place_id, reason, if_match, change } => {
            let request = v1::ClearPlaceRequest {
                place_id,
                request_id: change.request_id,
                etag: if_match,
                reason,
                validate_only: change.dry_run,
            };
            let answer = call.fleet().await?.clear_place(unary(request)).await?.into_inner();
            show(answer.place, out).map(drop)
        }
        Verb::Block { call, place_id, reason, lasts, change } => {
            let request = v1::BlockPlaceRequest {
                place_id,
                request_id: change.request_id,
                reason,
                lasts: lasts.map(milliseconds),
                validate_only: change.dry_run,
            };
            let answer = call.fleet().await?.block_place(unary(request)).await?.into_inner();
            let place = show(answer.place, out)?;
            if !change.dry_run {
                out.next(&format!("midshift zone unblock {} --reason TEXT", place.place_id));
            }
            Ok(())
        }
        Verb::Unblock { call, place_id, reason, change } => {
            let request = v1::UnblockPlaceRequest {
                place_id,
                request_id: change.request_id,
                reason,
                validate_only: change.dry_run,
            };
            let answer = call.fleet().await?.unblock_place(unary(request)).await?.into_inner();
            show(answer.place, out).map(drop)
        }
    }
}

fn show(place: Option<v1::Place>, out: &Out) -> Result<v1::Place, Exit> {
    let place = place.unwrap_or_default();
    out.one(&place, &place.place_id, || place.row().join("  "))?;
    Ok(place)
}

/// The places of a server, all or those in use.
pub async fn list(call: &Call, in_use: bool) -> Result<v1::ListPlacesResponse, Exit> {
    let mut client = call.fleet().await?;
    let request = |page_token| unary(v1::ListPlacesRequest { in_use, page_size: PAGE_SIZE, page_token });
    Ok(pages::all(async |page_token| client.list_places(request(page_token)).await).await?)
}

/// Says which places stay kept for a robot, and how a person opens them. What was asked is done: that this list cannot be had is no error.
pub async fn tell_kept(call: &Call, robot_id: &str, out: &Out) {
    if out.format != Format::Table || robot_id.is_empty() {
        return;
    }
    let places = list(call, true).await.map(|whole| whole.places).unwrap_or_default();
    for place in places.iter().filter(|place| place.holders.iter().any(|h| h.robot_id == robot_id)) {
        out.next(&describe_kept_place(place, robot_id));
    }
}

fn describe_kept_place(place: &v1::Place, robot_id: &str) -> String {
    let (place_id, etag) = (&place.place_id, &place.etag);
    format!(
        "{place_id} stays kept for {robot_id} until it is heard and leaves it; if a person has looked and it is gone: \
         midshift zone clear {place_id} --reason TEXT --if-match {etag}"
    )
}

impl Listed for v1::Place {
    const HEADER: &'static [&'static str] = &["PLACE", "KIND", "RULE", "SEATS", "HELD BY", "WAITING", "CLOSED", "ETAG"];
    fn name(&self) -> String {
        self.place_id.clone()
    }
    fn row(&self) -> Vec<String> {
        vec![
            self.place_id.clone(),
            self.kind().as_str_name().trim_start_matches("PLACE_KIND_").to_owned(),
            self.rule().as_str_name().trim_start_matches("PLACE_RULE_").to_owned(),
            self.capacity.to_string(),
            describe_holders(self),
            self.waiting_robot_ids.join(", "),
            describe_closure(self),
            self.etag.clone(),
        ]
    }
}

/// Who has a place, may enter it or is awaited there. Empty: nobody.
pub fn describe_holders(place: &v1::Place) -> String {
    let holder = |h: &v1::PlaceHolder| {
        let state = h.state().as_str_name().trim_start_matches("PLACE_HOLDER_STATE_").to_lowercase();
        format!("{} {state}", h.robot_id)
    };
    let awaited = place.awaited_robot_ids.iter().map(|robot_id| format!("{robot_id} awaited"));
    place.holders.iter().map(holder).chain(awaited).collect::<Vec<_>>().join(", ")
}

/// What keeps robots out of a place, in a word or two. Empty: nothing.
pub fn describe_closure(place: &v1::Place) -> String {
    let until = |until: &Timestamp| format!(" until {}", time_of(until).rfc3339());
    let block = |block: &v1::PlaceBlock| format!("blocked{}", block.until.as_ref().map_or_else(String::new, until));
    let words = place.quarantine.iter().map(|reason| reason.code.clone()).chain(place.block.iter().map(block));
    words.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_that_stays_kept_names_its_robot_and_the_whole_command_that_opens_it() {
        let place = v1::Place { place_id: "B03".into(), etag: "17".into(), ..v1::Place::default() };
        let told = describe_kept_place(&place, "q-1");
        assert!(told.starts_with("B03 stays kept for q-1"), "{told}");
        assert!(told.ends_with("midshift zone clear B03 --reason TEXT --if-match 17"), "{told}");
    }
}
