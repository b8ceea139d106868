//! `midshift planner …`: live rules of the site's planner, and the plans that it made.

mod replay;
mod rules;

use super::client::{Call, Change, Exit, unary};
use super::out::Out;
use clap::Subcommand;
use midshift_proto::convert::ms_of;
use midshift_proto::fleet::v1;
use rules::Rules;
use std::path::PathBuf;

/// Verbs of the planner.
#[derive(Subcommand)]
pub enum Verb {
    /// Show the rules by which robots are chosen for tasks.
    Get {
        #[command(flatten)]
        call: Call,
    },
    /// Change rules of the planner; what is not named stays. They hold from its next turn on.
    Put {
        #[command(flatten)]
        call: Call,
        #[command(flatten)]
        rules: Rules,
        #[command(flatten)]
        change: Change,
    },
    /// List the newest plans: robots and tasks that were weighed, and how many pairs came of it.
    Plans {
        #[command(flatten)]
        call: Call,
    },
    /// Show one plan: which robot has which task by it, and what that cost. With `--output json` all that it was decided by, for `planner replay`.
    Plan {
        #[command(flatten)]
        call: Call,
        /// Number of the plan, as `planner plans` lists it; unless told, the newest.
        number: Option<u64>,
    },
    /// Make the decision of a plan once more, from a file and without a server. With rules, what they would have chosen instead.
    Replay {
        /// What `planner plan --output json` wrote; `-`: standard input.
        file: PathBuf,
        #[command(flatten)]
        rules: Rules,
    },
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Get { call } => {
            let request = unary(v1::GetPlannerRequest {});
            let policy = call.fleet().await?.get_planner(request).await?.into_inner().policy.unwrap_or_default();
            show(&policy, out)
        }
        Verb::Put { call, rules, change } => {
            let mut client = call.fleet().await?;
            let request = unary(v1::GetPlannerRequest {});
            let old = client.get_planner(request).await?.into_inner().policy.unwrap_or_default();
            let request = v1::PutPlannerRequest {
                policy: Some(rules.over(old)),
                request_id: change.request_id,
                validate_only: change.dry_run,
            };
            let answer = client.put_planner(unary(request)).await?.into_inner();
            show(&answer.policy.unwrap_or_default(), out)
        }
        Verb::Plans { call } => {
            let plans = call.fleet().await?.list_plans(unary(v1::ListPlansRequest {})).await?.into_inner();
            replay::list(&plans, out)
        }
        Verb::Plan { call, number } => {
            let plan = call.fleet().await?.get_plan(unary(v1::GetPlanRequest { number })).await?.into_inner().plan;
            replay::show(&plan.unwrap_or_default(), out)
        }
        Verb::Replay { file, rules } => replay::run(&file, rules, out),
    }
}

fn show(policy: &v1::PlannerPolicy, out: &Out) -> Result<(), Exit> {
    out.one(policy, &policy.site_id, || describe(policy))?;
    Ok(())
}

/// Two lines for people. A number of a newer version is shown as it is.
fn describe(policy: &v1::PlannerPolicy) -> String {
    let chosen = policy.policy.unwrap_or_default();
    let word = match v1::AssignmentPolicy::try_from(chosen) {
        Ok(v1::AssignmentPolicy::Rolling) => "rolling".to_owned(),
        Ok(v1::AssignmentPolicy::FifoNearest) => "fifo-nearest".to_owned(),
        _ => chosen.to_string(),
    };
    let seconds = |time: &Option<prost_types::Duration>| time.as_ref().map_or(0.0, |t| ms_of(t) as f64 / 1_000.0);
    let number = |value: Option<u32>| value.unwrap_or_default();
    format!(
        "{}  policy {word}  horizon {} s  hysteresis {} s\n  way: urgent {}, normal {}, background {}  ageing {} permille  lateness {} permille  energy {} ms a Wh",
        policy.site_id,
        seconds(&policy.horizon),
        seconds(&policy.hysteresis),
        number(policy.urgent_travel_weight),
        number(policy.normal_travel_weight),
        number(policy.background_travel_weight),
        number(policy.ageing_permille),
        number(policy.lateness_permille),
        number(policy.energy_ms_per_wh),
    )
}

#[cfg(test)]
mod tests {
    use super::rules::Policy;
    use super::*;
    use midshift_core::ids::SiteId;
    use midshift_core::planner_policy::PlannerPolicy;
    use midshift_core::rows::Revision;
    use midshift_proto::convert::fleet::encode_planner;
    use std::time::Duration;

    fn old() -> v1::PlannerPolicy {
        let site_id = SiteId::parse("hall").expect("an id");
        encode_planner(&PlannerPolicy::default_of(site_id), Some(Revision(7)))
    }

    #[test]
    fn what_is_not_named_stays_and_the_etag_of_what_was_seen_goes_along() {
        assert_eq!(Rules::default().over(old()), old());
        let all = Rules {
            policy: Some(Policy::FifoNearest),
            horizon: Some(Duration::from_millis(1_500)),
            urgent_weight: Some(9),
            normal_weight: Some(8),
            background_weight: Some(7),
            ageing: Some(6),
            lateness: Some(5),
            hysteresis: Some(Duration::ZERO),
            energy_weight: Some(4),
        };
        let new = all.over(old());
        assert_eq!((new.site_id.as_str(), new.etag.as_str()), ("hall", "7"));
        let shown = "hall  policy fifo-nearest  horizon 1.5 s  hysteresis 0 s\n  \
                     way: urgent 9, normal 8, background 7  ageing 6 permille  lateness 5 permille  energy 4 ms a Wh";
        assert_eq!(describe(&new), shown);
        let back = Rules { policy: Some(Policy::Rolling), ..Rules::default() }.over(new);
        assert_eq!(describe(&back), shown.replace("fifo-nearest", "rolling"));
    }

    #[test]
    fn a_policy_of_a_newer_version_is_shown_by_its_number_and_stays() {
        let newer = v1::PlannerPolicy { policy: Some(99), ..old() };
        assert!(describe(&newer).contains("policy 99 "), "{}", describe(&newer));
        assert_eq!(Rules { ageing: Some(1), ..Rules::default() }.over(newer).policy, Some(99));
    }
}
