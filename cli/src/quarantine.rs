//! `midshift quarantine …`: bundles that robots went back from.

use super::client::{Call, Change, DryRun, Exit, ended, unary};
use super::out::Out;
use super::pages::{self, Listed, PAGE_SIZE};
use clap::Subcommand;
use midshift_proto::convert::time_of;
use midshift_proto::ota::v1;

/// Verbs of quarantines.
#[derive(Subcommand)]
pub enum Verb {
    /// List which robots went back from which bundles, and why.
    Ls {
        #[command(flatten)]
        call: Call,
    },
    /// You have looked: the robot may have the bundle again.
    Lift {
        #[command(flatten)]
        call: Call,
        /// The robot that may have it again.
        robot_id: String,
        /// As NAME-VERSION or by its SHA-256.
        bundle: String,
        #[command(flatten)]
        change: Change,
    },
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Ls { call } => {
            let mut client = call.rollouts().await?;
            let request = |page_token| unary(v1::ListQuarantinesRequest { page_size: PAGE_SIZE, page_token });
            let whole = pages::all(async |page_token| client.list_quarantines(request(page_token)).await).await?;
            out.list(&whole)?;
            if let Some(first) = whole.quarantines.first() {
                out.next(&format!("midshift quarantine lift {} {}", first.robot_id, named(first)));
            }
            Ok(())
        }
        Verb::Lift { call, robot_id, bundle, change } => {
            let only = change.only();
            let request = v1::LiftQuarantineRequest {
                robot_id: robot_id.clone(),
                bundle: bundle.clone(),
                request_id: change.request_id,
                validate_only: change.dry_run,
            };
            let answer = call.rollouts().await?.lift_quarantine(unary(request)).await.map_err(Exit::with_facts)?;
            let answer = answer.into_inner();
            out.one(&answer, &robot_id, || lifted(&answer, &robot_id, &bundle, only))?;
            let next =
                "midshift rollout ls; a completed roll-out tries it again with: midshift rollout retry ID --failed";
            ended(answer.done_before.as_ref(), only, next, out);
            Ok(())
        }
    }
}

/// What is so after a call to lift it: a check alone that no call was before leaves a quarantine in place.
fn lifted(answer: &v1::LiftQuarantineResponse, robot_id: &str, bundle: &str, only: DryRun) -> String {
    match (&answer.quarantine, only) {
        (Some(_), DryRun::Yes) if answer.done_before.is_none() => format!("{robot_id} could have {bundle} again"),
        (Some(kept), _) => {
            let why = kept.reason.as_ref().map_or("", |reason| &reason.code);
            let since = kept.since.as_ref().map(|t| time_of(t).rfc3339()).unwrap_or_default();
            format!("{robot_id} may not have {bundle}: it went back from it since, {since} {why}")
        }
        (None, _) => format!("{robot_id} may have {bundle} again"),
    }
}

/// By name and version, else by digest.
fn named(quarantine: &v1::Quarantine) -> &str {
    if quarantine.bundle_label.is_empty() { &quarantine.bundle } else { &quarantine.bundle_label }
}

impl Listed for v1::Quarantine {
    const HEADER: &'static [&'static str] = &["ROBOT", "BUNDLE", "WHY", "SINCE", "ROLLOUT"];
    fn name(&self) -> String {
        format!("{} {}", self.robot_id, self.bundle)
    }
    fn row(&self) -> Vec<String> {
        vec![
            self.robot_id.clone(),
            named(self).to_owned(),
            self.reason.as_ref().map(|r| r.code.clone()).unwrap_or_default(),
            self.since.as_ref().map(|t| time_of(t).rfc3339()).unwrap_or_default(),
            self.rollout_id.clone(),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lift_says_what_is_so_now_and_a_robot_that_went_back_again_is_not_said_to_be_free() {
        let said = |before: bool, is_kept: bool, only| {
            let done_before = before.then(prost_types::Timestamp::default);
            let reason =
                Some(midshift_proto::common::v1::Reason { code: "PROBATION_FAILED".into(), ..Default::default() });
            let kept = v1::Quarantine { reason, since: done_before, ..Default::default() };
            let quarantine = is_kept.then_some(kept);
            lifted(&v1::LiftQuarantineResponse { done_before, quarantine }, "r-1", "walk-1.5.0", only)
        };
        assert_eq!(said(false, false, DryRun::No), "r-1 may have walk-1.5.0 again");
        assert_eq!(said(false, true, DryRun::Yes), "r-1 could have walk-1.5.0 again");
        let again =
            "r-1 may not have walk-1.5.0: it went back from it since, 1970-01-01T00:00:00.000Z PROBATION_FAILED";
        for only in [DryRun::No, DryRun::Yes] {
            assert_eq!(said(true, true, only), again);
            assert_eq!(said(true, false, only), "r-1 may have walk-1.5.0 again");
        }
    }

    #[test]
    fn a_bundle_that_no_release_lists_any_more_is_called_by_its_digest() {
        let listed = v1::Quarantine { bundle: "ab".into(), bundle_label: "walk-1.5.0".into(), ..Default::default() };
        let unlisted = v1::Quarantine { bundle: "ab".into(), ..Default::default() };
        assert_eq!([&listed, &unlisted].map(|q| q.row()[1].clone()), ["walk-1.5.0", "ab"]);
    }
}
