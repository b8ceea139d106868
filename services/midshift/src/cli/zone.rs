//! `midshift zone …`: passages and standing places.

use super::client::{Call, Change, Exit, unary};
use super::out::Out;
use clap::Subcommand;
use midshift_proto::fleet::v1;

/// Verbs of places.
#[derive(Subcommand)]
pub enum Verb {
    /// List places.
    Ls {
        #[command(flatten)]
        call: Call,
        /// Only places that are held, waited for or quarantined.
        #[arg(long)]
        in_use: bool,
    },
    /// A person has looked: nobody and nothing is inside.
    Clear {
        #[command(flatten)]
        call: Call,
        /// Which.
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
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Ls { call, in_use } => {
            let mut client = call.fleet().await?;
            let mut whole = v1::ListPlacesResponse::default();
            loop {
                let request =
                    v1::ListPlacesRequest { in_use, page_size: 1_000, page_token: whole.next_page_token.clone() };
                let page = client.list_places(unary(request)).await?.into_inner();
                whole.places.extend(page.places);
                whole.next_page_token = page.next_page_token;
                if whole.next_page_token.is_empty() {
                    break;
                }
            }
            let header = ["PLACE", "KIND", "SEATS", "HELD BY", "WAITING", "QUARANTINE", "ETAG"];
            out.many(&whole, &whole.places, |p| p.place_id.clone(), &header, row)?;
            Ok(())
        }
        Verb::Clear { call, place_id, reason, if_match, change } => {
            let request = v1::ClearPlaceRequest {
                place_id,
                request_id: change.request_id,
                etag: if_match,
                reason,
                validate_only: change.dry_run,
            };
            let place = call.fleet().await?.clear_place(unary(request)).await?.into_inner().place.unwrap_or_default();
            out.one(&place, &place.place_id, || row(&place).join("  "))?;
            Ok(())
        }
    }
}

fn row(place: &v1::Place) -> Vec<String> {
    let holder = |h: &v1::PlaceHolder| {
        let state = h.state().as_str_name().trim_start_matches("PLACE_HOLDER_STATE_").to_lowercase();
        format!("{} {state}", h.robot_id)
    };
    let awaited = place.awaited_robot_ids.iter().map(|robot_id| format!("{robot_id} awaited"));
    vec![
        place.place_id.clone(),
        place.kind().as_str_name().trim_start_matches("PLACE_KIND_").to_owned(),
        place.capacity.to_string(),
        place.holders.iter().map(holder).chain(awaited).collect::<Vec<_>>().join(", "),
        place.waiting_robot_ids.join(", "),
        place.quarantine.as_ref().map(|q| q.code.clone()).unwrap_or_default(),
        place.etag.clone(),
    ]
}
