//! The bytes of one slot: a mark, the generation, the length, a checksum over both and the payload, then the payload.

use crate::error::Error;
use crc::{CRC_64_XZ, Crc};
use std::ops::RangeInclusive;

/// Bytes that a slot may have.
pub const ROOMS: RangeInclusive<usize> = 512..=16 * 1024 * 1024;
const MARK: [u8; 8] = *b"midlatch";
const HEAD: usize = 32;
const CHECK: Crc<u64> = Crc::<u64>::new(&CRC_64_XZ);

/// One value with its number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Slot {
    pub generation: u64,
    pub payload: Vec<u8>,
}

impl Slot {
    /// As it stands in the file: what of the slot lies behind it is left as it is.
    pub fn encode(&self, room: usize) -> Result<Vec<u8>, Error> {
        let bytes = HEAD + self.payload.len();
        if bytes > room || !ROOMS.contains(&room) {
            return Err(Error::TooLarge { bytes, room });
        }
        let length = self.payload.len() as u64;
        let mut all = Vec::with_capacity(bytes);
        all.extend(MARK);
        all.extend(self.generation.to_le_bytes());
        all.extend(length.to_le_bytes());
        all.extend(check(self.generation, &self.payload).to_le_bytes());
        all.extend(&self.payload);
        Ok(all)
    }

    /// What a slot holds; none if it is not whole.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (head, rest) = bytes.split_at_checked(HEAD)?;
        let number = |at: usize| head[at..at + 8].try_into().map(u64::from_le_bytes).ok();
        let (generation, length, sum) = (number(8)?, number(16)?, number(24)?);
        let payload = rest.get(..usize::try_from(length).ok()?)?;
        let is_whole = head.starts_with(&MARK) && check(generation, payload) == sum;
        is_whole.then(|| Self { generation, payload: payload.to_vec() })
    }
}

fn check(generation: u64, payload: &[u8]) -> u64 {
    let mut digest = CHECK.digest();
    digest.update(&generation.to_le_bytes());
    digest.update(payload);
    digest.finalize()
}
