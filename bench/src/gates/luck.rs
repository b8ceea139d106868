//! Chance, from a seed.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// Chance for one kind of roll-out: what it draws does not depend on which others were simulated before.
pub fn seeded(seed: u64, kind: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(kind);
    rng
}
