//! Pieces of a file on the wire: made by the server, held against their check by the robot.
//!
//! Invariant: the check finds what the network broke and nothing else; what is installed is checked by SHA-256.

use crate::ota::v1::FetchChunksResponse;
use crc::{CRC_32_ISCSI, Crc, Table};

/// CRC-32C, with tables for sixteen bytes at a time.
static CRC_32C: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISCSI);

/// A piece that begins at `offset`, with its check.
pub fn piece(offset: u64, data: Vec<u8>) -> FetchChunksResponse {
    FetchChunksResponse { offset, crc32c: CRC_32C.checksum(&data), data }
}

/// Whether a piece arrived as it was sent.
pub fn is_whole(piece: &FetchChunksResponse) -> bool {
    CRC_32C.checksum(&piece.data) == piece.crc32c
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_check_is_the_castagnoli_one_and_every_changed_bit_shows() {
        // The check value of the catalogue, and the first example of RFC 3720, B.4.
        assert_eq!(piece(0, b"123456789".to_vec()).crc32c, 0xE306_9283);
        assert_eq!(piece(0, vec![0; 32]).crc32c, 0x8A91_36AA);
        let whole = piece(7, b"some bytes".to_vec());
        assert!(is_whole(&whole));
        for bit in 0..whole.data.len() * 8 {
            let mut broken = whole.clone();
            broken.data[bit / 8] ^= 1 << (bit % 8);
            assert!(!is_whole(&broken), "bit {bit}");
        }
    }
}
