//! Rules of areas and of the planner there and back.

use midshift_core::ids::{AreaId, SiteId};
use midshift_core::planner_policy::{AssignmentPolicy, PlannerPolicy};
use midshift_core::policy::AreaPolicy;
use midshift_core::reason::Violations;
use midshift_core::rows::Revision;
use midshift_proto::convert::At;
use midshift_proto::convert::fleet::{encode_planner, encode_policy, parse_planner};
use midshift_proto::fleet::v1;
use midshift_proto::{json::from_json, parse_field};
use serde_json::json;

#[test]
fn a_policy_takes_defaults_for_what_is_absent_and_comes_back_whole() {
    let wire: v1::AreaPolicy = from_json(json!({"areaId": "hall", "speedLimitMmS": 800})).expect("json");
    let policy: AreaPolicy = parse_field(Some(wire), "policy").expect("valid");
    let wanted =
        AreaPolicy { speed_limit_mm_s: Some(800), ..AreaPolicy::default_of(AreaId::parse("hall").expect("id")) };
    assert_eq!(policy, wanted);
    let wire = encode_policy(&policy, Some(Revision(3)));
    assert_eq!(wire.etag, "3");
    assert_eq!(parse_field(Some(wire), "policy"), Ok(policy));
}

#[test]
fn what_roll_outs_must_keep_to_comes_back_whole() {
    let wire = json!({"areaId": "hall", "software": {
        "offWorkPermille": 200, "keepInWork": {"pick": 3}, "frozen": true, "actsOnRates": true,
        "windows": [{"days": [1, 5], "fromMinute": 1320, "toMinute": 300, "zone": "Europe/Berlin"}],
    }});
    let policy: AreaPolicy =
        parse_field(Some(from_json::<v1::AreaPolicy>(wire).expect("json")), "policy").expect("valid");
    let s = &policy.software;
    assert_eq!((s.off_work_permille, s.windows.len(), s.frozen, s.acts_on_rates), (200, 1, true, true));
    assert_eq!(parse_field(Some(encode_policy(&policy, None)), "policy"), Ok(policy));
}

#[test]
fn a_policy_hears_every_rule_it_breaks() {
    let wire = json!({"areaId": "hall", "speedLimitMmS": 1, "avoidanceDistanceMm": 10_001, "chargeStopPermille": 100});
    let mut wire: v1::AreaPolicy = from_json(wire).expect("json");
    wire.incident_after = Some(prost_types::Duration { seconds: -1, nanos: 1 });
    let refusal = parse_field::<AreaPolicy, v1::AreaPolicy>(Some(wire), "policy").expect_err("invalid");
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    let broken = ["incident_after", "speed_limit_mm_s", "avoidance_distance_mm", "charge_stop_permille"];
    assert_eq!(fields, broken.map(|field| format!("policy.{field}")));
    let refusal = parse_field::<AreaPolicy, v1::AreaPolicy>(None, "policy").expect_err("invalid");
    assert_eq!(refusal.violations[0].field, "policy");
}

/// Rules of the planner as the site `hall` reads them, or the fields that it refuses.
fn planner(wire: v1::PlannerPolicy) -> Result<PlannerPolicy, Vec<String>> {
    let mut bad = Violations::default();
    let read = parse_planner(wire, &SiteId::parse("hall").expect("an id"), At::top("policy"), &mut bad);
    read.ok_or_else(|| bad.0.into_iter().map(|violation| violation.field).collect())
}

#[test]
fn rules_of_the_planner_take_defaults_for_what_is_absent_and_come_back_whole() {
    let default = PlannerPolicy::default_of(SiteId::parse("hall").expect("an id"));
    assert_eq!(planner(v1::PlannerPolicy::default()), Ok(default.clone()));
    let wire = json!({"siteId": "hall", "policy": "ASSIGNMENT_POLICY_FIFO_NEAREST", "horizon": "0s", "hysteresis": "1.5s",
        "urgentTravelWeight": 9, "normalTravelWeight": 8, "backgroundTravelWeight": 7, "ageingPermille": 0,
        "latenessPermille": 6, "energyMsPerWh": 0});
    let put = PlannerPolicy {
        policy: AssignmentPolicy::FifoNearest,
        horizon_ms: 0,
        urgent_travel_weight: 9,
        normal_travel_weight: 8,
        background_travel_weight: 7,
        ageing_permille: 0,
        lateness_permille: 6,
        hysteresis_ms: 1_500,
        energy_ms_per_wh: 0,
        ..default
    };
    assert_eq!(planner(from_json(wire).expect("json")), Ok(put.clone()));
    let wire = encode_planner(&put, Some(Revision(3)));
    assert_eq!(wire.etag, "3");
    assert_eq!(planner(wire), Ok(put.clone()));
    assert_eq!(encode_planner(&put, None).etag, "", "nobody ever put any");
}

#[test]
fn rules_of_the_planner_hear_every_rule_they_break() {
    let time = |seconds| Some(prost_types::Duration { seconds, nanos: 0 });
    let broken = v1::PlannerPolicy {
        site_id: "yard".to_owned(),
        policy: Some(0),
        horizon: time(-1),
        urgent_travel_weight: Some(0),
        normal_travel_weight: Some(101),
        background_travel_weight: Some(u32::MAX),
        ageing_permille: Some(10_001),
        lateness_permille: Some(10_001),
        hysteresis: Some(prost_types::Duration { seconds: 1, nanos: -1 }),
        energy_ms_per_wh: Some(5_001),
        ..v1::PlannerPolicy::default()
    };
    let fields = [
        "hysteresis",
        "policy",
        "site_id",
        "horizon",
        "urgent_travel_weight",
        "normal_travel_weight",
        "background_travel_weight",
        "ageing_permille",
        "lateness_permille",
        "energy_ms_per_wh",
    ];
    assert_eq!(planner(broken), Err(fields.map(|field| format!("policy.{field}")).to_vec()));
    for policy in [0, 99] {
        let wire = v1::PlannerPolicy { policy: Some(policy), ..v1::PlannerPolicy::default() };
        assert_eq!(planner(wire), Err(vec!["policy.policy".to_owned()]), "{policy}");
    }
    let elsewhere = v1::PlannerPolicy { site_id: "Not an id".to_owned(), ..v1::PlannerPolicy::default() };
    assert_eq!(planner(elsewhere), Err(vec!["policy.site_id".to_owned()]));
}
