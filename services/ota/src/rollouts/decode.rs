//! What callers ask for, as core's types. Every broken rule of a request is told at once.

use midshift_core::gates::EffortLimits;
use midshift_core::ids::{AreaId, BundleId, RobotId};
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::spec::{RolloutSpec, Selector, Wave};
use midshift_proto::convert::{At, WireEnum, parse_ms};
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_wave::Size;
use prost_types::Duration;

/// The bundle that a caller names: by digest, or by name and version; of several builds of one version the newest.
///
/// # Errors
/// None is called so.
pub fn bundle(view: &RolloutProjection, text: &str) -> Result<BundleId, Refusal> {
    if let Ok(id) = BundleId::parse(text)
        && view.bundles.contains_key(id.as_str())
    {
        return Ok(id);
    }
    let called = view.bundles.values().map(|b| &b.row).filter(|b| b.label() == text);
    let newest = called.max_by_key(|b| (b.listed, b.published)).map(|b| b.bundle.clone());
    let reason = || Reason::from(Code::BundleNotFound).with("bundle", text.chars().take(100).collect::<String>());
    newest.ok_or_else(|| Refusal::new(Kind::NotFound, reason()))
}

/// A spec as a caller wrote it, with every default in its place; that of the probation is the server's, in milliseconds
/// of site time.
pub fn spec(wire: &v1::RolloutSpec, bundle: BundleId, probation_ms: u64, bad: &mut Violations) -> RolloutSpec {
    let default = RolloutSpec { probation_ms, ..RolloutSpec::new(bundle) };
    let at = At::top("spec");
    let mut ms = |field: &str, duration: &Option<Duration>, default: u64| {
        let at = at.field(field);
        match parse_ms(duration.as_ref(), at, bad).map(u64::try_from) {
            None => default,
            Some(Ok(ms)) => ms,
            Some(Err(_)) => {
                bad.add(at.to_string(), "must not be negative");
                default
            }
        }
    };
    let drain_within_ms = ms("drain_within", &wire.drain_within, default.drain_within_ms);
    let probation_ms = ms("probation", &wire.probation, default.probation_ms);
    let soak_ms = ms("soak", &wire.soak, default.soak_ms);
    let exposure_within_ms = ms("exposure_within", &wire.exposure_within, default.exposure_within_ms);
    let lost_after_ms = ms("lost_after", &wire.lost_after, default.lost_after_ms);
    let waves = if wire.waves.is_empty() { default.waves.clone() } else { waves(&wire.waves, bad) };
    RolloutSpec {
        selector: wire.selector.as_ref().map(|s| selector(s, bad)).unwrap_or_default(),
        waves,
        max_in_flight: wire.max_in_flight,
        drain_within_ms,
        probation_ms,
        soak_ms,
        exposure_tasks: wire.exposure_tasks.unwrap_or(default.exposure_tasks),
        exposure_within_ms,
        small_wave: word(wire.small_wave, "spec.small_wave", bad),
        small_wave_failure: word(wire.small_wave_failure, "spec.small_wave_failure", bad),
        abort_scope: word(wire.abort_scope, "spec.abort_scope", bad),
        allow_full_push: wire.allow_full_push,
        rate_bytes_s: wire.rate_bytes_s,
        acts_on_rates: wire.acts_on_rates,
        complete_percent: wire.complete_percent.unwrap_or(default.complete_percent),
        lost_after_ms,
        writes_off_lost: wire.writes_off_lost,
        rollback_floor: wire.rollback_floor,
        effort: wire.effort.map(effort).unwrap_or_default(),
        bundle: default.bundle,
    }
}

fn effort(wire: v1::EffortLimits) -> EffortLimits {
    EffortLimits {
        slower_permille: wire.slower_permille,
        energy_permille: wire.energy_permille,
        hotter_decidegrees: wire.hotter_decidegrees,
    }
}

/// A word whose UNSPECIFIED means its default.
fn word<T: WireEnum + Default>(number: i32, field: &str, bad: &mut Violations) -> T {
    match (number, T::from_wire(number)) {
        (_, Some(value)) => value,
        (0, None) => T::default(),
        (_, None) => {
            bad.add(field, format!("{number} is no value of it"));
            T::default()
        }
    }
}

fn waves(wire: &[v1::RolloutWave], bad: &mut Violations) -> Vec<Wave> {
    let mut waves = Vec::new();
    for (ix, wave) in wire.iter().enumerate() {
        let field = || format!("spec.waves[{ix}]");
        match &wave.size {
            Some(Size::Count(count)) => waves.push(Wave::Count(*count)),
            Some(Size::Percent(percent)) => waves.push(Wave::Percent(*percent)),
            Some(Size::Version(version)) => waves.push(Wave::Version(version.clone())),
            Some(Size::Rest(true)) => waves.push(Wave::Rest),
            Some(Size::Label(label)) => match label.split_once('=') {
                Some((key, value)) => waves.push(Wave::Label { key: key.to_owned(), value: value.to_owned() }),
                None => bad.add(field(), "a label must be key=value"),
            },
            Some(Size::Rest(false)) | None => bad.add(field(), "must say what it is made of"),
        }
    }
    waves
}

fn selector(wire: &v1::RolloutSelector, bad: &mut Violations) -> Selector {
    let mut selector = Selector {
        labels: wire.labels.clone(),
        models: wire.models.iter().cloned().collect(),
        versions: wire.versions.iter().cloned().collect(),
        ..Selector::default()
    };
    for (ix, id) in wire.robot_ids.iter().enumerate() {
        selector.robots.extend(bad.accept(&format!("spec.selector.robot_ids[{ix}]"), RobotId::parse(id)));
    }
    for (ix, id) in wire.area_ids.iter().enumerate() {
        selector.areas.extend(bad.accept(&format!("spec.selector.area_ids[{ix}]"), AreaId::parse(id)));
    }
    selector
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_duration_that_is_none_is_refused_by_its_field() {
        let span = |seconds, nanos| Some(Duration { seconds, nanos });
        let wire = v1::RolloutSpec {
            drain_within: span(60, 1_000_000_000),
            probation: span(60, 0),
            soak: span(-60, 0),
            exposure_within: span(i64::MAX, 0),
            ..v1::RolloutSpec::default()
        };
        let mut bad = Violations::default();
        spec(&wire, BundleId::parse(&"0".repeat(64)).expect("an id"), 1_000, &mut bad);
        let fields: Vec<_> = bad.0.iter().map(|v| v.field.as_str()).collect();
        assert_eq!(fields, ["spec.drain_within", "spec.soak", "spec.exposure_within"]);
    }
}
