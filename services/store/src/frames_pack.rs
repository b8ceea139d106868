//! How the frames of one group lie in one `frame_log` row: each as its robot, ring, first and last number and bytes, and all of it compressed.
//!
//! Invariant: `unpack(row(pack(frames))) == frames`; a row cut short or garbled is an error, never a shorter answer.
//! Layout, all little-endian: u8 length and robot_id, u8 length and ring, u64 first, u64 last, u32 length and bytes. Before what is compressed, by
//! zstd, stand a zero, which is no robot's length, and its length in a u32. What would not be smaller, and what 0.2.0 wrote, is as it is.

use crate::{Coarsen, Frame};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use std::borrow::Cow;
use std::io;
use std::sync::Arc;
use zstd::bulk::Compressor;

/// A row is full with so many bytes, before it is compressed.
pub(crate) const ROW_BYTES: usize = 64 * 1024;
/// The fastest: samples of a fleet are alike.
const LEVEL: i32 = 1;
/// First byte of a row that is compressed.
const COMPRESSED: u8 = 0;
/// Before its bytes: that, and how many they were.
const HEAD_BYTES: usize = 5;
/// A row is full, and then comes the longest frame.
const BYTES_MAX: usize = ROW_BYTES + limits::TELEMETRY_BATCH_BYTES + 1_024;

/// A `frame_log` row that cannot be read, or a frame that cannot be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("frame_log row: {0}")]
pub(crate) struct BadFrames(&'static str);

pub(crate) fn pack(frame: &Frame, out: &mut Vec<u8>) -> Result<(), BadFrames> {
    for text in [frame.robot_id.as_str(), &frame.ring] {
        out.push(u8::try_from(text.len()).map_err(|_| BadFrames("ring is longer than 255 bytes"))?);
        out.extend(text.as_bytes());
    }
    out.extend(frame.first_seq.to_le_bytes());
    out.extend(frame.last_seq.to_le_bytes());
    let length = u32::try_from(frame.bytes.len()).map_err(|_| BadFrames("frame is longer than 4 GiB"))?;
    out.extend(length.to_le_bytes());
    out.extend(frame.bytes.iter());
    Ok(())
}

/// Makes rows; it has room of its own, which is made once.
pub(crate) struct RowCompressor(Compressor<'static>);

impl RowCompressor {
    pub(crate) fn new() -> io::Result<Self> {
        let mut compressor = Compressor::new(LEVEL)?;
        compressor.include_checksum(true)?;
        Ok(Self(compressor))
    }
    /// The row of packed frames.
    pub(crate) fn row(&mut self, packed: Vec<u8>) -> io::Result<Vec<u8>> {
        let Ok(length) = u32::try_from(packed.len()) else { return Ok(packed) };
        let compressed = self.0.compress(&packed)?;
        if compressed.len() + HEAD_BYTES >= packed.len() {
            return Ok(packed);
        }
        Ok([&[COMPRESSED][..], &length.to_le_bytes(), &compressed].concat())
    }
}

/// What a row was packed as.
fn packed(mut row: &[u8]) -> Result<Cow<'_, [u8]>, BadFrames> {
    if row.first() != Some(&COMPRESSED) {
        return Ok(Cow::Borrowed(row));
    }
    let [_] = fixed(&mut row)?;
    let length = u32::from_le_bytes(fixed(&mut row)?) as usize;
    if length > BYTES_MAX {
        return Err(BadFrames("is longer than any that is written"));
    }
    let packed = zstd::bulk::decompress(row, length).map_err(|_| BadFrames("cannot be decompressed"))?;
    if packed.len() != length { Err(BadFrames("cut short")) } else { Ok(Cow::Owned(packed)) }
}

/// A row as it is once `coarsen` was let at each of its frames. A frame that cannot be read is left without its samples, and its numbers stay.
pub(crate) fn coarser(row: &[u8], coarsen: Coarsen) -> Result<Vec<u8>, BadFrames> {
    let mut out = Vec::with_capacity(row.len());
    for frame in unpack(row)? {
        let bytes = coarsen(&frame.bytes).unwrap_or_else(|| {
            tracing::error!(robot_id = %frame.robot_id, first_seq = frame.first_seq, last_seq = frame.last_seq, "samples cannot be read and were taken out");
            Vec::new()
        });
        pack(&Frame { bytes: Arc::from(bytes), ..frame }, &mut out)?;
    }
    let row = RowCompressor::new().and_then(|mut compressor| compressor.row(out));
    row.map_err(|_| BadFrames("cannot be compressed"))
}

pub(crate) fn unpack(row: &[u8]) -> Result<Vec<Frame>, BadFrames> {
    let (packed, mut frames) = (packed(row)?, Vec::new());
    let mut rest = &*packed;
    while !rest.is_empty() {
        let robot_id = RobotId::parse(text(&mut rest)?).map_err(|_| BadFrames("not a robot_id"))?;
        let ring = Arc::from(text(&mut rest)?);
        let first_seq = u64::from_le_bytes(fixed(&mut rest)?);
        let last_seq = u64::from_le_bytes(fixed(&mut rest)?);
        let length = u32::from_le_bytes(fixed(&mut rest)?);
        let bytes = Arc::from(bytes(&mut rest, length as usize)?);
        frames.push(Frame { robot_id, ring, first_seq, last_seq, bytes });
    }
    Ok(frames)
}

fn bytes<'a>(rest: &mut &'a [u8], length: usize) -> Result<&'a [u8], BadFrames> {
    let (taken, left) = rest.split_at_checked(length).ok_or(BadFrames("cut short"))?;
    *rest = left;
    Ok(taken)
}

