//! Directives, as the server makes each in the cycle that decides it, beside bare signatures.

use crate::figure::Figure;
use anyhow::ensure;
use midshift_bundle::directive::{Directive, LIFE_MS, PAYLOAD_TYPE};
use midshift_bundle::keys::SecretKey;
use midshift_core::ids::{BundleId, RobotId, RolloutId};
use midshift_core::rollout::{Order, Sign};
use midshift_core::time::Utc;
use midshift_ota::rollouts::Signer;
use std::hint::black_box;
use tokio::time::Instant;

/// Runs rounds of both in turn, each of so many.
pub fn run(directives: usize, rounds: usize) -> anyhow::Result<Vec<Figure>> {
    ensure!(directives > 0, "no directives to sign");
    let key = SecretKey::of_seed([7; 32]);
    let robots: Vec<RobotId> =
        (0..directives).map(|n| RobotId::parse(&format!("rbt-{n:05}"))).collect::<Result<_, _>>()?;
    let (bundle, rollout_id) = (BundleId::parse(&"5a".repeat(32))?, RolloutId::parse("bench-1")?);
    let issued_at = midshift_agent::clock::wall();
    let signer = Signer(&key);
    let bytes = signed(&key, &robots[0], &bundle, &rollout_id, issued_at)?;
    let (mut whole, mut bare) = (Vec::new(), Vec::new());
    for _ in 0..rounds {
        whole.push(per_s(&robots, |robot_id| {
            let (bundle, rollout_id) = (&bundle, &rollout_id);
            let (generation, manifest_length, rollback_floor) = (1, 1_000, 0);
            let order = Order { robot_id, generation, bundle, manifest_length, rollback_floor, rollout_id, issued_at };
            black_box(signer.directive(&order).len());
        }));
        bare.push(per_s(&robots, |_| {
            black_box(key.sign(black_box(&bytes)));
        }));
    }
    let limit = format!("bare ed25519 of the same {} bytes", bytes.len());
    Ok(vec![Figure::new("P9", "directives built, signed and encoded", "1/s", &whole, Some((&limit, &bare)))])
}

/// What is signed of a directive: its payload, behind what DSSE puts before it.
fn signed(
    key: &SecretKey,
    robot_id: &RobotId,
    bundle: &BundleId,
    rollout_id: &RolloutId,
    issued_at: Utc,
) -> anyhow::Result<Vec<u8>> {
    let directive = Directive {
        robot_id: robot_id.clone(),
        key_id: key.public().id(),
        generation: 1,
        manifest: bundle.as_str().parse()?,
        manifest_length: 1_000,
        rollback_floor: 0,
        issued_at,
        expires: issued_at.plus_ms(LIFE_MS),
        rollout: rollout_id.to_string(),
    };
    let payload = serde_json::to_string(&directive)?;
    Ok(format!("DSSEv1 {} {PAYLOAD_TYPE} {} {payload}", PAYLOAD_TYPE.len(), payload.len()).into_bytes())
}

/// How often it can be done in a second, on one thread.
fn per_s(robots: &[RobotId], mut one: impl FnMut(&RobotId)) -> f64 {
    let begun = Instant::now();
    robots.iter().for_each(&mut one);
    robots.len() as f64 / begun.elapsed().as_secs_f64()
}
