//! Signs what the planner decided: one envelope for one robot.

use midshift_bundle::directive::{Directive, LIFE_MS};
use midshift_bundle::keys::SecretKey;
use midshift_core::rollout::{Order, Sign};

/// Signs with the server's key for directives.
pub struct Signer<'a>(pub &'a SecretKey);

impl Sign for Signer<'_> {
    fn directive(&self, order: &Order) -> String {
        // The id of a bundle is the digest of its manifest.
        let Ok(manifest) = order.bundle.as_str().parse() else { return String::new() };
        let directive = Directive {
            robot_id: order.robot_id.clone(),
            key_id: self.0.public().id(),
            generation: order.generation,
            manifest,
            manifest_length: order.manifest_length,
            rollback_floor: order.rollback_floor,
            issued_at: order.issued_at,
            expires: order.issued_at.plus_ms(LIFE_MS),
            rollout: order.rollout_id.to_string(),
        };
        let envelope = directive.sign(self.0);
        metrics::counter!("midshift_ota_directives_signed_total").increment(1);
        String::from_utf8(envelope).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_bundle::bugs::Bugs;
    use midshift_bundle::directive::Expected;
    use midshift_core::ids::{BundleId, RobotId, RolloutId};
    use midshift_core::time::Utc;
    use std::collections::BTreeMap;

    #[test]
    fn a_robot_reads_the_floor_that_was_asked_for() {
        let key = SecretKey::of_seed([7; 32]);
        let (robot_id, rollout_id) = (RobotId::parse("r1").expect("an id"), RolloutId::parse("ro").expect("an id"));
        let bundle = BundleId::parse(&"5a".repeat(32)).expect("an id");
        let order = Order {
            robot_id: &robot_id,
            generation: 1,
            bundle: &bundle,
            manifest_length: 1_000,
            rollback_floor: 3,
            rollout_id: &rollout_id,
            issued_at: Utc(1_000),
        };
        let envelope = Signer(&key).directive(&order);
        let keys = BTreeMap::from([(key.public().id(), key.public())]);
        let bugs = Bugs::default();
        let expected = Expected { robot_id: &robot_id, keys: &keys, generation: 0, now: Utc(2_000), bugs };
        let read = Directive::verify(envelope.as_bytes(), &expected).expect("it is signed");
        assert_eq!(read.rollback_floor, 3);
    }
}