fn fixed<const N: usize>(rest: &mut &[u8]) -> Result<[u8; N], BadFrames> {
    bytes(rest, N)?.try_into().map_err(|_| BadFrames("cut short"))
}

fn text<'a>(rest: &mut &'a [u8]) -> Result<&'a str, BadFrames> {
    let [length] = fixed(rest)?;
    std::str::from_utf8(bytes(rest, usize::from(length))?).map_err(|_| BadFrames("text is not UTF-8"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(robot: &str, first_seq: u64) -> Frame {
        Frame {
            robot_id: RobotId::parse(robot).expect("a robot id"),
            ring: Arc::from("ring-7"),
            first_seq,
            last_seq: first_seq + 2,
            bytes: Arc::from(&b"samples"[..]),
        }
    }

    #[test]
    fn rows_of_many_frames_are_smaller_and_read_back_and_one_that_is_damaged_is_an_error() {
        let frames: Vec<Frame> = (1..=100).map(|first| frame("rbt-01", first)).collect();
        let mut packed = Vec::new();
        frames.iter().for_each(|frame| pack(frame, &mut packed).expect("a short frame"));
        let mut compressor = RowCompressor::new().expect("room");
        let row = compressor.row(packed.clone()).expect("a row");
        assert!(row.len() * 4 < packed.len(), "{} of {}", row.len(), packed.len());
        assert_eq!(unpack(&row), Ok(frames.clone()));
        for cut in 1..row.len() {
            assert!(unpack(&row[..cut]).is_err(), "cut at {cut}");
        }
        for at in 0..row.len() {
            let mut garbled = row.clone();
            garbled[at] ^= 0x10;
            // Bits that say nothing may change.
            assert!(unpack(&garbled).map_or(true, |read| read == frames), "garbled at {at}");
        }
        let mut longer = row;
        longer[1] += 1;
        assert!(unpack(&longer).is_err());
        longer[4] = 255;
        assert_eq!(unpack(&longer), Err(BadFrames("is longer than any that is written")));
    }

    #[test]
    fn a_row_that_would_not_be_smaller_and_one_of_an_older_version_are_as_they_are() {
        let mut packed = Vec::new();
        pack(&frame("a", 1), &mut packed).expect("a short frame");
        let row = RowCompressor::new().expect("room").row(packed.clone()).expect("a row");
        assert_eq!(row, packed);
        assert_eq!(unpack(&packed), Ok(vec![frame("a", 1)]));
    }

    #[test]
    fn frames_read_back_as_written_and_a_row_cut_anywhere_but_between_two_is_an_error() {
        let frames = vec![frame("a", 1), frame("rbt-02", 900)];
        let mut packed = Vec::new();
        pack(&frames[0], &mut packed).expect("a short frame");
        let first_length = packed.len();
        pack(&frames[1], &mut packed).expect("a short frame");
        assert_eq!(unpack(&packed), Ok(frames));
        for cut in (1..packed.len()).filter(|cut| *cut != first_length) {
            assert!(unpack(&packed[..cut]).is_err(), "cut at {cut}");
        }
    }
}
