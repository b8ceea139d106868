//! The rules of areas and of the planner. What else fleet answers is composed from its view, in its service.

use super::{At, Parse, WireEnum, duration, id, parse_ms, permille, task::etag, word};
use crate::fleet::v1;
use midshift_core::ids::{AreaId, SiteId};
use midshift_core::planner_policy::PlannerPolicy;
use midshift_core::policy::{AreaPolicy, SoftwareRules, Window};
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
        software: Some(encode_rules(&policy.software)),
        incident_after: Some(duration(policy.incident_after_ms)),
    }
}

fn encode_rules(rules: &SoftwareRules) -> v1::SoftwareRules {
    let window = |w: &Window| v1::MaintenanceWindow {
        days: w.days.iter().map(|d| u32::from(*d)).collect(),
        from_minute: u32::from(w.from_minute),
        to_minute: u32::from(w.to_minute),
        zone: w.zone.clone(),
    };
    v1::SoftwareRules {
        off_work_permille: Some(u32::from(rules.off_work_permille)),
        keep_in_work: rules.keep_in_work.clone(),
        windows: rules.windows.iter().map(window).collect(),
        frozen: rules.frozen,
        acts_on_rates: rules.acts_on_rates,
    }
}

/// A number that the rules of core then hold against their limits; one that is too large for them stays too large.
fn narrow<T: TryFrom<u32> + Bounded>(value: u32) -> T {
    T::try_from(value).unwrap_or(T::MAX)
}

/// The largest value of a small number.
trait Bounded {
    const MAX: Self;
}

impl Bounded for u8 {
    const MAX: Self = u8::MAX;
}

impl Bounded for u16 {
    const MAX: Self = u16::MAX;
}

fn parse_rules(rules: v1::SoftwareRules) -> SoftwareRules {
    let default = SoftwareRules::default();
    let window = |w: v1::MaintenanceWindow| Window {
        days: w.days.into_iter().map(narrow).collect(),
        from_minute: narrow(w.from_minute),
        to_minute: narrow(w.to_minute),
        zone: w.zone,
    };
    SoftwareRules {
        off_work_permille: rules.off_work_permille.map_or(default.off_work_permille, narrow),
        keep_in_work: rules.keep_in_work,
        windows: rules.windows.into_iter().map(window).collect(),
        frozen: rules.frozen,
        acts_on_rates: rules.acts_on_rates,
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
            incident_after_ms: parse_ms(self.incident_after.as_ref(), at.field("incident_after"), bad)
                .map_or(default.incident_after_ms, |ms| u64::try_from(ms).unwrap_or(0)),
            software: self.software.map(parse_rules).unwrap_or_default(),
            ..default
        };
        policy.check(&at.to_string(), bad);
        (bad.0.len() == before).then_some(policy)
    }
}

/// The rules of the planner. `revision`: of their row; none if nobody ever put any.
pub fn encode_planner(policy: &PlannerPolicy, revision: Option<Revision>) -> v1::PlannerPolicy {
    v1::PlannerPolicy {
        site_id: policy.site_id.to_string(),
        etag: revision.map(etag).unwrap_or_default(),
        policy: Some(policy.policy.to_wire()),
        horizon: Some(duration(policy.horizon_ms)),
        urgent_travel_weight: Some(policy.urgent_travel_weight),
        normal_travel_weight: Some(policy.normal_travel_weight),
        background_travel_weight: Some(policy.background_travel_weight),
        ageing_permille: Some(policy.ageing_permille),
        lateness_permille: Some(policy.lateness_permille),
        hysteresis: Some(duration(policy.hysteresis_ms)),
        energy_ms_per_wh: Some(policy.energy_ms_per_wh),
    }
}

/// Reads the rules of the planner of this site. Absent values take their defaults; all rules are checked, also when one
/// of them cannot be read. None if and only if something was added to `bad`.
pub fn parse_planner(
    wire: v1::PlannerPolicy,
    site_id: &SiteId,
    at: At<'_>,
    bad: &mut Violations,
) -> Option<PlannerPolicy> {
    let before = bad.0.len();
    let default = PlannerPolicy::default_of(site_id.clone());
    let own = if wire.site_id.is_empty() {
        Some(site_id.clone())
    } else {
        id(&wire.site_id, SiteId::parse, at.field("site_id"), bad)
    };
    // A time before none is as far from every rule as can be.
    let mut ms = |time: Option<prost_types::Duration>, default: u64, name: &'static str| {
        let ms = parse_ms(time.as_ref(), at.field(name), bad);
        ms.map_or(default, |ms| u64::try_from(ms).unwrap_or(u64::MAX))
    };
    let horizon_ms = ms(wire.horizon, default.horizon_ms, "horizon");
    let hysteresis_ms = ms(wire.hysteresis, default.hysteresis_ms, "hysteresis");
    let policy = match wire.policy {
        None => Some(default.policy),
        Some(number) => word(number, at.field("policy"), bad),
    };
    let policy = PlannerPolicy {
        site_id: own.unwrap_or(default.site_id),
        policy: policy.unwrap_or(default.policy),
        horizon_ms,
        urgent_travel_weight: wire.urgent_travel_weight.unwrap_or(default.urgent_travel_weight),
        normal_travel_weight: wire.normal_travel_weight.unwrap_or(default.normal_travel_weight),
        background_travel_weight: wire.background_travel_weight.unwrap_or(default.background_travel_weight),
        ageing_permille: wire.ageing_permille.unwrap_or(default.ageing_permille),
        lateness_permille: wire.lateness_permille.unwrap_or(default.lateness_permille),
        hysteresis_ms,
        energy_ms_per_wh: wire.energy_ms_per_wh.unwrap_or(default.energy_ms_per_wh),
    };
    policy.check_for(site_id, &at.to_string(), bad);
    (bad.0.len() == before).then_some(policy)
}
