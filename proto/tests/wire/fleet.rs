//! Areas' rules there and back.

use midshift_core::ids::AreaId;
use midshift_core::policy::AreaPolicy;
use midshift_core::rows::Revision;
use midshift_proto::convert::fleet::encode_policy;
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
