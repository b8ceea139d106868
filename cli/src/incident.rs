//! `midshift incident …`: what a person should look into.

use super::client::{Call, Change, Exit, unary};
use super::lookup::{self, Found, whole_id};
use super::out::{Out, plain};
use super::pages::{self, Listed, PAGE_SIZE};
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
            let request = v1::ListIncidentsRequest {
                include_closed: all,
                robot_id: robot,
                page_size: PAGE_SIZE,
                ..v1::ListIncidentsRequest::default()
            };
            let read = async |page_token| {
                client.list_incidents(unary(v1::ListIncidentsRequest { page_token, ..request.clone() })).await
            };
            Ok(out.list(&pages::all(read).await?)?)
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
        Ok(Found::page(&page, Listed::row))
    };
    whole_id("incident", typed, listed).await
}

fn show(incident: &v1::Incident, out: &Out) -> Result<(), Exit> {
    let text = || {
        let reason = incident.reason.as_ref().map(|r| format!("{}  {}", r.code, plain(&r.message))).unwrap_or_default();
        let facts = incident.reason.iter().flat_map(|r| &r.metadata).collect::<std::collections::BTreeMap<_, _>>();
        let facts: String = facts.into_iter().map(|(key, value)| format!("\n  {key}: {}", plain(value))).collect();
        let closed = incident.closed.as_ref().map(|c| format!("\nclosed by {}: {}", plain(&c.actor), plain(&c.reason)));
        format!("{}\n{reason}{facts}{}", incident.row().join("  "), closed.unwrap_or_default())
    };
    out.one(incident, &incident.incident_id, text)?;
    Ok(())
}

impl Listed for v1::Incident {
    const HEADER: &'static [&'static str] = &["OPENED", "CODE", "ABOUT", "CLOSED BY", "INCIDENT"];
    fn name(&self) -> String {
        self.incident_id.clone()
    }
    fn row(&self) -> Vec<String> {
        let fact = |key: &str| self.reason.as_ref().and_then(|r| r.metadata.get(key)).cloned().unwrap_or_default();
        let (rollout_id, place_id) = (fact("rollout_id"), fact("place_id"));
        let about = [&self.robot_id, &self.task_id, &self.area_id, &rollout_id, &place_id];
        vec![
            self.open_time.as_ref().map(|t| time_of(t).rfc3339()).unwrap_or_default(),
            self.reason.as_ref().map(|r| r.code.clone()).unwrap_or_default(),
            about.into_iter().filter(|id| !id.is_empty()).cloned().collect::<Vec<_>>().join(" "),
            self.closed.as_ref().map(|c| c.actor.clone()).unwrap_or_default(),
            self.incident_id.clone(),
        ]
    }
}
