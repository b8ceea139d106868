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
            rollback_floor: 0,
            issued_at: order.issued_at,
            expires: order.issued_at.plus_ms(LIFE_MS),
            rollout: order.rollout_id.to_string(),
        };
        let envelope = directive.sign(self.0);
        metrics::counter!("midshift_ota_directives_signed_total").increment(1);
        String::from_utf8(envelope).unwrap_or_default()
    }
}
