//! The bytes of one slot: a mark, the generation, the length, a checksum over generation and payload, then the payload.

use crate::error::Error;
use crc::{CRC_64_XZ, Crc};
use std::ops::RangeInclusive;

/// Bytes that a slot may have.
pub const ROOMS: RangeInclusive<usize> = 512..=16 * 1024 * 1024;
const MARK: [u8; 8] = *b"midlatch";
/// Bytes before the payload.
pub const HEAD: usize = 32;
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

    /// What a slot holds, of its head and of what is read behind it; none if it is not whole.
    pub fn decode(head: &[u8; HEAD], payload: Vec<u8>) -> Option<Self> {
        let generation = number(head, 8);
        let is_whole = head.starts_with(&MARK) && check(generation, &payload) == number(head, 24);
        is_whole.then_some(Self { generation, payload })
    }
}

/// Bytes of the payload behind a head; none if a slot of this size has no room for them.
pub fn payload_bytes(head: &[u8; HEAD], room: usize) -> Option<usize> {
    usize::try_from(number(head, 16)).ok().filter(|bytes| *bytes <= room - HEAD)
}

fn number(head: &[u8; HEAD], at: usize) -> u64 {
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&head[at..at + 8]);
    u64::from_le_bytes(bytes)
}

fn check(generation: u64, payload: &[u8]) -> u64 {
    let mut digest = CHECK.digest();
    digest.update(&generation.to_le_bytes());
    digest.update(payload);
    digest.finalize()
}
