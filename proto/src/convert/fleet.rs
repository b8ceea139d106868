//! The rules of areas. What else fleet answers is composed from its view, in its service.

use super::{At, Parse, id, permille, task::etag};
use crate::fleet::v1;
use midshift_core::ids::AreaId;
use midshift_core::policy::AreaPolicy;
use midshift_core::reason::Violations;
use midshift_core::rows::Revision;

/// The rules of an area. `revision`: of its row; none if nobody ever put one.
pub fn encode_policy(policy: &AreaPolicy, revision: Option<Revision>) -> v1::AreaPolicy {
    v1::AreaPolicy {
        area_id: policy.area_id.to_string(),
        etag: revision.map(etag).unwrap_or_default(),
        speed_limit_mm_s: policy.speed_limit_mm_s,
        avoidance_distance_mm: policy.avoidance_distance_mm,
        charge_mandatory_permille: Some(u32::from(policy.charge_mandatory_permille)),
        charge_opportunistic_permille: Some(u32::from(policy.charge_opportunistic_permille)),
        charge_stop_permille: Some(u32::from(policy.charge_stop_permille)),
        charge_preemptible_permille: Some(u32::from(policy.charge_preemptible_permille)),
    }
}

/// Absent values take their defaults; all rules of a policy are checked.
impl Parse<AreaPolicy> for v1::AreaPolicy {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<AreaPolicy> {
        let before = bad.0.len();
        let default = AreaPolicy::default_of(id(&self.area_id, AreaId::parse, at.field("area_id"), bad)?);
        let mut share = |value: Option<u32>, default: u16, name: &'static str| match value {
            None => Some(default),
            Some(value) => permille(value, at.field(name), bad),
        };
        let mandatory =
            share(self.charge_mandatory_permille, default.charge_mandatory_permille, "charge_mandatory_permille");
        let opportunistic = share(
            self.charge_opportunistic_permille,
            default.charge_opportunistic_permille,
            "charge_opportunistic_permille",
        );
        let stop = share(self.charge_stop_permille, default.charge_stop_permille, "charge_stop_permille");
        let preemptible =
            share(self.charge_preemptible_permille, default.charge_preemptible_permille, "charge_preemptible_permille");
        let policy = AreaPolicy {
            speed_limit_mm_s: self.speed_limit_mm_s,
            avoidance_distance_mm: self.avoidance_distance_mm,
            charge_mandatory_permille: mandatory?,
            charge_opportunistic_permille: opportunistic?,
            charge_stop_permille: stop?,
            charge_preemptible_permille: preemptible?,
            ..default
        };
        policy.check(&at.to_string(), bad);
        (bad.0.len() == before).then_some(policy)
    }
}
