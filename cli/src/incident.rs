//! `midshift incident …`: what a person should look into.

use super::client::{Call, Change, Exit, unary};
use super::lookup::{self, Found, whole_id};
use super::out::{Out, plain};
use clap::Subcommand;
use midshift_proto::convert::time_of;
use midshift_proto::fleet::v1;

/// Verbs of incidents.
#[derive(Subcommand)]
pub enum Verb {
    /// List incidents.
    Ls {
        #[command(flatten)]
        call: Call,
        /// Also those that a person has closed.
        #[arg(long)]
        all: bool,
        /// Only about this robot.
        #[arg(long, default_value = "")]
        robot: String,
    },
    /// Show one.
    Get {
        #[command(flatten)]
        call: Call,
        /// Its id, or a prefix that only one incident has.
        incident_id: String,
    },
    /// You have looked into it.
    Close {
        #[command(flatten)]
        call: Call,
        /// Its id, or a prefix that only one incident has.
        incident_id: String,
        /// What you found.
        #[arg(long)]
        reason: String,
        /// Only if it is as you saw it, from `incident get -o json`.
        #[arg(long, default_value = "")]
        if_match: String,
        #[command(flatten)]
        change: Change,
    },
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Ls { call, all, robot } => {
            let mut client = call.fleet().await?;
            let mut whole = v1::ListIncidentsResponse::default();
            loop {
                let request = v1::ListIncidentsRequest {
                    include_closed: all,
                    robot_id: robot.clone(),
                    page_size: 1_000,
                    page_token: whole.next_page_token.clone(),
                    incident_id_prefix: String::new(),
                };
                let page = client.list_incidents(unary(request)).await?.into_inner();
                whole.incidents.extend(page.incidents);
                whole.next_page_token = page.next_page_token;
                if whole.next_page_token.is_empty() {
                    break;
                }
            }
            let header = ["OPENED", "CODE", "ABOUT", "CLOSED BY", "INCIDENT"];
            out.many(&whole, &whole.incidents, |i| i.incident_id.clone(), &header, row)?;
            Ok(())
        }
        Verb::Get { call, incident_id } => {
            let request = v1::GetIncidentRequest { incident_id: find(&call, &incident_id).await? };
            let incident = call.fleet().await?.get_incident(unary(request)).await?.into_inner().incident;
            show(&incident.unwrap_or_default(), out)
        }
        Verb::Close { call, incident_id, reason, if_match, change } => {
            let request = v1::CloseIncidentRequest {
                incident_id: find(&call, &incident_id).await?,
                request_id: change.request_id,
                etag: if_match,
                reason,
                validate_only: change.dry_run,
            };
            let incident = call.fleet().await?.close_incident(unary(request)).await?.into_inner().incident;
            show(&incident.unwrap_or_default(), out)
        }
    }
}

/// The whole id, of an incident that is open or closed.
async fn find(call: &Call, typed: &str) -> Result<String, Exit> {
    let mut client = call.fleet().await?;
    let listed = async {
        let request = v1::ListIncidentsRequest {
            include_closed: true,
            page_size: lookup::SHOWN,
            incident_id_prefix: typed.to_owned(),
            ..v1::ListIncidentsRequest::default()
        };
        let page = client.list_incidents(unary(request)).await?.into_inner();
        Ok(Found::page(&page.incidents, &page.next_page_token, |i| &i.incident_id, row))
    };
    whole_id("incident", typed, listed).await
}

fn show(incident: &v1::Incident, out: &Out) -> Result<(), Exit> {
    let text = || {
        let reason = incident.reason.as_ref().map(|r| format!("{}  {}", r.code, plain(&r.message))).unwrap_or_default();
        let facts = incident.reason.iter().flat_map(|r| &r.metadata).collect::<std::collections::BTreeMap<_, _>>();
        let facts: String = facts.into_iter().map(|(key, value)| format!("\n  {key}: {}", plain(value))).collect();
        let closed = incident.closed.as_ref().map(|c| format!("\nclosed by {}: {}", plain(&c.actor), plain(&c.reason)));
        format!("{}\n{reason}{facts}{}", row(incident).join("  "), closed.unwrap_or_default())
    };
    out.one(incident, &incident.incident_id, text)?;
    Ok(())
}

fn row(incident: &v1::Incident) -> Vec<String> {
    let fact = |key: &str| incident.reason.as_ref().and_then(|r| r.metadata.get(key)).cloned().unwrap_or_default();
    let (rollout_id, place_id) = (fact("rollout_id"), fact("place_id"));
    let about = [&incident.robot_id, &incident.task_id, &incident.area_id, &rollout_id, &place_id];
    vec![
        incident.open_time.as_ref().map(|t| time_of(t).rfc3339()).unwrap_or_default(),
        incident.reason.as_ref().map(|r| r.code.clone()).unwrap_or_default(),
        about.into_iter().filter(|id| !id.is_empty()).cloned().collect::<Vec<_>>().join(" "),
        incident.closed.as_ref().map(|c| c.actor.clone()).unwrap_or_default(),
        incident.incident_id.clone(),
    ]
}
